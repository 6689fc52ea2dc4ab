"""Lanes on their way to attractors: they settle period by period, hasten along slow approaches, and start searches.

A *lane* works on one point at a time. It keeps the states of the last 33 periods, from which the number of periods after
which the motion recurs is guessed, and counts the growth of a tangent for the Lyapunov exponent.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.piecewise_march import Motion
from drivetrain_jax.analysis.plane_map import apply
from drivetrain_jax.systems import PiecewiseLinearOscillator

MOST_PERIODS = 32
# Recurrences that count as equally good.
_NEAR, _NARROW = 30.0, 1.5
# An approach is slow if two displacements in succession differ by less than this part; how much of the way that they
# predict is taken at once, and the longest way, over the size of the state.
_SLOW, _PART, _LONGEST = 0.05, 0.5, 0.02
# Exponent of the decay that is waited for after that, and the most periods.
_DECAYED, _LONGEST_WAIT = 9.0, 64
_ROWS = np.arange(MOST_PERIODS + 1, dtype=np.int32)[:, None]


class Lane(NamedTuple):
    """State of the lanes, each field ``(width, ...)``: job and place in it, the motion, and the search in progress."""

    job: Array
    place: Array
    motion: Motion
    count: Array  # periods settled
    due: Array  # periods after which the next search starts
    since: Array  # periods settled when the motion was last hastened
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


def select(condition: Array, new: Any, old: Any) -> Any:
    """``new`` where the condition holds, else ``old``, for trees of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def candidates(lane: Lane, history: Array, omega: Array) -> tuple[Array, Array]:
    """Two guesses at the period multiple: the smallest m after which the motion recurs to within a factor of the best
    recurrence, for a generous factor and for a narrow one. Row ``n % 33`` of ``history``, shape ``(33, 2 width)``, has
    displacements and velocities after n periods."""
    u, v = lane.latest
    distance = jnp.abs(history[:, : u.size] - u) + jnp.abs(history[:, u.size :] - v) / omega
    age = (lane.count - _ROWS) % (MOST_PERIODS + 1)
    distance = jnp.where((age > 0) & (age <= lane.count - lane.since), distance, jnp.inf)
    best = distance.min(axis=0)
    floor = 1e-13 * (jnp.abs(u) + jnp.abs(v) / omega)

    def smallest(factor: float) -> Array:
        recurs = distance <= factor * best + floor
        return jnp.where(recurs, age, MOST_PERIODS).min(axis=0).astype(jnp.int32)

    return smallest(_NEAR), smallest(_NARROW)


def record(history: Array, now: Array, lane: Lane) -> Array:
    """``history`` with the latest state in the lanes ``now``."""
    row = jnp.where(now, lane.count % (MOST_PERIODS + 1), -1)
    return jnp.where(jnp.concatenate([row, row]) == _ROWS, jnp.concatenate(lane.latest), history)


def restart(lane: Lane, going: Array, u: Array, v: Array, periods: Array) -> Lane:
    """Lanes ``going`` start anew at the beginning of a period from ``(u, v)``."""
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    count = jnp.zeros(u.shape, jnp.int32)
    fresh = Motion(zero, one, zero, u, v, (one, zero, zero, one), jnp.broadcast_to(periods, u.shape) + count, count)
    return lane._replace(motion=select(going, fresh, lane.motion))


def settle(lane: Lane, now: Array, forget: int, omega: Array) -> Lane:
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
    return restart(select(now, settled, lane), now, motion.u, motion.v, 1)


def search(lane: Lane, now: Array, multiple: Array, second: Array) -> Lane:
    """Start Newton shooting from the latest state in the lanes ``now``, for this period multiple."""
    begun = lane._replace(
        searching=jnp.ones_like(now),
        multiple=multiple,
        second=second,
        corrections=jnp.zeros_like(lane.corrections),
        guess=lane.latest,
        change=jnp.full_like(lane.change, jnp.inf),
    )
    return restart(select(now, begun, lane), now, *lane.latest, multiple)


