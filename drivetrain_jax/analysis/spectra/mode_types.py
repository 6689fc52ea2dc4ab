"""Modes of one block of a spring system with their families: rotational, translational, planet, or a mixture.

Eigenvectors of a multiple frequency are arbitrary within its space, and nearly so in a cluster. Within each cluster the
vectors are therefore turned until they diagonalise the operator that has the number of the family as its eigenvalue:
a pure mode that is in the space at all then appears as a vector of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.singular_values import EPS
from drivetrain_jax.analysis.numerics.singular_vectors import jacobi_vectors, product
from drivetrain_jax.systems import FAMILIES, Block

MODE_TYPES = ("rigid", *FAMILIES, "coupled")
RIGID, COUPLED = 0, len(FAMILIES) + 1
# A mode belongs to a family if less than this share of it lies outside.
PURITY = 1e-6
# Distance within which angular frequencies form a cluster, relative; and in units of rounding of the largest one.
CLUSTER = 5e-8
_ROUNDING = 64
# Up to this asymmetry the families are uncoupled but for nearly equal frequencies, and these are separated by family.
SYMMETRIC = 2e-9
_CLUSTER_IF_SYMMETRIC = 5e-5
# Vectors of one family are turned towards the polarisation only where their frequencies agree to rounding.
_MULTIPLE = 1e-10
_POLARISATION = 0.5


class BlockModes(NamedTuple):
    """Modes of one block: angular ``frequency`` (n, ...), mass-weighted ``vectors`` (n, n, ...) as columns in the
    coordinates of the block, share of each family ``participation`` (n, families, ...), ``found`` (...)."""

    frequency: Array
    vectors: Array
    participation: Array
    found: Array


def block_modes(block: Block, largest: Array, asymmetry: Array) -> BlockModes:
    """Modes of ``block`` (lanes (N,)) by rising frequency; ``largest`` is the system's largest angular frequency.

    The frequencies are Rayleigh quotients ``|G v|``: their error is of second order in that of the vectors.
    """
    vectors, found = jacobi_vectors(block.factor)
    frequency, vectors = _rising(block.factor, vectors)
    vectors = _align(block, frequency, vectors, largest, asymmetry)
    frequency, vectors = _rising(block.factor, vectors)
    shares = _in_frame(block, vectors) ** 2
    participation = jnp.stack([jnp.sum(shares[block.family == kind], axis=0) for kind in range(len(FAMILIES))], axis=1)
    return BlockModes(frequency, vectors, participation, found)


def _rising(factor: Array, vectors: Array) -> tuple[Array, Array]:
    frequency = jnp.sqrt(jnp.sum(product(factor, vectors) ** 2, axis=0))
    order = jnp.argsort(frequency, axis=0)
    sorted_vectors = jnp.take_along_axis(vectors, order[None], axis=1)
    return jnp.take_along_axis(frequency, order, axis=0), sorted_vectors


def _in_frame(block: Block, vectors: Array) -> Array:
    return vectors if block.frame is None else product(jnp.swapaxes(block.frame, 0, 1), vectors)


def clusters(frequency: Array, tolerance: Array) -> Array:
    """Whether modes i and j are in one cluster, (n, n, ...): neighbours ``tolerance`` (n - 1, ...) apart at most."""
    apart = (frequency[1:] - frequency[:-1] > tolerance).astype(jnp.int32)
    number = jnp.concatenate([jnp.zeros_like(apart[:1]), jnp.cumsum(apart, axis=0)])
    return number[:, None] == number[None]


def _align(block: Block, frequency: Array, vectors: Array, largest: Array, asymmetry: Array) -> Array:
    """``vectors`` turned within clusters until they are as pure as they can be."""
    if len(frequency) == 1 or len(set(block.family)) + len(set(block.polar)) == 2:
        return vectors
    rounding = _ROUNDING * EPS * largest
    relative = jnp.where(asymmetry <= SYMMETRIC, _CLUSTER_IF_SYMMETRIC, CLUSTER)
    shares, lanes = _in_frame(block, vectors), (1,) * (vectors.ndim - 2)
    weighted = (1.0 + block.family).reshape(-1, 1, *lanes) * shares
    turned = np.where(block.polar, _POLARISATION, 0.0).reshape(-1, 1, *lanes) * shares
    near = clusters(frequency, jnp.maximum(relative * frequency[1:], rounding))
    equal = clusters(frequency, jnp.maximum(_MULTIPLE * frequency[1:], rounding))
    across = jnp.swapaxes(shares, 0, 1)
    operator = jnp.where(near, product(across, weighted), 0.0) + jnp.where(equal, product(across, turned), 0.0)
    return product(vectors, jacobi_vectors(operator)[0])


def mode_types(frequency: Array, participation: Array, largest: Array) -> Array:
    """Codes of ``MODE_TYPES``, int8 (n, ...), from ``participation`` (n, families, ...).

    Rigid is what moves at no frequency that differs from zero by more than rounding.
    """
    pure = participation > 1 - PURITY
    family = jnp.where(jnp.any(pure, axis=1), 1 + jnp.argmax(pure, axis=1), COUPLED)
    return jnp.where(is_rigid(frequency, largest), RIGID, family).astype(jnp.int8)


def is_rigid(frequency: Array, largest: Array) -> Array:
    """Which modes have no frequency beyond rounding of the largest one."""
    return frequency <= _ROUNDING * EPS * largest
