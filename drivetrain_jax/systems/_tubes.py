"""Round tubes: materials, and torsional stiffness from diameters and lengths."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import POSITIVE, Conversion, numeric

# Young's modulus [Pa], shear modulus [Pa], density [kg/m^3] of structural steel, aluminium alloys and Ti-6Al-4V.
MATERIALS = {
    "steel": (2.1e11, 2.1e11 / 2.6, 7850.0),
    "aluminium": (7.0e10, 7.0e10 / 2.66, 2700.0),
    "titanium": (1.14e11, 1.14e11 / 2.68, 4430.0),
}


def ring_power(outer: Any, inner: Any, power: int) -> Any:
    """``outer^power - inner^power``; :class:`InputError` unless the bore is smaller."""
    xp, outside, inside = numeric(outer, inner)
    # A traced value cannot be checked.
    if xp is np and np.any(inside >= outside):
        raise InputError(f"inner_diameter = {inner!r}: expected less than outer_diameter = {outer!r}")
    return outside**power - inside**power


_EACH: dict[str, Any] = {"listed": True, "broadcast": True}
# Tubes as shafts, one entry each.
TUBES = (
    Parameter("outer_diameter", "m", "outer diameters of the shafts", usual=10.0, **POSITIVE, **_EACH),
    Parameter("inner_diameter", "m", "bores of the shafts", default=0.0, usual=10.0, lower=0.0, **_EACH),
    Parameter("length", "m", "lengths of the shafts", usual=100.0, listed=True, **POSITIVE),
    Parameter("material", "1", "material of all shafts: G", choices=tuple(MATERIALS)),
    Parameter("G", "Pa", "shear modulus of the shafts", **POSITIVE, **_EACH),
)


def stiffness_of_tubes(name: str, replaceable: bool = False) -> tuple[Conversion, ...]:
    """The conversions of ``TUBES`` to the list of stiffnesses ``name``."""
    return (
        Conversion("G", ("material",), lambda word: MATERIALS[word][1], "that of the material", optional=True),
        Conversion(
            name,
            ("outer_diameter", "inner_diameter", "length", "G"),
            lambda outer, inner, length, g: math.pi / 32 * g * ring_power(outer, inner, 4) / length,
            "pi/32 G (outer_diameter^4 - inner_diameter^4)/length",
            replaceable=replaceable,
        ),
    )
