"""Rules for the numbers of a result, each a function of the Dataset alone; and what is known of every analysis without jax.

NaN obeys every rule.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from drivetrain_jax._errors import shown
from drivetrain_jax._quantities import FIRST_FAILURE

# Relative tolerance for the rounding of a formula evaluated in another order.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Rule:
    """A rule with its ``text``: ``broken(dataset)`` is true where it is broken, and needs all of ``variables``."""

    text: str
    variables: tuple[str, ...]
    broken: Callable[[xr.Dataset], xr.DataArray]

    def __post_init__(self) -> None:
        if isinstance(self.variables, str):
            raise TypeError(f"variables = {self.variables!r}: expected a tuple of names, ({self.variables!r},)")


def within(name: str, lower: float = -np.inf, upper: float = np.inf) -> Rule:
    """``lower <= name <= upper`` up to rounding."""
    bounds = [f"{lower:g} <= " if lower > -np.inf else "", f" <= {upper:g}" if upper < np.inf else ""]
    room = ROUNDING * max(abs(x) for x in (lower, upper, 0.0) if np.isfinite(x))
    return Rule(
        f"{bounds[0]}{name}{bounds[1]}", (name,), lambda ds: (ds[name] < lower - room) | (ds[name] > upper + room)
    )


def ordered(name: str, dim: str, falling: bool = False, key: Callable = lambda values: values) -> Rule:
    """``name`` rises (or falls) along ``dim`` up to rounding; ``key`` computes the compared quantity."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        values = key(ds[name])
        step = values.diff(dim)
        # Frequencies of modes without mass are infinite.
        room = ROUNDING * abs(values).where(np.isfinite(values), 0.0).max(dim)
        return step > room if falling else step < -room

    return Rule(f"{name} {'falls' if falling else 'rises'} along {dim}", (name,), broken)


def sums_to_one(name: str, dim: str, others: tuple[str, ...] = ()) -> Rule:
    """``name`` summed over ``dim``, plus ``others``, is 1 where there is a value."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        total = ds[name].sum(dim) + sum(ds[other] for other in others)
        return (abs(total - 1) > ROUNDING) & ds[name].notnull().any(dim)

    return Rule(" + ".join((f"sum of {name} over {dim}", *others)) + " = 1", (name, *others), broken)


def in_order(*names: str) -> Rule:
    """Each of ``names`` is at most the next."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        size = sum(abs(ds[name]) for name in names)
        pairs = [ds[a] > ds[b] + ROUNDING * size for a, b in itertools.pairwise(names)]
        return xr.concat(pairs, "pair").any("pair")

    return Rule(" <= ".join(names), names, broken)


def multiple(name: str, factor: float, of: str) -> Rule:
    """``name = factor * of``."""
    return Rule(f"{name} = {factor:.6g} {of}", (name, of), lambda ds: _differ(ds[name], factor * ds[of]))


def _differ(one: xr.DataArray, other: xr.DataArray) -> xr.DataArray:
    infinite = (np.isinf(one) != np.isinf(other)) & one.notnull() & other.notnull()
    return infinite | (abs(one - other) > ROUNDING * (abs(one) + abs(other)))


def _events_differ(ds: xr.Dataset) -> xr.DataArray:
    listed = ds["event_time"].notnull().sum("event")
    return (listed != np.minimum(ds["event_count"], ds.sizes["event"])) & (ds["outcome"] < FIRST_FAILURE)


@dataclass(frozen=True)
class Declared:
    """A record of an analysis that needs no jax: the rules of its results, and how figures draw them."""

    #: Rules of the results.
    rules: tuple[Rule, ...] = ()
    #: Variables that may be NaN after a success.
    gaps: tuple[str, ...] = ()
    #: Variables that may have a value after a failure.
    kept: tuple[str, ...] = ()
    #: False for a function of the parameters, which has no outcomes.
    has_points: bool = True
    #: Variables of each panel of lines; default: a panel for every result.
    panels: tuple[tuple[str, ...], ...] = ()
    #: Variables of maps; default: those of the panels.
    fields: tuple[str, ...] = ()
    #: Variables whose lines have a logarithmic scale.
    logarithmic: tuple[str, ...] = ()
    #: Dots in place of lines, for results that jump between branches.
    dots: bool = False
    #: Module and function of ``view`` that draws what lines and maps cannot; None from it asks for these.
    figure: str = ""
    #: Predicted resonances in figures: ``all``, only those that the forcing excites (``forced``), or none.
    predicted: str = ""
    #: Results by several methods may share a figure.
    overlaid: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.rules, tuple) or not all(isinstance(rule, Rule) for rule in self.rules):
            raise TypeError(f"rules: got {shown(self.rules)}; expected a tuple of rules, (rule, ...)")


# Error of a radius that is known to be 1: four roundings.
_ROUNDING = 1e-15


def _radius_differs(ds: xr.Dataset) -> xr.DataArray:
    largest = abs(ds["floquet_multiplier"]).max("multiplier")
    return abs(largest - ds["spectral_radius"]) > 1e-9 * largest


