"""Physical data of a cardan shaft and the parameters of ``cardan``, eq. (7) of docs/theory/cardan.md."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import numeric
from drivetrain_jax.systems._physical import POSITIVE, RPM, Conversion, PhysicalData


def _alpha(c2: Any, c1: Any) -> Any:
    xp, c2, c1 = numeric(c2, c1)
    # Without damping of the driving shaft the ratio has no meaning. A traced value cannot be checked.
    if xp is np and np.any((c1 == 0) & (c2 != 0)):
        raise InputError(f"c2 = {c2.tolist()!r}: allowed is 0 if c1 = 0 (alpha = c2/c1)")
    return xp.divide(c2, xp.where(c1 == 0, 1.0, c1))


def _radians(angle: Any) -> Any:
    xp, angle = numeric(angle)
    return xp.radians(angle)


def _frequency(j1: Any, k1: Any) -> Any:
    xp, j1, k1 = numeric(j1, k1)
    return xp.sqrt(k1 / j1)


def _unit_of_damping(j1: Any, k1: Any) -> Any:
    xp, j1, k1 = numeric(j1, k1)
    # Square roots one by one, because in some units the product overflows.
    return 2 * xp.sqrt(k1) * xp.sqrt(j1)


PHYSICAL = PhysicalData(
    (
        Parameter("J1", "kg m2", "inertia of the driving disk", **POSITIVE),
        Parameter("J2", "kg m2", "inertia of the driven disk", **POSITIVE),
        Parameter("k1", "N m/rad", "stiffness of the driving shaft", **POSITIVE),
        Parameter("k2", "N m/rad", "stiffness of the driven shaft", **POSITIVE),
        Parameter("c1", "N m s/rad", "damping of the driving shaft", lower=0.0),
        Parameter("c2", "N m s/rad", "damping of the driven shaft", lower=0.0),
        Parameter("speed", "rpm", "speed of the driving shaft", **POSITIVE),
        Parameter("angle", "deg", "joint angle", lower=-90.0, upper=90.0, open_lower=True, open_upper=True),
    ),
    (
        Conversion("beta", ("angle",), _radians, "angle", np.degrees),
        Conversion(
            "Omega",
            ("speed", "J1", "k1"),
            lambda speed, j1, k1: speed * RPM / _frequency(j1, k1),
            "speed sqrt(J1/k1)",
            lambda omega, j1, k1: omega * _frequency(j1, k1) / RPM,
        ),
        Conversion(
            "zeta",
            ("c1", "J1", "k1"),
            lambda c1, j1, k1: c1 / _unit_of_damping(j1, k1),
            "c1/(2 sqrt(k1 J1))",
            lambda zeta, j1, k1: zeta * _unit_of_damping(j1, k1),
        ),
        Conversion("alpha", ("c2", "c1"), _alpha, "c2/c1"),
        Conversion("mu", ("k2", "k1"), lambda k2, k1: k2 / k1, "k2/k1", lambda mu, k1: mu * k1),
        Conversion("gamma", ("J2", "J1"), lambda j2, j1: j2 / j1, "J2/J1", lambda gamma, j1: gamma * j1),
    ),
)
