"""Motions of a shaft that cost no energy: how many there are, and their shapes.

They exist where springs or rotational stiffness are missing altogether, and have the exact frequency 0 if they move
mass, whatever the other parameters. They are combinations of ``1``, ``x`` and, for each joint that is a hinge,
``max(0, x - x_joint)``.
"""

from __future__ import annotations

from functools import reduce

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import inertia_and_determinant, matmul
from drivetrain_jax.systems import Shaft

# Size up to which a combination of motions counts as none: they are of order one.
_NOTHING = 1e-9
# Frequency at which the gyroscopic effect exceeds every inertia [rad/s].
_SLOW = 1e-60


def _in_planes(shaft: Shaft) -> tuple[Shaft, ...]:
    """The shaft in each plane of its supports."""
    return (shaft,) if shaft.k_y is None else (shaft._replace(k_y=None), shaft._replace(k=shaft.k_y, k_y=None))


def _slow_inertias(shaft: Shaft) -> Shaft:
    """The shaft with the signs of its rotary inertias at the lowest frequencies, where the gyroscopic effect prevails."""
    return shaft.turning(jnp.full(shaft.lanes, _SLOW))


def zero_modes(shaft: Shaft) -> Array:
    """Number of mechanisms (modes of frequency 0), shape of the lanes, from the missing springs and hinges.

    The gyroscopic effect gives a mechanism a frequency if it makes its inertia negative.
    """
    if shaft.spin is not None or shaft.k_y is not None:
        return _slow_modes(shaft)
    shaft = shaft.spread()
    return _number(_unrestrained(shaft, _motions_at_nodes(shaft)[1], *_springs(shaft)))


def _number(columns: Array) -> Array:
    """Number of the columns that are not used up."""
    return jnp.sum(jnp.any(columns != 0, axis=0), axis=0)


def _springs(shaft: Shaft) -> tuple[Array, Array]:
    """Flags of the nodes whose deflection springs hold, and of those whose rotation they hold."""
    held = shaft.k > 0
    return held, jnp.zeros_like(held) if shaft.k_rot is None else shaft.k_rot > 0


def _slow_modes(shaft: Shaft) -> Array:
    """Number of positive inertias of the mechanisms, of both planes together if there are two."""
    lanes, shaft = shaft.lanes, shaft.spread()
    ends, at_ends = _motions_at_nodes(shaft)
    free, *second = (_unrestrained(plane, at_ends, *_springs(plane)) for plane in _in_planes(shaft))
    turned = shaft if shaft.spin is None else shaft._replace(spin=-shaft.spin)
    mass, backward = (_masses(_slow_inertias(turning), at_ends, ends) for turning in (shaft, turned))
    if second:
        none = jnp.zeros_like(free)
        free = jnp.concatenate([jnp.concatenate([free, none], 1), jnp.concatenate([none, second[0]], 1)])
        # Not the mean of both: beside the gyroscopic effect the masses would be rounded away.
        still = shaft._replace(spin=None, polar=None, rhoIp=None)
        same, other = 2 * _masses(still, at_ends, ends), mass - backward
        mass = jnp.concatenate([jnp.concatenate([same, other], 1), jnp.concatenate([other, same], 1)])
    matrix = matmul(jnp.swapaxes(free, 0, 1), matmul(mass, free))
    flat = -matrix.reshape(*matrix.shape[:2], -1)
    return jax.vmap(lambda turning: inertia_and_determinant(turning)[0], in_axes=-1)(flat).reshape(lanes).astype(int)


def is_undefined(shaft: Shaft) -> Array:
    """True if a mechanism moves no mass, a segment has rotary inertia without mass, or a number is missing: no frequency is
    defined then.

    Such a mechanism remains where everything that has mass is held. Shape of the lanes.
    """
    if shaft.k_y is not None:
        first, second = (is_undefined(plane) for plane in _in_planes(shaft))
        return first | second
    missing = [jnp.any(jnp.isnan(field), axis=0) for field in shaft if field is not None]
    shaft = shaft.spread()
    massive, (held, turning) = shaft.rhoA > 0, _springs(shaft)
    none = jnp.zeros_like(massive[:1])
    deflection = jnp.concatenate([massive, none]) | jnp.concatenate([none, massive]) | held
    if shaft.m is not None:
        deflection = deflection | (shaft.m > 0)
    if shaft.inertia is not None:
        turning = turning | (shaft.inertia != 0)
    weightless = _number(_unrestrained(shaft, _motions_at_nodes(shaft)[1], deflection, turning)) > 0
    weightless = reduce(jnp.logical_or, missing, weightless)
    return weightless if shaft.rhoI is None else weightless | jnp.any(~massive & (shaft.rhoI > 0), axis=0)


