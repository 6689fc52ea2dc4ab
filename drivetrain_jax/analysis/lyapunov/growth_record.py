"""Growth of tangent vectors along a trajectory, recorded in segments of equal time (Benettin's method).

Benettin, Galgani, Giorgilli & Strelcyn, Meccanica 15 (1980): tangent vectors are carried by the linearised flow and
orthonormalised after every strobe, or more often if rounding requires it. The mean logarithms of the Gram-Schmidt lengths
are the Lyapunov exponents. A record has a fixed number of segments for any time, so its memory does not grow.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.march_steps import needed_parts
from drivetrain_jax.analysis.lyapunov.variational import (
    Frame,
    Vector,
    initial_frame,
    initial_state,
    one_kernel,
    orthonormal,
    strobe_map,
)
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.systems import Flow

SEGMENTS = 64
# Fractions of the time at which the standard error is tested.
_CHECKS = (SEGMENTS // 4, SEGMENTS // 2, SEGMENTS)
# The first quarter of the record is transient; the rest is averaged in blocks.
_DISCARD, BLOCKS = 4, 12
# Number of standard errors above which a change between the halves is drift, not scatter of the blocks.
_DRIFTS = 5.0
# A decaying motion is followed until its transient has fallen by e to this power.
SETTLED = 12.0
# Size of a component above which the motion is unbounded.
BOUND = 1e6


class Record(NamedTuple):
    """Records of each segment; the first axis of every record counts segments.

    ``growth``: logarithmic growth of the orthonormal vectors, ``(SEGMENTS, m, ...)``; ``contraction``: integral of the
    divergence, ``(SEGMENTS, ...)``; ``size``: largest component (without phases and angles) at a strobe; ``used``: number
    of valid segments, ``(...)``; ``bounded``: true if the state stayed finite and within ``BOUND``; ``state`` and
    ``strobe``: end of the march; ``span``: duration of a segment.
    """

    growth: Array
    contraction: Array
    size: Array
    used: Array
    bounded: Array
    state: Vector
    strobe: Array
    span: Array


class _March(NamedTuple):
    frame: Frame
    strobe: Array
    alive: Array
    bounded: Array
    segment: Array
    growth: Array
    contraction: Array
    size: Array
    used: Array


def strobes_per_segment(flow: Flow, max_time: float) -> Array:
    """Strobes in each of ``SEGMENTS`` equal parts of ``max_time``, at least one, shape ``(...)``."""
    return jnp.ceil(jnp.asarray(max_time / flow.period / SEGMENTS)).astype(jnp.int64)


def state_size(flow: Flow, y: Vector) -> Array:
    """Largest component in absolute value of those that a bounded motion keeps bounded."""
    kept = [abs(x) for i, x in enumerate(y) if i not in (*flow.phases, *flow.cyclic)] or [abs(x) for x in y]
    return reduce(jnp.maximum, kept)


def record_growth(flow: Flow, steps: Any, max_time: float, target: float, active: Array) -> Record:
    """March until every member's standard error is below ``target``, at most ``max_time``, with ``steps`` per strobe.

    A decaying motion is also followed until its transient is below e^-12. Each member stops on its own: its record does not
    depend on the other members, except for rounding if one of them is orthonormalised within strobes. Members that are not
    ``active`` do not start.
    """
    frame = initial_frame(flow)
    shape = frame.state[0].shape
    length = jnp.broadcast_to(strobes_per_segment(flow, max_time), shape)
    record = jnp.zeros((SEGMENTS, *shape))
    active = jnp.broadcast_to(active, shape)
    start = _March(
        frame, jnp.zeros(shape, jnp.int64), active, jnp.ones(shape, bool), jnp.int64(0),
        jnp.zeros((SEGMENTS, len(frame.tangents[0]), *shape)), record, record, jnp.zeros(shape, jnp.int64),
    )  # fmt: skip
    segment = one_kernel(flow)(_segment(flow, steps, needed_parts(flow, steps), length))
    span = length * flow.period

    def body(march: _March) -> _March:
        march = segment(march, jnp.max(jnp.where(march.alive, length, 0)))
        return jax.lax.cond(
            jnp.any(jnp.asarray(_CHECKS) == march.segment), lambda m: _stopped(m, span, target), lambda m: m, march
        )

    march = jax.lax.while_loop(lambda m: (m.segment < SEGMENTS) & jnp.any(m.alive), body, start)
    return Record(
        march.growth, march.contraction, march.size, march.used, march.bounded, march.frame.state, march.strobe, span
    )


def _grown(flow: Flow, steps: Any, parts: Array) -> Callable[[Array, Frame], tuple[Frame, Array]]:
    """The map ``(strobe, frame) -> frame one strobe later`` with orthonormal vectors, and the growth of each."""
    advance = strobe_map(flow, steps)

    def strobe(number: Array, frame: Frame) -> tuple[Frame, Array]:
        def part(k: Array, carry: tuple[Frame, Array]) -> tuple[Frame, Array]:
            frame, growth = carry
            frame = advance(number, frame, k * steps // parts, (k + 1) * steps // parts)
            tangents, logs = stored(orthonormal)(frame.tangents)
            return frame._replace(tangents=tangents), growth + logs

        return jax.lax.fori_loop(0, parts, part, (frame, jnp.zeros_like(frame.tangents[0])))

    return strobe


def _segment(flow: Flow, steps: Any, parts: Array, length: Array) -> Callable[[_March, Array], _March]:
    """The march over one segment, at most ``longest`` strobes, as one kernel: it has no sums or maxima over an axis."""
    advance = _grown(flow, steps, parts)

    def strobe(carry: tuple) -> tuple:
        k, frame, number, alive, bounded, growth, size = carry
        moving = alive & (k < length)
        new, logs = advance(number, frame)
        largest = state_size(flow, new.state)
        well = reduce(jnp.logical_and, map(jnp.isfinite, logs), largest < BOUND)
        moving &= well
        frame = jax.tree.map(lambda a, b: jnp.where(moving, a, b), new, frame)
        growth = growth + jnp.where(moving, logs, 0.0)
        left = alive & (k < length) & ~well
        size = jnp.where(moving, jnp.maximum(size, largest), size)
        return k + 1, frame, number + moving, alive & ~left, bounded & ~left, growth, size

    def segment(march: _March, longest: Array) -> _March:
        nothing = jnp.zeros_like(march.size[0])
        frame = march.frame._replace(contraction=nothing)
        carry = (
            jnp.int64(0),
            frame,
            march.strobe,
            march.alive,
            march.bounded,
            jnp.zeros_like(march.growth[0]),
            nothing,
        )
        _, frame, number, alive, bounded, growth, size = jax.lax.while_loop(lambda c: c[0] < longest, strobe, carry)
        at = march.segment
        return _March(
            frame, number, alive, bounded, at + 1, march.growth.at[at].set(growth),
            march.contraction.at[at].set(frame.contraction), march.size.at[at].set(size), march.used + alive,
        )  # fmt: skip

    return segment


def _stopped(march: _March, span: Array, target: float) -> _March:
    """The march without members whose standard error is small enough and whose transient has decayed."""
    mean, error = block_mean(march.growth, march.used, span)
    largest = jnp.max(mean, axis=0)
    settled = (largest > 0) | (largest * march.used * span < -SETTLED)
    reached = settled & (jnp.max(error, axis=0) <= target)
    return march._replace(alive=march.alive & ~reached)


def block_size(used: Array) -> Array:
    """Segments in each of the ``BLOCKS`` blocks that are averaged."""
    return jnp.maximum((used - used // _DISCARD) // BLOCKS, 1)


def block_mean(series: Array, used: Array, span: Array) -> tuple[Array, Array]:
    """Mean rate of ``series`` (per segment) after the transient and its standard error, both ``(m, ...)``.

    The first quarter of the ``used`` segments is discarded. The rest makes 12 blocks; the error is the larger one of
    those of 12 and of 6 block means, so that correlation from block to block enlarges it, together with the drift.
    """
    index = jnp.arange(SEGMENTS).reshape(-1, *(1,) * (series.ndim - 1))
    first = used // _DISCARD
    size = block_size(used)
    block = jnp.where((index >= first) & (index < first + BLOCKS * size), (index - first) // size, BLOCKS)
    means = jnp.stack([jnp.sum(jnp.where(block == b, series, 0.0), axis=0) for b in range(BLOCKS)]) / (size * span)
    pairs = means.reshape(BLOCKS // 2, 2, *means.shape[1:]).mean(axis=1)
    errors = [jnp.std(m, axis=0, ddof=1) / jnp.sqrt(m.shape[0]) for m in (means, pairs)]
    return jnp.mean(means, axis=0), jnp.hypot(jnp.maximum(*errors), drift(means))


def drift(means: Array) -> Array:
    """Change from the first half of the block means to the second, minus the part explained by their scatter.

    For a vector that grows in proportion to time the rates fall like 1/t, and differ from their limit by more than they
    scatter.
    """
    half = BLOCKS // 2
    change = jnp.mean(means[:half], axis=0) - jnp.mean(means[half:], axis=0)
    # A drift hardly changes neighbours: half the mean square of their differences is the variance of a single block.
    chance = jnp.mean(jnp.diff(means, axis=0) ** 2, axis=0) / half
    return jnp.sqrt(jnp.maximum(change**2 - _DRIFTS**2 * chance, 0.0))


def running_mean(series: Array, used: Array, span: Array) -> Array:
    """The mean if the march had ended after each segment, ``(SEGMENTS, m, ...)``; NaN beyond the end."""
    sums = jnp.concatenate([jnp.zeros_like(series[:1]), jnp.cumsum(series, axis=0)])
    ends = jnp.arange(1, SEGMENTS + 1)
    firsts = ends // _DISCARD
    count = (ends - firsts).reshape(-1, *(1,) * (series.ndim - 1))
    mean = (sums[ends] - sums[firsts]) / (count * span)
    return jnp.where(ends.reshape(count.shape) <= used, mean, jnp.nan)


def sampled(flow: Flow, steps: Any, state: Vector, strobe: Array, count: int) -> tuple[Array, Vector]:
    """States at the ``count`` strobes that follow, shape ``(count, n, ...)``, and the last state as a vector."""
    advance = one_kernel(flow)(strobe_map(flow, steps))

    def body(carry: tuple, _: None) -> tuple:
        frame, number = carry
        frame = advance(number, frame)
        return (frame, number + 1), jnp.stack(frame.state)

    (frame, _), states = jax.lax.scan(body, (Frame(state), strobe), None, length=count)
    return states, frame.state


def discarded(flow: Flow, steps: Any, count: Any) -> Vector:
    """The state after ``count`` strobes from the start."""
    advance = strobe_map(flow, steps)

    def march(frame: Frame, count: Array) -> Frame:
        return jax.lax.fori_loop(0, count, advance, frame)

    return one_kernel(flow)(march)(Frame(initial_state(flow)), jnp.int64(count)).state
