"""What each analysis declares about its results. An analysis without an entry has the rules of every result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import xarray as xr

from drivetrain_jax.invariants.rules import Rule, in_order, multiple, ordered, relation, sums_to_one, within


@dataclass(frozen=True)
class Declared:
    """``rules`` of an analysis; ``gaps`` are the variables that may lack a value although a point has succeeded, ``kept``
    those that may have one although it has failed.

    ``has_points`` is false for a function of the parameters: there is no outcome of a point then.
    """

    rules: tuple[Rule, ...] = ()
    gaps: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    has_points: bool = True


def declared(analysis: str) -> Declared:
    """What the analysis of this name declares."""
    return _DECLARED.get(analysis, Declared())


def _all_multipliers(compare: Callable[[xr.DataArray, xr.Dataset], xr.DataArray]) -> Callable:
    return lambda ds: compare(abs(ds["floquet_multiplier"]).max("multiplier"), ds)


def _liouville(ds: xr.Dataset) -> xr.DataArray:
    """A coefficient's error ``e`` moves the outermost of n roots by at least ``e / 2^n`` (in units of rho)."""
    # Of how many roots is known where all multipliers are stored. Elsewhere as many as cardan has, the most of any system of
    # this package (tripod has two): a number too large overlooks more, one too small faults what is right.
    n = ds.sizes.get("multiplier", 4)
    return abs(ds["liouville_residual"]) > 2**n * ds["spectral_radius_error"] / ds["spectral_radius"]


def _verdict(ds: xr.Dataset) -> xr.DataArray:
    """0 stable, 1 unstable, 2 undecided, against the interval of the spectral radius."""
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
    """What the steps do not resolve does not add up, and is no success."""
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
        # A motion that left has exponents only, a run that met its aim early no history beyond.
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
        # Few strobes that do not repeat tell nothing.
        gaps=("chaos_k01",),
    ),
    "parameters": Declared(
        (
            within("natural_angular_frequency", 0.0),
            within("mean_inertia", 0.0),
            within("torsional_stiffness", 0.0),
            ordered("midshaft_frequency", "mode"),
        )
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
        # A motion that never repeats has no transition over its period, one at rest no phase.
        gaps=("phase", "spectral_radius", "floquet_multiplier", "state_error"),
    ),
    "frequency_response": Declared(
        (*_MOTION, in_order("branch_u_min", "branch_u_max"), ordered("fold_frequency", "fold")),
        # As many places as there may be branches and folds, no phase at rest, and no backbone at some frequencies.
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
        # As many places as there may be attractors.
        gaps=("basin_fraction", "basin_error", "attractor_u_max", "attractor_u_min"),
        kept=("unsettled_fraction",),
    ),
}
