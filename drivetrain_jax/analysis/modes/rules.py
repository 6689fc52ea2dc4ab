"""Rules for results of the analysis ``modes``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, ordered, sums_to_one, within

RULES = Declared(
    (
        ordered("natural_frequency", "mode"),
        within("natural_frequency", 0.0),
        within("participation", 0.0, 1.0),
        sums_to_one("participation", "family"),
        within("dominant_share", 0.0, 1.0),
        within("kinetic_energy", 0.0, 1.0),
        sums_to_one("kinetic_energy", "body"),
        within("mac", 0.0, 1.0),
    )
)
