"""States of a flow at requested times by diffrax, with errors from a second run."""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import count
from drivetrain_jax.analysis._base import Request
from drivetrain_jax.analysis.numerics.lanes import moved_in_time
from drivetrain_jax.systems import Flow

NUM = count("num", "number of equally spaced times from 0 to stop", default=1001, lower=2, upper=1e7)

# Tolerance of the steps over rtol, ratio of the coarser run, and tightest tolerance. Tight, because errors of steps
# accumulate over the memory of the damped motion.
_SHARPNESS, _COARSER, _SHARPEST = 0.01, 10.0, 1e-15
# Ratio of the longest steps of the accurate run to those of the coarser run, which are one segment at first: with one step,
# or two, per segment both runs could agree and show no error. Every further attempt shortens both by this ratio.
_PART = 1 / 3
# Further attempts: fraction of rtol as next target, tightest tolerance, number of attempts.
_RESERVE, _SHARPEST_AGAIN, _MOST_ATTEMPTS = 0.3, 1e-14, 3
# Most steps of one segment (at most a strobe).
_MAX_SEGMENT = 4096
# Most strobes and steps of a history of up to a second, or for each second of it, and of any history: 2e5 strobes take a
# minute on one core. At 3000 Hz the driveshaft takes 3e3 strobes and 5e4 steps in a second; solvers of order 5 take up to
# 20 times as many.
_STROBES, _MAX_STROBES = 200_000, 2_000_000
_STEPS, _MAX_STEPS = {"Dopri8": 1_000_000}, 20_000_000
# Least number of steps for each requested time; fraction of the most steps above which a run is not repeated.
_STEPS_TO_TIME, _REPEATABLE = 100, 0.1


class _Place(NamedTuple):
    """State of the integration: time ``(strobe + fraction) * period``, state, largest component at the end of a segment so
    far, number of steps, and a flag of success."""

    strobe: Array
    fraction: Array
    y: Array
    reached: Array
    steps: Array
    healthy: Array


class History(NamedTuple):
    """States (T, n) by ``steps`` of ``tolerance``, their estimated ``error``, and the ratio ``excess`` of the largest error
    to the allowed error."""

    tolerance: Array
    states: Array
    error: Array
    excess: Array
    healthy: Array
    attempts: Array
    steps: Array


class Limits(NamedTuple):
    """Most strobes and most steps of a run over a whole history."""

    strobes: float
    steps: float


def limits_of(request: Request) -> Limits:
    """The limits of the requested history."""
    times = requested_times(request)
    seconds = max(1.0, times[-1])
    steps = max(_STEPS.get(request.options["solver"], _MAX_STEPS) * seconds, _STEPS_TO_TIME * len(times))
    return Limits(min(_STROBES * seconds, _MAX_STROBES), min(steps, _MAX_STEPS))


def requested_times(request: Request) -> tuple[float, ...]:
    """The times of the options: ``times``, or ``num`` equally spaced times from 0 to ``stop``, ends included.

    Raises :class:`InputError` if both or neither are given, or if ``times`` does not rise.
    """
    times, stop, num = (request.options[name] for name in ("times", "stop", "num"))
    if times and stop:
        raise InputError(f"options.stop = {stop:g}: given together with times; expected one of the two")
    if times and num != NUM.default:
        raise InputError(f"options.num = {num}: given together with times; expected one of the two")
    if not times and not stop:
        raise InputError("options.times: missing; expected times, or stop and num")
    if times and (np.diff(times) <= 0).any():
        raise InputError("options.times: expected rising times")
    return tuple(times) if times else tuple(np.linspace(0.0, stop, num).tolist())


def size_of(flow: Flow) -> Array:
    """Estimated size of a component of the motion: the initial state plus its change within a radian."""
    start = _start(flow)
    rate = flow.vector(0, 0.0, start)
    fastest = 2 * np.pi / flow.period if flow.fastest is None else flow.fastest
    return jnp.max(jnp.abs(start)) + jnp.max(jnp.abs(rate)) / fastest


def _start(flow: Flow) -> Array:
    return jnp.stack([jnp.asarray(x, float) for x in flow.start])


def has_finite_start(flow: Flow) -> Array:
    """True if the field is finite at the start."""
    start = _start(flow)
    return jnp.all(jnp.isfinite(start)) & jnp.all(jnp.isfinite(flow.vector(0, 0.0, start)))


def _segment(
    flow: Flow, solver: diffrax.AbstractSolver, tolerance: Any, part: Any, place: _Place, end: Array
) -> tuple[Array, Array, Array]:
    """State at the fraction ``end`` of the strobe, number of steps, and a flag of success."""
    atol = jnp.maximum(tolerance * size_of(flow), 1e-300)
    longest = part * (end - place.fraction)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda s, y, _: flow.period * flow.vector(place.strobe, s, y)), solver, place.fraction, end, None,
        place.y, stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=atol, dtmax=longest),
        saveat=diffrax.SaveAt(t1=True), adjoint=diffrax.ForwardMode(), max_steps=_MAX_SEGMENT, throw=False,
    )  # fmt: skip
    well = solution.result == diffrax.RESULTS.successful
    return solution.ys[0], solution.stats["num_steps"], well  # pyright: ignore[reportOptionalSubscript]


