"""Rules of each analysis. An analysis without an entry has only the general rules.

Other packages add rules of their analyses through the entry point group ``drivetrain_jax.rules``; each entry point names a
:class:`Declared`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax._plugins import RULES, load_plugin
from drivetrain_jax._rules import Rule, in_order, multiple, ordered, relation, sums_to_one, within


@dataclass(frozen=True)
class Declared:
    """``rules`` of an analysis. ``gaps``: variables that may be NaN after a success; ``kept``: variables that may have a
    value after a failure.

    ``has_points`` is false for a function of the parameters, which has no outcomes.
    """

    rules: tuple[Rule, ...] = ()
    gaps: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    has_points: bool = True


def declared(analysis: str) -> Declared:
    """The declaration of the analysis with this name."""
    if analysis in _DECLARED:
        return _DECLARED[analysis]
    try:
        found = load_plugin(RULES, analysis, "the rules of an analysis", lambda x: isinstance(x, Declared))
    except ImportError as error:
        raise InputError(f"analysis = {analysis!r}: {' '.join(str(error).split())}") from error
    return Declared() if found is None else found


def _all_multipliers(compare: Callable[[xr.DataArray, xr.Dataset], xr.DataArray]) -> Callable:
    return lambda ds: compare(abs(ds["floquet_multiplier"]).max("multiplier"), ds)


def _liouville(ds: xr.Dataset) -> xr.DataArray:
    """True where the residual contradicts the bound: a coefficient's error e moves the largest of n roots by e/2^n."""
    # Unless all multipliers are stored, n is four, as for cardan. A larger n misses errors, a smaller one invents them.
    n = ds.sizes.get("multiplier", 4)
    return abs(ds["liouville_residual"]) > 2**n * ds["spectral_radius_error"] / ds["spectral_radius"]


def _verdict(ds: xr.Dataset) -> xr.DataArray:
    """0 stable, 1 unstable, 2 undecided, from the interval of the spectral radius."""
    rho, error, verdict = ds["spectral_radius"], ds["spectral_radius_error"], ds["verdict"]
    return ((rho + error < 1) != (verdict == 0)) | ((rho - error > 1) != (verdict == 1))


_FLOQUET = Declared(
    (
        ordered("floquet_multiplier", "multiplier", falling=True, key=abs),
        relation(
            "spectral_radius is the largest modulus of floquet_multiplier",
            ("spectral_radius", "floquet_multiplier"),
            _all_multipliers(lambda top, ds: abs(top - ds["spectral_radius"]) > 1e-9 * top),
        ),
        relation(
            "verdict follows from spectral_radius and its bound",
            ("verdict", "spectral_radius", "spectral_radius_error"),
            _verdict,
        ),
        relation(
            "liouville_residual lies within the bound of spectral_radius",
            ("liouville_residual", "spectral_radius", "spectral_radius_error"),
            _liouville,
        ),
        within("spectral_radius", 0.0),
    ),
)
_MOTION = (
    in_order("u_min", "u_max"),
    within("u_rms", 0.0),
    within("spectral_radius", 0.0),
    within("period_multiple", 0.0),
    relation("u_rms <= max |u|", ("u_rms", "u_max", "u_min"), lambda ds: _rms_too_large(ds)),
)


def _rms_too_large(ds: xr.Dataset) -> xr.DataArray:
    largest = xr.where(abs(ds["u_max"]) > abs(ds["u_min"]), abs(ds["u_max"]), abs(ds["u_min"]))
    return ds["u_rms"] > largest * (1 + 1e-9)


def _sum_rule(ds: xr.Dataset) -> xr.DataArray:
    """After a success the exponents must sum to the mean divergence."""
    off = abs(ds["sum_rule_residual"]) > 1e-2 * abs(ds["lyapunov_spectrum"]).sum("exponent")
    return off & (ds["outcome"] == 0)


_DECLARED = {
    "atlas": Declared(
        (in_order("lower", "upper"), in_order("panel_lower", "panel_upper"), within("panel_degrees", 1.0)),
        has_points=False,
    ),
    "floquet": _FLOQUET,
    "forced": Declared(
        (within("amplitude", 0.0), within("condition", 1.0), within("orbit_amplitude", 0.0)), kept=("condition",)
    ),
    "lyapunov": Declared(
        (
            ordered("lyapunov_spectrum", "exponent", falling=True),
            relation("the exponents sum to the mean divergence", ("sum_rule_residual", "lyapunov_spectrum"), _sum_rule),
            within("averaging_time", 0.0),
            within("chaos_k01", -1.0, 1.0),
            within("period_multiple", 0.0),
        ),
        # An unbounded motion has only exponents; a run that converged early has no history after that.
        gaps=(
            "lyapunov_standard_error",
            "lyapunov_history",
            "step_change",
            "sum_rule_residual",
            "averaging_time",
            "paper_estimator",
            "chaos_k01",
        ),
    ),
    "poincare": Declared(
        (within("distinct_points", 0.0), within("chaos_k01", -1.0, 1.0)),
        # K is undefined for a short section that does not repeat.
        gaps=("chaos_k01",),
    ),
    "modes": Declared(
        (
            ordered("natural_frequency", "mode"),
            within("natural_frequency", 0.0),
            within("participation", 0.0, 1.0),
            sums_to_one("participation", "family"),
            within("kinetic_energy", 0.0, 1.0),
            sums_to_one("kinetic_energy", "body"),
            within("mac", 0.0, 1.0),
        )
    ),
    "critical_speeds": Declared(
        (
            ordered("natural_frequency", "mode"),
            within("natural_frequency", 0.0),
            multiple("angular_frequency", 2 * math.pi, "natural_frequency"),
            multiple("critical_speed", 60.0, "natural_frequency"),
            within("count_certified", 0.0, 1.0),
            within("mode_shape", -1.0, 1.0),
        )
    ),
    "steady_state": Declared(
        (
            *_MOTION,
            in_order("u_min", "u_mean", "u_max"),
            within("impacts", 0.0),
            within("contact_fraction", 0.0, 1.0),
        ),
        # A motion that never repeats has no multipliers, a motion at rest no phase.
        gaps=("phase", "spectral_radius", "floquet_multiplier", "state_error"),
    ),
    "frequency_response": Declared(
        (*_MOTION, in_order("branch_u_min", "branch_u_max"), ordered("fold_frequency", "fold")),
        # There are more places than branches and folds; a motion at rest has no phase, and some frequencies have no
        # backbone.
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
    ),
    "basins": Declared(
        (
            within("basin_fraction", 0.0, 1.0),
            sums_to_one("basin_fraction", "attractor", ("unsettled_fraction",)),
            in_order("attractor_u_min", "attractor_u_max"),
        ),
        # There are more places than attractors.
        gaps=("basin_fraction", "basin_error", "attractor_u_max", "attractor_u_min"),
        kept=("unsettled_fraction",),
    ),
}
