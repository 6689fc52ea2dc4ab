"""The tip of a tongue of parametric resonance: the least excitation that makes a periodic system unstable.

At the edge of a subharmonic tongue one Floquet multiplier is -1, that is p = det(Z + I) = 0. :func:`tongue_edge` solves
this for the amplitude of the excitation at given frequencies; :func:`tongue_tip` finds the least of these amplitudes over
the frequency from the Chebyshev interpolant of the edge, which is an analytic function near its minimum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.floquet.multipliers import characteristic_coefficients
from drivetrain_jax.analysis.floquet.propagator import propagator
from drivetrain_jax.systems import LinearPeriodic

Form = Callable[[Any, Any], LinearPeriodic]

# Steps of order 8 per period: the monodromy matrix is then exact to rounding for a few radians of phase.
_STEPS = 64
_ITERATIONS = 40
# Relative change after which the secant method has converged to rounding, and its next quotient would be rounding.
_CONVERGED = 1e-8
# Frequencies of the scan and nodes of the interpolants, whose intervals shrink from pass to pass.
_NODES, _PASSES, _NARROWING = 17, 2, 0.5


class TongueTip(NamedTuple):
    """Least ``amplitude`` at the edge of a tongue and the ``frequency`` it belongs to, NaN if none was found.

    The errors are the differences between the last two passes; ``curvature`` is d2(amplitude)/d(frequency)2 there.
    """

    amplitude: float
    frequency: float
    amplitude_error: float
    frequency_error: float
    curvature: float


def edge_function(form: LinearPeriodic) -> Array:
    """``det(Z + I)`` of the system ``form``: 0 where a multiplier is -1."""
    a = characteristic_coefficients(propagator(form, jnp.int32(_STEPS)).matrix)
    # (-1)^n det(-I - Z), from the coefficients of det(s I - Z) at s = -1.
    return 1 + sum((-1) ** (k + 1) * a[k] for k in range(a.shape[0]))  # pyright: ignore[reportReturnType]


def tongue_edge(form: Form, frequency: Array, guess: Array) -> Array:
    """Amplitude at which ``form(amplitude, frequency)`` has the multiplier -1, for every frequency, shape ``(N,)``.

    By the secant method from ``guess`` (scalar or ``(N,)``) and the same less 5 per cent; NaN where it does not converge.
    """
    frequency = jnp.asarray(frequency, float)

    def edge(amplitude: Array) -> Array:
        return jax.vmap(lambda *point: edge_function(form(*point)))(amplitude, frequency)

    def moving(old: Array, q: Array) -> Array:
        return jnp.abs(q - old) > _CONVERGED * jnp.abs(q)

    def secant(state: tuple[Array, ...]) -> tuple[Array, ...]:
        old, value, q, count = state
        new = edge(q)
        # A lane that has arrived stays: its next difference quotient would be rounding.
        step = jnp.where(moving(old, q) & (new != value), new * (q - old) / (new - value), 0.0)
        return q, new, q - step, count + 1

    def unfinished(state: tuple[Array, ...]) -> Array:
        old, _, q, count = state
        return (count < _ITERATIONS) & jnp.any(moving(old, q))

    first = jnp.broadcast_to(jnp.asarray(guess, float), frequency.shape)
    start = (0.95 * first, edge(0.95 * first), first, 0)
    old, _, q, _ = jax.lax.while_loop(unfinished, secant, start)  # pyright: ignore[reportArgumentType]
    return jnp.where(moving(old, q), jnp.nan, q)


def tongue_tip(form: Form, amplitude: float, frequency: float, width: float) -> TongueTip:
    """The tip of the subharmonic tongue of ``form(amplitude, frequency)`` near a first guess of both.

    The tip is looked for within ``frequency * (1 +- width)``; the damping ratio is a suitable width and perturbation
    theory a suitable guess. Both arguments of ``form`` are traced numbers. NaN if the edge is not lowest
    inside that interval.
    """
    edge = jax.jit(lambda f, guess: tongue_edge(form, f, guess))
    scan = frequency * np.linspace(1 - width, 1 + width, _NODES)
    found = np.asarray(edge(scan, amplitude))
    found = np.where(np.isfinite(found), found, np.inf)
    lowest = int(np.argmin(found))
    if lowest in (0, _NODES - 1) or not np.isfinite(found[lowest - 1 : lowest + 2]).all():
        return TongueTip(*(math.nan,) * 5)
    half, tips = scan[1] - scan[0], [(found[lowest], scan[lowest])]
    for _ in range(_PASSES):
        amplitude, frequency = tips[-1]
        curve = np.polynomial.Chebyshev.interpolate(
            lambda f, guess: np.asarray(edge(f, guess)),
            _NODES - 1,
            domain=(frequency - half, frequency + half),
            args=(amplitude,),
        )
        tips.append(_lowest(curve))
        half *= _NARROWING
    errors = np.abs(np.subtract(tips[-1], tips[-2]))
    return TongueTip(*map(float, (*tips[-1], *errors, curve.deriv(2)(tips[-1][1]))))


def _lowest(curve: np.polynomial.Chebyshev) -> tuple[float, float]:
    """Value and place of the lowest minimum of ``curve`` within its interval; NaN if there is none."""
    if not np.isfinite(curve.coef).all():
        return math.nan, math.nan
    low, high = curve.domain
    turning = curve.deriv().roots()
    turning = turning.real[abs(turning.imag) < 1e-9 * (high - low)]
    turning = turning[(turning > low) & (turning < high)]
    if not turning.size:
        return math.nan, math.nan
    place = turning[np.argmin(curve(turning))]
    return curve(place), place
