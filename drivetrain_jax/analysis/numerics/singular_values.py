"""Singular values of many small matrices at once, without LAPACK: matrices of shape ``(m, n, N)``, lanes last.

Householder bidiagonalisation, then the implicit QR iteration on the bidiagonal matrix (Golub & Van Loan, Matrix
Computations, 8.6; Demmel & Kahan, SIAM J. Sci. Stat. Comput. 11, 873, 1990). The singular values are never squared, so
small values keep their digits. Every lane works on its own unreduced block; the sweeps of all lanes run through the same
instructions, which vectorise over the lanes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from drivetrain_jax.analysis.numerics.lanes import evaluated_once

EPS = float(np.finfo(float).eps)
# Values (and their squares) that affect no digit, because matrices are scaled to entries of order one.
_TINY, _TINY_SQUARE = 1e-150, 1e-300
# Off-diagonal entries below this count as zero; squares of larger entries do not underflow.
_NEGLIGIBLE = 1e-140
# Most QR sweeps per singular value: fewer than two are needed on average, and LAPACK allows six per value and column.
_SWEEPS_PER_VALUE = 12
# Columns per stage of the reduction; each stage works on the rows and columns that earlier stages have left.
_STAGE = 9
# Terms of a sum that are added in one pass over the memory.
_TERMS = 8


class Bidiagonal(NamedTuple):
    """Bidiagonal matrices whose singular values times ``scale`` are those of the original matrices.

    ``diagonal`` and ``upper`` have shape (n, N); the last entry of ``upper`` is zero. ``finite`` (N,) is false where the
    original has an entry that is not finite.
    """

    diagonal: Array
    upper: Array
    scale: Array
    finite: Array


def singular_values(*blocks: Array) -> tuple[Array, Array]:
    """Singular values of block-diagonal matrices: ``(n, N)`` rising, and flags if all were found, ``(N,)``.

    ``blocks`` have shapes ``(m_i, n_i, N)`` with ``m_i >= n_i``; ``n`` is the sum of ``n_i``. Backward stable: errors are
    of the order of the rounding unit times the largest singular value. A lane with an entry that is not finite returns NaN
    and does not delay the others.
    """
    values, complete = bidiagonal_values(bidiagonal_form(*blocks))
    return jnp.sort(values, axis=0), complete


def bidiagonal_form(*blocks: Array) -> Bidiagonal:
    """One bidiagonal matrix with the singular values of all ``blocks``; each block has its own rows."""
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(block), axis=(0, 1)) for block in blocks]), axis=0)
    # Test every entry, because a maximum may lose NaN.
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(block), axis=(0, 1)) for block in blocks]), axis=0)
    scale = jnp.where(finite & (size > 0), size, 1.0)
    pairs = [_bidiagonalise(jnp.where(finite, block / scale, 0.0)) for block in blocks]
    return Bidiagonal(*(jnp.concatenate([pair[i] for pair in pairs]) for i in (0, 1)), scale, finite)  # pyright: ignore[reportCallIssue]


def _reflector(x: Array, place: Array) -> tuple[Array, Array, Array, Array]:
    """``v`` and ``2/|v|^2`` of the reflection that clears ``x`` below its leading entry, and this entry after and before.

    ``place`` (n, 1) marks the leading entry of ``x`` (n, N), which vanishes above it.
    """
    leading = jnp.sum(jnp.where(place, x, 0.0), axis=0)
    square = jnp.sum(x * x, axis=0)
    norm = jnp.sqrt(square)
    new = jnp.where(leading > 0, -norm, norm)
    half = square - leading * new
    some = half > _TINY_SQUARE
    return jnp.where(place, x - new, x), jnp.where(some, 1 / jnp.where(some, half, 1.0), 0.0), new, leading


def _combination(weights: Array, a: Array, axis: int) -> Array:
    """``sum_i weights[i] a[i]`` over the rows (``axis`` 0) or columns (1) of ``a`` (m, n, N), weights (m or n, N).

    A sum of slices vectorises over the lanes, unlike a reduction. It adds some terms at a time, because a single expression
    would take long to compile.
    """
    count = a.shape[axis]
    rest = count % _TERMS if count >= 2 * _TERMS else count

    def term(i: Any) -> Array:
        row = lax.dynamic_index_in_dim(weights, i, 0, keepdims=False)
        return row * lax.dynamic_index_in_dim(a, i, axis, keepdims=False)

    def add(group: Array, total: Array) -> Array:
        return total + sum(term(rest + group * _TERMS + i) for i in range(_TERMS))

    start = sum((term(i) for i in range(rest)), jnp.zeros((a.shape[1 - axis], a.shape[2])))
    return lax.fori_loop(0, (count - rest) // _TERMS, add, start)


def _reduce_row_and_column(k: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Clear column ``k`` below the diagonal and row ``k`` right of its neighbour, by one combined update."""
    a, diagonal, upper = state
    rows, columns, certain = jnp.arange(a.shape[0])[:, None], jnp.arange(a.shape[1])[:, None], k >= 0

    def column() -> tuple[Array, ...]:
        return _reflector(jnp.where(rows >= k, lax.dynamic_index_in_dim(a, k, 1, keepdims=False), 0.0), rows == k)

    v, factor, new_diagonal, leading = evaluated_once(certain, column)
    w = evaluated_once(certain, lambda: factor * _combination(v, a, 0))

    # Evaluate once: where the row is only rounding, two evaluations would give two different reflections.
    y = evaluated_once(
        certain, lambda: lax.dynamic_index_in_dim(a, k, 0, keepdims=False) - (leading - new_diagonal) * w
    )

    def row() -> tuple[Array, ...]:
        u, factor, new, _ = _reflector(jnp.where(columns > k, y, 0.0), columns == k + 1)
        return u, factor, new, jnp.sum(w * u, axis=0)

    u, factor_u, new_upper, across = evaluated_once(certain, row)
    z = evaluated_once(certain, lambda: factor_u * (_combination(u, a, 1) - v * across))
    a = a - v[:, None] * w - z[:, None] * u
    diagonal = lax.dynamic_update_index_in_dim(diagonal, new_diagonal, k, 0)
    return a, diagonal, lax.dynamic_update_index_in_dim(upper, new_upper, k, 0)