def resume(lane: Lane, failed: Array, history: Array, local: PiecewiseLinearOscillator) -> tuple[Lane, Array]:
    """After a failed search: the second candidate if there is one, else on with settling, hastened where it is slow.

    Also returns the lanes whose latest state has changed.
    """
    again = failed & (lane.second != lane.multiple)
    back = failed & ~again
    (u, v), slow = _ahead(lane, history, local.omega + jnp.zeros(failed.shape))
    slow = back & slow
    # What the state is off the slow direction dies as the determinant does: the next displacements must be free of it.
    decay = jnp.minimum(_DECAYED / jnp.maximum(local.damping * local.period, 1e-300), _LONGEST_WAIT)
    wait = jnp.where(
        slow, 2 * lane.multiple + 1 + decay.astype(jnp.int32), jnp.maximum(4, (lane.count - lane.since) // 3)
    ).astype(jnp.int32)
    resumed = lane._replace(
        searching=jnp.zeros_like(failed),
        due=lane.count + wait,
        since=jnp.where(slow, lane.count, lane.since),
        latest=(jnp.where(slow, u, lane.latest[0]), jnp.where(slow, v, lane.latest[1])),
    )
    lane = select(back, resumed, lane)
    lane = restart(lane, back, *lane.latest, 1)
    return search(lane, again, lane.second, lane.second), slow


def _ahead(lane: Lane, history: Array, omega: Array) -> tuple[tuple[Array, Array], Array]:
    """States part of the way on where the motion drifts slowly, and which these are.

    Next to a fold or a period doubling a motion goes along one direction, by displacements d that change little from
    one recurrence to the next: ``d' = q d`` with q near 1. What remains of an approach is ``d q/(1 - q)``; half of it
    at most is taken, so that no fixed point on the way is passed. A departure (q > 1) is taken on likewise.
    """

    def past(ago: Array) -> Array:
        row = (lane.count - ago) % (MOST_PERIODS + 1)
        return jnp.where(jnp.concatenate([row, row]) == _ROWS, history, 0.0).sum(axis=0)

    def size(z: Array) -> Array:
        return jnp.abs(z[: omega.size]) + jnp.abs(z[omega.size :]) / omega

    now, before, first = jnp.concatenate(lane.latest), past(lane.multiple), past(2 * lane.multiple)
    way = size(now - before)
    turn = size(now - 2 * before + first)
    known = 2 * lane.multiple <= jnp.minimum(lane.count - lane.since, MOST_PERIODS)
    slow = known & (turn <= _SLOW * way) & (way <= _LONGEST * size(now))
    part = jnp.minimum(_PART * way / jnp.maximum(turn, 1e-300), _LONGEST * size(now) / jnp.maximum(way, 1e-300))
    part = jnp.where(slow, part, 0.0)
    ahead = now + jnp.concatenate([part, part]) * (now - before)
    return (ahead[: omega.size], ahead[omega.size :]), slow


def enter(lane: Lane, now: Array, job: Array, place: Array, u: Array, v: Array, hint: Array) -> Lane:
    """Lanes ``now`` enter a new point from ``(u, v)`` and search at once for an orbit of ``hint`` periods."""
    zero = jnp.zeros_like(u)
    fresh = lane._replace(
        job=job,
        place=place,
        count=jnp.zeros_like(lane.count),
        due=jnp.full_like(lane.due, 4),
        since=jnp.zeros_like(lane.since),
        latest=(u, v),
        tangent=(zero + 0.6, zero + 0.8),
        growth=zero,
        cost=jnp.zeros_like(lane.count),
    )
    return search(select(now, fresh, lane), now, hint, hint)


def blank(width: int) -> Lane:
    """Lanes that have entered no point yet."""
    real, whole = jnp.zeros(width), jnp.zeros(width, jnp.int32)
    pair, flag = (real, real), jnp.zeros(width, bool)
    motion = Motion(real, real + 1, real, real, real, (real + 1, real, real, real + 1), whole, whole)
    return Lane(
        job=whole,
        place=whole,
        motion=motion,
        count=whole,
        due=whole,
        since=whole,
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
