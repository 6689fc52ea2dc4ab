"""Rules for results of the analysis ``lyapunov``."""

from __future__ import annotations

import xarray as xr

from drivetrain_jax._rules import Declared, ordered, relation, within

# Largest residual if all exponents are nearly zero [1/s]: volume changes by rounding and steps.
_VOLUME_RATE = 1e-9


def _sum_rule(ds: xr.Dataset) -> xr.DataArray:
    """After a success the exponents must sum to the mean divergence."""
    allowed = 1e-2 * abs(ds["lyapunov_spectrum"]).sum("exponent") + _VOLUME_RATE
    return (abs(ds["sum_rule_residual"]) > allowed) & (ds["outcome"] == 0)


RULES = Declared(
    (
        ordered("lyapunov_spectrum", "exponent", falling=True),
        relation("the exponents sum to the mean divergence", ("sum_rule_residual", "lyapunov_spectrum"), _sum_rule),
        within("chaos_k01", -1.0, 1.0),
        within("period_multiple", 0.0),
    ),
    # NaN is allowed: an unbounded motion has only exponents, and the history of a run ends where it converged.
    gaps=(
        "lyapunov_standard_error",
        "lyapunov_history",
        "sum_rule_residual",
        "paper_estimator",
        "chaos_k01",
    ),
)
