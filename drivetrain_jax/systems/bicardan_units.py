"""Physical data of a bicardanic shaft and the parameters of ``bicardan``, see docs/systems/bicardan.md."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import numeric
from drivetrain_jax.systems._physical import POSITIVE, Conversion, PhysicalData

# Young's modulus [Pa], shear modulus [Pa], density [kg/m^3] of structural steel, aluminium alloys and Ti-6Al-4V.
MATERIALS = {
    "steel": (2.1e11, 2.1e11 / 2.6, 7850.0),
    "aluminium": (7.0e10, 7.0e10 / 2.66, 2700.0),
    "titanium": (1.14e11, 1.14e11 / 2.68, 4430.0),
}


def _ring(outer: Any, inner: Any, power: int) -> Any:
    xp, outside, inside = numeric(outer, inner)
    # A traced value cannot be checked.
    if xp is np and np.any(inside >= outside):
        raise InputError(f"inner_diameter = {inner!r}: allowed is less than outer_diameter = {outer!r}")
    return outside**power - inside**power


def _area(outer: Any, inner: Any) -> Any:
    return math.pi / 4 * _ring(outer, inner, 2)


def _second_moment(outer: Any, inner: Any) -> Any:
    return math.pi / 64 * _ring(outer, inner, 4)


def shear_coefficient(outer: Any, inner: Any, e: Any, g: Any) -> Any:
    """Cowper's coefficient of a hollow circle, J. Appl. Mech. 33 (1966), 335-340."""
    _, outer, inner, e, g = numeric(outer, inner, e, g)
    nu, m2 = e / (2 * g) - 1, (inner / outer) ** 2
    round_part = (1 + m2) ** 2
    return 6 * (1 + nu) * round_part / ((7 + 6 * nu) * round_part + (20 + 12 * nu) * m2)


def _shear_stiffness(outer: Any, inner: Any, e: Any, g: Any) -> Any:
    return shear_coefficient(outer, inner, e, g) * g * _area(outer, inner)


_EACH: dict[str, Any] = {"listed": True, "broadcast": True}
_SECTION = ("outer_diameter", "inner_diameter")

PHYSICAL = PhysicalData(
    (
        Parameter("outer_diameter", "m", "outer diameters of the segments", usual=10.0, **POSITIVE, **_EACH),
        Parameter("inner_diameter", "m", "bores of the segments", default=0.0, usual=10.0, lower=0.0, **_EACH),
        Parameter("material", "1", "material of all segments: E, G, density", choices=tuple(MATERIALS)),
        Parameter("E", "Pa", "Young's modulus of the segments", **POSITIVE, **_EACH),
        Parameter("G", "Pa", "shear modulus of the segments; without it no shear", **POSITIVE, **_EACH),
        Parameter("density", "kg/m3", "density of the segments, 0: without mass", lower=0.0, **_EACH),
    ),
    (
        Conversion("E", ("material",), lambda name: MATERIALS[name][0], "that of the material", optional=True),
        Conversion("G", ("material",), lambda name: MATERIALS[name][1], "that of the material", optional=True),
        Conversion("density", ("material",), lambda name: MATERIALS[name][2], "that of the material", optional=True),
        Conversion(
            "EI",
            (*_SECTION, "E"),
            lambda outer, inner, e: e * _second_moment(outer, inner),
            "pi/64 E (outer_diameter^4 - inner_diameter^4)",
            per="length",
        ),
        Conversion(
            "rhoA",
            (*_SECTION, "density"),
            lambda outer, inner, density: density * _area(outer, inner),
            "pi/4 density (outer_diameter^2 - inner_diameter^2)",
            replaceable=True,
            per="length",
        ),
        Conversion(
            "kGA",
            (*_SECTION, "E", "G"),
            _shear_stiffness,
            "pi/4 kappa G (outer_diameter^2 - inner_diameter^2)",
            optional=True,
            per="length",
        ),
        Conversion(
            "rhoI",
            (*_SECTION, "rhoA", "G"),
            lambda outer, inner, rhoA, g: rhoA * (outer**2 + inner**2) / 16,
            "rhoA (outer_diameter^2 + inner_diameter^2)/16",
            optional=True,
        ),
    ),
)
