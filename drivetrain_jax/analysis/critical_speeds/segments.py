"""The segments of a shaft with their nodes, in the units in which the propagation runs."""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.mechanisms import highest_frequency
from drivetrain_jax.systems import Shaft
from drivetrain_jax.systems._models import horner, sincos

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
    def of(cls, shaft: Shaft, faint: bool = False) -> Scales:
        """The scales of ``shaft``."""
        massless, mean = shaft.rhoA == 0, _mean_mass(shaft.rhoA)
        b = jnp.sqrt(jnp.sqrt(jnp.where(massless, mean, shaft.rhoA) / shaft.EI))
        if faint:
            phase = jnp.sum(jnp.where(massless, 0.0, shaft.length * b), axis=0)
            highest = jnp.where(phase > 0, 1.0, highest_frequency(shaft))
            phase = jnp.where(phase > 0, phase, 1 / jnp.where(highest == 0, 1.0, highest))
            b = jnp.where(massless, _FAINT * jnp.minimum(b, phase / shaft.length), b)
        e1 = b * shaft.EI
        # Not the number 0: derivatives by rhoA pass here.
        return cls(shaft.length * b, b, e1, b * e1, b * b * e1, jnp.where(massless, shaft.rhoA / mean, 1.0))


def _mean_mass(rhoA: Array) -> Array:
    """The mean of all segments, 1 if none has mass. Other masses would give scales the lanes of other parameters."""
    mean = jnp.mean(rhoA, axis=0)
    return jax.lax.stop_gradient(jnp.where(mean == 0, 1.0, mean))


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


def segments_of(shaft: Shaft, faint: bool = False) -> tuple[Segment, LastNode]:
    """The segments, each with the node in front of it, and the last node; for ``faint`` see :class:`Scales`."""
    scales = Scales.of(shaft)
    inner = Scales.of(shaft, faint=True) if faint else scales
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
        rotary = jnp.zeros_like(square) if shaft.rhoI is None else square * shaft.rhoI / mass
    before, behind = split_inertia(shaft)
    k_rot, inertia, m = (None if x is None else x[:-1] for x in (shaft.k_rot, behind, shaft.m))
    own = inner.beta, inner.e1, inner.e2, inner.e3, None if faint else inner.r
    segments = Segment(*own, shaft.k[:-1], unit[:-1], m, hinges, turn, k_rot, inertia, before, shear, rotary)
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
    ``exp(+-i trigonometric z)``; ``hyperbolic2`` is negative above the cut-off frequency (``s t > 1``)."""

    trigonometric2: Any
    hyperbolic2: Any

    @classmethod
    def of(cls, s: Any, t: Any) -> Waves:
        """From the shear number and the rotary number."""
        half = (s + t) / 2
        trigonometric2 = half + jnp.sqrt(((s - t) / 2) ** 2 + 1)
        return cls(trigonometric2, (1 - s * t) / trigonometric2)


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
    waves, massless = Waves.of(s, t), r == 0
    long = jnp.where(massless, 0.0, z)
    ch, sh, growth = even_and_odd(waves.hyperbolic2, long)
    c, sn, _ = even_and_odd(-waves.trigonometric2, long)
    unit = jnp.exp(-growth)
    real, total = -(s + t), waves.trigonometric2 + waves.hyperbolic2
    g4 = (0.5 * real * sh * sn - (ch * c - unit)) / total**2
    g3 = (ch * sn - sh * c) / (2 * total)
    direct = (
        sh * c - g3 * (waves.hyperbolic2 - 3 * waves.trigonometric2),
        0.5 * sh * sn - 2 * real * g4,
        g3,
        g4,
    )
    small = massless | (z * z * 2 * (jnp.maximum(s, t) + 1) < _SERIES**2)
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
