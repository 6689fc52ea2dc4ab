"""Gear rattle: two spur gears meshing with backlash, driven by a mean torque and a harmonic torque.

Source: M. Rezaee, A. Farshidianfar, "Solving the nonlinear equations of rattling vibration of two meshing gears with
damping by multiple scales and averaging" (in Persian). docs/theory/rattle.md lists where the printed equations had to
be corrected.

``u = r_x theta_x - r_y theta_y`` is the relative displacement along the line of action, ``I = I_x I_y/(I_x r_y^2 +
I_y r_x^2)`` the equivalent mass, and ``B0 + B1 cos(omega t) = M_x r_x/I_x + M_y r_y/I_y`` an acceleration. With an
``unbalance`` e its amplitude is ``B1 + e omega^2``. The equation is
``u'' + (c/I) u' + (k/I) f_s(u) = B0 + B1 cos(omega t)`` with the spring of
:class:`~drivetrain_jax.systems.PiecewiseLinearOscillator`. With r in m, u and b are lengths, k, c
and I the stiffness, damping and mass along the line of action. Table 1 lists b as 10 deg, read here as the number pi/18: the
equation is homogeneous in u, b, B0 and B1, so that any unit of length is valid.

The damper of the paper acts always. With ``damping = "contact"`` it acts only while the flanks touch, ``|u| > b``.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any

from jax import Array

from drivetrain_jax._quantities import Component, Parameter
from drivetrain_jax.resonances import RATTLE
from drivetrain_jax.systems._base import (
    POSITIVE,
    RPM,
    Conversion,
    Number,
    PhysicalData,
    System,
    numeric,
    parameter,
    serves,
)
from drivetrain_jax.systems._models import PiecewiseLinearOscillator

# Physical data of a pair of gears and the parameters of ``rattle``, eqs (1) and (6)-(8) of docs/theory/rattle.md.


def _unit_of_damping(k: Any, i: Any) -> Any:
    xp, k, i = numeric(k, i)
    return 2 * xp.sqrt(k * i)


PHYSICAL = PhysicalData(
    (
        Parameter("J_x", "kg m2", "inertia of the driving gear", **POSITIVE),
        Parameter("J_y", "kg m2", "inertia of the driven gear", **POSITIVE),
        Parameter("r_x", "m", "base radius of the driving gear", usual=10.0, **POSITIVE),
        Parameter("r_y", "m", "base radius of the driven gear", usual=10.0, **POSITIVE),
        Parameter("torque_mean", "N m", "mean torque on the driving gear, balanced by the load on the driven one"),
        Parameter("torque_amplitude", "N m", "amplitude of the torque on the driving gear"),
        Parameter("order", "1", "periods of the torque per turn of the driving gear", default=1.0, **POSITIVE),
        Parameter("speed", "rpm", "speed of the driving gear", **POSITIVE),
        Parameter("backlash", "m", "backlash along the line of action, from flank to flank", lower=0.0),
        Parameter("mesh_stiffness", "N/m", "stiffness in contact, along the line of action", **POSITIVE),
        Parameter("damping_ratio", "1", "damping ratio in contact", lower=0.0),
    ),
    (
        Conversion(
            "omega",
            ("speed", "order"),
            lambda speed, order: order * speed * RPM,
            "order speed",
            lambda omega, order: omega / order / RPM,
        ),
        Conversion(
            "I",
            ("J_x", "J_y", "r_x", "r_y"),
            lambda jx, jy, rx, ry: 1 / (rx**2 / jx + ry**2 / jy),
            "J_x J_y/(J_x r_y^2 + J_y r_x^2)",
        ),
        Conversion("B0", ("torque_mean", "r_x", "I"), lambda t, rx, i: t / (rx * i), "torque_mean/(r_x I)"),
        Conversion("B1", ("torque_amplitude", "r_x", "J_x"), lambda t, rx, jx: t * rx / jx, "torque_amplitude r_x/J_x"),
        Conversion("b", ("backlash",), lambda backlash: backlash / 2, "backlash/2", lambda b: 2 * b),
        Conversion("k", ("mesh_stiffness",), lambda k: k, "mesh_stiffness", lambda k: k),
        Conversion(
            "c",
            ("damping_ratio", "k", "I"),
            lambda ratio, k, i: ratio * _unit_of_damping(k, i),
            "2 damping_ratio sqrt(k I)",
            lambda c, k, i: c / _unit_of_damping(k, i),
        ),
    ),
)


# Table 1 of the paper: b = 10 deg.
PRESETS = {"table1": {"B0": 0.05, "B1": 0.03, "b": math.pi / 18, "c": 0.05, "alpha": 0.25, "k": 1.0, "I": 1.0}}


_MOTION = ("omega", "B0", "B1", "b", "c", "alpha", "k", "I", "unbalance", "damping")


class Rattle(System):
    """The oscillator of the module's docstring.

    >>> import jax.numpy as jnp
    >>> from drivetrain_jax import Rattle
    >>> gears = Rattle(omega=0.7, **Rattle.presets["table1"])
    >>> print(gears.vector_field(0.0, jnp.array([0.2, 0.0])).round(6))
    [0.     0.0109]
    """

    name = "rattle"
    title = "Gear rattle: a pair of gears with backlash"
    source = "Rezaee & Farshidianfar (in Persian); corrections in docs/theory/rattle.md"
    presets = PRESETS
    resonances = RATTLE
    physical = PHYSICAL
    time_units = "s"
    roles = MappingProxyType({"speed": "omega", "initial_displacement": "u0", "initial_rate": "v0", "half_play": "b"})
    state = (Component("u", "m", "relative displacement"), Component("v", "m/s", "relative velocity"))

    omega: Number = parameter("rad/s", "frequency of the drive", symbol="ω", **POSITIVE)
    B0: Number = parameter("m/s2", "mean of the drive")
    B1: Number = parameter("m/s2", "amplitude of the drive")
    b: Number = parameter("m", "half the backlash", lower=0.0)
    c: Number = parameter("N s/m", "damping of the mesh", lower=0.0)
    alpha: Number = parameter("1", "stiffness within the backlash over that in contact", symbol="α", lower=0.0)
    k: Number = parameter("N/m", "stiffness in contact", **POSITIVE)
    I: Number = parameter("kg", "equivalent mass", **POSITIVE)  # noqa: E741
    unbalance: Number | None = parameter("m", "unbalance: adds unbalance omega^2 to B1", derived="none")
    damping: str = parameter("1", "where the damper acts", default="always", choices=("always", "contact"))
    u0: Number = parameter("m", "relative displacement at t = 0", default=0.0)
    v0: Number = parameter("m/s", "relative velocity at t = 0", default=0.0)

    @serves("basins", parameters=_MOTION)
    @serves("steady_state")
    @serves("history", returns=PiecewiseLinearOscillator)
    def oscillator(self) -> PiecewiseLinearOscillator:
        """The oscillator in units of its mass."""
        return self.along_frequencies().driven_at(self.omega)

    @serves("frequency_response", parameters=_MOTION)
    def along_frequencies(self) -> PiecewiseLinearOscillator:
        """The same with the unbalance apart, so that the drive follows its frequency."""
        return PiecewiseLinearOscillator(
            damping=self.c / self.I,
            stiffness=self.k / self.I,
            alpha=self.alpha,
            b=self.b,
            B0=self.B0,
            B1=self.B1,
            omega=self.omega,
            unbalance=0.0 if self.unbalance is None else self.unbalance,
            damps_play=self.damping == "always",
        )

    def vector_field(self, t: Any, y: Array) -> Array:
        """``(u', u'')`` of ``y = (u, u')``, shape ``(2, ...)``, at the time ``t`` [s]."""
        return self.oscillator().field(t, y)
