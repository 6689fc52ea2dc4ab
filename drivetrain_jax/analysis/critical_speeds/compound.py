"""The characteristic function of a stepped shaft and the number of its roots, without cancellation and without poles.

All states (f, theta, M, F) that obey the conditions left of a section form a Lagrangian plane. Seen from the right it
is a dynamic stiffness: ``(F, -M) = S (f, theta)`` with symmetric ``S``. Poles of ``S`` are avoided by carrying

    u = u0 (1, S22, S12, S11, det S),

which are, up to sign, the 2x2 minors of two states (Pluecker coordinates; the sixth equals ``u2``). A free end has
u = (1, 0, 0, 0, 0). With q = sqrt(p), in units that make all matrices free of p (theta/q, M/q^2, F/q^3):

- support and lumped mass: S11 += kappa, kappa = k/q^3 - m q, that is u3 += kappa u0, u4 += kappa u1;
- rotational spring and rotary inertia: S22 += kappa, kappa = k_rot/q - I q^3, that is u1 += kappa u0, u4 += kappa u3;
- joint with the rotational stiffness k_hinge: u0 += (q/k_hinge) u1, u3 += (q/k_hinge) u4;
- segment: u -> exp(z B) u in coordinates scaled by its own alpha and EI, see :mod:`shaft_functions`.

The characteristic function is ``Psi = u4`` behind the last support. It is proportional to the paper's determinant (25).

Count (Wittrick & Williams 1971). Natural frequencies below p: ``N = sum J0 + negative eigenvalues of the pivots`` in
the block elimination of the dynamic stiffness from left to right. J0 counts the clamped-clamped frequencies of a
segment. The pivot of the node in front of a segment is ``D = S + K``; its inertia follows from two signs that the
propagation has at hand, ``sgn det D = sgn(u0 u0' Q)`` and the sign of its trace; that of a joint is ``S22 + k_hinge``,
which is negative if u0 changes its sign there. At a pole the signs of u0 and of Q are not determined. Each enters twice, so
the total is right at every frequency, and its parity is the sign of Psi.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.segments import (
    Compound,
    General,
    LastNode,
    Plane,
    Segment,
    compound,
    general,
    segments_of,
    sign_of,
)
from drivetrain_jax.systems import Shaft

# Halvings of a Timoshenko segment: enough for a million half waves.
_MAX_LEVELS = 22


class Value(NamedTuple):
    """The characteristic function at one q, ``psi`` in [-1, 1] (``u4`` over the norm of ``u``), and the number
    ``count`` of natural frequencies below, zero modes included."""

    psi: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]


class _State(NamedTuple):
    u: Plane
    sign: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]


def characteristic(shaft: Shaft, q: Array) -> Value:
    """The characteristic function at ``q = sqrt(p)``, ``p`` in rad/s.

    ``q`` has shape ``(..., *lanes)`` and the fields of ``shaft`` ``(n, *lanes)``; results have the shape of ``q``.
    """
    # Faint instead of no mass: the same digits without multiplications by r.
    segments, last = segments_of(shaft, faint=True)
    zero = q * 0 * segments.beta[0]
    start = _State((zero + 1, zero, zero, zero, zero), zero + 1, zero)

    def step(state: _State, segment: Segment) -> tuple[_State, None]:
        u, sign, count = _enter(state, segment, q)
        functions = functions_of(segment, q)
        behind = functions.propagate(u)
        clamped, sign_q = clamped_count(segment, functions, q)
        positive = sign_of(behind[0])
        count = count + clamped + _negative(positive * sign * sign_q, _trace(u, sign, functions, sign_q))
        sign = positive
        size = _size(behind)
        return _State(_out_of(tuple(x / size for x in behind), segment), sign, count), None

    state, _ = jax.lax.scan(step, start, segments)
    return _end(state, last, q)


def pairings(shaft: Shaft, q: Array) -> Array:
    """The characteristic function behind every segment, in [-1, 1], shape ``(n, *q.shape)``.

    Where the planes of the states that obey the conditions to the left and right of a section share a line, their
    product vanishes. At a rigid support with a hinge the parts of the shaft are independent: seen from one, the product
    is that of its own natural frequencies alone, whereas ``Psi`` behind the last support shows those of the last part.
    """
    left = planes(shaft, q)[1]
    right = tuple(x[::-1] for x in planes(shaft.mirrored(), q)[0])
    product = 2 * left[2] * right[2] + sum(left[i] * right[4 - i] for i in (0, 1, 3, 4))
    return product / (_size(left) * _size(right))


def planes(shaft: Shaft, q: Array) -> tuple[Plane, Plane, Array, Array]:
    """The plane ``u`` in front of and behind every segment, in its own coordinates, with the logarithms of the factors
    that belong to them; arrays of shape ``(n, *q.shape)``.

    A factor common to all segments is left out: that of the supports and joints, which the plane from the left has
    passed where the plane from the right has not. It is common because the units of supports and joints are those of
    both sides: the mirrored shaft has the same.
    """
    segments, _ = segments_of(shaft)
    zero = q * 0 * segments.beta[0]
    start = _State((zero + 1, zero, zero, zero, zero), zero + 1, zero)

    def step(carry: tuple[_State, Array], segment: Segment) -> Any:
        state, logarithm = carry
        front = _enter(state, segment, q).u
        functions = functions_of(segment, q)
        behind = functions.propagate(front)
        size = _size(behind)
        unit = tuple(x / size for x in behind)
        after = logarithm + functions.growth + jnp.log(size)
        return (_State(_out_of(unit, segment), state.sign, state.count), after), (front, unit, logarithm, after)

    return jax.lax.scan(step, (start, zero), segments)[1]


def functions_of(segment: Segment, q: Array) -> Compound | General:
    """The scaled compound of a segment at ``q``."""
    z, r = q * segment.beta, 1.0 if segment.r is None else segment.r
    if segment.shear is None:
        return compound(z, r)
    return general(z, r, q * q * segment.shear, q * q * segment.rotary)  # pyright: ignore[reportOperatorIssue]


def _enter(state: _State, segment: Segment, q: Array) -> _State:
    """Across the joint, its inertias and the support in front of ``segment``, and into its coordinates."""
    u, sign, count = state
    if segment.inertia_before is not None:
        u = _across_rotation(u, None, segment.inertia_before, segment.turn, q)
    if segment.k_hinge is not None:
        u = _across_hinge(u, segment.k_hinge, segment.turn, q)  # pyright: ignore[reportArgumentType]
        after = sign_of(u[0])
        count, sign = count + 0.5 * (1 - after * sign), after
    u = _across_rotation(u, segment.k_rot, segment.inertia, segment.turn, q)
    u = _across_support(u, segment.k, segment.m, segment.unit, q)
    u0, u1, u2, u3, u4 = u
    e1, e2, e3 = segment.e1, segment.e2, segment.e3
    return _State((u0, u1 / e1, u2 / e2, u3 / e3, u4 / (e1 * e3)), sign, count)


def _out_of(u: Plane, segment: Segment) -> Plane:
    u0, u1, u2, u3, u4 = u
    e1, e2, e3 = segment.e1, segment.e2, segment.e3
    return u0, u1 * e1, u2 * e2, u3 * e3, u4 * (e1 * e3)


def support_shares(k: Array, m: Array | None, unit: Array, q: Array) -> tuple[Array, Array]:
    """1 and kappa = k/q^3 - m q, both over 1 + |kappa|/unit: finite for a rigid support too."""
    return _shares(k, q * q * q, None if m is None else m * q, unit)


def rotation_shares(k_rot: Array | None, inertia: Array | None, unit: Array, q: Array) -> tuple[Array, Array]:
    """1 and kappa = k_rot/q - I q^3, both over 1 + |kappa|/unit."""
    load = None if inertia is None else inertia * (q * q * q)
    return _shares(jnp.zeros_like(unit) if k_rot is None else k_rot, q, load, unit)


def _shares(k: Array, per: Array, load: Array | None, unit: Array) -> tuple[Array, Array]:
    rigid = jnp.isinf(k)
    kappa = jnp.where(rigid, 0.0, k) / per
    if load is not None:
        kappa = kappa - load
    share = 1 / (1 + jnp.abs(kappa) / unit)
    return jnp.where(rigid, 0.0, share), jnp.where(rigid, unit, kappa * share)


def hinge_shares(k_hinge: Array, unit: Array, q: Array) -> tuple[Array, Array]:
    """1 and q/k_hinge, both over 1 + q unit/k_hinge: finite for a free hinge too."""
    rigid = jnp.isinf(k_hinge)
    finite = jnp.where(rigid, 0.0, k_hinge)
    total = finite + q * unit
    return jnp.where(rigid, 1.0, finite / total), jnp.where(rigid, 0.0, q / total)


def _across_support(u: Plane, k: Array, m: Array | None, unit: Array, q: Array) -> Plane:
    """S11 += k/q^3 - m q, everything times a factor: a rigid support leaves what is finite."""
    keep, add = support_shares(k, m, unit, q)
    u0, u1, u2, u3, u4 = u
    return keep * u0, keep * u1, keep * u2, keep * u3 + add * u0, keep * u4 + add * u1


def _across_rotation(u: Plane, k_rot: Array | None, inertia: Array | None, unit: Array | None, q: Array) -> Plane:
    """S22 += k_rot/q - I q^3, everything times a factor; nothing to do without both."""
    if k_rot is None and inertia is None:
        return u
    keep, add = rotation_shares(k_rot, inertia, unit, q)  # pyright: ignore[reportArgumentType]
    u0, u1, u2, u3, u4 = u
    return keep * u0, keep * u1 + add * u0, keep * u2, keep * u3, keep * u4 + add * u3


def _across_hinge(u: Plane, k_hinge: Array, unit: Array, q: Array) -> Plane:
    """u0 += (q/k_hinge) u1, u3 += (q/k_hinge) u4, everything times a factor."""
    keep, add = hinge_shares(k_hinge, unit, q)
    u0, u1, u2, u3, u4 = u
    return keep * u0 + add * u1, keep * u1, keep * u2, keep * u3 + add * u4, keep * u4


def _end(state: _State, last: LastNode, q: Array) -> Value:
    """Psi behind the last node, and the inertia of the last pivot, which is S itself."""
    e1, e3 = last.e1, last.e3
    u0, u1, u2, u3, u4 = u = _across_support(state.u, last.k, last.m, last.unit, q)
    # A clamped end leaves Psi alone of all entries, so that they are compared in front of the rotational spring.
    size = jnp.sqrt(u0**2 + (u1 / e1) ** 2 + (u2**2 / (e1 * e3)) + (u3 / e3) ** 2 + (u4 / (e1 * e3)) ** 2)
    _, u1, _, u3, u4 = _across_rotation(u, last.k_rot, last.inertia, e1, q)
    u1, u3, u4 = u1 / e1, u3 / e3, u4 / (e1 * e3)
    return Value(u4 / size, state.count + _negative(sign_of(u4) * state.sign, (u1 + u3) * state.sign))


def clamped_count(segment: Segment, functions: Compound | General, q: Array) -> tuple[Array, Array]:
    """J0, the clamped-clamped natural frequencies of a segment below p, and the sign of Q that belongs to it."""
    if isinstance(functions, Compound):
        # The frequencies cos z ch z = 1 lie next to z = (n + 1/2) pi: between them (-1)^floor(z/pi) is far from a jump.
        half_waves = jnp.floor(functions.growth / math.pi)
        sign = sign_of(functions.Q)
        parity = 1 - 2 * (half_waves - 2 * jnp.floor(half_waves / 2))
        return half_waves - 0.5 * (1 - parity * sign), sign
    return _count_by_halving(q * segment.beta, functions)


def _count_by_halving(z: Array, whole: General) -> tuple[Array, Array]:
    """J0 of a Timoshenko segment: ``J0(z) = 2 J0(z/2) + negative(K11(z/2)) + negative(K22(z/2))``.

    At the middle of a clamped segment the pivot is diag(2 K11, 2 K22) of its halves, and Q(z) has the sign of their
    product. Parts with ``z^2 (2 max(s, t) + 1) < pi^2`` have no clamped frequency (Poincare's inequality).
    """
    s, t = whole.s, whole.t
    part = z * jnp.sqrt(2 * jnp.maximum(s, t) + 1) / math.pi
    levels = jnp.max(jnp.ceil(jnp.log2(jnp.maximum(jnp.nan_to_num(part, posinf=1.0), 1.0))) + 1)
    levels = jnp.minimum(levels, _MAX_LEVELS).astype(int)
    clamped = tuple(jnp.full_like(z, x) for x in (0.0, 0.0, 0.0, 0.0, 1.0))

    def double(level: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        count, sign = state
        w = general(z * 2.0 ** (level - levels), whole.r, s, t).propagate(clamped)
        k11, k22 = sign_of(w[3]) * sign, sign_of(w[1]) * sign
        return 2 * count + 0.5 * (1 - k11) + 0.5 * (1 - k22), k11 * k22

    return jax.lax.fori_loop(0, levels, double, (jnp.zeros_like(z), jnp.ones_like(z)))


def _trace(u: Plane, sign: Array, functions: Compound | General, sign_q: Array) -> Array:
    """A number with the sign of the trace of ``D = S + K``, each diagonal entry relative to the size of its terms.

    It is asked for only where det D > 0, so that both entries have this sign: one that cancels does not outvote the
    other.
    """
    if isinstance(functions, Compound):
        w0, w1, w3 = functions.Q, functions.W, functions.Y
    else:
        zero = jnp.zeros_like(u[0])
        w0, w1, _, w3, _ = functions.propagate((zero, zero, zero, zero, zero + 1))
    q0, u0 = jnp.abs(w0) * sign_q, jnp.abs(u[0]) * sign
    left1, left2, right1, right2 = u[3] * q0, u[1] * q0, w3 * u0, w1 * u0
    size1, size2 = jnp.abs(left1) + jnp.abs(right1), jnp.abs(left2) + jnp.abs(right2)
    return ((left1 + right1) * size2 + (left2 + right2) * size1) * sign * sign_q


def _negative(determinant: Array, trace: Array) -> Array:
    """Negative eigenvalues of a symmetric 2x2 matrix from the signs of its determinant and its trace."""
    return jnp.where(determinant < 0, 1.0, jnp.where(trace < 0, 2.0, 0.0))


def _size(u: Plane) -> Array:
    return sum(jnp.abs(x) for x in u)  # pyright: ignore[reportReturnType]
