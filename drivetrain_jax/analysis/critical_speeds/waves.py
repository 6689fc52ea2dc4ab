"""Functions of one uniform beam segment, scaled so that they neither overflow nor cancel.

A segment of the phase ``z = alpha l`` carries the second compound (the 2x2 minors) of its transfer matrix. In the
coordinates of :mod:`~drivetrain_jax.analysis.critical_speeds.compound` it is ``exp(z B)`` for a sparse 5x5 matrix ``B``:

    B u = (u1 + s u3, -2 u2 + s u4 - t u0, -u3, u4 - r u0, -r u1 - t u3)

with the shear number ``s = alpha^2 EI/kGA``, the rotary number ``t = alpha^2 rhoI/rhoA`` (both 0 without shear and
rotary inertia) and ``r = 1``. Its entries contain products such as ``ch z cos z`` whose differences the plain transfer
matrix forms numerically, losing ``exp(z)``; here they are formed analytically. All results are multiplied by
``exp(-growth)``. A segment without mass has ``r = 0`` and the ``alpha`` of any other mass; its entries are polynomials of z,
right to the first order in r for derivatives.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems.trigonometry import horner, sincos

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
