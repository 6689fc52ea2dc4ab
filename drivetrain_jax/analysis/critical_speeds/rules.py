"""Rules for results of the analysis ``critical_speeds``."""

from __future__ import annotations

import math

from drivetrain_jax._rules import Declared, multiple, ordered, within

RULES = Declared(
    (
        ordered("natural_frequency", "mode"),
        within("natural_frequency", 0.0),
        multiple("angular_frequency", 2 * math.pi, "natural_frequency"),
        multiple("critical_speed", 60.0, "natural_frequency"),
        within("count_certified", 0.0, 1.0),
        within("mode_shape", -1.0, 1.0),
    )
)