def _ahead(place: _Place, target: tuple[Array, Array]) -> Array:
    """True if the place is before the target."""
    strobe, fraction = target
    return place.healthy & ((place.strobe < strobe) | (place.fraction < fraction))


def trajectory(
    flow: Flow,
    times: Array,
    tolerance: Any,
    part: Any,
    solver: diffrax.AbstractSolver,
    limits: Limits,
    begins: Any = True,
) -> tuple[Array, Array, Array, Array]:
    """States at the rising ``times``, shape ``(len(times), n)``, the largest component, a flag of success, and the steps.

    States after a failure, beyond the limits or without ``begins`` are NaN. ``tolerance`` bounds the error of a step
    relative to the state and to :func:`size_of`; ``part`` its length relative to its segment, which is at most a strobe.
    """
    turns = times / flow.period
    few = turns[-1] <= limits.strobes
    strobes = jnp.where(few, jnp.floor(turns), 0.0).astype(jnp.int64)

    def advance(place: _Place, target: tuple[Array, Array]) -> _Place:
        strobe, fraction = target
        last = place.strobe == strobe
        # In a batch the loop runs until the last lane is done: finished or failed lanes integrate over an empty span.
        end = jnp.where(_ahead(place, target), jnp.where(last, fraction, 1.0), place.fraction)
        y, steps, well = _segment(flow, solver, tolerance, part, place, end)
        total = place.steps + steps
        healthy = place.healthy & well & (total <= limits.steps) & jnp.all(jnp.isfinite(y))
        y = jnp.where(healthy, y, place.y)
        reached = jnp.maximum(place.reached, jnp.max(jnp.abs(y)))
        strobe, fraction = jnp.where(last, strobe, place.strobe + 1), jnp.where(last, fraction, 0.0)
        return _Place(strobe, fraction, y, reached, total, healthy)

    def to(place: _Place, target: tuple[Array, Array]) -> tuple[_Place, Array]:
        place = jax.lax.while_loop(lambda p: _ahead(p, target), lambda p: advance(p, target), place)
        strobe, fraction = target
        rate = flow.period * flow.vector(strobe, fraction, place.y)
        y = moved_in_time(place.y, rate, fraction - place.fraction)
        return place, jnp.where(place.healthy, y, jnp.nan)

    start = _start(flow)
    healthy = begins & has_finite_start(flow) & few
    rest = _Place(jnp.int64(0), jnp.zeros(()), start, jnp.max(jnp.abs(start)), jnp.int64(0), healthy)
    place, states = jax.lax.scan(to, rest, (strobes, turns - strobes))
    return states, place.reached, place.healthy, place.steps


def _twice(flow: Flow, times: Array, tolerance: Array, attempts: Array, request: Request) -> History:
    """The states at ``times``, and as their error the difference from a run at ``_COARSER`` times the tolerance."""
    solver, limits = getattr(diffrax, request.options["solver"])(), limits_of(request)
    settings = tolerance * jnp.array([1.0, _COARSER]), _PART**attempts * jnp.array([_PART, 1.0])

    def run(begins: Array, setting: tuple[Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        states, reached, healthy, steps = trajectory(flow, times, *setting, solver, limits, begins)
        some = jnp.any(jnp.isfinite(states[:, 0]) & (times > 0))
        return healthy | some, (states, reached, healthy, steps)

    # Both runs in one loop, so that they are compiled once. Without a value there is no error either.
    _, (runs, reached, healthy, steps) = jax.lax.scan(run, jnp.bool_(True), settings)
    error = jnp.abs(runs[0] - runs[1])
    largest = jnp.max(error)
    excess = jnp.where(largest == 0, 0.0, largest / (request.options["rtol"] * reached[0]))
    return History(tolerance, runs[0], error, excess, healthy[0], attempts + jnp.int8(1), steps[0])


def integrated(flow: Flow, request: Request) -> History:
    """States and errors at the requested times, from tighter runs if the first ones miss ``rtol``."""
    times = jnp.asarray(requested_times(request))
    limits = limits_of(request)

    def sharper(history: History) -> Array:
        return history.tolerance * _RESERVE / history.excess

    def missed(history: History) -> Array:
        hopeful = (history.excess > 1) & (sharper(history) >= _SHARPEST_AGAIN) & (history.attempts < _MOST_ATTEMPTS)
        hopeful &= history.steps <= _REPEATABLE * limits.steps
        return (history.attempts == 0) | (history.healthy & hopeful)

    def attempt(history: History) -> History:
        first = history.attempts == 0
        tolerance = jnp.where(missed(history) & ~first, sharper(history), history.tolerance)
        new = _twice(flow, times, tolerance, history.attempts, request)
        better = first | (new.excess < history.excess)
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, history)
        return kept._replace(attempts=new.attempts)

    nothing = jnp.full((len(times), flow.size), jnp.nan)
    tolerance = jnp.asarray(max(_SHARPNESS * request.options["rtol"], _SHARPEST))
    start = History(tolerance, nothing, nothing, jnp.asarray(jnp.nan), jnp.bool_(False), jnp.int8(0), jnp.int64(0))
    return jax.lax.while_loop(missed, attempt, start)