def number_of_modes(shaft: Shaft) -> Array:
    """Number of natural frequencies, zero modes included, shape of the lanes: infinite if a segment has mass."""
    if shaft.k_y is not None:
        forward, backward = _in_planes(shaft)
        backward = backward._replace(spin=None if shaft.spin is None else -shaft.spin)
        return number_of_modes(forward) + number_of_modes(backward)
    count = jnp.zeros(shaft.k.shape[1:], int)
    if shaft.m is not None:
        count = count + jnp.sum((shaft.m > 0) & jnp.isfinite(shaft.k), axis=0)
    # A polar inertia alone gives a tilt a frequency of backward whirl.
    if (inertia := _slow_inertias(shaft).inertia) is not None:
        turning = inertia > 0 if shaft.inertia is None else (inertia > 0) | (shaft.inertia > 0)
        if shaft.k_rot is not None:
            turning = turning & jnp.isfinite(shaft.k_rot)
        count = count + jnp.sum(turning, axis=0)
        if shaft.k_hinge is not None:
            # Both sides of an elastic joint turn.
            count = count + jnp.sum(turning[1:-1] & jnp.isfinite(shaft.k_hinge), axis=0)
    return jnp.where(jnp.any(shaft.rhoA > 0, axis=0), jnp.inf, count)


def highest_frequency(shaft: Shaft) -> Array:
    """A bound of ``q = sqrt(p)`` of all frequencies of a shaft whose segments have no mass, shape of the lanes.

    No eigenvalue p^2 exceeds the sum of stiffness over mass of the motions of single nodes with mass. The gyroscopic effect
    and the second plane are left out.
    """
    shear, bend = 12 * shaft.EI / shaft.length**3, 4 * shaft.EI / shaft.length
    none = jnp.zeros_like(shear[:1])

    def at_nodes(x: Array) -> Array:
        return jnp.concatenate([x, none]) + jnp.concatenate([none, x])

    total = jnp.zeros(shaft.lanes)
    if shaft.m is not None:
        total = total + jnp.sum(_ratio(at_nodes(shear) + _finite(shaft.k), shaft.m), axis=0)
    if shaft.inertia is not None:
        turned = at_nodes(bend)
        if shaft.k_rot is not None:
            turned = turned + _finite(shaft.k_rot)
        if shaft.k_hinge is not None:
            edge = jnp.zeros_like(shaft.k_hinge[:1])
            turned = turned + 2 * jnp.concatenate([edge, _finite(shaft.k_hinge), edge])
        # Half of the inertia is on each side of a joint.
        total = total + jnp.sum(_ratio(2 * turned, shaft.inertia), axis=0)
    return 2 * jnp.sqrt(jnp.sqrt(total))


def _finite(stiffness: Array) -> Array:
    return jnp.where(jnp.isinf(stiffness), 0.0, stiffness)


def _ratio(stiffness: Array, mass: Array) -> Array:
    return jnp.where(mass > 0, stiffness / jnp.where(mass > 0, mass, 1.0), 0.0)


def mechanism_shapes(shaft: Shaft, x: Array) -> Array:
    """Deflections of the zero modes at ``x`` in [0, 1], the distance from A over the whole length, orthogonal in the
    mass.

    Shape ``(rows, len(x), *lanes)``: the zero modes first, the other rows are 0. A free shaft moves as a whole, then
    turns about its centre of mass.
    """
    lanes, shaft = shaft.lanes, shaft.spread()
    ends, at_ends = _motions_at_nodes(shaft)
    combination = _unrestrained(shaft, at_ends, *_springs(shaft))
    mass = _masses(shaft, at_ends, ends)
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


def _motions_at_nodes(shaft: Shaft) -> tuple[Array, Array]:
    """The nodes, over the whole length, and the motions there."""
    ends = jnp.concatenate([jnp.zeros_like(shaft.length[:1]), jnp.cumsum(shaft.length, axis=0)])
    ends = ends / ends[-1]
    return ends, _motions(shaft, ends, ends)


