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
from drivetrain_jax.analysis.numerics.singular_values import EPS, singular_values
from drivetrain_jax.analysis.numerics.singular_vectors import jacobi_vectors
from drivetrain_jax.systems import Block

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
