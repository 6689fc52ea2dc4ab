"""Mode shapes of a stepped shaft, without the growth that spoils the plain transfer matrices.

At a natural frequency the planes L of the states that obey the conditions left of a section and R of those that obey
the conditions right of it share one line, the mode: with the symplectic form w, ``L w R = c v v^T``, c the same at all
sections. So the state v follows from the two planes at each node, at full accuracy and with its amplitude. Within
a segment v is split into its waves; decaying waves are followed from the end at which they are large.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.analysis.shafts.compound import Scales, between, hinge_shares, planes, support_shares
from drivetrain_jax.analysis.shafts.functions import Plane, Waves, even_and_odd, sign_of
from drivetrain_jax.systems import Shaft

# Multiple of its asymmetry up to which the product of two planes is rounding.
_APART = 30.0


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


def _states(left: Plane, right: Plane) -> tuple[Array, Array]:
    """The state that both planes contain, up to its sign, ``(4, ...)``, its square of the size of ``L w R``; and
    whether it is more than rounding.

    Planes that share no line leave a product that is not symmetric. So they do in a part of the shaft that is at rest,
    where both are of the order of rounding, and the root of that would not be.
    """
    # w R: F_v f_w - f_v F_w + theta_v M_w - M_v theta_w.
    R = _right(right)
    product = matmul(_left(left), jnp.stack([-R[3], R[2], -R[1], R[0]]))
    diagonal = jnp.stack([product[i, i] for i in range(4)])
    best = jnp.argmax(jnp.abs(diagonal), axis=0)
    chosen = [best == i for i in range(4)]
    column = sum(jnp.where(chosen[i], product[:, i], 0.0) for i in range(4))
    square = sum(jnp.where(chosen[i], jnp.abs(diagonal[i]), 0.0) for i in range(4))
    moving = square > _APART * jnp.abs(product[0, 3] - product[3, 0])
    return column / jnp.sqrt(jnp.where(square > 0, square, 1.0)), moving


def _node_states(shaft: Shaft, q: Array) -> tuple[Array, Array]:
    """States in front of and behind every segment in its own coordinates, of one scale, signs still open: (4, n,
    ...)."""
    front, behind, log_front, log_behind = planes(shaft, q)
    from_d, from_d_behind, log_d, log_d_behind = planes(shaft.mirrored(), q)
    left_end, left_moving = _states(front, tuple(x[::-1] for x in from_d_behind))
    right_end, right_moving = _states(behind, tuple(x[::-1] for x in from_d))
    moving = jnp.stack([left_moving, right_moving])
    # Where parts that do not see each other share a frequency all is rounding, and any amplitudes will do.
    moving = moving | ~jnp.any(moving, axis=(0, 1))
    logs = jnp.stack([log_front + log_d_behind[::-1], log_behind + log_d[::-1]])
    scale = Scales.of(shaft).e1
    scale = scale.reshape(scale.shape[0], *(1,) * (logs.ndim - 1 - scale.ndim), *scale.shape[1:])
    sizes = jnp.sqrt(scale) * jnp.exp(0.5 * (logs - jnp.max(logs, axis=(0, 1))))
    sizes = jnp.where(moving, sizes, 0.0)
    return left_end * sizes[0], right_end * sizes[1]


class _Split(NamedTuple):
    """The waves of one segment at one end: deflection and its derivative in z of the two pairs."""

    trig: Array
    trig_slope: Array
    hyper: Array
    hyper_slope: Array

    @classmethod
    def of(cls, v: Array, waves: Waves, s: Array, t: Array) -> _Split:
        """Projections of the state ``v`` = (f, theta, M, F) by the squares of the wave numbers."""
        f, theta, moment, force = v
        slope = theta - s * force
        curved, third = moment - s * f, force - t * theta - s * slope
        total = waves.trigonometric2 + waves.hyperbolic2
        trig = (waves.hyperbolic2 * f - curved) / total
        trig_slope = (waves.hyperbolic2 * slope - third) / total
        return cls(trig, trig_slope, f - trig, slope - trig_slope)


def _deflection(front: _Split, behind: _Split, waves: Waves, z: Array, xi: Array) -> Array:
    """Deflection at the phases ``xi`` in [0, z] of a segment."""
    c, sn, _ = even_and_odd(-waves.trigonometric2, xi)
    trigonometric = front.trig * c + front.trig_slope * sn
    mu = jnp.sqrt(jnp.maximum(waves.hyperbolic2, 1e-30))
    long = mu * z > 1
    falling = 0.5 * (front.hyper - front.hyper_slope / mu) * jnp.exp(-mu * xi)
    rising = 0.5 * (behind.hyper + behind.hyper_slope / mu) * jnp.exp(-mu * (z - xi))
    ch, sh, growth = even_and_odd(waves.hyperbolic2, jnp.where(long, 0.0, xi))
    short = (front.hyper * ch + front.hyper_slope * sh) * jnp.exp(growth)
    return trigonometric + jnp.where(long, falling + rising, short)


def mode_shapes(shaft: Shaft, q: Array, x: Array) -> Array:
    """Deflections of the modes ``q = sqrt(p) > 0`` at ``x`` in [0, 1], the distance from A over the whole length.

    ``q`` has shape ``(modes, *lanes)``, the result ``(modes, len(x), *lanes)``. The largest deflection is +1.
    """
    scales = Scales.of(shaft)
    front, behind = _node_states(shaft, q)
    lanes = q.shape[1:]
    place = x.reshape(len(x), *(1,) * len(lanes)) * jnp.sum(shaft.length, axis=0)
    starts = jnp.cumsum(shaft.length, axis=0) - shaft.length
    shape, before = jnp.zeros((q.shape[0], len(x), *lanes)), None
    for i in range(shaft.segments):
        square = (q * scales.b[i]) ** 2
        s = square * 0 if shaft.kGA is None else square * shaft.EI[i] / shaft.kGA[i]
        t = square * 0 if shaft.rhoI is None else square * shaft.rhoI[i] / shaft.rhoA[i]
        waves, z = Waves.of(s, t), q * scales.beta[i]
        a = front[:, i] if before is None else front[:, i] * _across_joint(shaft, q, i, before, front[:, i])
        entering = _Split.of(a, waves, s, t)
        before = behind[:, i] * _along_segment(entering, _Split.of(behind[:, i], waves, s, t), waves, z)
        leaving = _Split.of(before, waves, s, t)
        wide = [type(w)(*(y[:, None] for y in w)) for w in (entering, leaving, waves)]
        xi = (q * scales.b[i])[:, None] * jnp.clip(place - starts[i], 0.0, shaft.length[i])
        here = _deflection(*wide, z[:, None], xi)
        shape = here if i == 0 else jnp.where(place >= starts[i], here, shape)
    return normalised(shape)


def _along_segment(front: _Split, behind: _Split, waves: Waves, z: Array) -> Array:
    """Sign of the state behind a segment for which its trigonometric wave continues that in front."""
    c, sn, _ = even_and_odd(-waves.trigonometric2, z)
    carried = front.trig * c + front.trig_slope * sn
    turned = front.trig_slope * c - waves.trigonometric2 * front.trig * sn
    return sign_of(carried * behind.trig + turned * behind.trig_slope / waves.trigonometric2)


def _across_joint(shaft: Shaft, q: Array, i: int, before: Array, after: Array) -> Array:
    """Sign with which the state behind the joint in front of segment i continues that in front of the joint.

    Four numbers are the same on both sides, whatever the joint: f, M, the shear force with half the reaction of
    support and mass, the slope with half the turn of the joint, the last two times what keeps them finite. Each alone
    can vanish, f and M do in every antisymmetric mode. Where all do, at a free hinge on a rigid support, nothing passes
    through the joint: the parts are independent, and so are their signs.
    """
    scales = Scales.of(shaft)
    b, e1, e2, e3 = (between(x)[i - 1] for x in scales[1:])
    m = None if shaft.m is None else shaft.m[i]
    keep, reaction = support_shares(shaft.k[i], m, e3, q)
    hold, turn = (1.0, 0.0) if shaft.k_hinge is None else hinge_shares(shaft.k_hinge[i - 1], e1, q)

    def shared(state: Array, side: int, half: float) -> tuple[Array, ...]:
        f, theta, moment, force = state
        theta, moment, force = theta * scales.b[side], moment * scales.e2[side], force * scales.e3[side]
        return f, (hold * theta + half * turn * moment) / b, moment / e2, (keep * force - half * reaction * f) / e3

    # In the states of the planes M and F are those of the second and third derivative: theta rises, F falls.
    pairs = zip(shared(before, i - 1, 0.5), shared(after, i, -0.5), strict=True)
    return sign_of(sum(left * right for left, right in pairs))


def normalised(shape: Array) -> Array:
    """``(modes, stations, ...)`` with the largest deflection of every mode +1."""
    best = jnp.argmax(jnp.abs(shape), axis=1, keepdims=True)
    return shape / jnp.take_along_axis(shape, best, axis=1)