def _liouville(ds: xr.Dataset) -> xr.DataArray:
    """True where the residual contradicts the bound: a coefficient's error e moves the largest of n roots by e/2^n."""
    # If the multipliers are not stored, n is four as for cardan. A larger n misses errors, a smaller n reports false ones.
    n = ds.sizes.get("multiplier", 4)
    wrong = abs(ds["liouville_residual"]) > 2**n * ds["spectral_radius_error"] / ds["spectral_radius"]
    return wrong & ~_is_one(ds)


def _is_one(ds: xr.Dataset) -> xr.DataArray:
    """True where the radius is known to be 1: without damping, if all multipliers are simple and on the unit circle."""
    rho, error = ds["spectral_radius"], ds["spectral_radius_error"]
    return (error <= _ROUNDING) & (abs(rho - 1) <= error)


def _verdict(ds: xr.Dataset) -> xr.DataArray:
    """0 stable, 1 unstable, 2 undecided, from the interval of the spectral radius.

    Where the radius is 1, stable means bounded. Without damping an atlas also knows it to exceed 1 within its interval.
    """
    rho, error, verdict = ds["spectral_radius"], ds["spectral_radius_error"], ds["verdict"]
    stable, unstable = (rho + error < 1) | _is_one(ds), rho - error > 1
    return (stable != (verdict == 0)) | (unstable & (verdict != 1)) | ((rho + error <= 1) & (verdict == 1))


def _rms_too_large(ds: xr.Dataset) -> xr.DataArray:
    largest = xr.where(abs(ds["u_max"]) > abs(ds["u_min"]), abs(ds["u_max"]), abs(ds["u_min"]))
    return ds["u_rms"] > largest * (1 + 1e-9)


# Rules of motions, shared with frequency responses.
MOTION = (
    in_order("u_min", "u_max"),
    within("u_rms", 0.0),
    within("spectral_radius", 0.0),
    within("period_multiple", 0.0),
    Rule("u_rms <= max |u|", ("u_rms", "u_max", "u_min"), _rms_too_large),
)


# Excess of a spectral radius over 1 up to which an orbit may be called stable.
_MARGIN = 2e-8


def _branches_fall(ds: xr.Dataset) -> xr.DataArray:
    amplitude = ds["branch_amplitude"]
    inner = [dim for dim in amplitude.dims if dim != "branch" and dim not in ds["outcome"].dims]
    return amplitude.max(inner).diff("branch") < -ROUNDING * amplitude.max([*inner, "branch"])


def _stability_differs(ds: xr.Dataset) -> xr.DataArray:
    stability, radius = ds["branch_stability"], ds["branch_spectral_radius"]
    wrong = ((stability == 0) & (radius > 1 + _MARGIN)) | ((stability == 1) & (radius <= 1))
    return wrong | ((stability == 2) != radius.isnull())


# Largest residual if all exponents are nearly zero [1/s]: volume changes by rounding and steps.
_VOLUME_RATE = 1e-9


def _sum_rule(ds: xr.Dataset) -> xr.DataArray:
    """After a success the exponents must sum to the mean divergence."""
    allowed = 1e-2 * abs(ds["lyapunov_spectrum"]).sum("exponent") + _VOLUME_RATE
    return (abs(ds["sum_rule_residual"]) > allowed) & (ds["outcome"] == 0)


_SPEEDS = ("critical_speed", "natural_frequency")


def _speeds_differ(ds: xr.Dataset) -> xr.DataArray:
    order = json.loads(ds.attrs.get("options", "{}")).get("order", 0)
    return _differ(max(abs(order), 1) * ds["critical_speed"], 60 * ds["natural_frequency"])


