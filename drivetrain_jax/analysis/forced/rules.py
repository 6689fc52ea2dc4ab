"""Rules for results of the analysis ``forced``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, within

RULES = Declared(
    (within("amplitude", 0.0), within("condition", 1.0), within("orbit_amplitude", 0.0)), kept=("condition",)
)
