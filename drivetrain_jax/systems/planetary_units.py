"""Numbers of teeth of a planetary gear and what follows from them, see docs/systems/planetary.md."""

from __future__ import annotations

import math
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import numeric
from drivetrain_jax.systems._physical import POSITIVE, Conversion, PhysicalData


def _teeth(teeth: tuple[float, ...]) -> tuple[float, ...]:
    if len(teeth) != 3 or not teeth[0] + teeth[1] < teeth[2]:
        raise InputError(f"teeth = {list(teeth)}: allowed are those of sun, planet and ring, with sun + planet < ring")
    return teeth


def _phase(angle: Any) -> Any:
    xp, angle = numeric(angle)
    return angle - 2 * math.pi * xp.round(angle / (2 * math.pi))


PHYSICAL = PhysicalData(
    (
        Parameter("teeth", "1", "teeth of sun, planet and ring", lower=1.0, listed=True, integer=True),
        Parameter("carrier_order", "1", "tooth meshes per turn of the carrier, ring held", **POSITIVE),
        Parameter("sun_order", "1", "tooth meshes per turn of the sun, ring held", **POSITIVE),
    ),
    (
        Conversion("carrier_order", ("teeth",), lambda z: _teeth(z)[2], "teeth[2]", whole=("teeth",)),
        Conversion(
            "sun_order",
            ("teeth",),
            lambda z: z[0] * z[2] / (z[0] + z[2]),
            "teeth[0] teeth[2]/(teeth[0] + teeth[2])",
            whole=("teeth",),
        ),
        Conversion(
            "phase_s",
            ("teeth", "planet_angle"),
            lambda z, angle: _phase(-z[0] * angle),
            "-teeth[0] planet_angle",
            optional=True,
            whole=("teeth",),
        ),
        Conversion(
            "phase_r",
            ("teeth", "planet_angle"),
            lambda z, angle: _phase(z[2] * angle),
            "teeth[2] planet_angle",
            optional=True,
            whole=("teeth",),
        ),
    ),
)
