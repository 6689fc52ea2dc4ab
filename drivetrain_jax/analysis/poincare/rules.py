"""Rules for results of the analysis ``poincare``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, within

RULES = Declared(
    (within("distinct_points", 0.0), within("chaos_k01", -1.0, 1.0)),
    # K is undefined for a short section that does not repeat.
    gaps=("chaos_k01",),
)
