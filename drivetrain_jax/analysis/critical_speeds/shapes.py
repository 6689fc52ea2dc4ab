"""Mode shapes of a stepped shaft, without the growth that spoils the plain transfer matrices.

At a natural frequency the planes L of the states that obey the conditions left of a section and R of those that obey
the conditions right of it share one line, the mode: with the symplectic form w, ``L w R = c v v^T``, c the same at all
sections. That gives the state v where the mode is largest. From there it is carried outwards, to the right within the
planes R and to the left within the planes L (as eigenvectors from twisted factorisations: Dhillon & Parlett, Linear
Algebra Appl. 387 (2004) 1): what comes across a segment or a joint fixes the state in the plane behind it, and does so
also where the product has lost a part that hardly moves, or is at rest.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import planes
from drivetrain_jax.analysis.critical_speeds.eigenspace import states_in_clusters
from drivetrain_jax.analysis.critical_speeds.links import Links, Segments, across_joints, along_segments
from drivetrain_jax.analysis.critical_speeds.segments import Scales
from drivetrain_jax.analysis.critical_speeds.waves import Plane, even_and_odd
from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.systems import Shaft

# Multiple of its asymmetry up to which the product of two planes is rounding.
_APART = 30.0
# A deflection up to this part of the state is rounding.
_ROUNDING = 1024 * np.finfo(float).eps
# The state (f, theta, M, F) seen from the other end of the shaft.
_MIRROR = np.array([1.0, -1.0, 1.0, -1.0])


def _left(u: Plane) -> Array:
    """The plane as the antisymmetric matrix of its minors, rows f, theta, M, F, shape ``(4, 4, ...)``."""
    return _antisymmetric(u[0], u[1], -u[2], u[3], u[4])


def _right(u: Plane) -> Array:
    """The same from the plane of the mirrored shaft: theta and F change their sign."""
    return _antisymmetric(-u[0], u[1], u[2], u[3], -u[4])


def _antisymmetric(y12: Array, y13: Array, y14: Array, y24: Array, y34: Array) -> Array:
    o = jnp.zeros_like(y12)
    rows = ((o, y12, y13, y14), (-y12, o, y14, y24), (-y13, -y14, o, y34), (-y14, -y24, -y34, o))
    return jnp.stack([jnp.stack(row) for row in rows])


def _shared_states(left: Plane, right: Plane) -> tuple[Array, Array, Array]:
    """The state that both planes contain, ``(4, ...)``, its largest entry 1; the square of that entry in
    ``L w R``; and whether it is more than rounding.

    Planes that share no line leave a product that is not symmetric. So they do in a part of the shaft that is at rest,
    where both are of the order of rounding.
    """
    # w R: F_v f_w - f_v F_w + theta_v M_w - M_v theta_w.
    R = _right(right)
    product = matmul(_left(left), jnp.stack([-R[3], R[2], -R[1], R[0]]))
    diagonal = jnp.stack([product[i, i] for i in range(4)])
    best = jnp.argmax(jnp.abs(diagonal), axis=0)
    chosen = [best == i for i in range(4)]
    column = sum(jnp.where(chosen[i], product[:, i], 0.0) for i in range(4))
    entry = sum(jnp.where(chosen[i], diagonal[i], 0.0) for i in range(4))
    moving = jnp.abs(entry) > _APART * jnp.abs(product[0, 3] - product[3, 0])
    return column / jnp.where(entry == 0, 1.0, entry), jnp.abs(entry), moving


def _next_state(plane: Array, link: Links, state: Array) -> Array:
    """The state in a plane behind a link, ``(4, ...)``: from the two forms that differ most there, 0 if all are 0."""
    rows, values = link.behind, matmul(link.before, state[:, None])[:, 0]
    images = matmul(plane, jnp.swapaxes(rows, 0, 1))
    minors = matmul(rows, images)
    pairs = tuple(combinations(range(4), 2))
    best = jnp.argmax(jnp.stack([jnp.abs(minors[i, j]) for i, j in pairs]), axis=0)
    result, minor = jnp.zeros_like(state), jnp.zeros_like(state[0])
    for k, (i, j) in enumerate(pairs):
        result = jnp.where(best == k, images[:, j] * values[i] - images[:, i] * values[j], result)
        minor = jnp.where(best == k, minors[i, j], minor)
    return jnp.where(minor == 0, 0.0, result / jnp.where(minor == 0, 1.0, minor))


def _carried(across: Links, along: Links, ahead: tuple[Plane, Plane], start: Array | np.ndarray, place: Array) -> Array:
    """States at the 2n ends of segments from the one at ``place`` (``start``) to the last; 0 before. ``ahead`` are the
    planes of the other side there, in front of and behind the segments. Shape ``(2n, 4, modes, ...)``."""

    def step(state: Array, segment: Any) -> tuple[Array, Array]:
        number, across, along, front, behind = segment
        entering = jnp.where(place == number, start, _next_state(_right(front), across, state))
        leaving = jnp.where(place == number + 1, start, _next_state(_right(behind), along, entering))
        return leaving, jnp.stack([entering, leaving])

    segments = len(along.before)
    states = jax.lax.scan(step, jnp.zeros_like(start), (2 * jnp.arange(segments), across, along, *ahead))[1]
    return states.reshape(2 * segments, *start.shape)


def _end_states(shaft: Shaft, q: Array, waves: Segments) -> tuple[Array, Array]:
    """States in front of and behind every segment in its own coordinates, of one scale: ``(n, 4, modes, ...)``."""
    mirrored = shaft.mirrored()
    front, behind, log_front, log_behind = planes(shaft, q)
    from_d, from_d_behind, log_d, log_d_behind = planes(mirrored, q)
    right_front, right_behind = (tuple(x[::-1] for x in u) for u in (from_d_behind, from_d))

    def ends(front: Array, behind: Array) -> Array:
        return jnp.stack([front, behind], axis=-q.ndim - 1).reshape(*front.shape[: -q.ndim - 1], -1, *q.shape)

    at_front, at_behind = _shared_states(front, right_front), _shared_states(behind, right_behind)
    shared, square, moving = (ends(a, b) for a, b in zip(at_front, at_behind, strict=True))
    # If parts share a frequency, all is rounding; their states come from the eigenspace.
    moving = moving | ~jnp.any(moving, axis=0)
    logs = ends(log_front + log_d_behind[::-1], log_behind + log_d[::-1])
    unit = jnp.log(jnp.repeat(Scales.of(shaft).e1, 2, axis=0))[:, None]
    place = jnp.argmax(jnp.where(moving, jnp.log(square) + unit + logs, -jnp.inf), axis=0)
    start = jnp.take_along_axis(shared, place[None, None], axis=1)[:, 0]

    along, turned = along_segments(waves), _MIRROR.reshape(4, *(1,) * q.ndim)
    to_the_right = _carried(across_joints(shaft, q), along, (right_front, right_behind), start, place)
    last = 2 * shaft.segments - 1
    along, ahead = jax.tree.map(lambda x: x[::-1], (along, (behind, front)))
    to_the_left = _carried(across_joints(mirrored, q), along, ahead, turned * start, last - place)[::-1] * turned
    number = jnp.arange(last + 1).reshape(-1, *(1,) * (q.ndim + 1))
    states = states_in_clusters(shaft, q, jnp.where(number < place, to_the_left, to_the_right))
    return states[::2], states[1::2]


def _deflection(w: Segments, front: Array, behind: Array, xi: Array) -> Array:
    """Deflection at the phases ``xi`` in [0, z] of a segment with these states at its ends."""
    alpha, beta, alpha_h, beta_h = w.split(front)
    _, _, alpha_end, beta_end = w.split(behind)
    cos, sin, _ = even_and_odd(-w.trigonometric2, xi)
    trigonometric = beta * cos - w.trigonometric2 * alpha * sin
    mu, long = w.number, w.long
    falling = 0.5 * (beta_h - mu * alpha_h) * jnp.exp(-mu * xi)
    rising = 0.5 * (beta_end + mu * alpha_end) * jnp.exp(-mu * (w.z - xi))
    ch, sh, growth = even_and_odd(w.hyperbolic2, jnp.where(long, 0.0, xi))
    short = (beta_h * ch + w.hyperbolic2 * alpha_h * sh) * jnp.exp(growth)
    waves = w.sine * trigonometric + w.cosine * jnp.where(long, falling + rising, short)
    return jnp.where(w.massless, sum(a * v for a, v in zip(w.cubic(xi), front, strict=True)), waves)


def mode_shapes(shaft: Shaft, q: Array, x: Array) -> Array:
    """Deflections of the modes ``q = sqrt(p) > 0`` at ``x`` in [0, 1], the distance from A over the whole length.

    ``q`` has shape ``(modes, *lanes)``, the result ``(modes, len(x), *lanes)``. The largest deflection is +1. A mode that
    turns without deflection, as hinged spans with shear and rotary inertia have at their cut-off, is 0 everywhere.
    """
    waves, b = Segments.of(shaft, q), Scales.of(shaft).b
    front, behind = _end_states(shaft, q, waves)
    lanes = q.shape[1:]
    place = x.reshape(len(x), *(1,) * len(lanes)) * jnp.sum(shaft.length, axis=0)
    starts = jnp.cumsum(shaft.length, axis=0) - shaft.length
    shape = jnp.zeros((q.shape[0], len(x), *lanes))
    for i in range(shaft.segments):
        wide = Segments(*(field[i][:, None] for field in waves))
        xi = (q * b[i])[:, None] * jnp.clip(place - starts[i], 0.0, shaft.length[i])
        here = _deflection(wide, front[i][:, :, None], behind[i][:, :, None], xi)
        shape = here if i == 0 else jnp.where(place >= starts[i], here, shape)
    size = jnp.max(jnp.abs(jnp.concatenate([front, behind])), axis=(0, 1))
    still = jnp.max(jnp.abs(shape), axis=1) <= _ROUNDING * size
    return normalised(jnp.where(still[:, None], 0.0, shape))


def normalised(shape: Array) -> Array:
    """``(modes, stations, ...)`` with the largest deflection of every mode +1; a mode without any stays 0."""
    best = jnp.argmax(jnp.abs(shape), axis=1, keepdims=True)
    largest = jnp.take_along_axis(shape, best, axis=1)
    return shape / jnp.where(largest == 0, 1.0, largest)
