"""Branches of modes along a path, by the modal assurance criterion (MAC) between neighbouring points.

Modes that exchange their order in frequency keep their branches. At a veering, where two modes exchange their shapes, the
branch goes with the shape. Modes of a multiple frequency are compared as a space.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul

# Share of a branch's shape in the space of its new frequency below which the shape of the new mode replaces it.
_CARRIED = 0.25
# Weight of the distance of single vectors, which decides between the modes of one space: their MAC are equal.
_OWN = 1e-3


def follow(vectors: Array, same: Array) -> tuple[Array, Array]:
    """``branch`` and ``mac``, both ``(L, n, ...)``, of modes along a path of ``L`` points.

    ``vectors`` (L, m, n, ...) are orthonormal shapes as columns, for example mass-weighted shapes. ``same`` (L, n, n, ...)
    marks modes of equal frequency at a point. ``branch`` (int32) is the number, from 1, of the mode at the first point that
    each mode continues. ``mac``, from 0 to 1, is the share of the branch's previous shape in the space of the mode (1 at the
    first point). Every branch continues at every point; pairs are formed by falling MAC. A point with ``vectors`` that are
    not finite has the order by frequency and a ``mac`` of NaN. Such points are skipped: the points on both sides are
    neighbours, and the first point is the first finite one.
    """
    n = vectors.shape[2]
    numbers = jnp.arange(1, n + 1, dtype=jnp.int32).reshape(n, *(1,) * (vectors.ndim - 3))
    first = jnp.broadcast_to(numbers, (n, *vectors.shape[3:]))

    def advance(reference: Array, point: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        shapes, equal = point
        known = jnp.all(jnp.isfinite(shapes), axis=(0, 1))
        shapes = jnp.where(known, shapes, 0.0)
        overlap = looped_matmul(jnp.swapaxes(reference, 0, 1), shapes)
        squares = overlap**2
        shared = jnp.sum(squares[:, :, None] * equal[None], axis=1)
        chosen = _pair(jnp.where(known, shared + _OWN * squares, jnp.eye(n).reshape(n, n, *(1,) * (shapes.ndim - 2))))
        branch = jnp.sum(chosen * first[:, None], axis=0)
        begun = jnp.any(reference != 0, axis=(0, 1))
        mac = jnp.where(begun, jnp.sum(chosen * shared, axis=0), 1.0)
        carried = _carry(overlap, shapes, equal, chosen)
        reference = jnp.where(known, carried, reference)
        return reference, (branch.astype(jnp.int32), jnp.where(known, jnp.minimum(mac, 1.0), jnp.nan))

    start = jnp.where(jnp.isfinite(vectors[0]), vectors[0], 0.0)
    _, (branch, mac) = lax.scan(advance, start, (vectors[1:], same[1:]))
    finite = jnp.all(jnp.isfinite(vectors[0]), axis=(0, 1))
    begin = jnp.where(finite, jnp.ones(first.shape), jnp.nan)
    return jnp.concatenate([first[None], branch]), jnp.concatenate([begin[None], mac])


def _pair(score: Array) -> Array:
    """Permutation matrix (n, n, ...) that pairs branches and modes by falling ``score`` (branches, modes, ...)."""
    n, lanes = score.shape[0], score.shape[2:]
    number = jnp.arange(n * n).reshape(n, n, *(1,) * len(lanes))

    def take(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        score, chosen = state
        best = jnp.argmax(score.reshape(n * n, *lanes), axis=0)
        hit = number == best
        row, column = jnp.any(hit, axis=1, keepdims=True), jnp.any(hit, axis=0, keepdims=True)
        return jnp.where(row | column, -1.0, score), chosen + hit

    return lax.fori_loop(0, n, take, (score, jnp.zeros(score.shape)))[1]


def _carry(overlap: Array, shapes: Array, equal: Array, chosen: Array) -> Array:
    """Shapes of the branches at this point: the projection of each shape on the space of its mode, if large enough."""
    inside = jnp.sum(chosen[:, :, None] * equal[None], axis=1) * overlap
    size = jnp.sum(inside**2, axis=1)
    keep = size > _CARRIED
    continued = inside / jnp.sqrt(jnp.where(keep, size, 1.0))[:, None]
    weights = jnp.where(keep[:, None], continued, chosen)
    return looped_matmul(shapes, jnp.swapaxes(weights, 0, 1))