def _bidiagonalise(a: Array) -> tuple[Array, Array]:
    """Diagonal and upper diagonal, both ``(n, N)``, of a bidiagonal matrix with the singular values of ``a``.

    ``a`` has shape ``(m, n, N)`` with ``m >= n``; the last entry of the upper diagonal is zero.
    """
    stages = []
    while a.shape[1]:
        steps = min(_STAGE, a.shape[1])
        zero = jnp.zeros((steps, a.shape[2]), a.dtype)
        a, diagonal, upper = lax.fori_loop(0, steps, _reduce_row_and_column, (a, zero, zero))
        stages.append((diagonal, upper))
        a = a[steps:, steps:]
    diagonal, upper = (jnp.concatenate([pair[i] for pair in stages]) for i in (0, 1))
    return diagonal, upper.at[-1].set(0.0)


def _smaller_value(f: Array, g: Array, h: Array) -> Array:
    """The smaller singular value of [[f, g], [0, h]]."""
    low, high = jnp.minimum(jnp.abs(f), jnp.abs(h)), jnp.maximum(jnp.abs(f), jnp.abs(h))
    total = jnp.sqrt((high + low) ** 2 + g**2) + jnp.sqrt((high - low) ** 2 + g**2)
    return 2 * low * (high / jnp.maximum(total, _TINY))


def _rotation(f: Array, g: Array) -> tuple[Array, Array, Array]:
    """``c``, ``s`` and ``r`` with [c, s; -s, c] (f, g) = (r, 0); the identity where both are negligible.

    The rotation is always orthogonal, because it also applies to entries that are not negligible.
    """
    square = f * f + g * g
    some = square > _NEGLIGIBLE**2
    inverse = lax.rsqrt(jnp.where(some, square, 1.0))
    return jnp.where(some, f * inverse, 1.0), jnp.where(some, g * inverse, 0.0), jnp.where(some, square * inverse, f)


