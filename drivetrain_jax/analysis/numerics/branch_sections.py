"""Motions of a branch at a given frequency, from points along the branch.

Between two points the branch is a Hermite cubic with the slopes of parabolas through three points. The cubic is cut in two
where it turns back in frequency, so that the motions on both sides of a fold are found.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.amplitude_roots import sign_changes

_HALVINGS = 50
# Relative difference of extremes below which two motions are the same.
_SAME = 1e-9


class Course(NamedTuple):
    """Points of a branch, and the slopes at both ends of each interval.

    ``cut`` is the fraction of each interval at which it is cut. ``nodes`` are the frequencies at the points and, between
    them, at the cuts.
    """

    points: Array
    slopes: tuple[Array, Array]
    cut: Array
    nodes: Array


def _cubic(ends: tuple[Array, Array], slopes: tuple[Array, Array], part: Array) -> Array:
    rest = 1 - part
    values = rest**2 * (1 + 2 * part) * ends[0] + part**2 * (3 - 2 * part) * ends[1]
    return values + part * rest * (rest * slopes[0] - part * slopes[1])


def course(points: Array, scale: Array) -> Course:
    """The branch through ``points``, shape ``(S, n, N)``, the frequency last among the n, NaN after the last point.

    ``scale``, shape ``(n, N)``, makes the components comparable.
    """
    rise = jnp.diff(points, axis=0)
    length = jnp.sqrt(jnp.sum((rise / scale) ** 2, axis=1, keepdims=True))
    rate = rise / jnp.where(length > 0, length, 1.0)
    inner = (length[1:] * rate[:-1] + length[:-1] * rate[1:]) / (length[1:] + length[:-1])
    # At both ends of the branch, use the slope of the chord.
    inner = jnp.where(jnp.isfinite(inner), inner, rate[:-1])
    slope = jnp.concatenate([rate[:1], inner, rate[-1:]])
    slopes = (slope[:-1] * length, slope[1:] * length)
    omega = points[:, -1]
    first, last, total = slopes[0][:, -1], slopes[1][:, -1], rise[:, -1]
    # Zero of the derivative of the cubic: first + 2 (3 total - 2 first - last) s + 3 (first + last - 2 total) s^2.
    middle, square = 3 * total - 2 * first - last, 3 * (first + last - 2 * total)
    root = jnp.sqrt(jnp.maximum(middle**2 - first * square, 0.0))
    part = -first / (middle + jnp.where(middle < 0, -root, root))
    other = -(middle + jnp.where(middle < 0, -root, root)) / jnp.where(square == 0, 1.0, square)
    part = jnp.where((part > 0) & (part < 1), part, other)
    turns = (first * last < 0) & (part > 0) & (part < 1)
    cut = jnp.where(turns, part, 0.5)
    between = _cubic((omega[:-1], omega[1:]), (first, last), cut)
    nodes = jnp.stack([omega[:-1], between], axis=1).reshape(-1, omega.shape[1])
    return Course(points, slopes, cut, jnp.concatenate([nodes, omega[-1:]]))


def sections(branch: Course, omega: Array, count: int) -> tuple[Array, Array, Array]:
    """Up to ``count`` positions of the branch at ``omega`` in its order, ``(count, n, N)``, and two flags.

    The flags mark existing positions, and lanes in which these are all positions.
    """
    above = branch.nodes > omega
    changes = sign_changes(above, count) & jnp.isfinite(branch.nodes[1:])
    every = jnp.sum((above[1:] != above[:-1]) & jnp.isfinite(branch.nodes[1:]), axis=0) <= count
    exists = jnp.any(changes, axis=1)
    place = jnp.argmax(changes, axis=1)
    number, second = place // 2, place % 2

    def at(values: Array, shift: int = 0) -> Array:
        if values.ndim == 2:
            return jnp.take_along_axis(values, number + shift, axis=0)
        return jnp.take_along_axis(values, (number + shift)[:, None], axis=0)

    ends = (at(branch.points), at(branch.points, 1))
    slopes = tuple(at(slope) for slope in branch.slopes)
    cut = at(branch.cut)
    low, high = jnp.where(second, cut, 0.0), jnp.where(second, 1.0, cut)
    start = jnp.take_along_axis(branch.nodes, place, axis=0) > omega

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        here = _cubic((ends[0][:, -1], ends[1][:, -1]), (slopes[0][:, -1], slopes[1][:, -1]), middle) > omega
        return jnp.where(here == start, middle, low), jnp.where(here == start, high, middle)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))
    found = _cubic(ends, slopes, ((low + high) / 2)[:, None])  # pyright: ignore[reportArgumentType]
    return jnp.where(exists[:, None], found, 0.0), exists, every


def distinct(high: Array, low: Array) -> Array:
    """True if all motions with these extremes, ``(count, ...)`` by rising ``high`` and NaN after the last, are different.

    If two positions of a branch lead to the same motion, another motion is missing.
    """
    size = jnp.maximum(jnp.abs(high), jnp.abs(low))[1:]
    same = (jnp.abs(jnp.diff(high, axis=0)) <= _SAME * size) & (jnp.abs(jnp.diff(low, axis=0)) <= _SAME * size)
    return ~jnp.any(same, axis=0)
