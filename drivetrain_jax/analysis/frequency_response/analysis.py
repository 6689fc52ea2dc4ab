"""Frequency response: motions along the frequency or the speed of the drive.

A system with forced periodic orbits has the branches of these orbits. The rest is about an oscillator with play: motions
found by slow sweeps of the drive's frequency, up and down.

The speed of the system is the path: a line of frequencies is computed as a whole. A sweep starts from rest at the lowest
(up) or highest (down) frequency and stays on its branch until this ends or becomes unstable; then it jumps to the motion
that follows in time. Methods: the exact solution, harmonic balance (a chosen number of harmonics), multiple scales (the
paper's closed form for a cubic spring) and the describing function (bias and fundamental). ``residual`` is the rms residual
of the equation of motion.

Outcome: the worse one of both directions. Results of the other direction are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax._rules import BUILT_IN
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver, finite_results
from drivetrain_jax.analysis.forced.analysis import NEAR, SAME, STABLE_MARGIN, distinct, orbits_near
from drivetrain_jax.analysis.forced.orbit import REACH, speed_map
from drivetrain_jax.analysis.frequency_response import closed_form_response, harmonic_response
from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis
from drivetrain_jax.analysis.impacts import exact_response
from drivetrain_jax.analysis.impacts.motion import ABSENT, PHASE, REGIME, REGIMES, STABILITY, STABLE, UNSTABLE
from drivetrain_jax.analysis.numerics.continuation import course, folds_and_doublings, follow, sections
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import ForcedModel, PiecewiseLinearOscillator, System

# Branches of forced periodic orbits over the speed, stable or not, with their folds and period doublings.
#
# Continuation by arc length (:mod:`~drivetrain_jax.analysis.numerics.continuation`) begins at speeds along the line, at the
# orbits to which Newton's method leads from rest there, and runs both ways over a ratio of 1.3, through folds. Newton's
# method corrects the orbits at the speeds of the line. Orbits on branches that these do not meet are not found.

_MOST_ORBITS, _MOST_SPECIAL = 7, 16
# Ratio of neighbouring starts, most starts, steps of each branch, its longest step, and the tolerance of its integrations.
_SPACING, _STARTS, _ATTEMPTS, _LONGEST, _RTOL = 1.15, 48, 400, 0.06, 1e-9
# Positions of one branch at a speed, folds and doublings of each kind on one branch, most steps of an integration.
_EACH, _EACH_SPECIAL, _STEPS = 3, 4, 4096


def _branch_variables(system: type[System]) -> tuple[Variable, ...]:
    assert system.displacements is not None  # System refuses a model of forced without them
    units, speed = system.state[0].units, system.parameter(system.role("speed")).units
    branch = ("branch",)
    return (
        Variable("branch_amplitude", units, "largest displacement of the orbits", (*branch, system.displacements.name)),
        Variable("branch_spectral_radius", "1", "spectral radius of the monodromy matrix about the orbits", branch),
        Variable("branch_stability", "1", "stability of the orbits", branch, dtype="int8", flags=STABILITY),
        Variable("fold_frequency", speed, "speeds at which branches turn back, rising", ("fold",)),
        Variable("doubling_frequency", speed, "speeds at which periods double, rising", ("doubling",)),
    )


def _branch_dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    assert system.displacements is not None
    numbers = tuple(range(1, _MOST_SPECIAL + 1))
    return (
        Dimension("branch", "number of the orbit, by rising amplitude", tuple(range(1, _MOST_ORBITS + 1))),
        system.displacements,
        Dimension("fold", "number of the fold", numbers),
        Dimension("doubling", "number of the period doubling", numbers),
    )


def _branch_solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    solve = over_lanes(partial(_solve_branches, system, request))
    return (Solver("continuation", solve, seconds=1e-2, chunk=8, march=True, short_loops=True, lengthy=True),)


def _solve_branches(
    system: type[System], request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    """The requested results of one line; ``effort`` only orders the batches."""
    speed = system.role("speed")
    rising, place = np.unique(np.asarray(values[speed]), return_inverse=True)

    def model_at(value: Any) -> ForcedModel:
        return system.models["frequency_response"].build({**values, speed: value})

    n = model_at(rising[0]).size or len(system.state)
    special = not {"fold_frequency", "doubling_frequency"}.isdisjoint(request.outputs)
    guesses, every, frequencies = _branches_of_orbits(model_at, rising, n, special)

    def orbits_at(section: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        value, guess, every = section
        orbits = orbits_near(model_at(value), guess, request.options["rtol"])
        exists = distinct(orbits.orbit.state, SAME)
        order = jnp.lexsort((jnp.max(orbits.largest, axis=1), ~exists))
        exists = exists[order]
        largest = jnp.where(exists[:, None], orbits.largest[order], jnp.nan)
        radius = jnp.where(exists, orbits.radius[order], jnp.nan)
        stability = jnp.where(radius > 1 + STABLE_MARGIN, UNSTABLE, STABLE)
        stability = jnp.where(exists, stability, ABSENT).astype(jnp.int8)
        missed = jnp.any(exists & (orbits.orbit.outcome[order] != Outcome.SUCCESS))
        lost = jnp.any(jnp.isfinite(guess[:, 0]) & jnp.isnan(orbits.radius))
        outcome = jnp.where(missed | lost | ~every, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
        outcome = jnp.where(jnp.any(exists), outcome, Outcome.NOT_CONVERGED)
        return largest, radius, stability, outcome.astype(jnp.int8)

    columns = jax.lax.map(orbits_at, (jnp.asarray(rising), guesses, every))
    names = ("branch_amplitude", "branch_spectral_radius", "branch_stability", "outcome")
    results = {name: column[place] for name, column in zip(names, columns, strict=True)}
    results |= {name: jnp.broadcast_to(x, (place.size, *x.shape)) for name, x in frequencies.items()}
    return {name: results[name] for name in (*request.outputs, "outcome")}


def _branches_of_orbits(
    model_at: Any, rising: np.ndarray, n: int, special: bool
) -> tuple[Array, Array, dict[str, Array]]:
    """Approximate orbits at the speeds ``rising`` (L,), ``(L, 7, n)``, NaN after the last; flags of speeds with no others,
    ``(L,)``; and frequencies of folds and doublings, if ``special``."""
    low, high = float(rising[0]), float(rising[-1])
    starts = np.geomspace(low, high, min(math.ceil(math.log(high / low) / math.log(_SPACING)) + 1, _STARTS))
    at = jnp.asarray(np.tile(starts, 2))
    x = jnp.concatenate([jnp.zeros((n, at.size)), at[None]])
    scale = jnp.concatenate([jnp.ones((n, at.size)), at[None]])
    mapped = speed_map(model_at, _RTOL, _STEPS)
    branch = follow(
        mapped,
        x,
        scale,
        direction=jnp.repeat(jnp.array([1.0, -1.0]), starts.size),
        attempts=_ATTEMPTS,
        longest=_LONGEST,
        limits=(jnp.maximum(at / REACH, low) * (1 - 1e-9), jnp.minimum(at * REACH, high) * (1 + 1e-9)),
        converged=1e-9,
    )
    along = course(branch.x, scale)

    def positions(value: Array) -> tuple[Array, Array]:
        guess, exists, every = sections(along, value, _EACH)
        y = jnp.where(exists[:, None], guess, jnp.nan)[:, :n].transpose(0, 2, 1).reshape(-1, n)
        new = distinct(y, NEAR)
        first = jnp.argsort(~new)[:_MOST_ORBITS]
        return jnp.where(new[first][:, None], y[first], jnp.nan), jnp.all(every) & (jnp.sum(new) <= _MOST_ORBITS)

    guesses, every = jax.lax.map(positions, jnp.asarray(rising))
    frequencies: dict[str, Array] = {}
    if special:
        p, complete = folds_and_doublings(lambda _: mapped, branch, (low, high), _EACH_SPECIAL, _MOST_SPECIAL, at.size)
        frequencies |= zip(("fold_frequency", "doubling_frequency"), p[..., 0], strict=True)
        every &= complete[0]
    return guesses, every, frequencies


SWEEP = ("sweep_direction",)
BRANCH = ("branch",)
VARIABLES = (
    Variable("u_max", "m", "largest relative displacement", SWEEP),
    Variable("u_min", "m", "smallest relative displacement", SWEEP),
    Variable("u_rms", "m", "root mean square of the relative displacement, mean included", SWEEP),
    Variable("phase", "rad", PHASE, SWEEP),
    Variable("regime", "1", REGIME, SWEEP, dtype="int8", flags=REGIMES),
    Variable("stability", "1", "stability of the motion", SWEEP, dtype="int8", flags=STABILITY),
    Variable("spectral_radius", "1", "spectral radius of the transition over the motion's period", SWEEP),
    Variable("residual", "m/s2", "rms residual of the equation of motion", SWEEP),
    Variable("period_multiple", "1", "period of the motion in drive periods (0: not found)", SWEEP, dtype="int32"),
    Variable("state_error", "m", "estimated error of the motion", SWEEP),
    Variable("branch_u_max", "m", "largest relative displacement of every motion found", BRANCH),
    Variable("branch_u_min", "m", "smallest relative displacement of every motion found", BRANCH),
    Variable("branch_stability", "1", "stability of every motion found", BRANCH, dtype="int8", flags=STABILITY),
    Variable("peak_amplitude", "m", "largest amplitude of the fundamental over all frequencies"),
    Variable("peak_frequency", "rad/s", "frequency of the largest amplitude (0: the static one)"),
    Variable("fold_frequency", "rad/s", "frequencies at which branches end, rising", ("fold",)),
    Variable("doubling_frequency", "rad/s", "frequencies at which periods double, rising", ("doubling",)),
    Variable("backbone_amplitude", "m", "amplitude of the free undamped motion of this frequency"),
    Variable("fit_range", "m", "range R of the cubic fitted to the spring"),
)
OPTIONS = (
    RTOL,
    count("most_periods", "largest number of drive periods until a motion settles", default=1000, lower=32, upper=1e6),
    count("harmonics", "harmonics of the drive's frequency", default=15, lower=1, upper=200),
    count("subharmonic", "order of the subharmonics kept", default=1, lower=1, upper=8),
    count("samples", "samples per period of the drive, 0: by the harmonics", default=0, lower=0, upper=1e5),
    Parameter("fit_range", "m", "range R of the cubic fit (0: its own peak amplitude)", default=0.0, lower=0.0),
)
METHODS = {
    "exact": ("rtol", "most_periods"),
    "harmonic_balance": ("harmonics", "subharmonic", "samples"),
    "multiple_scales": ("fit_range",),
    "describing_function": (),
}
# Results that not every method provides.
_CLOSED = ("multiple_scales", "describing_function")
_APPROXIMATE = ("harmonic_balance", *_CLOSED)
_ONLY = {
    **dict.fromkeys(("period_multiple", "state_error"), ("exact",)),
    "doubling_frequency": ("exact",),
    "residual": _APPROXIMATE,
    "fold_frequency": ("exact", *_CLOSED),
    **dict.fromkeys(("peak_amplitude", "peak_frequency", "backbone_amplitude"), _CLOSED),
    "fit_range": ("multiple_scales",),
}
# Closed forms of curves whose drive has one amplitude.
_OF_ONE_DRIVE = frozenset(("peak_amplitude", "peak_frequency", "fold_frequency"))
_SPECIAL = frozenset(("fold_frequency", "doubling_frequency"))
# Lines of a chunk: for a map of 200 lines, equally many for two cores.
_CHUNK = 50


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Directions, branches and folds; ``InputError`` for a result that the method does not provide, or too few samples."""
    for name in request.outputs:
        if request.method not in _ONLY.get(name, (request.method,)):
            methods = ", ".join(_ONLY[name])
            raise InputError(f"outputs: method {request.method} does not give {name}; expected {methods}")
    PiecewiseLinearOscillator.check_method(fixed.get("damping") != "contact", request.method)
    for name in () if fixed.get("unbalance") is None else _OF_ONE_DRIVE.intersection(request.outputs):
        if request.method != "exact":
            raise InputError(
                f"outputs: {request.method} gives {name} for a drive of one amplitude; "
                "expected with an unbalance other results, or the method exact for fold_frequency"
            )
    samples, harmonics = (request.options.get(name, 0) for name in ("samples", "harmonics"))
    if 0 < samples <= 2 * harmonics:
        allowed = f"0 (by the harmonics) or at least {2 * harmonics + 1}, which tell {harmonics} harmonics apart"
        raise InputError(f"options.samples = {samples}: expected {allowed}")
    branches = closed_form_response.BRANCHES.get(request.method, harmonic_response.BRANCHES)
    folds = exact_response.SPECIAL if request.method == "exact" else closed_form_response.FOLDS
    return (
        Dimension("sweep_direction", "direction of the sweep", ("up", "down")),
        Dimension("branch", "number of the motion, by rising amplitude", tuple(range(1, branches + 1))),
        Dimension("fold", "number of the fold", tuple(range(1, folds + 1))),
        Dimension("doubling", "number of the period doubling", tuple(range(1, exact_response.SPECIAL + 1))),
    )


