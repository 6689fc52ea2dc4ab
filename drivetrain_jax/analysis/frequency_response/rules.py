"""Rules for results of the analysis ``frequency_response``."""

from __future__ import annotations

from drivetrain_jax._rules import Declared, in_order, ordered
from drivetrain_jax.analysis.steady_state.rules import MOTION

RULES = Declared(
    (*MOTION, in_order("branch_u_min", "branch_u_max"), ordered("fold_frequency", "fold")),
    # NaN is allowed: the dimensions of branches and folds are longer than most points need, a motion at rest has no phase,
    # and some frequencies have no backbone.
    gaps=(
        "phase",
        "branch_u_max",
        "branch_u_min",
        "fold_frequency",
        "doubling_frequency",
        "backbone_amplitude",
        "peak_amplitude",
        "peak_frequency",
        "spectral_radius",
        "state_error",
    ),
    kept=("fit_range",),
)
