"""Lanes on their way to attractors: they settle period by period, start searches, and confirm the results.

A *lane* processes one point at a time, stores the states of the last 33 periods to guess the period multiple, and
accumulates the growth of a tangent for the Lyapunov exponent.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.attractor_approach import (
    PROBES,
    Orbit,
    doubled,
    is_attracted,
    linearisation_holds,
    probe,
    recurrences,
)
from drivetrain_jax.analysis.impacts.piecewise_march import Motion
from drivetrain_jax.analysis.impacts.plane_map import apply

MOST_PERIODS = 32
# Ratios to the best recurrence up to which another one counts as equally good: generous and narrow.
_NEAR, _NARROW = 30.0, 1.5
# Recurrences for which an orbit is kept although the motion does not yet satisfy the linearisation about it.
_PATIENCE = 8
_ROWS = np.arange(MOST_PERIODS + 1, dtype=np.int32)[:, None]


class Lane(NamedTuple):
    """State of the lanes, each field ``(width, ...)``: job, place in the job, motion, and search in progress."""

    job: Array
    place: Array
    motion: Motion
    count: Array  # periods settled  # pyright: ignore[reportIncompatibleMethodOverride]
    due: Array  # periods after which the next search starts
    latest: tuple[Array, Array]  # state after the settled periods
    tangent: tuple[Array, Array]
    growth: Array  # logarithm of the growth of the tangent
    cost: Array  # largest number of steps of a settled period
    spent: Array  # steps in all, of searches too
    searching: Array
    multiple: Array
    corrections: Array
    second: Array  # candidate to try if this period multiple fails
    guess: tuple[Array, Array]
    first: tuple[Array, Array]  # F^m of the initial state of the search
    change: Array  # size of the last correction
    approaching: Array
    orbit: Orbit  # the orbit that the motion approaches
    begun: Array  # periods settled when the approach began
    held: Array  # successive recurrences that agree with the linearisation
    probing: Array  # number of the point on the slow line under test, -1: none


def select(condition: Array, new: Any, old: Any) -> Any:
    """``new`` where the condition holds, else ``old``, for trees of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def candidates(lane: Lane, history: Array, omega: Array) -> tuple[Array, Array]:
    """Two guesses at the period multiple, for a generous and for a narrow factor.

    A guess is the smallest m whose recurrence is within this factor of the best one. Row ``n % 33`` of ``history``, shape
    ``(33, 2 width)``, holds displacements and velocities after n periods.
    """
    u, v = lane.latest
    distance = jnp.abs(history[:, : u.size] - u) + jnp.abs(history[:, u.size :] - v) / omega
    age = (lane.count - _ROWS) % (MOST_PERIODS + 1)
    distance = jnp.where((age > 0) & (age <= lane.count), distance, jnp.inf)
    best = distance.min(axis=0)
    floor = 1e-13 * (jnp.abs(u) + jnp.abs(v) / omega)

    def smallest(factor: float) -> Array:
        recurs = distance <= factor * best + floor
        return jnp.where(recurs, age, MOST_PERIODS).min(axis=0).astype(jnp.int32)

    first, second = smallest(_NEAR), smallest(_NARROW)
    # Near an orbit whose period is about to double the motion alternates: twice the period recurs best, but Newton's method
    # converges slowly for twice the period and fast for the period itself.
    return first, jnp.where((second == first) & (first % 2 == 0), first // 2, second)


def record(history: Array, now: Array, lane: Lane) -> Array:
    """``history`` with the latest state in the lanes ``now``."""
    row = jnp.where(now, lane.count % (MOST_PERIODS + 1), -1)
    return jnp.where(jnp.concatenate([row, row]) == _ROWS, jnp.concatenate(lane.latest), history)


def restart(lane: Lane, going: Array, u: Array, v: Array, periods: Array | int) -> Lane:
    """Lanes ``going`` restart at the beginning of a period from ``(u, v)``."""
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    count = jnp.zeros(u.shape, jnp.int32)
    fresh = Motion(zero, one, zero, u, v, (one, zero, zero, one), jnp.broadcast_to(periods, u.shape) + count, count)
    return lane._replace(motion=select(going, fresh, lane.motion))


def settle(lane: Lane, now: Array, forget: int, omega: Array) -> Lane:
    """The lanes after one more settled period in the lanes ``now``; at period ``forget`` the growth restarts from 0."""
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
        approaching=jnp.zeros_like(now),
        held=jnp.zeros_like(lane.held),
        multiple=multiple,
        second=second,
        corrections=jnp.zeros_like(lane.corrections),
        guess=lane.latest,
        change=jnp.full_like(lane.change, jnp.inf),
    )
    return restart(select(now, begun, lane), now, *lane.latest, multiple)


