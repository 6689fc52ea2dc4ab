"""Modes of multiple and of almost equal frequencies: the eigenspace of all of them, and its directions.

At a natural frequency the conditions ``A(q) x = 0`` on the states x at the ends of all segments have a solution. For a
cluster of frequencies the solutions are the smallest singular vectors X of A at one of them. With the left vectors Y,
which follow from X by the symplectic form, ``Y^T A' X`` is the mass matrix of the modes (times a number) and ``Y^T A X``
their stiffness beside that frequency: the directions that diagonalise both are the modes, orthogonal in the mass
(Rayleigh & Ritz). In an exactly multiple frequency the stiffness is rounding and any orthogonal directions are right: those
are taken that differ most in their places, so that each moves one of the spans that hinges on rigid supports separate.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import rotation_shares, support_shares
from drivetrain_jax.analysis.critical_speeds.links import Links, Segments, across_joints, along_segments
from drivetrain_jax.analysis.critical_speeds.segments import Scales
from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul, matmul, solve
from drivetrain_jax.analysis.numerics.singular_vectors import jacobi_vectors
from drivetrain_jax.systems import Shaft

# Relative distance up to which q belong to a cluster: a double root of Psi is known to the root of rounding only.
_CLOSE = 1e-7
# Relative distance up to which q are equal, and the one by which places part them.
_EQUAL, _PARTED = 1e-13, 1e-14
# The symplectic form of the states (f, theta, M, F).
_FORM = np.array([[0, 0, 0, -1.0], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]])


def states_in_clusters(shaft: Shaft, q: Array, states: Array) -> Array:
    """``states`` at the ends of segments, ``(2n, 4, modes, *lanes)``, with those of the eigenspace where ``q`` is in a
    cluster."""
    modes, lanes = q.shape[0], q.shape[1:]
    if modes == 1:
        return states
    flat = q.reshape(modes, -1)
    near = jnp.abs(flat[1:] - flat[:-1]) <= _CLOSE * flat[1:]
    apart, index = jnp.ones_like(near[:1]), jnp.arange(modes)[:, None]
    first = jax.lax.cummax(jnp.where(jnp.concatenate([apart, ~near]), index, 0))
    last = jax.lax.cummin(jnp.where(jnp.concatenate([~near, apart]), index, modes), reverse=True)
    fields = jax.tree.map(lambda field: field.reshape(len(field), -1), shaft.spread())
    most = min(modes, 2 * shaft.segments)

    def own(mode: tuple[Array, ...]) -> Array:
        q, size, rank, known = mode
        return jax.lax.cond(
            jnp.any(size > 1),
            lambda: jnp.where(size > 1, _states(fields, q, size, rank, most), known),
            lambda: known,
        )

    known = jnp.moveaxis(states.reshape(*states.shape[:2], modes, -1), 2, 0)
    found = jax.lax.map(own, (jnp.take_along_axis(flat, first, axis=0), last - first + 1, index - first, known))
    return jnp.moveaxis(found, 0, 2).reshape(*states.shape[:2], modes, *lanes)


def _states(shaft: Shaft, q: Array, size: Array, rank: Array, most: int) -> Array:
    """States ``(2n, 4, lanes)`` of the mode ``rank`` of the ``size`` ones at and above ``q``, at most ``most``."""
    (before, behind), slopes = jax.jvp(partial(_conditions, shaft), (q,), (jnp.ones_like(q),))
    links, lanes = before.shape[2:]
    number = jnp.arange(links)
    blocks = jnp.zeros((links, 4, links + 1, 4, lanes)).at[number, :, number].set(jnp.moveaxis(before, 2, 0))
    blocks = blocks.at[number, :, number + 1].set(-jnp.moveaxis(behind, 2, 0))
    matrix = blocks[:, :, 1:-1].reshape(4 * links, 4 * (links - 1), lanes)
    vectors = jacobi_vectors(matrix)[0]
    smallest = jnp.argsort(jnp.sum(looped_matmul(matrix, vectors) ** 2, axis=0), axis=0)[:most]
    vectors = jnp.take_along_axis(vectors, smallest[None], axis=1)
    x = jnp.moveaxis(vectors.reshape(links - 1, 4, most, lanes), 0, 2)

    dual = matmul(jnp.asarray(_FORM)[:, :, None, None], x) * jnp.repeat(Scales.of(shaft).e3, 2, axis=0)
    nothing = jnp.zeros_like(x[:, :, :1])

    def in_front(of: Array) -> Array:
        return jnp.concatenate([nothing, of], axis=2)

    def after(of: Array) -> Array:
        return jnp.concatenate([of, nothing], axis=2)

    both = jnp.concatenate([before, behind], axis=1)
    pair = jnp.concatenate([in_front(dual), after(dual)])
    y = solve(matmul(both, jnp.swapaxes(both, 0, 1)), matmul(both, pair))

    direction, unit = jnp.arange(most)[:, None], jnp.eye(most)[:, :, None]
    inside = (direction[:, None] < size) & (direction[None] < size)

    def form(left: Array, right: Array) -> Array:
        product = jnp.sum(matmul(jnp.swapaxes(left, 0, 1), right), axis=2)
        return jnp.where(inside, 0.5 * (product + jnp.swapaxes(product, 0, 1)), 0.0)

    def change(links: Links) -> Array:
        return matmul(links.before, in_front(x)) - matmul(links.behind, after(x))

    mass = form(y, change(Links(*slopes))) + jnp.where(inside, 0.0, unit)
    axes = jacobi_vectors(mass)[0]
    axes = axes / jnp.sqrt(jnp.sum(axes * matmul(mass, axes), axis=0))

    def along_axes(form: Array) -> Array:
        return matmul(jnp.swapaxes(axes, 0, 1), matmul(form, axes))

    stiffness = along_axes(form(y, change(Links(before, behind))))
    places = along_axes(form(x, x * jnp.arange(links - 1)[:, None]))
    places = _PARTED * q * places / jnp.sum(jnp.abs(places), axis=(0, 1))
    stiffness = jnp.where(jnp.abs(stiffness) > _EQUAL * q, stiffness, 0.0) - places
    # Positive, so that its singular vectors are its eigenvectors.
    turned = jacobi_vectors(stiffness + 2 * jnp.sum(jnp.abs(stiffness), axis=(0, 1)) * unit)[0]
    distance = -jnp.sum(turned * matmul(stiffness, turned), axis=0)
    place = jnp.argsort(jnp.where(direction < size, distance, jnp.inf), axis=0)
    own = jnp.take_along_axis(place, jnp.minimum(rank, most - 1)[None], axis=0)
    combination = matmul(axes, jnp.take_along_axis(turned, own[None], axis=1))
    return jnp.moveaxis(matmul(x, combination[:, :, None])[:, 0], 0, 1)


def _conditions(shaft: Shaft, q: Array) -> Links:
    """The forms along all segments, across all joints and at the ends, ``(4, 4, 2n + 1, lanes)``, at ``q`` of every lane.

    At an end, two forms of its state vanish, and two of a state beyond it, which is nothing.
    """
    scales, q = Scales.of(shaft), q[None]
    along, across = along_segments(Segments.of(shaft, q)), across_joints(shaft, q)
    none, one = jnp.zeros_like(q), jnp.ones_like(q)

    def end(node: int, sign: float) -> tuple[Array, Array]:
        m, k_rot, inertia = (None if x is None else x[node] for x in (shaft.m, shaft.k_rot, shaft.inertia))
        e1, e3 = scales.e1[node], scales.e3[node]
        keep, add = support_shares(shaft.k[node], m, e3, q)
        turn, hold = rotation_shares(k_rot, inertia, e1, q)
        force, moment = (sign * add / e3, none, none, keep), (none, -sign * hold / e1, turn, none)
        empty = (none,) * 4
        rows = (force, moment, empty, empty), (empty, empty, (one, none, none, none), (none, one, none, none))
        at, beyond = (jnp.stack([jnp.stack(jnp.broadcast_arrays(*row)) for row in part]) for part in rows)
        return at, beyond

    (at_a, beyond_a), (at_d, beyond_d) = end(0, 1.0), end(-1, -1.0)

    def woven(first: Array, across: Array, along: Array, last: Array) -> Array:
        segments = jnp.stack(jnp.broadcast_arrays(across, along), axis=1).reshape(-1, *along.shape[1:])[1:]
        return jnp.moveaxis(jnp.concatenate([first[None], segments, last[None]])[..., 0, :], 0, 2)

    return Links(woven(beyond_a, across.before, along.before, at_d), woven(at_a, across.behind, along.behind, beyond_d))
