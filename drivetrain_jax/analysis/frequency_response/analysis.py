"""Frequency response: motions along the frequency or the speed of the drive.

A system with forced periodic orbits has the branches of these orbits (:mod:`.orbit_branches`). The rest is about an
oscillator with play: motions found by slow sweeps of the drive's frequency, up and down.

The speed of the system is the path: a line of frequencies is computed as a whole. A sweep starts from rest at the lowest
(up) or highest (down) frequency and stays on its branch until this ends or becomes unstable; then it jumps to the motion
that follows in time. Methods: the exact solution, harmonic balance (a chosen number of harmonics), multiple scales (the
paper's closed form for a cubic spring) and the describing function (bias and fundamental). ``residual`` is the rms residual
of the equation of motion.

Outcome: the worse one of both directions. Results of the other direction are kept. Approximate methods end as ``NOT_FINITE``
where a frequency, a rate or a ratio of their numbers is beyond 1e70 or, if not 0, below 1e-70: their powers would overflow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, reduce
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax._rules import BUILT_IN
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver, finite_results
from drivetrain_jax.analysis.frequency_response import closed_form_response, harmonic_response, orbit_branches
from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis
from drivetrain_jax.analysis.impacts import exact_response
from drivetrain_jax.analysis.impacts.motion import (
    ABSENT,
    PHASE,
    REGIME,
    REGIMES,
    STABILITY,
    from_scaled_length,
    to_scaled_length,
)
from drivetrain_jax.systems import ForcedModel, PiecewiseLinearOscillator, System

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
    Parameter(
        "most_periods",
        "1",
        "largest number of drive periods until a motion settles",
        default=1000,
        lower=32,
        upper=1e6,
        integer=True,
    ),
    Parameter("harmonics", "1", "harmonics of the drive's frequency", default=15, lower=1, upper=200, integer=True),
    Parameter("subharmonic", "1", "order of the subharmonics kept", default=1, lower=1, upper=8, integer=True),
    Parameter(
        "samples",
        "1",
        "samples per period of the drive, 0: by the harmonics",
        default=0,
        lower=0,
        upper=1e5,
        integer=True,
    ),
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
# Largest number, in units of length of the motions and of seconds, and inverse of the smallest: fourth powers are finite.
_LARGE = 1e70
# Lines of a chunk: for a map of 200 lines, equally many for two cores.
_CHUNK = 50


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Directions, branches and folds; ``InputError`` for a result that the method does not provide, or too few samples."""
    for name in request.outputs:
        if request.method not in _ONLY.get(name, (request.method,)):
            methods = ", ".join(_ONLY[name])
            raise InputError(f"outputs: method {request.method} does not give {name}; allowed for it is {methods}")
    PiecewiseLinearOscillator.check_method(fixed.get("damping") != "contact", request.method)
    for name in () if fixed.get("unbalance") is None else _OF_ONE_DRIVE.intersection(request.outputs):
        if request.method != "exact":
            raise InputError(
                f"outputs: {request.method} gives {name} for a drive of one amplitude; "
                f"allowed with an unbalance are the other results, or the method exact for fold_frequency"
            )
    samples, harmonics = (request.options.get(name, 0) for name in ("samples", "harmonics"))
    if 0 < samples <= 2 * harmonics:
        allowed = f"0 (by the harmonics) or at least {2 * harmonics + 1}, which tell {harmonics} harmonics apart"
        raise InputError(f"options.samples = {samples}: allowed is {allowed}")
    branches = closed_form_response.BRANCHES.get(request.method, harmonic_response.BRANCHES)
    folds = exact_response.SPECIAL if request.method == "exact" else closed_form_response.FOLDS
    return (
        Dimension("sweep_direction", "direction of the sweep", ("up", "down")),
        Dimension("branch", "number of the motion, by rising amplitude", tuple(range(1, branches + 1))),
        Dimension("fold", "number of the fold", tuple(range(1, folds + 1))),
        Dimension("doubling", "number of the period doubling", tuple(range(1, exact_response.SPECIAL + 1))),
    )


def _shape(model: PiecewiseLinearOscillator) -> tuple[int, ...]:
    """Shape of the batch: of all fields but the frequency."""
    fields = (model.damping, model.stiffness, model.alpha, model.b, model.B0, model.B1, model.unbalance)
    return jnp.broadcast_shapes(*(jnp.shape(field) for field in fields))


