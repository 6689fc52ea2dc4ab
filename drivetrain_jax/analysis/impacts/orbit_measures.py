"""Measures of a motion of a piecewise linear oscillator over its period: extremes, means, contacts and impacts.

The exact steps also stop at every reversal of the velocity, so every extreme is the end of a step. Means are Gauss-Legendre
sums over the steps, with 8 nodes on at most two radians of the fastest motion.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.attractor import MOST_PERIODS, take
from drivetrain_jax.analysis.impacts.piecewise_march import (
    Bound,
    Derivatives,
    Here,
    Lanes,
    Motion,
    advanced_once,
    allowed_steps,
    certain_span,
    derivatives,
    flank_bounds,
    least_step,
    likely_span,
    locate,
    prepare,
    responses,
    start,
    timed_motion,
)
from drivetrain_jax.systems import PiecewiseLinearOscillator
from drivetrain_jax.systems._models import sincos

_NODES, _WEIGHTS = (x.tolist() for x in np.polynomial.legendre.leggauss(8))
_LONGEST_ARC = 2.0
# Relative size below which a motion is rounding, and relative difference up to which a state counts as recurring.
_ROUNDING, _RECURRENCE = 1e-13, 1e-7
_FEW = 8


class Measures(NamedTuple):
    """Sums over the measured periods, shape ``(N,)`` each; pairs are for the driving and the back flank.

    ``periods``: measured drive periods; ``high, low``: extremes of u; ``integrals``: of u, u^2, u cos(omega t) and
    u sin(omega t); ``contact``: time in contact; ``impacts``: number of times that a flank is reached; ``speed``: largest
    velocity at an impact; ``side``: region of the last step; ``matrix``: transition matrix; ``end``: the last u and v;
    ``complete``: 1, or 0 if the motion needed too many steps or was not finite.
    """

    periods: Array
    high: Array
    low: Array
    integrals: tuple[Array, Array, Array, Array]
    contact: tuple[Array, Array]
    impacts: tuple[Array, Array]
    speed: tuple[Array, Array]
    side: Array
    matrix: tuple[Array, Array, Array, Array]
    end: tuple[Array, Array]
    complete: Array


_RESULT = Measures(0, 0, 0, (0,) * 4, (0,) * 2, (0,) * 2, (0,) * 2, 0, (0,) * 4, (0,) * 2, 0)  # pyright: ignore[reportArgumentType]


def _fresh(u: Array, side: Array) -> Measures:
    zero = jnp.zeros_like(u)
    pair = (zero, zero)
    return Measures(zero, u, u, (zero,) * 4, pair, pair, pair, side, (zero + 1, zero, zero, zero + 1), pair, zero)  # pyright: ignore[reportArgumentType]


def _reversal(motion: Motion, rate: Derivatives, size: tuple[Array, Array]) -> Bound:
    """Bound of the velocity's distance from a change of sign; infinite without motion."""
    v, a = motion.v, rate.acceleration
    sign = jnp.where(v != 0, jnp.sign(v), jnp.sign(a))
    still = jnp.abs(v) * size[1] + jnp.abs(a) <= _ROUNDING * size[0]
    # An infinite value needs the slope 0: otherwise the root is a quotient of infinities.
    slope = jnp.where(still, 0.0, sign * a)
    return Bound(jnp.where(still, jnp.inf, jnp.abs(v)), slope, sign * rate.jerk, rate.snap_bound)


def _crossing(lanes: Lanes, side: Array, last: Array, motion: Motion) -> Array:
    """Zero, with the derivative of the time at which the lane passed from the region ``last`` to ``side``.

    Steps of neighbouring motions end at the same times, but the motions reach the flanks at different times.
    """
    passed = (side != last) & (motion.v != 0)
    late = ((side + last) * lanes.flank - motion.u) / jnp.where(passed, motion.v, 1.0)
    return jnp.where(passed, late - jax.lax.stop_gradient(late), 0.0)


