"""From initial conditions to attractors of a piecewise linear oscillator, many points at a time.

A *job* is a sequence of points, each started where the last one ended: a single point for a steady state, a line of
drive frequencies for an up or down sweep. ``width`` lanes work through the queue of jobs, each at its own pace: a lane
that settles slowly, or never, holds up no other one.

A lane settles period by period and now and then tries Newton shooting from where it is: ``z <- z + (1 - M)^-1 (F^m(z) -
z)`` with the exact transition matrix M over m periods, m being a number after which the recent motion nearly recurs. An
orbit counts as the attractor only if all its multipliers lie inside the unit circle and the motion is already in its
linear neighbourhood: ``|F^m(z) - z* - M (z - z*)| <= 0.2 (1 - rho) |z - z*|``, rho the spectral radius.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.piecewise_march import Motion, few_steps, prepare, usual_steps
from drivetrain_jax.analysis.plane_map import Matrix, apply, newton_correction, spectral_radius
from drivetrain_jax.systems import PiecewiseLinearOscillator

MOST_PERIODS = 32
# Newton: largest number of corrections, relative size at which one is the last, and below which rounding may end it.
_CORRECTIONS, _CONVERGED, _ROUNDING = 8, 1e-11, 1e-7
# Remainder of the linearisation that is tolerated, as part of the contraction 1 - rho.
_REMAINDER = 0.2
# Recurrences that count as equally good; distance over size at which the motion has arrived.
_NEAR, _NARROW, _ARRIVED = 30.0, 1.5, 1e-9
# A search is a failure beyond so many times the usual velocity, or so many times the steps that settling takes.
_ASTRAY, _COSTLY = 3.0, 4
_EPS = np.finfo(float).eps
_ROWS = np.arange(MOST_PERIODS + 1, dtype=np.int32)[:, None]


class Attractors(NamedTuple):
    """What each point ended on, every field of shape ``(points,)``.

    ``u, v``: state at the start of a drive period; ``multiple``: number of periods m after which it recurs (0 if not
    within 32); ``matrix``: transition matrix over these; ``error``: estimated absolute error of u; ``periods``: drive
    periods run; ``exponent``: Lyapunov exponent per unit of time, meaningful if ``multiple`` is 0; ``stalled``: given
    up because of its number of steps or because it is not finite (1, else 0).
    """

    u: Array
    v: Array
    multiple: Array
    matrix: Matrix
    error: Array
    periods: Array
    exponent: Array
    stalled: Array


_RESULT = Attractors(0, 0, 0, (0, 0, 0, 0), 0, 0, 0, 0)


class _Lane(NamedTuple):
    """State of the lanes, each field ``(width, ...)``: job and place in it, the motion, and the search in progress."""

    job: Array
    place: Array
    motion: Motion
    count: Array  # periods settled
    due: Array  # periods after which the next search starts
    latest: tuple[Array, Array]  # state after these
    tangent: tuple[Array, Array]
    growth: Array  # logarithm of the growth of the tangent
    cost: Array  # most steps that a settled period has taken
    searching: Array
    multiple: Array
    corrections: Array
    second: Array  # candidate to try if this period multiple fails
    guess: tuple[Array, Array]
    first: tuple[Array, Array]  # F^m of the state the search started from
    change: Array  # size of the last correction


def _select(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def take(oscillator: PiecewiseLinearOscillator, index: Array) -> PiecewiseLinearOscillator:
    """The oscillators number ``index``; fields that are the same for all stay scalars."""
    chosen = {f.name: getattr(oscillator, f.name) for f in fields(oscillator)}
    return replace(oscillator, **{name: x[index] if jnp.ndim(x) else x for name, x in chosen.items()})


def _candidates(lane: _Lane, history: Array, omega: Array) -> tuple[Array, Array]:
    """Two guesses at the period multiple: the smallest m after which the motion recurs to within a factor of the best
    recurrence, for a generous factor and for a narrow one. Row ``n % 33`` of ``history``, shape ``(33, 2 width)``, has
    displacements and velocities after n periods."""
    u, v = lane.latest
    distance = jnp.abs(history[:, : u.size] - u) + jnp.abs(history[:, u.size :] - v) / omega
    age = (lane.count - _ROWS) % (MOST_PERIODS + 1)
    distance = jnp.where((age > 0) & (age <= lane.count), distance, jnp.inf)
    best = distance.min(axis=0)
    floor = 1e-13 * (jnp.abs(u) + jnp.abs(v) / omega)

    def smallest(factor: float) -> Array:
        recurs = distance <= factor * best + floor
        return jnp.where(recurs, age, MOST_PERIODS).min(axis=0).astype(jnp.int32)

    return smallest(_NEAR), smallest(_NARROW)


def _record(history: Array, now: Array, lane: _Lane) -> Array:
    """``history`` with the latest state in the lanes ``now``."""
    row = jnp.where(now, lane.count % (MOST_PERIODS + 1), -1)
    return jnp.where(jnp.concatenate([row, row]) == _ROWS, jnp.concatenate(lane.latest), history)


def _restart(lane: _Lane, going: Array, u: Array, v: Array, periods: Array) -> _Lane:
    """Lanes ``going`` start anew at the beginning of a period from ``(u, v)``."""
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    count = jnp.zeros(u.shape, jnp.int32)
    fresh = Motion(zero, one, zero, u, v, (one, zero, zero, one), jnp.broadcast_to(periods, u.shape) + count, count)
    return lane._replace(motion=_select(going, fresh, lane.motion))


def _settle(lane: _Lane, now: Array, forget: int, omega: Array) -> _Lane:
    """One more period settled in the lanes ``now``; at the period number ``forget`` the growth is counted anew."""
    motion = lane.motion
    count = lane.count + 1
    tangent = apply(motion.matrix, *lane.tangent)
    size = jnp.abs(tangent[0]) + jnp.abs(tangent[1]) / omega
    settled = lane._replace(
        count=count,
        latest=(motion.u, motion.v),
        tangent=(tangent[0] / size, tangent[1] / size),
        growth=jnp.where(count == forget, 0.0, lane.growth + jnp.log(size)),
        cost=jnp.maximum(lane.cost, motion.steps),
    )
    return _restart(_select(now, settled, lane), now, motion.u, motion.v, 1)


def _search(lane: _Lane, now: Array, multiple: Array, second: Array) -> _Lane:
    """Start Newton shooting from the latest state in the lanes ``now``, for this period multiple."""
    begun = lane._replace(
        searching=jnp.ones_like(now),
        multiple=multiple,
        second=second,
        corrections=jnp.zeros_like(lane.corrections),
        guess=lane.latest,
        change=jnp.full_like(lane.change, jnp.inf),
    )
    return _restart(_select(now, begun, lane), now, *lane.latest, multiple)


class _Verdict(NamedTuple):
    """Outcome of a correction: lanes whose search has found the attractor or has failed, and the error of u."""

    found: Array
    failed: Array
    error: Array


def _speed(local: PiecewiseLinearOscillator, u: Array, v: Array) -> Array:
    """The velocity that the energy of a state in contact is worth, to within a factor of two."""
    return jnp.abs(v) + jnp.sqrt(local.stiffness) * jnp.maximum(jnp.abs(u) - local.b, 0.0)


def _usual_speed(local: PiecewiseLinearOscillator) -> Array:
    drive = jnp.abs(local.B0) + jnp.abs(local.B1)
    return local.omega * local.b + drive * (1 / local.omega + 1 / jnp.sqrt(local.stiffness))


def _shoot(lane: _Lane, now: Array, local: PiecewiseLinearOscillator, omega: Array) -> tuple[_Lane, _Verdict]:
    """One Newton correction in the lanes ``now``, and what it shows."""
    motion, (u, v) = lane.motion, lane.guess
    first = _select(lane.corrections == 0, (motion.u, motion.v), lane.first)
    du, dv = newton_correction(motion.matrix, motion.u - u, motion.v - v)
    guess = (u + du, v + dv)
    change = jnp.abs(du) + jnp.abs(dv) / omega
    size = jnp.abs(guess[0]) + jnp.abs(guess[1]) / omega
    stuck = (change <= _ROUNDING * size) & (change > lane.change / 2)
    converged = (change <= _CONVERGED * size) | stuck
    rho = spectral_radius(motion.matrix, -local.damping * lane.multiple * 2 * np.pi / omega)
    away = (lane.latest[0] - guess[0], lane.latest[1] - guess[1])
    ahead = apply(motion.matrix, *away)
    rest = jnp.abs(first[0] - guess[0] - ahead[0]) + jnp.abs(first[1] - guess[1] - ahead[1]) / omega
    distance = jnp.abs(away[0]) + jnp.abs(away[1]) / omega
    reached = (rest <= _REMAINDER * (1 - rho) * distance) | (distance <= _ARRIVED * size)
    found = now & converged & (rho < 1) & reached
    astray = ~(_speed(local, *guess) <= _ASTRAY * (_speed(local, *lane.latest) + _usual_speed(local)))
    going = now & ~converged & (lane.corrections < _CORRECTIONS) & ~astray
    inverse = jnp.abs(newton_correction(motion.matrix, jnp.ones_like(u), jnp.zeros_like(u))[0])
    error = change + 4 * _EPS * size * (1 + inverse) * jnp.sqrt(motion.steps.astype(float))
    corrected = lane._replace(
        guess=guess, first=first, change=change, corrections=lane.corrections + now.astype(jnp.int32)
    )
    lane = _restart(_select(going | found, corrected, lane), going, *guess, lane.multiple)
    return lane, _Verdict(found, now & ~going & ~found, error)


def _resume(lane: _Lane, failed: Array) -> _Lane:
    """After a failed search: the second candidate if there is one, else on with settling."""
    again = failed & (lane.second != lane.multiple)
    back = failed & ~again
    wait = jnp.maximum(4, lane.count // 3).astype(jnp.int32)
    resumed = lane._replace(searching=jnp.zeros_like(failed), due=lane.count + wait)
    lane = _restart(_select(back, resumed, lane), back, *lane.latest, 1)
    return _search(lane, again, lane.second, lane.second)


def _enter(lane: _Lane, now: Array, job: Array, place: Array, u: Array, v: Array, hint: Array) -> _Lane:
    """Lanes ``now`` enter a new point from ``(u, v)`` and search at once for an orbit of ``hint`` periods."""
    zero = jnp.zeros_like(u)
    fresh = lane._replace(
        job=job,
        place=place,
        count=jnp.zeros_like(lane.count),
        due=jnp.full_like(lane.due, 4),
        latest=(u, v),
        tangent=(zero + 0.6, zero + 0.8),
        growth=zero,
        cost=jnp.zeros_like(lane.count),
    )
    return _search(_select(now, fresh, lane), now, hint, hint)


def _blank(width: int) -> _Lane:
    real, whole = jnp.zeros(width), jnp.zeros(width, jnp.int32)
    pair, flag = (real, real), jnp.zeros(width, bool)
    motion = Motion(real, real + 1, real, real, real, (real + 1, real, real, real + 1), whole, whole)
    return _Lane(
        job=whole,
        place=whole,
        motion=motion,
        count=whole,
        due=whole,
        latest=pair,
        tangent=pair,
        growth=real,
        cost=whole,
        searching=flag,
        multiple=whole + 1,
        corrections=whole,
        second=whole,
        guess=pair,
        first=pair,
        change=real,
    )


def attractors(
    oscillator: PiecewiseLinearOscillator,
    route: Array,
    u0: Array,
    v0: Array,
    *,
    most_periods: int,
    width: int,
) -> Attractors:
    """Attractors reached at the points of every job.

    ``oscillator`` holds scalars or arrays over all points; ``route``, shape ``(jobs, length)``, the points that each
    job visits, in order; ``u0, v0``, shape ``(jobs,)``, the states it starts from. Each next point starts from the
    state that the last one ended on. Results have the shape ``(jobs, length)``.
    """
    jobs, length = route.shape
    width = min(width, jobs)
    visits = route.reshape(jobs * length)
    total = jobs * length
    # One array for all results: several scatters side by side make XLA's CPU compiler abort (jax 0.10.2).
    store = jnp.zeros((len(jax.tree.leaves(_RESULT)), total))
    numbers = jnp.arange(width, dtype=jnp.int32)
    lane = _enter(_blank(width), numbers >= 0, numbers, 0 * numbers, u0[:width], v0[:width], 0 * numbers + 1)
    history = _record(jnp.zeros((MOST_PERIODS + 1, 2 * width)), lane.searching, lane)

    def tick(state: tuple[_Lane, Array, Array, Array]) -> tuple[_Lane, Array, Array, Array]:
        lane, history, queue, store = state
        working = lane.job < jobs
        place = jnp.where(working, lane.job, 0) * length + lane.place
        local = take(oscillator, visits[place])
        lanes = prepare(local)
        omega = lanes.omega + jnp.zeros(width)
        lane = lane._replace(motion=few_steps(lanes, lane.motion))
        most = jnp.where(
            lane.searching & (lane.count > 0),
            lane.multiple * (_COSTLY * lane.cost + 500),
            lane.multiple * usual_steps(lanes),
        )
        broken = ~jnp.isfinite(lane.motion.u) | (lane.motion.steps > most)
        ready = working & ((lane.motion.left <= 0) | broken)
        after, verdict = _shoot(lane, ready & lane.searching & ~broken, local, omega)
        settles = ready & ~lane.searching & ~broken
        after = _settle(after, settles, most_periods // 4, omega)
        history = _record(history, settles, after)
        first, second = _candidates(after, history, omega)
        after = _search(after, settles & (after.count >= after.due), first, second)
        after = _resume(after, verdict.failed | (ready & lane.searching & broken))
        stalled = ready & ~lane.searching & broken
        done = verdict.found | stalled | (settles & (after.count >= most_periods))
        result = _result(lane, after, verdict, stalled, most_periods * 2 * np.pi / omega)
        where = jnp.where(done, place, total)
        store = store.at[:, where].set(jnp.stack(jax.tree.leaves(result)).astype(float), mode="drop")
        lane, queue = _proceed(after, done, result, queue, (u0, v0), length)
        return lane, _record(history, done, lane), queue, store

    state = (lane, history, jnp.asarray(width, jnp.int32), store)
    *_, store = jax.lax.while_loop(lambda state: jnp.any(state[0].job < jobs), tick, state)
    rows = jax.tree.unflatten(jax.tree.structure(_RESULT), list(store.reshape(-1, jobs, length)))
    return rows._replace(**{name: getattr(rows, name).astype(jnp.int32) for name in ("multiple", "periods", "stalled")})


def _result(lane: _Lane, after: _Lane, verdict: _Verdict, stalled: Array, span: Array) -> Attractors:
    """What a lane that is done has found; ``span`` is the longest time it may settle."""
    motion, found = lane.motion, verdict.found
    return Attractors(
        u=jnp.where(found, after.guess[0], motion.u),
        v=jnp.where(found, after.guess[1], motion.v),
        multiple=jnp.where(found, lane.multiple, 0),
        matrix=motion.matrix,
        error=jnp.where(found, verdict.error, jnp.nan),
        periods=after.count,
        exponent=after.growth / (0.75 * span),
        stalled=stalled,
    )


def _proceed(
    lane: _Lane, done: Array, result: Attractors, queue: Array, origin: tuple[Array, Array], length: int
) -> tuple[_Lane, Array]:
    """Lanes that are done go on to the next point of their job or, at its end, to the next job of the queue."""
    jobs = origin[0].size
    last = done & (lane.place == length - 1)
    fresh = queue + jnp.cumsum(last.astype(jnp.int32)) - 1
    job = jnp.where(last, fresh, lane.job)
    place = jnp.where(last, 0, lane.place + 1).astype(jnp.int32)
    index = jnp.minimum(job, jobs - 1)
    finite = jnp.isfinite(result.u) & ~last
    u = jnp.where(finite, result.u, origin[0][index])
    v = jnp.where(finite, result.v, origin[1][index])
    hint = jnp.where(last | (result.multiple == 0), 1, result.multiple)
    return _enter(lane, done, job, place, u, v, hint), queue + last.sum().astype(jnp.int32)
