"""Default parameters of the double-tripod driveshaft from the paper, and conflicts between them.

Tables 1, 2 and 4 of the source of :mod:`~drivetrain_jax.systems.tripod`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivetrain_jax.systems._base import Values, parameter

# Tables 1 and 2: the values that differ between the elements.
GEOMETRY: Mapping[str, Mapping[str, float]] = {
    "input": {
        "L_B": 0.190,
        "L_A": 0.130,
        "R": 0.070,
        "d_A": 0.054,
        "d_C": 0.098,
        "S_B": 0.0076,
        "J_m": 1.4645e-5,
        "chi_B": 0.22,
    },
    "output": {
        "L_B": 0.209,
        "L_A": 0.143,
        "R": 0.077,
        "d_A": 0.059,
        "d_C": 0.108,
        "S_B": 0.0092,
        "J_m": 2.1442e-5,
        "chi_B": 0.24,
    },
}
# Values of chi_n that the paper states and uses at beta = 9 deg; neither its text nor its formulas yield them.
STATED_CHI = {"input": 0.0026, "output": 0.0027}
EQUATIONS = {"input": ("25", "29"), "output": ("26", "30")}
CHI_SOURCES = ("derived", "printed_formula", "printed_value")
READINGS = ("octave", "harmonic")


SHAPE = ("element", "beta", "chi_n", "chi_source", *GEOMETRY["input"], "rho", "G")
_TORQUES = ("M_AEM", "M_MS", "chi_AEM", "chi_MS", "motor_order", "torque_reading", "L_DM2")
MOTION = (*SHAPE, "zeta", "equation", "excitation_frequency", *_TORQUES, "phi0", "velocity0")
_SIZE = {"lower": 0.0, "open_lower": True}


def of_element(name: str, units: str, long_name: str, *, positive: bool = True, **limits: Any) -> Any:
    """A parameter whose value in the paper depends on the element."""
    values = ", ".join(f"{geometry[name]:g} for the {element}" for element, geometry in GEOMETRY.items())
    return parameter(
        units, long_name, derived=values, **({**_SIZE, **limits} if positive else {"lower": 0.0, **limits})
    )


def positive(units: str, long_name: str, default: float | None = None, **more: Any) -> Any:
    """A parameter greater than 0."""
    return parameter(units, long_name, default=default, **_SIZE, **more)


def geometry(values: Values) -> dict[str, Any]:
    """The dimensions of the element: the given values, completed by those of the paper."""
    return {name: values.get(name, paper) for name, paper in GEOMETRY[values["element"]].items()}


def check_motion(fixed: Values) -> None:
    """Raise ``ValueError`` if the element does not have the equation, or if chi_n is given twice."""
    _check_equation(fixed, EQUATIONS[fixed["element"]])
    check_chi(fixed)


def check_parametric(fixed: Values) -> None:
    """Raise ``ValueError`` if the equation is not (29) or (30) as the element has it, or if chi_n is given twice."""
    _check_equation(fixed, EQUATIONS[fixed["element"]][1:])
    check_chi(fixed)


def _check_equation(fixed: Values, allowed: tuple[str, ...]) -> None:
    equation = fixed.get("equation")
    if equation is not None and equation not in allowed:
        raise ValueError(
            f"equation = {equation!r}: allowed for this analysis of the {fixed['element']} element is "
            f"{' or '.join(allowed)}"
        )


def check_chi(fixed: Values) -> None:
    """Raise ``ValueError`` if chi_n is given although the option asks for the value of the paper."""
    if "chi_n" in fixed and fixed["chi_source"] != "derived":
        raise ValueError(f"chi_n = {fixed['chi_n']:g}: given together with chi_source; allowed is one of the two")
