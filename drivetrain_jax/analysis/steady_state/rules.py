"""Rules for results of the analysis ``steady_state``."""

from __future__ import annotations

import xarray as xr

from drivetrain_jax._rules import Declared, in_order, relation, within


def _rms_too_large(ds: xr.Dataset) -> xr.DataArray:
    largest = xr.where(abs(ds["u_max"]) > abs(ds["u_min"]), abs(ds["u_max"]), abs(ds["u_min"]))
    return ds["u_rms"] > largest * (1 + 1e-9)


# Rules of motions, shared with frequency responses.
MOTION = (
    in_order("u_min", "u_max"),
    within("u_rms", 0.0),
    within("spectral_radius", 0.0),
    within("period_multiple", 0.0),
    relation("u_rms <= max |u|", ("u_rms", "u_max", "u_min"), _rms_too_large),
)

RULES = Declared(
    (
        *MOTION,
        in_order("u_min", "u_mean", "u_max"),
        within("impacts", 0.0),
        within("contact_fraction", 0.0, 1.0),
    ),
    # NaN is allowed: a motion that never repeats has no multipliers, a motion at rest has no phase, and a spectral radius
    # that underflows has no exponent.
    gaps=("phase", "spectral_radius", "floquet_multiplier", "lyapunov_exponent", "state_error"),
)
