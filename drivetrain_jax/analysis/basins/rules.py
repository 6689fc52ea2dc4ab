"""Rules for results of the analysis ``basins``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, in_order, sums_to_one, within

RULES = Declared(
    (
        within("basin_fraction", 0.0, 1.0),
        sums_to_one("basin_fraction", "attractor", ("unsettled_fraction",)),
        in_order("attractor_u_min", "attractor_u_max"),
    ),
    # NaN is allowed: results hold up to eight attractors, and most points have fewer.
    gaps=("basin_fraction", "basin_error", "attractor_u_max", "attractor_u_min"),
    kept=("unsettled_fraction",),
)