def _solve(
    build: Callable[..., PiecewiseLinearOscillator], request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    model = build(values)
    model.check_method(model.damps_play, request.method)
    options, shape = request.options, exact_response.batch_shape(model)
    if request.method == "exact":
        results = _exact(model, request)
    elif request.method == "harmonic_balance":
        basis = Basis(options["harmonics"], options["subharmonic"], options["samples"])
        results = harmonic_response.response(model, basis, shape, request.outputs)
    else:
        asked = options.get("fit_range", 0.0)
        fit_range = jnp.asarray(asked) if asked > 0 else None
        results = closed_form_response.response(model, request.method, fit_range, shape, request.outputs)
    return finite_results(
        results, path=True, gaps=BUILT_IN["frequency_response"].gaps, infinite=("peak_amplitude", "fit_range")
    )


def _exact(model: PiecewiseLinearOscillator, request: Request) -> dict[str, Array]:
    """The requested results of the method ``exact``; the outcome is the worse one of both directions."""
    rising, place = np.unique(np.asarray(model.omega), return_inverse=True)
    integrals = not exact_response.INTEGRALS.isdisjoint(request.outputs)
    motions = exact_response.sweeps(replace(model, omega=rising), **request.options, integrals=integrals)
    outcome = jnp.max(motions["outcome"], axis=1)
    special = not _SPECIAL.isdisjoint(request.outputs)
    if special or any(name.startswith("branch_") for name in request.outputs):
        results, complete = _exact_branch(model, rising, motions, special)
        motions |= results
        outcome = jnp.where(~complete & (outcome == Outcome.SUCCESS), Outcome.TOLERANCE_NOT_MET, outcome)
    results = {name: motions[name][place] for name in request.outputs}
    return results | {"outcome": outcome[place].astype(jnp.int8)}


def _exact_branch(
    model: PiecewiseLinearOscillator, rising: np.ndarray, motions: dict[str, Array], special: bool
) -> tuple[dict[str, Array], Array]:
    """The branch through the first motion of period one of the sweep up, and flags of the frequencies where it is
    complete."""
    shape = exact_response.batch_shape(model)
    lanes = int(np.prod(shape, dtype=int))
    single = motions["period_multiple"][:, 0].reshape(-1, lanes) == 1
    first = jnp.argmax(single, axis=0)
    state = motions["orbit_state"][:, 0].reshape(-1, 2, lanes)
    state = jnp.take_along_axis(state, first[None, None], axis=0)[0]
    x = jnp.concatenate([state, jnp.asarray(rising)[first][None]])
    x = jnp.where(jnp.any(single, axis=0), x, jnp.nan)
    results, complete = exact_response.branch(model, rising, x, special=special, width=exact_response.WIDTH)
    results = {name: value.reshape(*value.shape[:2], *shape) for name, value in results.items()}
    return results, complete.reshape(-1, *shape)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    build = system.models["frequency_response"].build
    return (Solver(request.method, partial(_solve, build, request), seconds=1e-3, chunk=_CHUNK),)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The branches of forced orbits, if the model of ``system`` has such."""
    if system.models["frequency_response"].returns is not ForcedModel:
        return {}
    variables = _branch_variables(system)
    return {
        "variables": variables,
        "default_outputs": tuple(v.name for v in variables),
        "methods": {"continuation": ("rtol",)},
        "method_titles": {"continuation": "branches of periodic orbits by arc length"},
        "options": (RTOL,),
        "patience": "",
        "solvers": _branch_solvers,
        "dimensions": _branch_dimensions,
    }


ANALYSIS = Analysis(
    name="frequency_response",
    title="frequency response",
    variables=VARIABLES,
    default_outputs=("u_max", "u_min", "u_rms", "phase", "regime", "stability"),
    methods=METHODS,
    method_titles={
        "exact": "exact motion from impact to impact, followed along the path",
        "harmonic_balance": "a chosen number of harmonics",
        "multiple_scales": "closed form for a cubic spring, as published; also called averaging",
        "describing_function": "bias and fundamental alone",
    },
    aliases={"averaging": "multiple_scales"},
    options=OPTIONS,
    patience="most_periods",
    solvers=_solvers,
    dimensions=_dimensions,
    path_axis=lambda system, _: system.role("speed"),
    of_system=_of_system,
)
