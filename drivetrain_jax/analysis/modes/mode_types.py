"""Modes of one block of a spring system, with the family of each mode or its shares of several families.

Eigenvectors of a multiple frequency are arbitrary within their space. A rotation makes them diagonalise the operator whose
eigenvalue is the number of the family, so that a pure mode in the space becomes an eigenvector. Eigenvectors of
different frequencies stay unchanged, however close the frequencies are. Only the type of a mode may come from a vector
rotated within a wider cluster.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul
from drivetrain_jax.analysis.numerics.singular_values import EPS, jacobi_vectors, singular_values
from drivetrain_jax.systems import Block

# Branches of modes along a path, by the modal assurance criterion (MAC) between neighbouring points.
#
# Modes that exchange their order in frequency keep their branches. At a veering, where two modes exchange their shapes,
# the branch goes with the shape. Modes of a multiple frequency are compared as a space.


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


# Code of a rigid mode; then follow the codes of the families and of a coupled mode.
RIGID = 0
# Largest share of a mode outside a family for which the mode belongs to the family.
PURITY = 1e-6
# Rounding units of the largest angular frequency within which frequencies count as equal.
_ROUNDING = 64
# Relative distance of neighbours in a cluster of angular frequencies, whose modes are typed, tracked and differentiated
# together.
CLUSTER = 5e-8
# Asymmetry up to which the families are coupled only at nearly equal frequencies; modes of wider clusters are then typed
# together.
SYMMETRIC = 2e-9
_CLUSTER_IF_SYMMETRIC = 5e-5
# Weight of motions along x, below the distance 1 of the numbers of the families, which take precedence.
_POLARISATION = 0.5


class BlockModes(NamedTuple):
    """Modes of one block: angular ``frequency`` (n, ...), mass-weighted ``vectors`` (n, n, ...) as columns in the
    coordinates of the block, share of each family ``participation`` (n, families, ...), code of the
    type as ``label`` (n, ...), ``found`` (...)."""

    frequency: Array
    vectors: Array
    participation: Array
    label: Array
    found: Array


def mode_type_names(families: tuple[str, ...]) -> tuple[str, ...]:
    """The types of modes by their codes."""
    return ("rigid", *families, "coupled")


def block_modes(block: Block, largest: Array, asymmetry: Array, families: int) -> BlockModes:
    """Modes of ``block`` (lanes (N,)) by rising frequency; ``largest`` is the system's largest angular frequency.

    The frequencies are singular values and not norms ``|G v|`` of the factor times a vector: errors of rotated vectors, and
    for rigid modes the rounding of all rotations, would enter the norms.
    """
    frequency, values_found = singular_values(block.factor)
    vectors, vectors_found = jacobi_vectors(block.factor)
    vectors = _rising(block.factor, vectors)
    rounding = jnp.broadcast_to(_ROUNDING * EPS * largest, frequency[1:].shape)
    own = _turned(block, vectors, clusters(frequency, rounding), np.where(block.polar, _POLARISATION, 0.0))
    relative = jnp.where(asymmetry <= SYMMETRIC, _CLUSTER_IF_SYMMETRIC, CLUSTER)
    named = vectors
    if len(set(block.family)) > 1:
        named = _turned(block, vectors, clusters(frequency, jnp.maximum(relative * frequency[1:], rounding)), 0.0)
    share, label = _participation(block, own, families), _label(_participation(block, named, families))
    return BlockModes(frequency, own, share, label, values_found & vectors_found)


def _rising(factor: Array, vectors: Array) -> Array:
    order = jnp.argsort(jnp.sum(looped_matmul(factor, vectors) ** 2, axis=0), axis=0)
    return jnp.take_along_axis(vectors, order[None], axis=1)


def _in_frame(block: Block, vectors: Array) -> Array:
    return vectors if block.frame is None else looped_matmul(jnp.swapaxes(block.frame, 0, 1), vectors)


def clusters(frequency: Array, tolerance: Array) -> Array:
    """Flags of modes i and j in the same cluster, (n, n, ...): neighbours at most ``tolerance`` (n - 1, ...) apart."""
    apart = (frequency[1:] - frequency[:-1] > tolerance).astype(jnp.int32)
    number = jnp.concatenate([jnp.zeros_like(apart[:1]), jnp.cumsum(apart, axis=0)])
    return number[:, None] == number[None]


def one_frequency(frequency: Array, largest: Array) -> Array:
    """Flags of modes (n, n, ...) in the same cluster, in a system whose largest frequency is ``largest`` (...)."""
    return clusters(frequency, jnp.maximum(CLUSTER * frequency[1:], _ROUNDING * EPS * largest))


def _turned(block: Block, vectors: Array, near: Array, further: np.ndarray | float) -> Array:
    """``vectors`` rotated within the clusters ``near`` so that they are as pure as possible.

    ``further`` weighs the columns of the frame within each family. Vectors move no more than necessary.
    """
    weights = 1.0 + block.family + further
    if len(set(weights)) == 1:
        return vectors

    def turn() -> Array:
        amplitudes = _in_frame(block, vectors)
        weighted = weights.reshape(-1, 1, *(1,) * (vectors.ndim - 2)) * amplitudes
        operator = jnp.where(near, looped_matmul(jnp.swapaxes(amplitudes, 0, 1), weighted), 0.0)
        return looped_matmul(vectors, jacobi_vectors(operator)[0])

    # A cluster of several modes has neighbours. Most gears without symmetry have no such cluster and need no rotation.
    neighbours = jnp.diagonal(near, offset=1)
    return lax.cond(jnp.any(neighbours), turn, lambda: vectors)


def _participation(block: Block, vectors: Array, families: int) -> Array:
    shares = _in_frame(block, vectors) ** 2
    return jnp.stack([jnp.sum(shares[block.family == kind], axis=0) for kind in range(families)], axis=1)


def _label(participation: Array) -> Array:
    pure = participation > 1 - PURITY
    return jnp.where(jnp.any(pure, axis=1), 1 + jnp.argmax(pure, axis=1), 1 + participation.shape[1])


def mode_types(frequency: Array, label: Array, largest: Array) -> Array:
    """Codes of the types, int8 (n, ...), from the codes of the families and the rigid modes."""
    return jnp.where(is_rigid(frequency, largest), RIGID, label).astype(jnp.int8)


def is_rigid(frequency: Array, largest: Array) -> Array:
    """Flags of modes whose frequency is zero up to rounding of the largest frequency."""
    return frequency <= _ROUNDING * EPS * largest