def resume(lane: Lane, failed: Array) -> Lane:
    """The lanes after failed searches: they try the second candidate if there is one, else continue settling."""
    lane = lane._replace(probing=jnp.where(failed, -1, lane.probing))
    again = failed & (lane.second != lane.multiple)
    back = failed & ~again
    due = jnp.where(back, lane.count + jnp.maximum(4, lane.count // 3), lane.due)
    lane = restart(lane._replace(searching=lane.searching & ~back, due=due), back, *lane.latest, 1)
    return search(lane, again, lane.second, lane.second)


def approach(lane: Lane, now: Array, orbit: Orbit) -> Lane:
    """The lanes after an orbit was found in the lanes ``now``: the motion continues from the latest state."""
    begun = lane._replace(
        searching=jnp.zeros_like(now),
        approaching=jnp.ones_like(now),
        orbit=orbit,
        begun=lane.count,
        due=lane.count + jnp.maximum(_PATIENCE * lane.multiple, lane.count // 3),
    )
    return restart(select(now, begun, lane), now, *lane.latest, 1)


def confirm(lane: Lane, now: Array, history: Array, flank: Any, omega: Array) -> tuple[Lane, Array]:
    """The lanes after a period in the lanes ``now``, and flags of lanes that have approached their orbit for long enough.

    If the motion does not satisfy the linearisation about the orbit, counting restarts; a new search may follow.
    """
    due = now & lane.approaching & (lane.count > lane.begun) & ((lane.count - lane.begun) % lane.multiple == 0)
    row = (lane.count - lane.multiple) % (MOST_PERIODS + 1)
    past = jnp.where(jnp.concatenate([row, row]) == _ROWS, history, 0.0).sum(axis=0)
    ok, arrived = linearisation_holds(lane.orbit, (past[: row.size], past[row.size :]), lane.latest, flank, omega)
    held = jnp.where(due, jnp.where(ok, lane.held + 1, 0), lane.held)
    return lane._replace(held=held), due & ok & (arrived | (held >= recurrences(lane.orbit)))


def try_line(lane: Lane, now: Array, orbit: Orbit, omega: Array) -> tuple[Lane, Array, Array]:
    """The lanes with the next point on the slow line, flags of success and flags of failure.

    Lanes ``now`` have found an orbit that they approach slowly, or have run from a point on the line. A lane succeeds if
    all its points approached the orbit, and fails at the first point that did not.
    """
    begins = now & (lane.probing < 0)
    twice, negative = doubled(orbit)
    negative &= lane.multiple <= MOST_PERIODS // 2
    multiple = jnp.where(begins & negative, 2 * lane.multiple, lane.multiple)
    lane = lane._replace(orbit=select(begins, select(negative, twice, orbit), lane.orbit), multiple=multiple)
    place, _ = probe(lane.orbit, lane.latest, lane.probing)
    good = is_attracted(lane.orbit, lane.latest, place, (lane.motion.u, lane.motion.v), omega)
    number = lane.probing + now.astype(jnp.int32)
    failed = now & ~begins & ~good
    through = now & ~begins & good & (number >= PROBES)
    _, start = probe(lane.orbit, lane.latest, number)
    # After a failure there is no other candidate.
    lane = lane._replace(probing=number, second=jnp.where(failed, lane.multiple, lane.second))
    lane = restart(lane, now & ~failed & ~through, *start, lane.multiple)
    return lane, through, failed


def enter(lane: Lane, now: Array, job: Array, place: Array, u: Array, v: Array, hint: Array) -> Lane:
    """Lanes ``now`` enter a new point from ``(u, v)`` and search at once for an orbit of ``hint`` periods."""
    zero = jnp.zeros_like(u)
    fresh = lane._replace(
        job=job,
        place=place,
        count=jnp.zeros_like(lane.count),
        due=jnp.full_like(lane.due, 4),
        probing=jnp.full_like(lane.probing, -1),
        latest=(u, v),
        tangent=(zero + 0.6, zero + 0.8),
        growth=zero,
        cost=jnp.zeros_like(lane.count),
        spent=zero,
    )
    return search(select(now, fresh, lane), now, hint, hint)


def blank(width: int) -> Lane:
    """Lanes without a point."""
    real, whole = jnp.zeros(width), jnp.zeros(width, jnp.int32)
    pair, flag = (real, real), jnp.zeros(width, bool)
    motion = Motion(real, real + 1, real, real, real, (real + 1, real, real, real + 1), whole, whole)
    return Lane(
        job=whole,
        place=whole,
        motion=motion,
        count=whole,
        due=whole,
        latest=pair,
        tangent=pair,
        growth=real,
        cost=whole,
        spent=real,
        searching=flag,
        multiple=whole + 1,
        corrections=whole,
        second=whole,
        guess=pair,
        first=pair,
        change=real,
        approaching=flag,
        orbit=Orbit(real, real, (real, real, real, real), real, real),
        begun=whole,
        held=whole,
        probing=whole - 1,
    )