# The analyses of this package by name.
BUILT_IN = {
    "atlas": Declared(
        (in_order("lower", "upper"), in_order("panel_lower", "panel_upper"), within("panel_degrees", 1.0)),
        has_points=False,
    ),
    "floquet": Declared(
        (
            ordered("floquet_multiplier", "multiplier", falling=True, key=abs),
            Rule(
                "spectral_radius is the largest modulus of floquet_multiplier",
                ("spectral_radius", "floquet_multiplier"),
                _radius_differs,
            ),
            Rule(
                "verdict follows from spectral_radius and its bound",
                ("verdict", "spectral_radius", "spectral_radius_error"),
                _verdict,
            ),
            Rule(
                "liouville_residual lies within the bound of spectral_radius",
                ("liouville_residual", "spectral_radius", "spectral_radius_error"),
                _liouville,
            ),
            within("spectral_radius", 0.0),
        ),
        gaps=("floquet_multiplier", "floquet_multiplier_error", "floquet_exponent"),
        panels=(("spectral_radius",),),
        fields=("verdict", "spectral_radius"),
        predicted="all",
    ),
    "forced": Declared(
        (within("amplitude", 0.0), within("condition", 1.0), within("orbit_amplitude", 0.0), within("torque", 0.0)),
        kept=("condition",),
        panels=(
            ("amplitude", "orbit_amplitude"),
            ("torque", "orbit_torque"),
            ("orbit_spectral_radius",),
            ("condition",),
        ),
        logarithmic=("amplitude", "orbit_amplitude", "torque", "orbit_torque", "condition"),
        predicted="forced",
    ),
    "history": Declared(
        (Rule("event_time has event_count values, up to its length", ("event_time", "event_count"), _events_differ),),
        # NaN is allowed: lists of events are longer than most motions need.
        gaps=("event_time", "event_velocity"),
        figure="motions.history",
    ),
    "parameters": Declared(),
    "phasing": Declared(),
    "harmonic_response": Declared(figure="responses.harmonic_response"),
    "steady_state": Declared(
        (*MOTION, in_order("u_min", "u_mean", "u_max"), within("impacts", 0.0), within("contact_fraction", 0.0, 1.0)),
        # NaN is allowed: a motion that never repeats has no multipliers, a motion at rest has no phase, and a spectral
        # radius that underflows has no exponent.
        gaps=("phase", "spectral_radius", "floquet_multiplier", "lyapunov_exponent", "state_error"),
        panels=(
            ("u_max", "u_min"),
            ("period_multiple",),
            ("spectral_radius",),
            ("lyapunov_exponent",),
            ("impact_velocity",),
            ("contact_fraction",),
        ),
        fields=("regime", "u_max"),
        dots=True,
        figure="motions.steady_state",
        predicted="all",
    ),
    "frequency_response": Declared(
        (
            *MOTION,
            in_order("branch_u_min", "branch_u_max"),
            within("branch_amplitude", 0.0),
            within("branch_spectral_radius", 0.0),
            Rule("largest branch_amplitude rises along branch", ("branch_amplitude", "outcome"), _branches_fall),
            Rule(
                "branch_stability follows from branch_spectral_radius",
                ("branch_stability", "branch_spectral_radius"),
                _stability_differs,
            ),
            ordered("fold_frequency", "fold"),
            ordered("doubling_frequency", "doubling"),
        ),
        # NaN is allowed: the dimensions of branches and folds are longer than most points need, a motion at rest has no
        # phase, and some frequencies have no backbone.
        gaps=(
            *("phase", "branch_u_max", "branch_u_min", "branch_amplitude", "branch_spectral_radius", "fold_frequency"),
            *("doubling_frequency", "backbone_amplitude", "peak_amplitude", "peak_frequency", "spectral_radius"),
            "state_error",
        ),
        kept=("fit_range",),
        figure="responses.frequency_response",
        predicted="forced",
        overlaid=True,
    ),
    "basins": Declared(
        (
            within("basin_fraction", 0.0, 1.0),
            sums_to_one("basin_fraction", "attractor", ("unsettled_fraction",)),
            in_order("attractor_u_min", "attractor_u_max"),
        ),
        # NaN is allowed: results hold up to eight attractors, and most points have fewer.
        gaps=("basin_fraction", "basin_error", "attractor_u_max", "attractor_u_min"),
        kept=("unsettled_fraction",),
        figure="motions.basins",
    ),
    "lyapunov": Declared(
        (
            ordered("lyapunov_spectrum", "exponent", falling=True),
            Rule("the exponents sum to the mean divergence", ("sum_rule_residual", "lyapunov_spectrum"), _sum_rule),
            within("chaos_k01", -1.0, 1.0),
            within("period_multiple", 0.0),
        ),
        # NaN is allowed: an unbounded motion has only exponents, and the history of a run ends where it converged.
        gaps=("lyapunov_standard_error", "lyapunov_history", "sum_rule_residual", "paper_estimator", "chaos_k01"),
        panels=(
            ("lyapunov_spectrum",),
            ("paper_estimator",),
            ("sum_rule_residual",),
            ("chaos_k01",),
            ("lyapunov_history",),
        ),
        fields=("verdict", "lyapunov_spectrum"),
    ),
    "poincare": Declared(
        (within("distinct_points", 0.0), within("chaos_k01", -1.0, 1.0)),
        # K is undefined for a short section that does not repeat.
        gaps=("chaos_k01",),
        figure="motions.section",
    ),
    "modes": Declared(
        (
            ordered("natural_frequency", "mode"),
            within("natural_frequency", 0.0),
            within("participation", 0.0, 1.0),
            sums_to_one("participation", "family"),
            within("dominant_share", 0.0, 1.0),
            within("kinetic_energy", 0.0, 1.0),
            sums_to_one("kinetic_energy", "body"),
            within("mac", 0.0, 1.0),
        ),
        figure="frequencies.modes",
    ),
    "critical_speeds": Declared(
        (
            ordered("natural_frequency", "mode"),
            within("natural_frequency", 0.0),
            multiple("angular_frequency", 2 * math.pi, "natural_frequency"),
            Rule("critical_speed = 60/max(|order|, 1) natural_frequency", _SPEEDS, _speeds_differ),
            within("count_certified", 0.0, 1.0),
            within("mode_shape", -1.0, 1.0),
        ),
        figure="frequencies.critical_speeds",
    ),
    "whirl": Declared(
        (ordered("whirl_frequency", "mode"), within("whirl_frequency", 0.0), within("whirl_count_certified", 0.0, 1.0)),
        figure="frequencies.whirl",
    ),
}
