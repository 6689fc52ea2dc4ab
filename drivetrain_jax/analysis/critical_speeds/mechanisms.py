"""Motions of a shaft that cost no energy: how many there are, and their shapes.

They exist where springs or rotational stiffness are missing altogether, and have the exact frequency 0, whatever the
other parameters. They are combinations of ``1``, ``x`` and, for each joint that is a hinge, ``max(0, x - x_joint)``.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.systems import Shaft

# Size up to which a combination of motions counts as none: they are of order one.
_NOTHING = 1e-9


def zero_modes(shaft: Shaft) -> Array:
    """Number of mechanisms (modes of frequency 0), shape of the lanes, from the missing springs and hinges.

    From left to right the motions (f, theta) without energy form the plane, a line or nothing. A support removes the
    motions with f != 0. A line with f = 0 is a rotation about this section. A hinge without stiffness frees theta, and a
    rotation that ends there is a separate mode.
    """
    lanes = shaft.lanes
    dimension, turning, found = jnp.full(lanes, 2), jnp.zeros(lanes, bool), jnp.zeros(lanes, int)
    for node in range(shaft.segments + 1):
        if shaft.k_hinge is not None and 0 < node < shaft.segments:
            free = shaft.k_hinge[node - 1] == 0
            found = found + (free & ((dimension == 2) | turning))
            line = free & (dimension == 1) & ~turning
            turning = jnp.where(free & (dimension == 0), True, turning)
            dimension = jnp.where(line, 2, jnp.where(free & (dimension == 0), 1, dimension))
        held = shaft.k[node] > 0
        moved = held & ~turning
        turning = jnp.where(moved & (dimension == 2), True, turning)
        dimension = jnp.where(moved, jnp.maximum(dimension - 1, 0), dimension)
        if node < shaft.segments:
            turning = jnp.zeros_like(turning)
    return found + dimension


def mechanism_shapes(shaft: Shaft, x: Array) -> Array:
    """Deflections of the zero modes at ``x`` in [0, 1], the distance from A over the whole length, orthogonal in the
    mass.

    Shape ``(rows, len(x), *lanes)``: the zero modes first, the other rows are 0. A free shaft moves as a whole, then
    turns about its centre of mass.
    """
    lanes, shaft = shaft.lanes, shaft.spread()
    ends = jnp.concatenate([jnp.zeros_like(shaft.length[:1]), jnp.cumsum(shaft.length, axis=0)])
    ends = ends / ends[-1]
    at_ends = _motions(shaft, ends, ends)
    combination = _unrestrained(shaft, at_ends)
    mass = _masses(shaft, at_ends, _motions(shaft, (ends[1:] + ends[:-1]) / 2, ends))
    columns, found = [], []
    for k in range(combination.shape[1]):
        vector = combination[:, k]
        for other in columns:
            vector = vector - other * _product(other, mass, vector)
        size = jnp.sqrt(jnp.maximum(_product(vector, mass, vector), 0.0))
        some = jnp.max(jnp.abs(vector), axis=0) > _NOTHING
        columns.append(jnp.where(some, vector / jnp.where(some, size, 1.0), 0.0))
        found.append(some)
    order = jnp.argsort(~jnp.stack(found), axis=0, stable=True)
    sorted_columns = jnp.take_along_axis(jnp.stack(columns, axis=1), order[None], axis=1)
    stations = jnp.broadcast_to(x.reshape(len(x), *(1,) * len(lanes)), (len(x), *lanes))
    return jnp.swapaxes(matmul(_motions(shaft, stations, ends), sorted_columns), 0, 1)


def _motions(shaft: Shaft, x: Array, ends: Array) -> Array:
    """The motions at ``x``, shape ``(len(x), motions, *lanes)``; 0 for a joint that is no hinge."""
    rows = [jnp.ones_like(x), x]
    if shaft.k_hinge is not None:
        for joint in range(1, shaft.segments):
            rows.append(jnp.where(shaft.k_hinge[joint - 1] == 0, jnp.maximum(x - ends[joint], 0.0), 0.0))
    return jnp.stack(rows, axis=1)


def _unrestrained(shaft: Shaft, at_ends: Array) -> Array:
    """Combinations of the motions without deflection at the supports, as columns; those used up are 0."""
    count, lanes = at_ends.shape[1], at_ends.shape[2:]
    unit = jnp.eye(count).reshape(count, count, *(1,) * len(lanes))
    used = jnp.any(at_ends != 0, axis=0)
    columns = unit * jnp.where(used, 1.0, 0.0)
    for node in range(len(at_ends)):
        deflection = sum(at_ends[node, i] * columns[i] for i in range(count))
        largest = jnp.argmax(jnp.abs(deflection), axis=0)[None]
        pivot = jnp.take_along_axis(deflection, largest, axis=0)
        taken = jnp.take_along_axis(columns, largest[None], axis=1)
        held = (shaft.k[node] > 0) & (jnp.abs(pivot) > _NOTHING)
        reduced = columns - taken * (deflection / jnp.where(held, pivot, 1.0))[None]
        chosen = jnp.arange(count).reshape(count, *(1,) * len(lanes)) == largest
        columns = jnp.where(held[None], jnp.where(chosen[None], 0.0, reduced), columns)
    return columns


def _masses(shaft: Shaft, at_ends: Array, at_middles: Array) -> Array:
    """Mass matrix of the motions (Simpson's rule, exact for their products), shape ``(motions, motions, *lanes)``."""

    def squares(rows: Array) -> Array:
        return rows[:, :, None] * rows[:, None]

    weight = (shaft.rhoA * shaft.length)[:, None, None] / 6
    total = weight * (squares(at_ends[1:]) + 4 * squares(at_middles) + squares(at_ends[:-1]))
    mass = jnp.sum(total, axis=0)
    if shaft.m is not None:
        mass = mass + jnp.sum(shaft.m[:, None, None] * squares(at_ends), axis=0)
    return mass


def _product(a: Array, mass: Array, b: Array) -> Array:
    return jnp.sum(a[:, None] * mass * b[None], axis=(0, 1))