def _solve(
    build: Callable[..., PiecewiseLinearOscillator], request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    """A line; ``effort`` only orders the batches."""
    model, unit = to_scaled_length(build(values))
    model.check_method(model.damps_play, request.method)
    options, shape = request.options, _shape(model)
    if request.method == "exact":
        results = _exact(model, request)
    elif request.method == "harmonic_balance":
        basis = Basis(options["harmonics"], options["subharmonic"], options["samples"])
        results = harmonic_response.response(model, basis, shape, request.outputs)
    else:
        given = options.get("fit_range", 0.0)
        fit_range = given / unit if given > 0 else None
        results = closed_form_response.response(model, request.method, fit_range, shape, request.outputs)
    results = from_scaled_length(results, unit)
    if request.method != "exact":
        results |= {"outcome": jnp.where(_in_range(model), results["outcome"], Outcome.NOT_FINITE).astype(jnp.int8)}
        results |= _without(results["outcome"] == Outcome.NOT_FINITE, results)
    return finite_results(
        results, path=True, gaps=BUILT_IN["frequency_response"].gaps, infinite=("peak_amplitude", "fit_range")
    )


def _in_range(model: PiecewiseLinearOscillator) -> Array:
    """True for frequencies and lanes in which no product of the closed forms overflows or underflows, ``(L, ...)``."""
    omega = jnp.asarray(model.omega).reshape(-1, *(1,) * len(_shape(model)))
    drive = model.amplitude(omega) / model.stiffness
    numbers = omega, model.damping, jnp.sqrt(model.stiffness), model.alpha, model.B0 / model.stiffness, drive
    sizes = [jnp.abs(jnp.asarray(x, float)) for x in numbers]
    return reduce(jnp.logical_and, [(x == 0) | ((x >= 1 / _LARGE) & (x <= _LARGE)) for x in sizes])


def _without(lost: Array, results: Mapping[str, Array]) -> dict[str, Array]:
    """``results`` with NaN, or ``ABSENT`` for stabilities, at the frequencies that are ``lost`` ``(L, ...)``."""

    def kept(x: Array, nothing: Any) -> Array:
        return jnp.where(jnp.expand_dims(lost, tuple(range(1, 1 + x.ndim - lost.ndim))), nothing, x).astype(x.dtype)

    found = {name: kept(x, jnp.nan) for name, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact)}
    return found | {name: kept(x, ABSENT) for name, x in results.items() if name.endswith("stability")}


def _exact(model: PiecewiseLinearOscillator, request: Request) -> dict[str, Array]:
    """The frequencies in rising order, and indices back to the path."""
    rising, place = np.unique(np.asarray(model.omega), return_inverse=True)
    found = exact_response.sweeps(
        replace(model, omega=rising),
        most_periods=request.options["most_periods"],
        rtol=request.options["rtol"],
        integrals=not exact_response.INTEGRALS.isdisjoint(request.outputs),
    )
    outcome = exact_response.worst(found["outcome"])
    special = not _SPECIAL.isdisjoint(request.outputs)
    if special or any(name.startswith("branch_") for name in request.outputs):
        results, complete = _exact_branch(model, rising, found, special)
        found |= results
        outcome = jnp.where(~complete & (outcome == Outcome.SUCCESS), Outcome.TOLERANCE_NOT_MET, outcome)
    results = {name: found[name][place] for name in request.outputs}
    return results | {"outcome": outcome[place].astype(jnp.int8)}


def _exact_branch(
    model: PiecewiseLinearOscillator, rising: np.ndarray, found: dict[str, Array], special: bool
) -> tuple[dict[str, Array], Array]:
    """The branch through the first motion of period one of the sweep up, and flags of the frequencies where it is
    complete."""
    shape = _shape(model)
    lanes = int(np.prod(shape, dtype=int))
    single = found["period_multiple"][:, 0].reshape(-1, lanes) == 1
    first = jnp.argmax(single, axis=0)
    state = found["orbit_state"][:, 0].reshape(-1, 2, lanes)
    state = jnp.take_along_axis(state, first[None, None], axis=0)[0]
    x = jnp.concatenate([state, jnp.asarray(rising)[first][None]])
    x = jnp.where(jnp.any(single, axis=0), x, jnp.nan)
    results, complete = exact_response.branch(model, rising, x, special=special, width=exact_response.WIDTH)
    return {name: value.reshape(*value.shape[:2], *shape) for name, value in results.items()}, complete.reshape(
        -1, *shape
    )


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    build = system.models["frequency_response"].build
    return (Solver(request.method, partial(_solve, build, request), seconds=1e-3, chunk=_CHUNK),)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The branches of forced orbits, if the model of ``system`` has such."""
    if system.models["frequency_response"].returns is not ForcedModel:
        return {}
    variables = orbit_branches.variables(system)
    return {
        "variables": variables,
        "default_outputs": tuple(v.name for v in variables),
        "methods": {"continuation": ("rtol",)},
        "method_titles": {"continuation": "branches of periodic orbits by arc length"},
        "options": (RTOL,),
        "patience": "",
        "solvers": orbit_branches.solvers,
        "dimensions": orbit_branches.dimensions,
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
