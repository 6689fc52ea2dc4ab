"""From initial conditions to attractors of a piecewise linear oscillator, many points at a time.

A *job* is a sequence of points: a single point for a steady state, a line of drive frequencies for an up or down sweep.
Each point starts from the state at which the previous point ended. ``width`` lanes process the queue of jobs, each at its
own pace, so a lane that settles slowly, or never, does not delay the others.

A lane settles period by period and from time to time tries Newton shooting from its state: ``z <- z + (1 - M)^-1 (F^m(z) -
z)``, where M is the exact transition matrix over m periods and the motion nearly recurs after m periods. An orbit is
accepted as the attractor under two conditions: all its multipliers lie inside the unit circle, and the motion, continued
from the start of the search, approaches the orbit (:mod:`~drivetrain_jax.analysis.impacts.attractor_lanes`).
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.attractor_lanes import (
    MOST_PERIODS,
    Lane,
    Orbit,
    approach,
    attracts,
    blank,
    candidates,
    confirm,
    enter,
    is_slow,
    linearisation_holds,
    reach,
    record,
    restart,
    resume,
    search,
    select,
    settle,
    try_line,
)
from drivetrain_jax.analysis.impacts.motion import Matrix, log_determinant, newton_correction
from drivetrain_jax.analysis.impacts.piecewise_march import (
    FEW,
    Lanes,
    Motion,
    allowed_steps,
    few_steps,
    locate,
    prepare,
    stays,
)
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Newton: most corrections, relative size of the last correction, and size below which corrections may stall by rounding.
_CORRECTIONS, _CONVERGED, _ROUNDING = 12, 1e-11, 1e-7
# Largest ratio of successive corrections: 2/3 at worst near an orbit whose period is about to double.
_SHRINKING = 0.75
# A search fails at this multiple of the usual velocity, or of the steps for settling.
_ASTRAY, _COSTLY = 3.0, 4
# Most steps of a point, searches included, and more for each of ``most_periods``. Of 64 points with drives down to 1e-3 of
# the natural frequency and damping down to 1e-4, 62 need at most 5e5, and the others do not repeat within 2e6.
_BUDGET, _PER_PERIOD = 4e5, 100
_EPS = np.finfo(float).eps
# Rounding of a period over that of the states at its steps.
_GROWTH = 64


class Attractors(NamedTuple):
    """The attractor of each point, every field of shape ``(points,)``.

    ``u, v``: state at the start of a drive period; ``multiple``: number of periods m after which the state recurs (0 if not
    within 32); ``matrix``: transition matrix over m periods; ``error``: estimated absolute error of u; ``periods``: drive
    periods run; ``exponent``: Lyapunov exponent per unit of time, meaningful if ``multiple`` is 0; ``stalled``: 1 if the
    motion was stopped because of its number of steps (it is not measured), 2 because it is not finite, else 0.
    """

    u: Array
    v: Array
    multiple: Array
    matrix: Matrix
    error: Array
    periods: Array
    exponent: Array
    stalled: Array


_RESULT = Attractors(0, 0, 0, (0, 0, 0, 0), 0, 0, 0, 0)  # pyright: ignore[reportArgumentType]


def averaged(periods: Any) -> Any:
    """Number of last periods over which the growth of a tangent is averaged."""
    return periods - periods // 4


def take(oscillator: PiecewiseLinearOscillator, index: Array) -> PiecewiseLinearOscillator:
    """The oscillators at the positions ``index``; fields common to all stay scalars."""
    chosen = {f.name: getattr(oscillator, f.name) for f in fields(oscillator)}
    return replace(oscillator, **{name: x[index] if jnp.ndim(x) else x for name, x in chosen.items()})


class _Verdict(NamedTuple):
    """Outcome of a correction: lanes that found an attracting orbit, lanes that approach it slowly, the orbit, and
    failed lanes."""

    found: Array
    slow: Array
    orbit: Orbit
    failed: Array


def _speed(local: PiecewiseLinearOscillator, u: Array, v: Array) -> Array:
    """The velocity that corresponds to the energy of a state in contact, within a factor of two."""
    return jnp.abs(v) + jnp.sqrt(local.stiffness) * jnp.maximum(jnp.abs(u) - local.b, 0.0)


def _usual_speed(local: PiecewiseLinearOscillator) -> Array:
    drive = jnp.abs(local.B0) + jnp.abs(local.B1)
    return local.omega * local.b + drive * (1 / local.omega + 1 / jnp.sqrt(local.stiffness))


def _shoot(
    lane: Lane, now: Array, local: PiecewiseLinearOscillator, lanes: Lanes, omega: Array
) -> tuple[Lane, _Verdict]:
    """One Newton correction in the lanes ``now``, and its outcome."""
    motion, (u, v) = lane.motion, lane.guess
    first = select(lane.corrections == 0, (motion.u, motion.v), lane.first)
    du, dv = newton_correction(motion.matrix, motion.u - u, motion.v - v)
    guess = (u + du, v + dv)
    change = jnp.abs(du) + jnp.abs(dv) / omega
    rounding = _rounding(lanes, motion, guess, omega)
    size = reach(*guess, local.b, omega)
    stuck = (change <= _ROUNDING * size + 64 * _EPS * jnp.abs(guess[0])) & (change > lane.change / 2)
    converged = (change <= _CONVERGED * size) | stuck
    astray = ~(_speed(local, *guess) <= _ASTRAY * (_speed(local, *lane.latest) + _usual_speed(local)))
    going = now & ~converged & (lane.corrections < _CORRECTIONS) & ~astray & (change <= _SHRINKING * lane.change)
    contraction = log_determinant(local, motion.matrix, lane.multiple * 2 * np.pi / omega)
    # At the limit of rounding, what is left may be as large as the last change and more.
    orbit = Orbit(*guess, motion.matrix, contraction, 2 * change + rounding)
    stable = now & converged & attracts(orbit)
    slow = (
        stable & is_slow(orbit, lane.latest, omega) & ~linearisation_holds(orbit, lane.latest, first, local.b, omega)[0]
    )
    corrected = lane._replace(
        guess=guess, first=first, change=change, corrections=lane.corrections + now.astype(jnp.int32)
    )
    lane = restart(select(going, corrected, lane), going, *guess, lane.multiple)
    return lane, _Verdict(stable & ~slow, slow, orbit, now & ~going & ~stable)


def _rounding(lanes: Lanes, motion: Motion, state: tuple[Array, Array], omega: Array) -> Array:
    """Effect on the u of an orbit of rounding the motion over its period.

    Rounding may grow within the period, which is not followed: with 32 in place of `_GROWTH`, the estimate was 7 % too small
    at one of 200,000 random orbits.
    """
    by_u, by_v = (newton_correction(motion.matrix, 1.0 - k + 0 * motion.u, k * omega)[0] for k in (0.0, 1.0))
    inverse = jnp.abs(by_u) + jnp.abs(by_v)
    size = jnp.abs(state[0]) + jnp.abs(state[1]) / omega
    rounding = _GROWTH * size * jnp.sqrt(motion.steps.astype(float)) + 2 * _taken_off(lanes, motion)
    return _EPS * rounding * (1 + inverse)


def _taken_off(lanes: Lanes, motion: Motion) -> Array:
    """Largest harmonic response that steps subtract from the displacement, which limits their accuracy."""
    here = locate(lanes, motion.u)
    own, contact, gap = (jnp.hypot(piece.cosine, piece.sine) for piece in (here.region, lanes.contact, lanes.gap))
    return jnp.where(stays(lanes, here, motion), own, jnp.maximum(contact, gap))


class _Work(NamedTuple):
    """The lanes, their latest states, the number of the next job, and the results so far, one row per field."""

    lane: Lane
    history: Array
    queue: Array
    store: Array


class _Task(NamedTuple):
    """The input: the points ``visits`` of all jobs in turn, ``length`` per job, and the initial states ``origin``."""

    oscillator: PiecewiseLinearOscillator
    visits: Array
    length: int
    origin: tuple[Array, Array]
    most_periods: int


def attractors(
    oscillator: PiecewiseLinearOscillator, route: Array, u0: Array, v0: Array, *, most_periods: int, width: int
) -> Attractors:
    """Attractors reached at the points of every job.

    ``oscillator`` holds scalars or arrays over all points. ``route``, shape ``(jobs, length)``, lists the points of each
    job in order; ``u0, v0``, shape ``(jobs,)``, are the initial states of the jobs. Each later point starts from the final
    state of the previous one. Results have the shape ``(jobs, length)``.
    """
    jobs, length = route.shape
    width = min(width, jobs)
    total = jobs * length
    task = _Task(oscillator, route.reshape(total), length, (u0, v0), most_periods)
    # One array for all results: several parallel scatters make XLA's CPU compiler abort (jax 0.10.2).
    store = jnp.zeros((len(jax.tree.leaves(_RESULT)), total))
    numbers = jnp.arange(width, dtype=jnp.int32)
    lane = enter(blank(width), numbers >= 0, numbers, 0 * numbers, u0[:width], v0[:width], 0 * numbers + 1)
    history = record(jnp.zeros((MOST_PERIODS + 1, 2 * width)), lane.searching, lane)
    work = _Work(lane, history, jnp.asarray(width, jnp.int32), store)
    work = jax.lax.while_loop(lambda work: jnp.any(work.lane.job < jobs), lambda work: _tick(task, work), work)
    rows = jax.tree.unflatten(jax.tree.structure(_RESULT), list(work.store.reshape(-1, jobs, length)))
    return rows._replace(**{name: getattr(rows, name).astype(jnp.int32) for name in ("multiple", "periods", "stalled")})


def _tick(task: _Task, work: _Work) -> _Work:
    """Advance all lanes by a few steps; lanes at the end of a period or of a search continue with the next task."""
    lane, history = work.lane, work.history
    total = task.visits.size
    working = lane.job < total // task.length
    place = jnp.where(working, lane.job, 0) * task.length + lane.place
    local = take(task.oscillator, task.visits[place])
    lanes = prepare(local)
    omega = lanes.omega + jnp.zeros(place.shape)
    lane = lane._replace(motion=few_steps(lanes, lane.motion), spent=lane.spent + FEW)
    broken = ~jnp.isfinite(lane.motion.u) | (lane.motion.steps > _most_steps(lane, lanes))
    broken |= lane.spent > _BUDGET + _PER_PERIOD * task.most_periods
    ready = working & ((lane.motion.left <= 0) | broken)
    shot, probed = (ready & lane.searching & ~broken & (on == (lane.probing >= 0)) for on in (False, True))
    after, verdict = _shoot(lane, shot, local, lanes, omega)
    settles = ready & ~lane.searching & ~broken
    after = settle(after, settles, task.most_periods - averaged(task.most_periods), omega)
    after, reached = confirm(after, settles, history, local.b, omega)
    history = record(history, settles, after)
    first, second = candidates(after, history, omega)
    after = search(after, settles & (after.held == 0) & (after.count >= after.due), first, second)
    after = approach(after, verdict.found, verdict.orbit)
    after, through, left = try_line(after, probed | verdict.slow, verdict.orbit, omega)
    reached |= through
    after = resume(after, verdict.failed | left | (ready & lane.searching & broken))
    stalled = ready & ~lane.searching & broken
    done = reached | stalled | (settles & (after.count >= task.most_periods))
    result = _result(after, reached, stalled, averaged(task.most_periods) * 2 * np.pi / omega)
    rows = jnp.stack(jax.tree.leaves(result)).astype(float)
    store = work.store.at[:, jnp.where(done, place, total)].set(rows, mode="drop")
    lane, queue = _proceed(after, done, result, work.queue, task)
    return _Work(lane, record(history, done, lane), queue, store)


def _most_steps(lane: Lane, lanes: Lanes) -> Array:
    """Steps after which a lane is stopped, because it moves from event to event without progress."""
    searching = lane.searching & (lane.count > 0)
    return lane.multiple * jnp.where(searching, _COSTLY * lane.cost + 500, allowed_steps(lanes))


def _result(lane: Lane, reached: Array, stalled: Array, span: Array) -> Attractors:
    """The result of a finished lane; ``span`` is the time over which the tangent of an unsettled lane has grown."""
    orbit = lane.orbit
    return Attractors(
        u=jnp.where(reached, orbit.u, lane.latest[0]),
        v=jnp.where(reached, orbit.v, lane.latest[1]),
        multiple=jnp.where(reached, lane.multiple, 0),
        matrix=orbit.matrix,
        error=jnp.where(reached, orbit.error, jnp.nan),
        periods=lane.count,
        exponent=lane.growth / span,
        stalled=jnp.where(stalled, jnp.where(jnp.isfinite(lane.motion.u), 1, 2), 0),
    )


def _proceed(lane: Lane, done: Array, result: Attractors, queue: Array, task: _Task) -> tuple[Lane, Array]:
    """Finished lanes continue with the next point of their job or, at its end, the next job of the queue."""
    origin = task.origin
    jobs = origin[0].size
    last = done & (lane.place == task.length - 1)
    fresh = queue + jnp.cumsum(last.astype(jnp.int32)) - 1
    job = jnp.where(last, fresh, lane.job)
    place = jnp.where(last, 0, lane.place + 1).astype(jnp.int32)
    index = jnp.minimum(job, jobs - 1)
    finite = jnp.isfinite(result.u) & ~last
    u = jnp.where(finite, result.u, origin[0][index])
    v = jnp.where(finite, result.v, origin[1][index])
    hint = jnp.where(last | (result.multiple == 0), 1, result.multiple)
    return enter(lane, done, job, place, u, v, hint), queue + last.sum().astype(jnp.int32)
