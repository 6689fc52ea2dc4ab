"""Parameters of the double-tripod driveshaft with the paper's values, and which of them go together.

Tables 1, 2 and 4 of the source that :mod:`~drivetrain_jax.systems.tripod` names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import Values

# Tables 1 and 2: what differs between the elements.
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
# The value the paper states and uses at beta = 9 deg; neither its text nor its formulas give it.
STATED_CHI = {"input": 0.0026, "output": 0.0027}
EQUATIONS = {"input": ("25", "29"), "output": ("26", "30")}
CHI_SOURCES = ("derived", "printed_formula", "printed_value")
READINGS = ("octave", "harmonic")


def _of_element(name: str, units: str, long_name: str, **limits: Any) -> Parameter:
    """A parameter whose value in the paper depends on the element."""
    values = ", ".join(f"{geometry[name]:g} for the {element}" for element, geometry in GEOMETRY.items())
    return Parameter(name, units, long_name, derived=values, **limits)


def _positive(name: str, units: str, long_name: str, default: float | None = None, **more: Any) -> Parameter:
    return Parameter(name, units, long_name, default=default, lower=0.0, open_lower=True, **more)


_SIZE = {"lower": 0.0, "open_lower": True}
PARAMETERS = (
    Parameter("element", "1", "element of the driveshaft", choices=tuple(GEOMETRY)),
    Parameter("beta", "rad", "joint angle", lower=0.0, upper=math.pi / 2, open_upper=True),
    _positive("zeta", "1", "damping ratio"),
    Parameter(
        "equation",
        "1",
        "equation of motion",
        choices=("25", "26", "29", "30"),
        derived="25 (input) or 26 (output) for history, otherwise 29 (input) or 30 (output)",
    ),
    _positive("excitation_frequency", "Hz", "excitation frequency", derived="Omega/pi"),
    Parameter(
        "chi_n",
        "1",
        "nonuniformity",
        derived="chi_source",
        lower=-1.0,
        upper=1.0,
        open_lower=True,
        open_upper=True,
    ),
    Parameter("chi_source", "1", "where chi_n comes from if it is not given", default="derived", choices=CHI_SOURCES),
    _positive("motor_order", "1", "frequency of the motor torque over 50 Hz", 6.0),
    Parameter("torque_reading", "1", "reading of the torque sums", default="octave", choices=READINGS),
    Parameter("phi0", "rad", "twist at t = 0", default=0.0),
    Parameter("velocity0", "rad/s", "rate of twist at t = 0", default=0.0),
    _of_element("L_B", "m", "length of the bell", **_SIZE),
    _of_element("L_A", "m", "length of the axle", **_SIZE),
    _of_element("R", "m", "radius of the tripod joint", **_SIZE),
    _of_element("d_A", "m", "diameter of the axle", **_SIZE),
    _of_element("d_C", "m", "distance of the bell's centre of mass from the tripod", lower=0.0),
    _of_element("S_B", "m2", "cross-section of the bell", lower=0.0),
    _of_element("J_m", "m4", "mean of the bell's principal moments of area", **_SIZE),
    _of_element("chi_B", "1", "nonuniformity of the bell's moments of area", lower=0.0, upper=1.0),
    _positive("rho", "kg/m3", "density", 7850.0),
    _positive("G", "Pa", "shear modulus", 77.3e9),
    _positive("L_DM2", "m", "length of the midshaft", 0.940),
    Parameter("M_AEM", "N m", "mean torque of the motor, on the input element", default=2550.0),
    Parameter("M_MS", "N m", "mean torque of the mill, on the output element", default=2100.0),
    Parameter("chi_AEM", "1", "nonuniformity of the motor torque", default=0.05),
    Parameter("chi_MS", "1", "nonuniformity of the mill torque", default=0.15),
)
SHAPE = ("element", "beta", "chi_n", "chi_source", *GEOMETRY["input"], "rho", "G")
_TORQUES = ("M_AEM", "M_MS", "chi_AEM", "chi_MS", "motor_order", "torque_reading", "L_DM2")
MOTION = (*SHAPE, "zeta", "equation", "excitation_frequency", *_TORQUES, "phi0", "velocity0")


def geometry(values: Values) -> dict[str, Any]:
    """The dimensions of the element: the given ones, the paper's for the others."""
    return {name: values.get(name, paper) for name, paper in GEOMETRY[values["element"]].items()}


def check_motion(fixed: Values) -> None:
    """``ValueError`` if the equation is not one of the element's, or chi_n is given twice."""
    _check_equation(fixed, EQUATIONS[fixed["element"]])
    check_chi(fixed)


def check_parametric(fixed: Values) -> None:
    """``ValueError`` if the equation is not the element's (29) or (30), or chi_n is given twice."""
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
    """``ValueError`` if chi_n is given although it is to be taken from the paper."""
    if "chi_n" in fixed and fixed["chi_source"] != "derived":
        raise ValueError(f"chi_n = {fixed['chi_n']:g}: given together with chi_source; allowed is one of the two")