def _split(pairs: Array) -> tuple[Array, Array, Array]:
    """``pairs`` without negligible upper entries, and first and last row of the lowest unreduced block (0 if none).

    Row ``j`` of ``pairs`` (n + 1, 2, N) holds the upper entry above the diagonal entry ``j``, and the diagonal entry.
    """
    upper, diagonal = pairs[1:, 0], jnp.abs(pairs[:, 1])
    coupled = jnp.abs(upper) > EPS * (diagonal[:-1] + diagonal[1:]) + _NEGLIGIBLE
    # Loop over the rows: a reduction would not vectorise over the lanes.
    last = first = jnp.zeros(pairs.shape[-1], int)
    for row in range(1, len(coupled) + 1):
        last = jnp.where(coupled[row - 1], row, last)
    for row in range(1, len(coupled)):
        first = jnp.where(~coupled[row - 1] & (row < last), row, first)
    cleared = jnp.stack([jnp.where(coupled, upper, 0.0), pairs[1:, 1]], axis=1)
    return jnp.concatenate([pairs[:1], cleared]), first, last


def _shifted_start(pairs: Array, first: Array, last: Array) -> Array:
    """Leading entry of the first rotation: that of ``B^T B - shift^2``, divided by the leading entry of B."""

    def entry(column: int, row: Array) -> Array:
        return jnp.take_along_axis(pairs[:, column], jnp.maximum(row, 0)[None], axis=0, mode="clip")[0]

    shift = _smaller_value(entry(1, last - 1), entry(0, last), entry(1, last))
    top = entry(1, first)
    size = jnp.maximum(jnp.abs(top), _TINY)
    # A shift without influence on the first rotation would only cost accuracy.
    shift = jnp.where((shift / size) ** 2 < EPS, 0.0, shift)
    return (size - shift) * (1 + shift / size) * jnp.where(top < 0, -1.0, 1.0)


