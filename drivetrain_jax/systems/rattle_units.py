"""Physical data of a pair of gears and the parameters of ``rattle``, eqs (1) and (6)-(8) of docs/theory/rattle.md."""

from __future__ import annotations

from typing import Any

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import numeric
from drivetrain_jax.systems._physical import POSITIVE, RPM, Conversion, PhysicalData


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