def _integrals(lanes: Lanes, here: Here, motion: Motion, d: Array) -> tuple[Array, Array, Array, Array]:
    """Integrals of u, u^2, u cos and u sin over the step ``d``."""
    region = here.region
    x = motion.u - (region.cosine * motion.cosine + region.sine * motion.sine)
    y = motion.v - lanes.omega * (region.sine * motion.cosine - region.cosine * motion.sine)
    pull = here.force - region.stiffness * x

    def node(k: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
        elapsed = d * (1 + jnp.asarray(_NODES)[k]) / 2
        weight = d * jnp.asarray(_WEIGHTS)[k] / 2
        step, impulse, _ = responses(region, elapsed)
        sine, cosine = sincos(lanes.omega * (motion.time + elapsed))
        u = x + impulse * y + step * pull + (region.cosine * cosine + region.sine * sine)
        terms = (u, u * u, u * cosine, u * sine)
        return tuple(total + weight * term for total, term in zip(sums, terms, strict=True))

    return jax.lax.fori_loop(0, len(_NODES), node, (jnp.zeros_like(d),) * 4)


def _watched(lanes: Lanes, motion: Motion, so_far: Measures, integrals: bool) -> tuple[Motion, Measures]:
    """The motion and its measures after one step, which ends at the next event or reversal at the latest."""
    here = locate(lanes, motion.u)
    region = here.region
    rest = lanes.period - motion.time
    limit = jnp.minimum(rest, 1.5 / lanes.omega)
    rate = derivatives(lanes, here, motion, limit)
    pace = jnp.maximum(region.rate, lanes.omega)
    extent = jnp.abs(motion.u) + jnp.abs(so_far.high) + jnp.abs(so_far.low)
    bounds = (*flank_bounds(lanes, here.side, motion, rate), _reversal(motion, rate, (extent * pace**2, pace)))
    d = certain_span(bounds, likely_span(here), limit)
    if integrals:
        x = motion.u - (region.cosine * motion.cosine + region.sine * motion.sine)
        y = motion.v - lanes.omega * (region.sine * motion.cosine - region.cosine * motion.sine)
        free = jnp.abs(here.force - region.stiffness * x) + region.rate * jnp.abs(y)
        moves = free > _ROUNDING * region.rate**2 * extent
        d = jnp.where(moves, jnp.minimum(d, _LONGEST_ARC / jnp.maximum(region.rate, 1e-300)), d)
    d = jnp.maximum(d, least_step(lanes, here, motion, rate))
    # The ends of steps do not affect the measures and are not differentiated, except for the end of the period.
    d = jnp.where(d >= rest, rest, jax.lax.stop_gradient(d))
    moved = advanced_once(lanes, here, motion, d)
    # An impact counts where a step begins beyond the flank. Compiled code may round the end of a step differently in two
    # uses, so that a count at the end of steps would miss impacts or count them twice.
    before, last = here.side, so_far.side
    hits = tuple((before == side) & (last != side) for side in (1.0, -1.0))
    # Without backlash contact is permanent, with the flank loaded by the mean drive.
    held = (before == 1) | ((before == 2) & (lanes.mean >= 0)), (before == -1) | ((before == 2) & (lanes.mean < 0))
    later = _crossing(lanes, before, last, motion)
    speed = jnp.abs(motion.v + rate.acceleration * later)
    moved_over = tuple(((last == side) * 1.0 - (before == side)) * later for side in (1, -1))
    spans = tuple(jnp.where(on, d, 0.0) + x for on, x in zip(held, moved_over, strict=True))
    added = _integrals(lanes, here, motion, d) if integrals else (jnp.zeros_like(d),) * 4
    return moved, so_far._replace(
        # No maximum: compiled code may round u differently in its two uses, and the derivative of a tie would count twice.
        # A displacement that is not finite makes the extreme NaN.
        high=jnp.where(moved.u <= so_far.high, so_far.high, moved.u),
        low=jnp.where(moved.u >= so_far.low, so_far.low, moved.u),
        integrals=tuple(a + b for a, b in zip(so_far.integrals, added, strict=True)),
        contact=tuple(map(jnp.add, so_far.contact, spans)),
        impacts=tuple(n + hit for n, hit in zip(so_far.impacts, hits, strict=True)),
        speed=tuple(jnp.maximum(s, jnp.where(hit, speed, 0.0)) for s, hit in zip(so_far.speed, hits, strict=True)),
        side=before,
    )


class _Task(NamedTuple):
    """The motions to measure; ``first`` ``(4, N)``: u, v, most periods, and 1 if a recurrence ends the motion, else 0."""

    oscillator: PiecewiseLinearOscillator
    first: Array
    integrals: bool


class _Work(NamedTuple):
    """State of the loop: each lane measures the motion ``index``; ``queue`` is the next motion, ``store`` holds results.

    ``renewed`` marks lanes that have just started another motion.
    """

    index: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    queue: Array
    renewed: Array
    motion: Motion
    so_far: Measures
    store: Array


def measure(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, multiple: Array, *, width: int, integrals: bool = True
) -> Measures:
    """Measures of the motions that start from ``(u, v)``, shape ``(N,)``.

    The measures run until the state recurs, at most for ``multiple`` periods, so that ``periods`` is the smallest period
    multiple, or for 32 periods where ``multiple`` is 0. Without ``integrals`` the integrals are zero.
    """
    count = u.size
    width = min(width, count)
    recurs = multiple > 0
    most = jnp.where(recurs, multiple, MOST_PERIODS)
    task = _Task(oscillator, jnp.stack([u, v, most.astype(float), recurs.astype(float)]), integrals)
    index, blank = jnp.arange(width, dtype=jnp.int32), jnp.zeros(width)
    motion = Motion(blank, blank, blank, blank, blank, (blank,) * 4, 0 * index, 0 * index)  # pyright: ignore[reportArgumentType]
    store = jnp.zeros((len(jax.tree.leaves(_RESULT)), count))
    work = _Work(index, jnp.asarray(width, jnp.int32), index >= 0, motion, _fresh(blank, blank), store)
    work = jax.lax.while_loop(lambda work: jnp.any(work.index < count), lambda work: _tick(task, work), work)
    return jax.tree.unflatten(jax.tree.structure(_RESULT), list(work.store))


def _tick(task: _Task, work: _Work) -> _Work:
    """Advance all lanes by a few steps; a lane with a finished motion stores its measures and starts the next motion."""
    count = task.first.shape[1]
    here = jnp.minimum(work.index, count - 1)
    u, v, periods, recurs = task.first[:, here]
    lanes = jax.tree.map(lambda x: x + jnp.zeros(work.index.size), prepare(take(task.oscillator, here)))
    fresh = start(lanes, u, v, periods.astype(jnp.int32)), _fresh(u, locate(lanes, u).side)
    pair = jax.tree.map(lambda new, old: jnp.where(work.renewed, new, old), fresh, (work.motion, work.so_far))
    motion, so_far = _few_steps(lanes, periods, pair, task.integrals)
    ended = motion.left <= periods - 1 - so_far.periods
    so_far = so_far._replace(periods=so_far.periods + ended)
    distance = jnp.abs(motion.u - u) + jnp.abs(motion.v - v) / lanes.omega
    # Not the size of u: at a wide backlash the motion about a flank is far from the origin.
    extent = so_far.high - so_far.low + jnp.abs(v) / lanes.omega
    back = (recurs > 0) & (distance <= _RECURRENCE * extent + _ROUNDING * jnp.abs(u))
    broken = ~jnp.isfinite(motion.u) | (motion.steps > 2 * periods * allowed_steps(lanes))
    done = (work.index < count) & (broken | (ended & (back | (motion.left <= 0))))
    result = so_far._replace(matrix=motion.matrix, end=(motion.u, motion.v), complete=jnp.where(broken, 0.0, 1.0))
    rows = jnp.stack(jax.tree.leaves(result)).astype(float)
    store = work.store.at[:, jnp.where(done, here, count)].set(rows, mode="drop")
    following = work.queue + jnp.cumsum(done.astype(jnp.int32)) - 1
    index = jnp.where(done, following, work.index)
    return _Work(index, work.queue + done.sum().astype(jnp.int32), done, motion, so_far, store)


def _few_steps(lanes: Lanes, periods: Array, pair: tuple[Motion, Measures], integrals: bool) -> tuple[Motion, Measures]:
    """The motion and its measures after a few steps; a lane waits at the end of a period for the test of recurrence."""

    def one(_: Array, pair: tuple[Motion, Measures]) -> tuple[Motion, Measures]:
        motion, so_far = pair
        moved = _watched(lanes, motion, so_far, integrals)
        active = (motion.left > periods - 1 - so_far.periods) & jnp.isfinite(motion.u)
        return jax.tree.map(lambda new, old: jnp.where(active, new, old), moved, pair)

    return jax.lax.fori_loop(0, _FEW, one, pair)


def history(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, multiple: Array, samples: int
) -> tuple[Array, Array]:
    """Displacement and velocity at ``samples`` times, shape ``(samples, N)`` each, from the state ``(u, v)``.

    The times divide ``multiple`` drive periods (32 where it is 0) into equal parts; the first time is the start.
    """
    periods = jnp.where(multiple > 0, multiple, MOST_PERIODS)
    return timed_motion(oscillator, u, v, jnp.arange(samples)[:, None] * periods / samples)[:2]
