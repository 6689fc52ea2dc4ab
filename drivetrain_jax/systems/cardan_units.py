"""Physical data of a cardan shaft in SI and workshop units, converted to the nondimensional parameters of ``cardan``.

    Omega = Omega0 sqrt(J1/k1), zeta = c1/(2 sqrt(k1 J1)), alpha = c2/c1, mu = k2/k1, gamma = J2/J1     eq. (7)

Source: docs/theory/cardan.md. With c1 = 0 alpha has no meaning; it is then 0, and c2 must be 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter

PHYSICAL = (
    Parameter("J1", "kg m2", "inertia of the driving disk", lower=0.0, open_lower=True),
    Parameter("J2", "kg m2", "inertia of the driven disk", lower=0.0, open_lower=True),
    Parameter("k1", "N m/rad", "stiffness of the driving shaft", lower=0.0, open_lower=True),
    Parameter("k2", "N m/rad", "stiffness of the driven shaft", lower=0.0, open_lower=True),
    Parameter("c1", "N m s/rad", "damping of the driving shaft", lower=0.0),
    Parameter("c2", "N m s/rad", "damping of the driven shaft", lower=0.0),
    Parameter("speed", "rpm", "speed of the driving shaft", lower=0.0, open_lower=True),
    Parameter("angle", "deg", "joint angle", lower=-90.0, upper=90.0, open_lower=True, open_upper=True),
)
_RPM = 2 * math.pi / 60


@dataclass(frozen=True)
class PhysicalShaft:
    """A cardan shaft in physical units: J in kg m^2, k in N m/rad, c in N m s/rad.

    Raises :class:`~drivetrain_jax.InputError` for a value out of range.
    """

    J1: float
    J2: float
    k1: float
    k2: float
    c1: float
    c2: float
    # Operating conditions, given with the physical data; and the names of all data.
    operation: ClassVar[tuple[str, ...]] = ("speed", "angle")
    quantities: ClassVar[tuple[Parameter, ...]] = PHYSICAL
    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in PHYSICAL)

    def __post_init__(self) -> None:
        for field in fields(self):
            _check(field.name, getattr(self, field.name))
        if self.c1 == 0 and self.c2 != 0:
            raise InputError(f"c2 = {self.c2!r}: allowed is 0 if c1 = 0 (alpha = c2/c1)")

    @property
    def base_frequency(self) -> float:
        """sqrt(k1/J1), rad/s: the unit of Omega."""
        return math.sqrt(self.k1 / self.J1)

    @property
    def critical_damping(self) -> float:
        """2 sqrt(k1 J1), N m s/rad: the unit of zeta."""
        # Square roots one by one, because in some units the product overflows.
        return 2 * math.sqrt(self.k1) * math.sqrt(self.J1)

    @property
    def parameters(self) -> dict[str, float]:
        """zeta, alpha, mu and gamma."""
        return {
            "zeta": self.c1 / self.critical_damping,
            "alpha": self.c2 / self.c1 if self.c1 else 0.0,
            "mu": self.k2 / self.k1,
            "gamma": self.J2 / self.J1,
        }

    def at(self, speed: float, angle: float) -> dict[str, float]:
        """All six parameters at ``speed`` in rpm and ``angle`` in degrees."""
        return {"beta": self.beta(angle), "Omega": self.omega(speed), **self.parameters}

    def omega(self, speed: float) -> float:
        """Omega of a speed in rpm."""
        return _check("speed", speed) * _RPM / self.base_frequency

    def beta(self, angle: float) -> float:
        """beta of an angle in degrees."""
        return math.radians(_check("angle", angle))

    def speed(self, omega: float) -> float:
        """Speed in rpm of a value of Omega."""
        return omega * self.base_frequency / _RPM

    def angle(self, beta: float) -> float:
        """Angle in degrees of a value of beta."""
        return math.degrees(beta)

    def damping(self, zeta: float) -> float:
        """c1 in N m s/rad of a value of zeta."""
        return zeta * self.critical_damping

    def parameter(self, name: str, value: float) -> tuple[str, float]:
        """The nondimensional parameter of ``speed`` in rpm or ``angle`` in degrees."""
        return ("Omega", self.omega(value)) if name == "speed" else ("beta", self.beta(value))

    def quantity(self, parameter: str, value: float) -> tuple[str, float, str] | None:
        """Name, value and unit of the physical quantity behind Omega, beta or zeta, None for another parameter."""
        if parameter == "Omega":
            return "speed", self.speed(value), "rpm"
        if parameter == "beta":
            return "angle", self.angle(value), "deg"
        return ("c1", self.damping(value), "N m s/rad") if parameter == "zeta" else None


def _check(name: str, value: float) -> float:
    parameter: Any = next(p for p in PHYSICAL if p.name == name)
    try:
        return float(parameter.check(value))
    except ValueError as error:
        raise InputError(str(error)) from None
