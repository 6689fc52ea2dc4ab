"""Bias and equivalent stiffness of the oscillator with play at an amplitude, for its describing function.

Symbols and equations: :mod:`~drivetrain_jax.analysis.frequency_response.describing_function`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator

_BIAS_STEPS = 24


class Point(NamedTuple):
    """Bias ``m``, equivalent stiffness ``kappa`` and its derivative with respect to the amplitude."""

    bias: Array
    stiffness: Array
    slope: Array


def moments(x: Array) -> tuple[Array, Array]:
    """Mean h0 and half the fundamental h1 of the part of a cosine above ``x``.

    ``h0 = (sqrt(1 - x^2) - x acos x)/pi`` (``-x`` for x <= -1, 0 for x >= 1), ``h1 = (acos x - x sqrt(1 - x^2))/pi``.
    """
    inside = jnp.clip(x, -1.0, 1.0)
    root, angle = jnp.sqrt(1 - inside**2), jnp.arccos(inside)
    return (root - inside * angle) / jnp.pi + jnp.maximum(-1 - x, 0.0), (angle - inside * root) / jnp.pi


def imbalance(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> tuple[Array, Array]:
    """Mean force minus mean drive, over k', and its derivative with respect to the bias (not negative)."""
    p, q = (model.b - bias) / amplitude, (model.b + bias) / amplitude
    beyond, before = moments(p)[0], moments(q)[0]
    force = model.alpha * bias + (1 - model.alpha) * amplitude * (beyond - before)
    share = (jnp.arccos(jnp.clip(p, -1.0, 1.0)) + jnp.arccos(jnp.clip(q, -1.0, 1.0))) / jnp.pi
    return force - model.B0 / model.stiffness, model.alpha + (1 - model.alpha) * share


def improved(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> Array:
    """Bias after one Newton step; unchanged where the mean force does not depend on the bias (free within the play)."""
    value, slope = imbalance(model, amplitude, bias)
    return bias - jnp.where(slope > 0, value / jnp.where(slope > 0, slope, 1.0), 0.0)


def bias_of(model: PiecewiseLinearOscillator, amplitude: Array) -> Array:
    """The bias at which the mean force balances the mean drive: bisection and Newton steps in turn."""
    static, reach = model.B0 / model.stiffness, jnp.abs(1 - model.alpha) * model.b
    reach = reach + jnp.zeros_like(amplitude)

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, guess = state
        for trial in (guess, (low + high) / 2):
            value = imbalance(model, amplitude, trial)[0]
            low = jnp.where((value <= 0) & (trial > low), trial, low)
            high = jnp.where((value >= 0) & (trial < high), trial, high)
        return low, high, jnp.clip(improved(model, amplitude, (low + high) / 2), low, high)

    low, high, guess = jax.lax.fori_loop(0, _BIAS_STEPS, step, (static - reach, static + reach, static + 0 * reach))
    return jnp.clip(improved(model, amplitude, guess), low, high)


def point_at(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> Point:
    """Equivalent stiffness at a balanced ``bias``, and its total derivative along the bias curve m(A)."""
    p, q = (model.b - bias) / amplitude, (model.b + bias) / amplitude
    inside = tuple(jnp.clip(x, -1.0, 1.0) for x in (p, q))
    root_p, root_q = (jnp.sqrt(1 - x**2) for x in inside)
    soft = 1 - model.alpha
    stiffness = model.stiffness * (model.alpha + soft * (moments(p)[1] + moments(q)[1]))
    support = imbalance(model, amplitude, bias)[1]
    drift = soft * (root_q - root_p) / jnp.pi / jnp.where(support > 0, support, 1.0)
    turn = root_p * (drift + p) + root_q * (q - drift)
    slope = model.stiffness * soft * 2 / jnp.pi * turn / amplitude
    return Point(bias, stiffness, slope)
