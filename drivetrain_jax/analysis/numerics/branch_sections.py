"""Motions of a branch at a given frequency, from points along the branch.

Between two points the branch is a Hermite cubic with the slopes of parabolas through three points. The cubic is cut in two
where it turns back in frequency, so that the motions on both sides of a fold are found.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# Stationary amplitudes of one-term approximations: all amplitudes at a frequency, and those of a slow sweep.
#
# Both closed-form approximations of a forced oscillator end in one equation for the amplitude A of the fundamental,
# ``residual(A, omega) = 0``. The residual is negative at A = 0 and positive for large A. The averaged amplitude grows
# where the residual is negative and falls where it is positive: the first, third, ... root is stable, every second root
# a saddle. Arrays have the batch as their trailing axes ``(...)``.


_HALVINGS = 60


def refined(omega: np.ndarray, largest: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rising frequencies that contain ``omega``, and the position of each entry of ``omega`` in them.

    Steps are at most the fraction ``largest`` of the frequency, with at most ``most`` parts of one interval.
    """
    rising = np.unique(omega)
    ratio = np.log(rising[1:] / rising[:-1])
    parts = np.clip(np.ceil(ratio / largest), 1, most).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(rising[:-1], rising[1:], parts, strict=True)]
    fine = np.concatenate([*pieces, rising[-1:]])
    return fine, np.searchsorted(fine, omega)


def bisect(function: Callable[[Array], Array], low: Array, high: Array, halvings: int = _HALVINGS) -> Array:
    """The point between ``low`` and ``high`` at which ``function`` becomes positive."""

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        above = function(middle) > 0
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    low, high = jax.lax.fori_loop(0, halvings, halve, (low, high))
    return (low + high) / 2


def sign_changes(positive: Array, count: int) -> Array:
    """Mask ``(count, K - 1, ...)`` of the interval with the n-th change of sign along the first axis."""
    return first_marks(positive[1:] != positive[:-1], count)


def first_marks(marks: Array, count: int) -> Array:
    """The first ``count`` of the ``marks`` (K, ...) along the first axis, one per row: ``(count, K, ...)``."""
    rank = jnp.cumsum(marks, axis=0)
    number = jnp.arange(1, count + 1).reshape(count, *(1,) * marks.ndim)
    return marks & (rank == number)


def take(mask: Array, values: Array, missing: float = np.nan) -> Array:
    """The entry of ``values`` (K, ...) that each row of ``mask`` (n, K, ...) marks; ``missing`` where it marks none."""
    picked = jnp.sum(jnp.where(mask, values, 0.0), axis=1)
    return jnp.where(jnp.any(mask, axis=1), picked, missing)


def follow(roots: Array) -> Array:
    """Indices of the roots of a sweep up and a sweep down, ``(L, K, ...) -> (L, 2, ...)``.

    ``roots`` rise along K and are padded with infinity; frequencies rise along L. A sweep starts from rest. Between folds
    the number of roots is constant, and the sweep keeps its position among them, even on steep branches. At the first
    frequency past a fold the amplitude changes like the averaged motion: to the next root above if the residual at the old
    amplitude is negative, to the next root below if it is positive.
    """
    size = roots.shape[1]

    def move(state: tuple[Array, Array, Array], at: Array) -> tuple[tuple[Array, Array, Array], Array]:
        amplitude, place, before = state
        below = jnp.sum(at < amplitude, axis=0)
        number = jnp.sum(jnp.isfinite(at), axis=0)
        index = jnp.where(number == before, place, jnp.minimum(2 * (below // 2), size - 1))
        reached = jnp.take_along_axis(at, index[None], axis=0)[0]
        return (jnp.where(jnp.isfinite(reached), reached, amplitude), index, number), index

    nowhere = jnp.zeros_like(jnp.sum(jnp.isfinite(roots[0]), axis=0))
    rest = (jnp.zeros_like(roots[0, 0]), nowhere, nowhere)
    up = jax.lax.scan(move, rest, roots)[1]
    down = jax.lax.scan(move, rest, roots, reverse=True)[1]
    return jnp.stack([up, down], axis=1)


_SECTION_HALVINGS = 50
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

    low, high = jax.lax.fori_loop(0, _SECTION_HALVINGS, halve, (low, high))
    found = _cubic(ends, slopes, ((low + high) / 2)[:, None])  # pyright: ignore[reportArgumentType]
    return jnp.where(exists[:, None], found, 0.0), exists, every


def distinct(high: Array, low: Array) -> Array:
    """True if all motions with these extremes, ``(count, ...)`` by rising ``high`` and NaN after the last, are different.

    If two positions of a branch lead to the same motion, another motion is missing.
    """
    size = jnp.maximum(jnp.abs(high), jnp.abs(low))[1:]
    same = (jnp.abs(jnp.diff(high, axis=0)) <= _SAME * size) & (jnp.abs(jnp.diff(low, axis=0)) <= _SAME * size)
    return ~jnp.any(same, axis=0)
