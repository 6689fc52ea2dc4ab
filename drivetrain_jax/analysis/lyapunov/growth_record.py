"""Growth of tangent vectors along a trajectory, recorded in segments of equal time (Benettin's method).

Benettin, Galgani, Giorgilli & Strelcyn, Meccanica 15 (1980): tangent vectors move with the linearised flow and are
orthonormalised after every strobe, or more often if rounding requires it. The mean logarithms of the Gram-Schmidt lengths
are the Lyapunov exponents. A record has a fixed number of segments, so its memory does not grow with the time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.orbit import Orbit, common_period, find_orbit, no_orbit
from drivetrain_jax.analysis.lyapunov.variational import (
    Frame,
    Vector,
    initial_frame,
    initial_state,
    needed_parts,
    one_kernel,
    orthonormal,
    strobe_map,
)
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.systems import Flow

# Decide if the steps resolve the motion; otherwise exponents are wrong even with small standard errors.
#
# There are two tests. First, the exponents must sum to the mean divergence, which is known independently. Steps that
# damp or excite an oscillation, or that miss a fast decay, fail this test. Second, the largest exponent must be the
# same with twice the step. Steps that perturb phases fail only this test, because they hardly change volume.

STANDARD_ERRORS = 3.0
# Largest residual of the sum rule relative to the largest exponent.
SUM_RULE = 1e-3
# Ratio to the largest exponent below which an exponent is zero.
_ZERO = 1e-6
# Largest change of volume within a strobe by rounding and steps, if all exponents are nearly zero.
_VOLUME = 1e-9
# Relative difference of two step sizes that counts as agreement, whatever the standard errors.
_AGREEMENT = 0.1


def adds_up(spectrum: Array, error: Array, residual: Array, period: Any) -> Array:
    """Flags where the residual of the sum rule, shape (...), is small relative to the exponents ``(m, ...)`` or their
    errors.

    Errors of unbounded motions are NaN and are ignored; the flag is false where the residual is NaN.
    """
    largest = jnp.max(jnp.abs(spectrum), axis=0)
    size = jnp.abs(residual)
    return (size <= SUM_RULE * largest) | (size <= jnp.max(error, axis=0)) | (size * period <= _VOLUME)


def same_exponent(value: Array, error: Array, other: Array, other_error: Array) -> Array:
    """Flags where two step sizes give the same exponent: within three combined standard errors or a tenth.

    If an error is NaN, as for an unbounded motion, only the tenth counts. The flag is false if a value is NaN.
    """
    allowed = jnp.fmax(STANDARD_ERRORS * jnp.hypot(error, other_error), _AGREEMENT * jnp.abs(value))
    return jnp.abs(value - other) <= allowed


def zero_floor(spectrum: Array) -> Array:
    """Size up to which an exponent counts as zero, whatever its standard error, shape (...)."""
    return _ZERO * jnp.max(jnp.abs(spectrum), axis=0)


def significant(spectrum: Array, error: Array) -> Array:
    """Flags where the largest exponent, the first of ``(m, ...)``, exceeds three standard errors."""
    return spectrum[0] > STANDARD_ERRORS * error[0] + zero_floor(spectrum)


def resolved(spectrum: Array, error: Array, residual: Array, period: Any, coarse: Array, coarse_error: Array) -> Array:
    """Flags where the exponents sum to the divergence and twice the step confirms a positive largest exponent, shape (...).

    ``coarse`` is the largest exponent with twice the step, ``coarse_error`` its error. Unbounded motions have no significant
    exponent, so only the sum rule applies to them.
    """
    same = same_exponent(spectrum[0], error[0], coarse, coarse_error)
    return adds_up(spectrum, error, residual, period) & (same | ~significant(spectrum, error))


SEGMENTS = 64
# Parts of the time after which orbits are looked for, and after the first one of which the standard error is tested.
_CHECKS = (SEGMENTS // 16, SEGMENTS // 4, SEGMENTS // 2, SEGMENTS)
# The first quarter of the record is transient; the rest is averaged in blocks.
_DISCARD, BLOCKS = 4, 12
# Number of standard errors above which the difference of the halves is drift, not scatter of the blocks.
_DRIFTS = 5.0
# Windows of weighted means, as fractions of the time: the first gives the value, its difference from the others the error.
_WINDOWS = ((0.5, 1.0), (0.375, 0.875), (0.25, 0.75))
_SAFETY = 3.0
# Ratio of the error of a weighted mean to the error of the blocks below which the weighted mean is used.
_SHARPER = 0.1
# Logarithm of the factor by which the transient of a decaying motion must have fallen before the march ends.
SETTLED = 12.0
# Size of a component above which the motion is unbounded.
BOUND = 1e6


class Record(NamedTuple):
    """Records of each segment; the first axis of every record counts segments.

    ``growth``: logarithmic growth of the orthonormal vectors, ``(SEGMENTS, m, ...)``; ``contraction``: integral of the
    divergence, ``(SEGMENTS, ...)``; ``growth_moment``, ``contraction_moment``: the same sums with each strobe weighted by
    its place in the segment, from -1/2 to 1/2; ``size``: largest component (without phases and angles) at a strobe;
    ``used``: number of valid segments, ``(...)``; ``bounded``: true if the state stayed finite and within ``BOUND``;
    ``state`` and ``strobe``: end of the march; ``orbit``: the orbits found; ``span``: duration of a segment.
    """

    growth: Array
    contraction: Array
    growth_moment: Array
    contraction_moment: Array
    size: Array
    used: Array
    bounded: Array
    state: Vector
    strobe: Array
    orbit: Orbit
    span: Array


class _March(NamedTuple):
    frame: Frame
    alive: Array
    segment: Array
    record: Record


def state_size(flow: Flow, y: Vector) -> Array:
    """Largest modulus of the components without phases and angles, which grow even if the motion is bounded."""
    kept = [abs(x) for i, x in enumerate(y) if i not in (*flow.phases, *flow.cyclic)] or [abs(x) for x in y]
    return reduce(jnp.maximum, kept)


def record_growth(
    flow: Flow, steps: Any, max_time: float, target: float, active: Array, *, to_the_end: bool = False
) -> Record:
    """March until every member is known to be on an orbit, or its standard error is below ``target``, with ``steps`` per
    strobe; at most for ``max_time``. Members on an orbit go on if the record is wanted ``to_the_end``.

    A decaying motion without an orbit also continues until its transient is below e^-12. Each member stops on its own: its
    record does not depend on the other members, except for rounding if one of them is orthonormalised within strobes.
    Members that are not ``active`` do not start.
    """
    frame = initial_frame(flow)
    shape = frame.state[0].shape
    # Strobes in each of the equal parts of ``max_time``, at least one.
    strobes = jnp.ceil(jnp.asarray(max_time / flow.period / SEGMENTS)).astype(jnp.int64)
    length = jnp.broadcast_to(strobes, shape)
    series, growth = jnp.zeros((SEGMENTS, *shape)), jnp.zeros((SEGMENTS, len(frame.tangents[0]), *shape))
    active, none, span = jnp.broadcast_to(active, shape), jnp.zeros(shape, jnp.int64), length * flow.period
    record = Record(
        growth, series, growth, series, series, none, jnp.ones(shape, bool), (), none, no_orbit(flow), span
    )  # fmt: skip
    segment = one_kernel(flow)(_segment(flow, steps, needed_parts(flow, steps, active), length))

    def body(march: _March) -> _March:
        march = segment(march, jnp.max(jnp.where(march.alive, length, 0)))
        return jax.lax.cond(jnp.any(jnp.asarray(_CHECKS) == march.segment), check, lambda m: m, march)

    def check(march: _March) -> _March:
        reached, diverging = _reached(march, target)
        record = march.record._replace(orbit=_orbit_of(flow, steps, march, reached, diverging))
        on_orbit = record.orbit.found & (not to_the_end)
        return march._replace(alive=march.alive & ~reached & ~on_orbit, record=record)

    start = _March(frame, active, jnp.int64(0), record)
    march = jax.lax.while_loop(lambda m: (m.segment < SEGMENTS) & jnp.any(m.alive), body, start)
    return march.record._replace(state=march.frame.state)


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
    """The march over one segment of at most ``longest`` strobes, as one kernel: it has no sums or maxima over an axis."""
    advance = _grown(flow, steps, parts)

    def strobe(carry: tuple) -> tuple:
        k, frame, number, alive, bounded, growth, moments, size = carry
        moving = alive & (k < length)
        new, logs = advance(number, frame)
        largest = state_size(flow, new.state)
        well = reduce(jnp.logical_and, map(jnp.isfinite, logs), largest < BOUND)
        moving &= well
        place = jnp.where(moving, (k + 0.5) / length - 0.5, 0.0)
        logs = jnp.where(moving, logs, 0.0)
        shrunk = jnp.where(moving, new.contraction - frame.contraction, 0.0)
        moments = moments[0] + place * logs, moments[1] + place * shrunk
        frame = jax.tree.map(lambda a, b: jnp.where(moving, a, b), new, frame)
        left = alive & (k < length) & ~well
        size = jnp.where(moving, jnp.maximum(size, largest), size)
        return k + 1, frame, number + moving, alive & ~left, bounded & ~left, growth + logs, moments, size

    def segment(march: _March, longest: Array) -> _March:
        old, at = march.record, march.segment
        nothing, no_growth = jnp.zeros_like(old.size[0]), jnp.zeros_like(old.growth[0])
        frame = march.frame._replace(contraction=nothing)
        carry = jnp.int64(0), frame, old.strobe, march.alive, old.bounded, no_growth, (no_growth, nothing), nothing
        end = jax.lax.while_loop(lambda c: c[0] < longest, strobe, carry)
        _, frame, number, alive, bounded, growth, moments, size = end
        new = old._replace(
            growth=old.growth.at[at].set(growth), contraction=old.contraction.at[at].set(frame.contraction),
            growth_moment=old.growth_moment.at[at].set(moments[0]), size=old.size.at[at].set(size), used=old.used + alive,
            contraction_moment=old.contraction_moment.at[at].set(moments[1]), bounded=bounded, strobe=number,
        )  # fmt: skip
        return _March(frame, alive, at + 1, new)

    return segment


def _reached(march: _March, target: float) -> tuple[Array, Array]:
    """Flags where the standard error is small enough and the transient has decayed, and where vectors grow beyond their
    error."""
    record = march.record
    mean, error, _ = mean_growth(record)
    largest = jnp.max(mean, axis=0)
    settled = (largest > 0) | (largest * record.used * record.span < -SETTLED)
    averaged = march.segment > _CHECKS[0]
    reached = averaged & settled & (jnp.max(error, axis=0) <= target)
    return reached, averaged & jnp.any(mean > STANDARD_ERRORS * error, axis=0)


def _orbit_of(flow: Flow, steps: Any, march: _March, reached: Array, diverging: Array) -> Orbit:
    """Orbits of the march, with those of members whose motion the steps resolve and that do not diverge from where it is.

    The volume of the vectors shows whether the steps resolve the motion. Multiples of the clocks' period are tried last.
    """
    record, state = march.record, march.frame.state
    time = record.used * record.span
    rates, shrinking = jnp.sum(record.growth, axis=0) / time, jnp.sum(record.contraction, axis=0) / time
    sound = adds_up(rates, jnp.zeros_like(rates), jnp.sum(rates, axis=0) - shrinking, flow.period)
    resting = jnp.max(record.size, axis=0) == 0
    wanted = march.alive & ~record.orbit.found & sound & (~diverging | resting)
    last = reached | (march.segment == SEGMENTS)
    orbit = find_orbit(flow, steps, state, record.strobe, common_period(flow, state), wanted, wanted & last)
    return jax.tree.map(lambda new, old: jnp.where(orbit.found, new, old), orbit, record.orbit)


def block_size(used: Array) -> Array:
    """Segments in each of the ``BLOCKS`` blocks that are averaged."""
    return jnp.maximum((used - used // _DISCARD) // BLOCKS, 1)


def block_mean(series: Array, used: Array, span: Array) -> tuple[Array, Array]:
    """Mean rate of ``series`` (per segment) after the transient and its standard error, both ``(m, ...)``.

    The first quarter of the ``used`` segments is discarded. The other segments make 12 blocks. The error is the larger
    standard error of 12 and of 6 block means, which covers correlation between blocks, combined with the drift.
    """
    index = jnp.arange(SEGMENTS).reshape(-1, *(1,) * (series.ndim - 1))
    first = used // _DISCARD
    size = block_size(used)
    block = jnp.where((index >= first) & (index < first + BLOCKS * size), (index - first) // size, BLOCKS)
    means = jnp.stack([jnp.sum(jnp.where(block == b, series, 0.0), axis=0) for b in range(BLOCKS)]) / (size * span)
    pairs = means.reshape(BLOCKS // 2, 2, *means.shape[1:]).mean(axis=1)
    errors = [jnp.std(m, axis=0, ddof=1) / jnp.sqrt(m.shape[0]) for m in (means, pairs)]
    return jnp.mean(means, axis=0), jnp.hypot(jnp.maximum(*errors), drift(means))


def weighted_mean(series: Array, moments: Array, used: Array, span: Array) -> tuple[Array, Array]:
    """Mean rate of ``series`` (per segment) with smooth weights, and its error, both ``(m, ...)``.

    With the weights exp(-1/(x (1 - x))) at the fraction x of a window, the averages of periodic and quasi-periodic motion
    converge faster than any power of the time (Das, Saiki, Sander & Yorke, Nonlinearity 30, 2017). The ``moments`` let the
    weights vary linearly within a segment. Vectors that have not yet aligned enlarge the error, through the earlier windows.
    """
    middle = (jnp.arange(SEGMENTS).reshape(-1, *(1,) * (series.ndim - 1)) + 0.5) / jnp.maximum(used, 1)
    means = []
    for begin, end in _WINDOWS:
        part = (middle - begin) / (end - begin)
        inside = (part > 0) & (part < 1)
        part = jnp.where(inside, part, 0.5)
        weights = jnp.where(inside, jnp.exp(-1 / (part * (1 - part))), 0.0)
        slopes = weights * (1 - 2 * part) / (part * (1 - part)) ** 2 / ((end - begin) * jnp.maximum(used, 1))
        means.append(jnp.sum(weights * series + slopes * moments, axis=0) / (jnp.sum(weights, axis=0) * span))
    return means[0], _SAFETY * jnp.maximum(*(abs(mean - means[0]) for mean in means[1:]))


def mean_growth(record: Record) -> tuple[Array, Array, Array]:
    """Mean rates of the vectors and their errors, both ``(m, ...)``, and flags of weighted means, ``(...)``.

    Means are weighted where this makes the errors of all vectors much smaller and no rate is positive beyond its error.
    """
    plain, errors = block_mean(record.growth, record.used, record.span)
    weighted, sharp = weighted_mean(record.growth, record.growth_moment, record.used, record.span)
    regular = jnp.all((plain <= 3 * errors) & (sharp < _SHARPER * errors), axis=0)
    return jnp.where(regular, weighted, plain), jnp.where(regular, sharp, errors), regular


def drift(means: Array) -> Array:
    """Change from the first half of the block means to the second, minus the part explained by their scatter.

    The rates of a vector that grows in proportion to time fall like 1/t, further from their limit than they scatter.
    """
    half = BLOCKS // 2
    change = jnp.mean(means[:half], axis=0) - jnp.mean(means[half:], axis=0)
    # Drift hardly affects differences of neighbours: half their mean square is the variance of a single block.
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