def _motions(shaft: Shaft, x: Array, ends: Array) -> Array:
    """The motions at ``x``, shape ``(len(x), motions, *lanes)``; 0 for a joint that is no hinge."""
    rows = [jnp.ones_like(x), x]
    if shaft.k_hinge is not None:
        for joint in range(1, shaft.segments):
            rows.append(jnp.where(shaft.k_hinge[joint - 1] == 0, jnp.maximum(x - ends[joint], 0.0), 0.0))
    return jnp.stack(rows, axis=1)


def _slopes(shaft: Shaft) -> Array:
    """The slopes of the motions in the segments over the whole length, shape ``(n, motions, *lanes)``."""
    one = jnp.ones_like(shaft.length)
    rows = [0 * one, one]
    if shaft.k_hinge is not None:
        number = jnp.arange(shaft.segments).reshape(-1, *(1,) * (one.ndim - 1))
        rows += [jnp.where((k == 0) & (number > joint), one, 0.0) for joint, k in enumerate(shaft.k_hinge)]
    return jnp.stack(rows, axis=1)


def _unrestrained(shaft: Shaft, at_ends: Array, held: Array, turning: Array) -> Array:
    """Combinations of the motions ``at_ends``, as columns, with no deflection at the nodes ``held`` and no rotation at the
    nodes ``turning``; those used up are 0."""
    count, lanes = at_ends.shape[1], at_ends.shape[2:]
    unit = jnp.eye(count).reshape(count, count, *(1,) * len(lanes))
    columns = unit * jnp.where(jnp.any(at_ends != 0, axis=0), 1.0, 0.0)
    rows = jnp.concatenate([at_ends, _slopes(shaft)]), jnp.concatenate([held, turning[:-1] | turning[1:]])
    return jax.lax.scan(lambda columns, row: (_without(columns, *row), None), columns, rows)[0]


def _without(columns: Array, row: Array, held: Array) -> Array:
    """The combinations ``columns`` of motions for which ``row @ columns`` is 0, if ``held``; the one used up is 0."""
    count, lanes = columns.shape[0], columns.shape[2:]
    value = sum(row[i] * columns[i] for i in range(count))
    largest = jnp.argmax(jnp.abs(value), axis=0)[None]
    pivot = jnp.take_along_axis(value, largest, axis=0)
    taken = jnp.take_along_axis(columns, largest[None], axis=1)
    held = held & (jnp.abs(pivot) > _NOTHING)
    reduced = columns - taken * (value / jnp.where(held, pivot, 1.0))[None]
    chosen = jnp.arange(count).reshape(count, *(1,) * len(lanes)) == largest
    return jnp.where(held[None], jnp.where(chosen[None], 0.0, reduced), columns)


def _masses(shaft: Shaft, at_ends: Array, ends: Array) -> Array:
    """Mass matrix of the motions (Simpson's rule, exact for their products), shape ``(motions, motions, *lanes)``."""

    def squares(rows: Array) -> Array:
        return rows[:, :, None] * rows[:, None]

    at_middles = _motions(shaft, (ends[1:] + ends[:-1]) / 2, ends)
    weight = (shaft.rhoA * shaft.length)[:, None, None] / 6
    total = weight * (squares(at_ends[1:]) + 4 * squares(at_middles) + squares(at_ends[:-1]))
    mass = jnp.sum(total, axis=0)
    if shaft.m is not None:
        mass = mass + jnp.sum(shaft.m[:, None, None] * squares(at_ends), axis=0)
    if shaft.rhoI is None and shaft.inertia is None:
        return mass
    # The slope is one in a segment; half of the inertia at a joint turns with the segment on each side.
    rotary = jnp.zeros_like(shaft.length) if shaft.rhoI is None else shaft.rhoI * shaft.length
    if shaft.inertia is not None:
        joints = 0.5 * shaft.inertia[1:-1]
        rotary = rotary + jnp.concatenate([shaft.inertia[:1], joints]) + jnp.concatenate([joints, shaft.inertia[-1:]])
    slope = (at_ends[1:] - at_ends[:-1]) / shaft.length[:, None]
    return mass + jnp.sum(rotary[:, None, None] * squares(slope), axis=0)


def _product(a: Array, mass: Array, b: Array) -> Array:
    return jnp.sum(a[:, None] * mass * b[None], axis=(0, 1))
