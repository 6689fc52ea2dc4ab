"""Right singular vectors of many small matrices at once, without LAPACK: one-sided Jacobi rotations, lanes last.

Hestenes' method (Golub & Van Loan, Matrix Computations, 8.6.3) with the pairs of a round-robin tournament: all pairs of
a round are disjoint and rotate together. The vectors are products of rotations, hence orthonormal up to rounding, even
within clusters and for singular values of zero.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from drivetrain_jax.analysis.numerics.singular_values import EPS

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
