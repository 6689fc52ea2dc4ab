"""The characteristic function of a stepped shaft and the number of its roots, without cancellation and without poles.

All states (f, theta, M, F) that obey the conditions left of a section form a Lagrangian plane. Seen from the right it
is a dynamic stiffness: ``(F, -M) = S (f, theta)`` with symmetric ``S``. Poles of ``S`` are avoided by carrying

    u = u0 (1, S22, S12, S11, det S),

which are, up to sign, the 2x2 minors of two states (Pluecker coordinates; the sixth equals ``u2``). A free end has
u = (1, 0, 0, 0, 0). With q = sqrt(p), in units that make all matrices free of p (theta/q, M/q^2, F/q^3):

- support and lumped mass: S11 += kappa, kappa = k/q^3 - m q, that is u3 += kappa u0, u4 += kappa u1;
- rotational spring and rotary inertia: S22 += kappa, kappa = k_rot/q - I q^3, that is u1 += kappa u0, u4 += kappa u3;
- joint with the rotational stiffness k_hinge: u0 += (q/k_hinge) u1, u3 += (q/k_hinge) u4;
- segment: u -> exp(z B) u in coordinates scaled by its own alpha and EI, see :func:`compound`.

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
from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.mechanisms import highest_frequency
from drivetrain_jax.systems import Shaft
from drivetrain_jax.systems._models import horner, sincos

# The segments of a shaft with their nodes, in the units in which the propagation runs.

# Phase of a segment without mass over that of all others, where it need only be negligible: its effect is the fourth power.
_FAINT = 1e-12


class Scales(NamedTuple):
    """Quantities of the segments alone: ``beta = l (rhoA/EI)^(1/4)``, so that z = q beta, and the units of S22, S12
    and S11: ``e1 = b EI``, ``e2 = b^2 EI``, ``e3 = b^3 EI`` with ``b = (rhoA/EI)^(1/4)``; shape ``(n, ...)`` each.

    A segment without mass takes the mean of all segments for ``rhoA``; results do not depend on it. ``r`` is the mass of
    a segment over the one in its ``b``: 0 there, else 1. ``faint`` takes so short a phase that r = 1 is right as well.
    """

    beta: Array
    b: Array
    e1: Array
    e2: Array
    e3: Array
    r: Array

    @classmethod
    def from_shaft(cls, shaft: Shaft, faint: bool = False) -> Scales:
        """The scales of ``shaft``."""
        massless, mean = shaft.rhoA == 0, jnp.mean(shaft.rhoA, axis=0)
        # The mean, 1 if no segment has mass. Other masses would give scales the lanes of other parameters.
        mean = jax.lax.stop_gradient(jnp.where(mean == 0, 1.0, mean))
        b = jnp.sqrt(jnp.sqrt(jnp.where(massless, mean, shaft.rhoA) / shaft.EI))
        if faint:
            phase = jnp.sum(jnp.where(massless, 0.0, shaft.length * b), axis=0)
            highest = jnp.where(phase > 0, 1.0, highest_frequency(shaft))
            phase = jnp.where(phase > 0, phase, 1 / jnp.where(highest == 0, 1.0, highest))
            b = jnp.where(massless, _FAINT * jnp.minimum(b, phase / shaft.length), b)
        e1 = b * shaft.EI
        # Not the number 0: derivatives by rhoA pass here.
        return cls(shaft.length * b, b, e1, b * e1, b * b * e1, jnp.where(massless, shaft.rhoA / mean, 1.0))


class Segment(NamedTuple):
    """A segment with the node in front of it: the slices over which the propagation runs. ``inertia_before`` is that in
    front of an elastic joint."""

    beta: Array
    e1: Array
    e2: Array
    e3: Array
    r: Array | None
    k: Array
    unit: Array
    m: Array | None
    k_hinge: Array | None
    turn: Array | None
    k_rot: Array | None
    inertia: Array | None
    inertia_before: Array | None
    shear: Array | None
    rotary: Array | None


class LastNode(NamedTuple):
    """The node at D, with the scales of the segment in front of it."""

    k: Array
    m: Array | None
    unit: Array
    k_rot: Array | None
    inertia: Array | None
    e1: Array
    e3: Array


def segments_of(shaft: Shaft, q: Array, faint: bool = False) -> tuple[Segment, LastNode]:
    """The segments, each with the node in front of it, and the last node, at ``q``; for ``faint`` see :class:`Scales`."""
    scales = Scales.from_shaft(shaft)
    inner = Scales.from_shaft(shaft, faint=True) if faint else scales
    shaft = shaft.turning(q * q)
    unit = jnp.concatenate([scales.e3[:1], between(scales.e3), scales.e3[-1:]])
    hinges = turn = None
    if shaft.k_hinge is not None:
        hinges = jnp.concatenate([jnp.full_like(shaft.k_hinge[:1], jnp.inf), shaft.k_hinge])
    if not (hinges is None and shaft.k_rot is None and shaft.inertia is None):
        turn = jnp.concatenate([scales.e1[:1], between(scales.e1)])
    shear = rotary = None
    if shaft.is_timoshenko:
        square = inner.b * inner.b
        shear = jnp.zeros_like(square) if shaft.kGA is None else square * shaft.EI / shaft.kGA
        # A segment without mass has no rotary inertia either.
        mass = jnp.where(shaft.rhoA == 0, 1.0, shaft.rhoA)
        rotary = jnp.zeros_like(square)
        if shaft.rhoI is not None:
            axes = (slice(None), *(None,) * (shaft.rhoI.ndim - square.ndim))
            rotary = square[axes] * shaft.rhoI / mass[axes]
    before, behind = split_inertia(shaft)
    k_rot, inertia, m = (None if x is None else x[:-1] for x in (shaft.k_rot, behind, shaft.m))
    scaled = inner.beta, inner.e1, inner.e2, inner.e3, None if faint else inner.r
    segments = Segment(*scaled, shaft.k[:-1], unit[:-1], m, hinges, turn, k_rot, inertia, before, shear, rotary)
    k_rot, inertia, m = (None if x is None else x[-1] for x in (shaft.k_rot, shaft.inertia, shaft.m))
    return segments, LastNode(shaft.k[-1], m, unit[-1], k_rot, inertia, scales.e1[-1], scales.e3[-1])


def split_inertia(shaft: Shaft) -> tuple[Array | None, Array | None]:
    """Rotary inertia in front of the joint at every node but the last, and behind the joint at every node.

    All of it is behind a joint if all joints are rigid (the first is then None).
    """
    whole = shaft.inertia
    if whole is None or shaft.k_hinge is None:
        return None, whole
    halves = 0.5 * whole[1:-1]
    first = jnp.zeros_like(whole[:1])
    return jnp.concatenate([first, halves]), jnp.concatenate([whole[:1], halves, whole[-1:]])


def between(scale: Array) -> Array:
    """The mean of both sides at every joint."""
    return (scale[1:] + scale[:-1]) / 2


# Functions of one uniform beam segment, scaled so that they neither overflow nor cancel.
#
# A segment of the phase ``z = alpha l`` carries the second compound (the 2x2 minors) of its transfer matrix. In the
# coordinates of :mod:`~drivetrain_jax.analysis.critical_speeds.compound` it is ``exp(z B)`` for a sparse 5x5 matrix ``B``:
#
#     B u = (u1 + s u3, -2 u2 + s u4 - t u0, -u3, u4 - r u0, -r u1 - t u3)
#
# with the shear number ``s = alpha^2 EI/kGA``, the rotary number ``t = alpha^2 rhoI/rhoA`` (both 0 without shear and
# rotary inertia) and ``r = 1``. Its entries contain products such as ``ch z cos z`` whose differences the plain
# transfer matrix forms numerically, losing ``exp(z)``; here they are formed analytically. All results are multiplied by
# ``exp(-growth)``. A segment without mass has ``r = 0`` and the ``alpha`` of any other mass; its entries are
# polynomials of z, right to the first order in r for derivatives.

# Five entries.
Plane = tuple[Array, ...]

# Below this phase the functions are summed as series: their closed forms cancel for z -> 0.
_SERIES = 2.0
_TERMS = 8
# The general series runs in z^2 and to the same phase of its fastest wave.
_GENERAL_TERMS = 14


def sign_of(x: Array) -> Array:
    """-1 for negative ``x``, else 1, of zero too."""
    return jnp.where(x < 0, -1.0, 1.0)


class Compound(NamedTuple):
    """Entries of ``exp(z B)`` for an Euler-Bernoulli segment, times ``exp(-z)``.

    P = (1 + ch c)/2, Q = (1 - ch c)/2, X = sh s/2, Y = (ch s + sh c)/2, W = (ch s - sh c)/2, D = ch c,
    c = cos z, s = sin z; without mass (r = 0) P = D = 1, Q = z^4/12, X = z^2/2, Y = z, W = z^3/3 and no ``growth``.
    """

    r: Array | float
    P: Array
    Q: Array
    X: Array
    Y: Array
    W: Array
    D: Array
    growth: Array

    def propagate(self, u: Plane) -> Plane:
        """``exp(z B) u exp(-z)``."""
        r, P, Q, X, Y, W, D, _ = self
        u0, u1, u2, u3, u4 = u
        m0, m1, m2, m3 = r * u0, r * u1, r * u2, r * u3
        return (
            P * u0 + Y * u1 - 2 * X * u2 + W * u3 + Q * u4,
            D * u1 - W * m0 - 2 * Y * u2 + 2 * X * u3 + W * u4,
            X * m0 + W * m1 + D * u2 - Y * u3 - X * u4,
            D * u3 - Y * m0 - 2 * X * m1 + 2 * W * m2 + Y * u4,
            Q * (r * m0) - Y * m1 + 2 * X * m2 - W * m3 + P * u4,
        )


def _series(start: int, factor: float) -> tuple[float, ...]:
    """Coefficients of ``factor sum_k (-4)^k x^k/(4 k + start)!``, highest power first."""
    return tuple(factor * (-4.0) ** k / factorial(4 * k + start) for k in reversed(range(_TERMS)))


_Q_SERIES, _X_SERIES, _Y_SERIES, _W_SERIES = _series(4, 2.0), _series(2, 1.0), _series(1, 1.0), _series(3, 2.0)


def compound(z: Array, r: Array | float) -> Compound:
    """The functions of an Euler-Bernoulli segment of the phase ``z > 0``; ``r`` is 1, or 0 without mass."""
    massless = r == 0
    growth = jnp.where(massless, 0.0, z)
    decay = jnp.exp(-growth)
    small = massless | (z < _SERIES)
    short = jnp.where(small, z, 0.0)
    square = short * short
    fourth = square * square
    power = r * fourth
    q = fourth * horner(_Q_SERIES, power)
    x = square * horner(_X_SERIES, power)
    y = short * horner(_Y_SERIES, power)
    w = short * square * horner(_W_SERIES, power)
    long = jnp.where(small, _SERIES, z)
    sine, cosine = sincos(long)
    square_decay = jnp.where(small, 0.0, decay * decay)
    ch, sh = 0.5 + 0.5 * square_decay, 0.5 - 0.5 * square_decay
    d = ch * cosine
    return Compound(
        r=r,
        P=jnp.where(small, (1 - r * q) * decay, 0.5 * (decay + d)),
        Q=jnp.where(small, q * decay, 0.5 * (decay - d)),
        X=jnp.where(small, x * decay, 0.5 * sh * sine),
        Y=jnp.where(small, y * decay, 0.5 * (ch * sine + sh * cosine)),
        W=jnp.where(small, w * decay, 0.5 * (ch * sine - sh * cosine)),
        D=jnp.where(small, (1 - 2 * r * q) * decay, d),
        growth=growth,
    )


class Waves(NamedTuple):
    """Squared wave numbers of a Timoshenko segment over alpha^2: solutions are ``exp(+-hyperbolic z)`` and
    ``exp(+-i trigonometric z)``; ``hyperbolic2`` is negative above the cut-off frequency (``s t > 1``). The
    gyroscopic effect may make ``t`` negative."""

    trigonometric2: Any
    hyperbolic2: Any

    @classmethod
    def from_numbers(cls, s: Any, t: Any) -> Waves:
        """From the shear number and the rotary number."""
        half = (s + t) / 2
        # The larger one without cancellation, the other by their product.
        larger = jnp.where(half < 0, -half, half) + jnp.sqrt(((s - t) / 2) ** 2 + 1)
        pair = larger, (1 - s * t) / larger
        return cls(jnp.where(half < 0, pair[1], pair[0]), jnp.where(half < 0, pair[0], pair[1]))


class General(NamedTuple):
    """``exp(z B) = 1 + g1 B + g2 B^2 + g3 B^3 + g4 B^4`` of a Timoshenko segment, times ``unit = exp(-growth)``."""

    r: Array | float
    s: Array
    t: Array
    unit: Array
    growth: Array
    g: tuple[Array, Array, Array, Array]

    def propagate(self, u: Plane) -> Plane:
        """``exp(z B) u exp(-growth)``."""
        total, power = [self.unit * x for x in u], u
        for g in self.g:
            power = self.generator(power)
            total = [a + g * b for a, b in zip(total, power, strict=True)]
        return tuple(total)

    def generator(self, u: Plane) -> Plane:
        """``B u``."""
        u0, u1, u2, u3, u4 = u
        r, s, t = self.r, self.s, self.t
        return u1 + s * u3, s * u4 - 2 * u2 - t * u0, -u3, u4 - r * u0, -r * u1 - t * u3


def even_and_odd(square: Array, z: Array) -> tuple[Array, Array, Array]:
    """``cosh(r z)`` and ``sinh(r z)/r`` for ``r^2 = square`` of either sign, times ``exp(-growth)``, and ``growth``."""
    growing = square > 0
    root = jnp.sqrt(jnp.where(square == 0, 1.0, jnp.abs(square)))
    phase = root * z
    growth = jnp.where(growing, phase, 0.0)
    sine, cosine = sincos(jnp.where(growing, 0.0, phase))
    square_decay = jnp.exp(-2 * growth)
    # expm1 keeps the digits of sinh for small phases.
    hyperbolic = -0.5 * jnp.expm1(-2 * growth)
    even = jnp.where(growing, 0.5 + 0.5 * square_decay, cosine)
    odd = jnp.where(growing, hyperbolic, sine) / root
    return jnp.where(square == 0, 1.0, even), jnp.where(square == 0, z, odd), jnp.where(square == 0, 0.0, growth)


def general(z: Array, r: Array | float, s: Array, t: Array) -> General:
    """The functions of a Timoshenko segment of the phase ``z > 0`` with shear number ``s`` and rotary number ``t``; ``r``
    is 1, or 0 without mass."""
    waves, massless = Waves.from_numbers(s, t), r == 0
    long = jnp.where(massless, 0.0, z)
    ch, sh, growth = even_and_odd(waves.hyperbolic2, long)
    c, sn, _ = even_and_odd(-waves.trigonometric2, long)
    unit = jnp.exp(-growth)
    real, total = -(s + t), waves.trigonometric2 + waves.hyperbolic2
    g4 = (0.5 * real * sh * sn - (ch * c - unit)) / total**2
    g3 = (ch * sn - sh * c) / (2 * total)
    direct = (sh * c - g3 * (waves.hyperbolic2 - 3 * waves.trigonometric2), 0.5 * sh * sn - 2 * real * g4, g3, g4)
    small = massless | (z * z * 2 * (jnp.maximum(s, jnp.abs(t)) + 1) < _SERIES**2)
    summed = _general_series(jnp.where(small, z, 0.0), r, s, t)
    g = tuple(jnp.where(small, unit * a, b) for a, b in zip(summed, direct, strict=True))
    return General(r, s, t, unit, growth, g)  # pyright: ignore[reportArgumentType]


def _general_series(z: Array, r: Array | float, s: Array, t: Array) -> tuple[Array, Array, Array, Array]:
    """g1 to g4 without scaling, from ``B^5 = -2 (r s + t) B^3 - ((r s - t)^2 + 4 r) B``."""
    square = z * z
    trace, product = -2 * (r * s + t), (r * s - t) ** 2 + 4 * r
    # Powers of z are part of p and q: those of a long segment without mass would overflow, and it needs few.
    p, q = jnp.ones_like(square), jnp.zeros_like(square)
    g1, g2, g3, g4 = (jnp.zeros_like(square) for _ in range(4))
    for n in range(_GENERAL_TERMS):
        odd, even = z * (1 / factorial(2 * n + 1)), square * (1 / factorial(2 * n + 2))
        g1, g3, g2, g4 = g1 + p * odd, g3 + q * odd, g2 + p * even, g4 + q * even
        p, q = -(product * square) * q, square * (p + trace * q)
    return g1, g2, g3, g4


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
    segments, last = segments_of(shaft, q, faint=True)
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
    segments, _ = segments_of(shaft, q)
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
