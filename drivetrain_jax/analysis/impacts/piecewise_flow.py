"""Closed-form flow of a :class:`~drivetrain_jax.systems.PiecewiseLinearOscillator` within one linear region, and the
longest step that certainly stays in the region. All functions act on lanes: arrays of one shape ``(N,)``.

Within a region ``u'' + C u' + K u = F + B1 cos(omega t)``. With the harmonic response ``q`` subtracted, ``x = u - q``
and ``y = x'``, and with the step response P and impulse response S = P' of the homogeneous equation,

    x(t + d) = x + S y + P (F - K x),    y(t + d) = S' y + S (F - K x),    S' = 1 - K P - C S.

``[[1 - K P, S], [-K S, S']]`` is the transition matrix; its determinant is ``exp(-C d)``. Neither K = 0 nor critical
damping is singular in this form. As the spring force is continuous, the transition matrix of a motion is the product of
the transition matrices of its steps, with a factor where the damping jumps (:mod:`.piecewise_march`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator, UnderdampedOscillator
from drivetrain_jax.systems.trigonometry import sincos

_TINY = 1e-150
# Largest |root| d for the Taylor series of the step response, and its number of terms.
_SHORT, _TERMS = 0.5, 14


class Piece(NamedTuple):
    """Constants of one linear region: ``K``, half the damping ``h = C/2``, ``root = sqrt(|K - h^2|)``, a flag of
    overdamping, the roots ``slow`` and ``fast`` (both -h if the region oscillates), the modulus ``rate`` of the larger root,
    and the harmonic response ``cosine cos(omega t) + sine sin(omega t)``."""

    stiffness: Array
    half_damping: Array
    root: Array
    overdamped: Array
    slow: Array
    fast: Array
    rate: Array
    cosine: Array
    sine: Array


def piece(oscillator: PiecewiseLinearOscillator, stiffness: Array, damping: Array) -> Piece:
    """The region of this stiffness and damping. The harmonic response of an undamped region at resonance is not finite."""
    h, omega = damping / 2, oscillator.omega
    q = stiffness - h**2
    overdamped = jnp.zeros_like(q, bool) if isinstance(oscillator, UnderdampedOscillator) else q < 0
    root = jnp.maximum(jnp.sqrt(jnp.abs(q)), _TINY)
    # The slow root follows from the product K of both roots, without cancellation.
    slow = jnp.where(overdamped, -stiffness / jnp.maximum(h + root, _TINY), -h)
    fast = jnp.where(overdamped, -(h + root), -h)
    rate = jnp.where(overdamped, h + root, jnp.sqrt(stiffness))
    detuning, lag = stiffness - omega**2, damping * omega
    scale = oscillator.B1 / (detuning**2 + lag**2)
    fields = (stiffness, h, root, overdamped, slow, fast, rate, scale * detuning, scale * lag)
    return Piece(*jnp.broadcast_arrays(*(jnp.asarray(field) for field in fields)))


def choose(condition: Array, first: Piece, second: Piece) -> Piece:
    """``first`` in the lanes where ``condition`` holds, else ``second``."""
    return Piece(*(jnp.where(condition, a, b) for a, b in zip(first, second, strict=True)))


def _short_step_response(region: Piece, d: Array) -> Array:
    """Step response by its Taylor series."""
    damping, stiffness = 2 * region.half_damping * d, region.stiffness * d * d
    before, term = jnp.zeros_like(d), d * d / 2
    total = term
    for n in range(1, _TERMS):
        before, term = term, -(damping * (n + 1) * term + stiffness * before) / ((n + 1) * (n + 2))
        total = total + term
    return total


def responses(region: Piece, d: Array) -> tuple[Array, Array, Array]:
    """Step response P, impulse response S and its derivative S' at the time ``d`` after a start from rest."""
    half_sine, half_cosine = sincos(jnp.where(region.overdamped, 0.0, region.root * d / 2))
    slow, fast = jnp.expm1(region.slow * d), jnp.expm1(region.fast * d)
    # Oscillating: exp(-h d) (sin, cos); the step response through the half angle.
    decay = 1 + slow
    ratio = 2 * half_sine * half_cosine / region.root
    wave = decay * ratio
    wave_rate = decay * (1 - 2 * half_sine**2) - region.half_damping * wave
    stiffness = jnp.maximum(region.stiffness, _TINY)
    wave_step = (decay * (2 * half_sine**2 - region.half_damping * ratio) - slow) / stiffness
    # Overdamped: differences of exponentials, by series where these are close.
    angle = region.root * d
    near = angle < 0.1
    square = jnp.where(near, angle, 0.0) ** 2
    hyperbolic = 1 + square / 6 * (1 + square / 20 * (1 + square / 42))
    middle = jnp.sqrt(decay * (1 + fast))
    apart = jnp.where(near, middle * d * hyperbolic, (slow - fast) / (2 * region.root))
    apart_rate = 1 + fast + region.slow * apart
    slow_integral = jnp.where(region.slow == 0, d, slow / jnp.where(region.slow == 0, 1.0, region.slow))
    fast_integral = fast / jnp.where(region.fast == 0, 1.0, region.fast)
    apart_step = jnp.where(
        near, (region.fast * apart - fast) / stiffness, (slow_integral - fast_integral) / (2 * region.root)
    )
    step = jnp.where(region.overdamped, apart_step, wave_step)
    short = region.rate * d < _SHORT
    step = jnp.where(short, _short_step_response(region, jnp.where(short, d, 0.0)), step)
    impulse = jnp.where(region.overdamped, apart, wave)
    return step, impulse, jnp.where(region.overdamped, apart_rate, wave_rate)


class Bound(NamedTuple):
    """A function of time known to lie above ``value + slope t + curvature t^2/2 - jerk t^3/6`` for ``t >= 0``."""

    value: Array
    slope: Array
    curvature: Array
    jerk: Array


def _parabola_root(bound: Bound, span: Array) -> Array:
    """First positive root of the parabola below ``bound`` on ``[0, span]``, infinite if there is none."""
    curvature = bound.curvature - bound.jerk * span / 3
    discriminant = bound.slope**2 - 2 * curvature * bound.value
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    falls = bound.slope < 0
    numerator = jnp.where(falls, 2 * bound.value, bound.slope + root)
    denominator = jnp.where(falls, root - bound.slope, -curvature)
    exists = jnp.where(falls, discriminant >= 0, curvature < 0)
    return jnp.where(exists, numerator / jnp.where(exists, denominator, 1.0), jnp.inf)


def certain_span(bounds: tuple[Bound, ...], likely: Array, limit: Array) -> Array:
    """A time up to which none of ``bounds`` falls below zero, at most ``limit``; the search starts at ``likely``.

    On ``[0, s]`` the cubic lies above a parabola, so the smaller one of ``s`` and the first root of the parabola is certain.
    A second trial with a smaller ``s`` makes the root accurate to third order. Repeated steps are a Newton iteration that
    approaches a zero from one side and cannot pass it.
    """
    best, span = jnp.zeros_like(limit), jnp.minimum(likely, limit)
    for _ in range(_TRIALS):
        root = jnp.stack([_parabola_root(bound, span) for bound in bounds]).min(axis=0)
        best = jnp.maximum(best, jnp.minimum(root, span))
        span = jnp.minimum(_STRETCH * best, limit)
    return best


_TRIALS, _STRETCH = 2, 1.3
