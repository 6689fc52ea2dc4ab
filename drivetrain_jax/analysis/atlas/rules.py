"""Rules for results of the analysis ``atlas``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, in_order, within

RULES = Declared(
    (in_order("lower", "upper"), in_order("panel_lower", "panel_upper"), within("panel_degrees", 1.0)),
    has_points=False,
)
