"""The count of whirl frequencies of a shaft whose supports differ between two planes, without poles.

In the deflections ``X cos pt`` and ``Y sin pt`` of the planes the dynamic stiffness is real and symmetric. Inside a segment
``X + Y`` whirls forward and ``X - Y`` backward, each for itself; only the springs ``k`` and ``k_y`` couple them. A segment
moves symmetrically or antisymmetrically about its middle. The states of its half give the stiffness of either motion,
``S = w w^T/b + rest`` with finite ``w``, ``b``, ``rest``; a pole is ``b = 0``. With an unknown of its own for every ``b``
(the matrix ``[[-b, w^T], [w, rest]]``) nothing is large, and the number of frequencies below p is (Wittrick & Williams 1971)

    N = sum J0 + negative eigenvalues of the matrix - number of b > 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import (
    Value,
    clamped_count,
    functions_of,
    segments_of,
    sign_of,
    split_inertia,
)
from drivetrain_jax.analysis.numerics.linear_algebra import inertia_and_determinant, solve
from drivetrain_jax.systems import Shaft

# Ends (f, theta in front; f, theta behind) of the symmetric and of the antisymmetric motion: its deflection, its slope.
_FORMS = np.array([[[1, 0, 1, 0], [-1, 0, 1, 0]], [[0, -1, 0, 1], [0, 1, 0, 1]]]) / np.sqrt(2)
# Relative distance from a frequency at which its null vector is computed.
_ASIDE = 1e-12


def _rows(segments: int, hinges: bool) -> tuple[np.ndarray, ...]:
    """Unknowns as rows: the ends and own unknowns of segments ``(n, 6, size)``; f, theta, theta behind the joint at nodes.

    The unknowns are f and theta at the nodes, the rotations of the joints if there are ``hinges``, and the segments' own.
    """
    nodes, joints = segments + 1, (segments - 1) * hinges
    f, theta, turned, inner = np.split(np.eye(2 * nodes + joints + 2 * segments), np.cumsum([nodes, nodes, joints]))
    behind = theta.copy()
    behind[1 : 1 + joints] += turned
    ends = np.stack([f[:-1], behind[:-1], f[1:], theta[1:]], axis=1)
    return np.concatenate([ends, inner.reshape(segments, 2, -1)], axis=1), f, theta, behind


def _one_sense(shaft: Shaft, q: Array, sense: Array, mass: Array) -> tuple[Array, Array]:
    """Matrix of one sense of whirl without springs, and the part of its count that is not the matrix's.

    ``mass`` multiplies all masses, for derivatives.
    """
    scaled = {name: getattr(shaft, name) for name in ("rhoA", "m", "rhoI", "inertia")}
    scaled = {name: None if x is None else mass * x for name, x in scaled.items()}
    shaft = shaft._replace(**scaled, spin=None if shaft.spin is None else sense * shaft.spin)
    segments, _ = segments_of(shaft, q)
    half = segments._replace(beta=segments.beta / 2)
    functions = functions_of(half, q)
    zero, one = jnp.zeros_like(half.beta), jnp.ones_like(half.beta)
    states = functions.propagate((zero, one, zero, zero, zero)), functions.propagate((zero, zero, zero, one, zero))
    u0, u1, u2, u3, u4 = (jnp.stack(pair) for pair in zip(*states, strict=True))
    clamped, sign = clamped_count(half, functions, q)
    turns = jnp.abs(u1) >= jnp.abs(u3)
    pivot = jnp.where(turns, u1, u3)
    count = 2 * jnp.sum(clamped) + jnp.sum(0.5 * (1 - sign_of(u0) * sign)) - jnp.sum(u0 * pivot > 0)

    w = jnp.stack([jnp.where(turns, u2 / pivot, 1.0), jnp.where(turns, 1.0, u2 / pivot)])
    rest = jnp.stack([turns, ~turns]) * (u4 / pivot)
    forms = jnp.sqrt(jnp.stack([half.e3, half.e1]))[:, None, :, None] * _FORMS[:, :, None]
    border = jnp.einsum("dkn,dkni->nki", w, forms)
    corner = -(u0 / pivot).T[:, :, None] * jnp.eye(2)
    local = jnp.einsum("dkn,dkni,dknj->nij", rest, forms, forms)
    local = jnp.block([[local, jnp.swapaxes(border, 1, 2)], [border, corner]])
    places, f, theta, behind = _rows(shaft.segments, shaft.k_hinge is not None)
    matrix = jnp.einsum("nai,nab,nbj->ij", places, local, places)
    front, back = split_inertia(shaft.turning(q * q))
    for load, power, rows in ((shaft.m, 1, f), (front, 3, theta[:-1]), (back, 3, behind)):
        if load is not None:
            matrix = matrix - jnp.einsum("n,ni,nj->ij", load * q**power, rows, rows)
    return matrix, count


def _matrix(shaft: Shaft, q: Array, masses: Array) -> tuple[Array, Array]:
    """The scaled matrix of both planes, ``(2 size, 2 size)``, and the part of the count that is not the matrix's.

    ``masses`` multiply those of forward and of backward whirl.
    """
    senses = jax.vmap(partial(_one_sense, shaft, q))(jnp.array([1.0, -1.0]), masses)
    (forward, backward), counts = senses
    same, other = (forward + backward) / 2, (forward - backward) / 2
    rotation = jnp.zeros(shaft.segments + 1) if shaft.k_rot is None else shaft.k_rot
    parts = [rotation / q] + ([] if shaft.k_hinge is None else [shaft.k_hinge / q]) + [jnp.zeros(2 * shaft.segments)]
    springs = jnp.concatenate([shaft.k / q**3, *parts, shaft.k_y / q**3, *parts])
    rigid = jnp.isinf(springs)
    whole = jnp.block([[same, other], [other, same]]) + jnp.diag(jnp.where(rigid, 0.0, springs))
    whole = jnp.where(rigid[:, None] | rigid, jnp.diag(jnp.where(rigid, 1.0, 0.0)), whole)
    scale = jnp.ones(len(whole))
    for _ in range(3):
        scale = scale / jnp.sqrt(jnp.max(jnp.abs(scale[:, None] * whole * scale), axis=0))
    scale = jax.lax.stop_gradient(scale)
    return scale[:, None] * whole * scale, jnp.sum(counts)


def _each(function: Callable[..., Any], shaft: Shaft, q: Array, *more: Array) -> Any:
    """``function(shaft, q, *more)`` of single lanes for arrays ``(..., *lanes)``; results have these axes first."""
    flat = jax.tree.map(lambda field: field.reshape(len(field), -1), shaft.spread())
    arrays = [x.reshape(-1, flat.k.shape[1], *x.shape[q.ndim :]) for x in (q, *more)]
    along = jax.vmap(function, in_axes=(1, *(0 for _ in arrays)))
    results = jax.vmap(along, in_axes=(None, *(0 for _ in arrays)))(flat, *arrays)
    return jax.tree.map(lambda x: x.reshape(*q.shape, *x.shape[2:]), results)


def characteristic(shaft: Shaft, q: Array) -> Value:
    """As :func:`~drivetrain_jax.analysis.critical_speeds.compound.characteristic`: the determinant, and the count."""

    def single(shaft: Shaft, q: Array) -> Value:
        matrix, count = _matrix(shaft, q, jnp.ones(2))
        negative, determinant = inertia_and_determinant(matrix)
        return Value(determinant, count + negative)

    return _each(single, shaft, q)


def null_vectors(shaft: Shaft, q: Array) -> Array:
    """Null vectors of the matrix at the frequencies ``q`` by inverse iteration, ``(*q.shape, 2 size)``."""

    def single(shaft: Shaft, q: Array) -> Array:
        # At the root itself a pivot may be exactly zero.
        matrix, _ = _matrix(shaft, q * (1 + _ASIDE), jnp.ones(2))
        vector = jnp.cos(jnp.arange(1.0, len(matrix) + 1))[:, None]
        for _ in range(3):
            vector = solve(matrix, vector)
            vector = vector / jnp.sqrt(jnp.sum(vector**2))
        return vector[:, 0]

    return _each(single, shaft, q)


def _form(shaft: Shaft, q: Array, vector: Array, masses: Array) -> Array:
    return vector @ _matrix(shaft, q, masses)[0] @ vector


def residual(vectors: Array, shaft: Shaft, q: Array) -> Array:
    """The quadratic form of the matrix for ``vectors``, whose zero is the frequency, ``(1, *q.shape)``."""
    return _each(lambda shaft, q, x: _form(shaft, q, x, jnp.ones(2)), shaft, q, vectors)[None]


def directions(shaft: Shaft, q: Array) -> Array:
    """``2 X.MY/(X.MX + Y.MY)`` of the modes at ``q``, in [-1, 1], from the derivatives by the masses of both senses."""

    def single(shaft: Shaft, q: Array, vector: Array) -> Array:
        forward, backward = jax.jacfwd(_form, argnums=3)(shaft, q, vector, jnp.ones(2))
        return (forward - backward) / (forward + backward)

    return _each(single, shaft, q, null_vectors(shaft, q))