def _sweep(pairs: Array, first: Array, last: Array) -> Array:
    """One implicit QR step in the block ``first..last`` of every lane (lanes without a block stay as they are)."""
    start, lanes = _shifted_start(pairs, first, last), pairs.shape[-1]
    begin, end = jnp.min(jnp.where(last > 0, first, pairs.shape[0] - 1)), jnp.max(last)

    def row(array: Array, k: Any) -> Array:
        return lax.dynamic_index_in_dim(array, k, 0, keepdims=False)

    def step(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        swept, f, c, s, above, here = state
        upper, below = row(pairs, k + 1)
        inside, top = (k >= first) & (k < last), k == first
        f, g, right = jnp.where(top, start, f), jnp.where(top, upper, s * upper), jnp.where(top, upper, c * upper)
        c, s, r = _rotation(f, g)
        above = jnp.where(inside & ~top, r, above)
        # Evaluate once: where f and g are only rounding, two evaluations would give two different rotations.
        f, g = evaluated_once(k >= 0, lambda: (c * here + s * right, s * below))
        right, corner = c * right - s * here, c * below
        c, s, r = _rotation(f, g)
        swept = lax.dynamic_update_index_in_dim(swept, jnp.stack([above, jnp.where(inside, r, here)]), k, 0)
        f, corner = c * right + s * corner, c * corner - s * right
        return swept, f, c, s, jnp.where(inside, f, upper), jnp.where(inside, corner, below)

    above, here = row(pairs, begin)
    zero = jnp.zeros(lanes)
    # Read from one array and write to another: a single array would be copied in every step.
    swept, _, _, _, above, here = lax.fori_loop(begin, end, step, (pairs, zero, zero, zero, above, here))
    return lax.dynamic_update_index_in_dim(swept, jnp.stack([above, here]), end, 0)


def bidiagonal_values(form: Bidiagonal) -> tuple[Array, Array]:
    """Singular values ``(n, N)``, of every block in its own rows but in no order, and flags if all were found.

    Lanes that are not finite, or whose values were not found, are NaN.
    """
    n, lanes = form.diagonal.shape
    zero = jnp.zeros((1, lanes))
    # An exact zero would stop the effect of the shift on the rows below.
    diagonal = jnp.where(jnp.abs(form.diagonal) < _TINY, _TINY, form.diagonal)
    above = jnp.concatenate([zero, form.upper[:-1], zero])
    pairs, first, last = _split(jnp.stack([above, jnp.concatenate([diagonal, zero])], axis=1))

    def unfinished(state: tuple[Array, ...]) -> Array:
        count, _, _, last = state
        return (count < _SWEEPS_PER_VALUE * n) & jnp.any(last > 0)

    def improve(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, pairs, first, last = state
        return count + 1, *_split(_sweep(pairs, first, last))

    _, pairs, _, last = lax.while_loop(unfinished, improve, (jnp.int32(0), pairs, first, last))
    complete = form.finite & (last == 0)
    values = jnp.abs(pairs[:n, 1])
    values = jnp.where(values < n * _TINY, 0.0, values) * form.scale
    return jnp.where(complete, values, jnp.nan), complete


# Right singular vectors of many small matrices at once, without LAPACK: one-sided Jacobi rotations, lanes last.
#
# Hestenes' method (Golub & Van Loan, Matrix Computations, 8.6.3) with the pairs of a round-robin tournament: all pairs
# of a round are disjoint and rotate together. The vectors are products of rotations, hence orthonormal up to rounding,
# even within clusters and for singular values of zero.

_MAX_SWEEPS = 30


def jacobi_vectors(a: Array) -> tuple[Array, Array]:
    """Orthonormal ``V`` (n, n, N) such that ``a V`` has orthogonal columns, in no order, and flags of convergence ``(N,)``.

    ``a`` has shape ``(m, n, N)``. Columns of a block-diagonal ``a`` are not mixed across the blocks. A lane with an
    entry that is not finite returns the identity, not converged.
    """
    m, n, lanes = a.shape
    finite = jnp.all(jnp.isfinite(a), axis=(0, 1))
    identity = jnp.broadcast_to(jnp.eye(n)[:, :, None], (n, n, lanes))
    size = jnp.max(jnp.abs(a), axis=(0, 1))
    scaled = a / jnp.where(finite & (size > 0), size, 1.0)
    columns = jnp.swapaxes(jnp.concatenate([jnp.where(finite, scaled, 0.0), identity]), 0, 1)
    if n == 1:
        return identity, finite
    half = (n + 1) // 2
    padded = jnp.concatenate([columns, jnp.zeros((2 * half - n, m + n, lanes))])
    # Smaller columns are rounding of the largest column and need not become orthogonal.
    noise = EPS * n * jnp.sqrt(jnp.max(jnp.sum(padded[:, :m] ** 2, axis=1), axis=0))

    def round_of_pairs(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        top, bottom, rotated = state
        top, bottom, turned = _rotate(top, bottom, m, noise)
        first, rest = top[:1], jnp.concatenate([bottom[:1], top[1:]])
        top, bottom = jnp.concatenate([first, rest[:-1]]), jnp.concatenate([bottom[1:], rest[-1:]])
        return top, bottom, rotated | turned

    def sweep(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, top, bottom, _ = state
        start = (top, bottom, jnp.zeros(lanes, bool))
        return count + 1, *lax.fori_loop(0, 2 * half - 1, round_of_pairs, start)

    def unfinished(state: tuple[Array, ...]) -> Array:
        return (state[0] < _MAX_SWEEPS) & jnp.any(state[3])

    # Columns 0..h-1 face columns h..2h-1; after a full tournament every column is back in its place.
    start = (jnp.int32(0), padded[:half], padded[half:], jnp.ones(lanes, bool))
    _, top, bottom, rotated = lax.while_loop(unfinished, sweep, start)
    vectors = jnp.concatenate([top, bottom])[:n, m:]
    return jnp.swapaxes(vectors, 0, 1), finite & ~rotated


def _rotate(top: Array, bottom: Array, m: int, noise: Array) -> tuple[Array, Array, Array]:
    """Columns rotated so that facing columns are orthogonal in their first ``m`` entries, and flags of rotated lanes."""
    x, y = top[:, :m], bottom[:, :m]
    a, b, product = jnp.sum(x * x, axis=1), jnp.sum(y * y, axis=1), jnp.sum(x * y, axis=1)
    sizes = jnp.sqrt(a) * jnp.sqrt(b)
    needed = (jnp.abs(product) > 4 * EPS * sizes) & (jnp.minimum(a, b) > noise**2)
    safe = jnp.where(needed, product, 1.0)
    zeta = (b - a) / (2 * safe)
    t = jnp.where(zeta < 0, -1.0, 1.0) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta**2))
    t = jnp.where(needed, t, 0.0)
    c = lax.rsqrt(1 + t * t)
    s = c * t
    c, s = c[:, None], s[:, None]
    return c * top - s * bottom, s * top + c * bottom, jnp.any(needed, axis=0)
