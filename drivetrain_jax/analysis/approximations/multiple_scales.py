"""First-order multiple scales (= averaging) of the oscillator with play, its spring replaced by a cubic polynomial.

Least squares on ``[-R, R]`` (:func:`cubic_fit`) give ``k'/I f_s(u) ~ l1 u + l2 u^3``, w0 = sqrt(l1). Near ``omega = w0``
the motion is ``u = a cos(omega t - beta)`` whose amplitude and phase drift slowly,

    a' = -mu a + F sin(beta),   a beta' = (delta - g a^2) a + F cos(beta),
    mu = c/(2 I),   F = B1/(2 w0),   delta = omega - w0,   g = 3 l2/(8 w0),

and the steady response, with rho = a^2, is cubic: ``[(delta - g rho)^2 + mu^2] rho = F^2`` (eqs (50), (63) of the paper,
corrected: its parameter epsilon cancels). The mean drive does not enter at this order. Backbone ``omega = w0 + g rho``,
peak ``a = F/mu`` on it, folds ``4 g^2 rho^3 (F^2 - mu^2 rho) = F^4``. All functions broadcast over a trailing batch.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.amplitude_roots import bisect, sign_changes, take
from drivetrain_jax.systems import PiecewiseLinearOscillator

MOST_ROOTS = 3
_RANGES = 96
_LARGEST = 1e150


class Cubic(NamedTuple):
    """``stiffness = l1`` [1/s^2] and ``cubic = l2`` [1/(s m)^2], and the range R of the fit [m]."""

    stiffness: Array
    cubic: Array
    fit_range: Array


class SlowFlow(NamedTuple):
    """Coefficients ``w0, mu, F, g`` of the averaged equations; NaN where l1 is not positive."""

    frequency: Array
    decay: Array
    drive: Array
    bend: Array


def _share(r: Array) -> Array:
    """What the play takes from l1: ``(45 r - 50 r^3 + 21 r^5)/16``, 1 at r = 1."""
    return r * (45 - r**2 * (50 - 21 * r**2)) / 16


def cubic_fit(model: PiecewiseLinearOscillator, fit_range: Array) -> Cubic:
    """Least-squares cubic of the spring on ``[-R, R]``; with r = b/R (at most 1, the spring is linear below):

    ``l1 = k' [1 - (1 - alpha)(45 r/16 - 25 r^3/8 + 21 r^5/16)]``, ``l2 = k' (1 - alpha)(35/16) r (1 - r^2)^2/R^2``.
    """
    play = jnp.where(model.b > 0, model.b, 0.0)
    r = jnp.clip(play / jnp.where(fit_range > 0, fit_range, 1.0), 0.0, 1.0)
    r = jnp.where(fit_range > 0, r, jnp.where(play > 0, 1.0, 0.0))
    soft = 1 - model.alpha
    # r/R rather than 1/R: an infinite range gives a linear spring.
    per_square = jnp.where(play > 0, (r / jnp.where(play > 0, play, 1.0)) ** 2, 0.0)
    cubic = model.stiffness * soft * 35 / 16 * r * (1 - r**2) ** 2 * per_square
    return Cubic(model.stiffness * (1 - soft * _share(r)), cubic, fit_range)


def self_consistent_range(model: PiecewiseLinearOscillator, shape: tuple[int, ...]) -> Array:
    """The range that equals the peak amplitude it gives: ``R c' sqrt(l1(R)) = B1``, infinite without damping.

    The largest one where there are several (alpha near 0); NaN where l1 is not positive (alpha = 0 within the play).
    """
    target = jnp.abs(model.B1) / jnp.where(model.damping > 0, model.damping, 1.0) + jnp.zeros(shape)

    def excess(r: Array) -> Array:
        # q(R) = R^2 l1 in units of b^2, as a function of r = b/R <= 1.
        stiffness = model.stiffness * (1 - (1 - model.alpha) * _share(r))
        return stiffness * jnp.where(model.b > 0, model.b, 1.0) ** 2 - (target * r) ** 2

    column = (_RANGES, *(1,) * len(shape))
    ratio = jnp.concatenate([jnp.zeros((1, *shape)), jnp.logspace(-8, 0, _RANGES).reshape(column) + jnp.zeros(shape)])
    mask = sign_changes(excess(ratio) > 0, 1)
    r = bisect(lambda r: -excess(r), take(mask, ratio[:-1]), take(mask, ratio[1:]))[0]
    beyond = model.b / jnp.where(r > 0, r, 1.0)
    # Without a change of sign the peak lies within the play, where the spring is linear.
    within = target / jnp.sqrt(model.stiffness * model.alpha)
    linear = target / jnp.sqrt(model.stiffness * jnp.ones(shape))
    found = jnp.where(jnp.any(mask, axis=(0, 1)), beyond, within)
    found = jnp.where(model.b > 0, found, linear)
    return jnp.where(model.damping > 0, found, jnp.inf)


def slow_flow(model: PiecewiseLinearOscillator, fit: Cubic) -> SlowFlow:
    """The averaged equations of the oscillator with the spring ``fit``."""
    frequency = jnp.sqrt(jnp.where(fit.stiffness > 0, fit.stiffness, jnp.nan))
    return SlowFlow(frequency, model.damping / 2, jnp.abs(model.B1) / (2 * frequency), 3 * fit.cubic / (8 * frequency))


def peak(flow: SlowFlow) -> tuple[Array, Array]:
    """Largest amplitude ``F/mu`` (infinite without damping) and the frequency ``w0 + g a^2`` where it is reached."""
    amplitude = jnp.where(flow.decay > 0, flow.drive / jnp.where(flow.decay > 0, flow.decay, 1.0), jnp.inf)
    return amplitude, flow.frequency + jnp.where(flow.bend != 0, flow.bend * amplitude**2, 0.0)


def folds(flow: SlowFlow) -> tuple[Array, Array]:
    """Squared amplitudes and frequencies ``(2, ...)`` of the folds, NaN where there are none.

    ``4 g^2 rho^3 (F^2 - mu^2 rho) = F^4`` has two roots, on either side of rho = 3 F^2/(4 mu^2), or none; the second
    is infinite without damping.
    """
    square = flow.drive**2
    mu2 = flow.decay**2 + jnp.zeros_like(square)
    ends = jnp.where(mu2 > 0, square / jnp.where(mu2 > 0, mu2, 1.0), _LARGEST ** (1 / 3))

    def surplus(rho: Array) -> Array:
        return 4 * flow.bend**2 * rho**3 * (square - mu2 * rho) - square**2

    middle = jnp.where(mu2 > 0, 0.75, 1.0) * ends
    lower = bisect(surplus, jnp.zeros_like(middle), middle)
    upper = jnp.where(mu2 > 0, bisect(lambda rho: -surplus(rho), middle, ends), jnp.inf)
    rho = jnp.where(surplus(middle) > 0, jnp.stack([lower, upper]), jnp.nan)
    half_width = jnp.sqrt(jnp.maximum(square / rho - mu2, 0.0))
    return rho, flow.frequency + flow.bend * rho + jnp.sign(flow.bend) * half_width


def response_residual(flow: SlowFlow, omega: Array, rho: Array) -> Array:
    """``[(delta - g rho)^2 + mu^2] rho - F^2``."""
    return ((omega - flow.frequency - flow.bend * rho) ** 2 + flow.decay**2) * rho - flow.drive**2


def roots(flow: SlowFlow, omega: Array) -> Array:
    """All amplitudes at one frequency, rising, ``(MOST_ROOTS, ...)``, infinite where there are fewer.

    The cubic is monotone between its stationary points, known in closed form: one bisection for each piece.
    """
    delta, square = omega - flow.frequency, flow.drive**2
    bend = jnp.where(flow.bend != 0, flow.bend, 1.0)
    spread = jnp.sqrt(jnp.maximum(delta**2 - 3 * flow.decay**2, 0.0))
    stationary = jnp.stack([2 * delta - spread, 2 * delta + spread]) / (3 * bend)
    stationary = jnp.sort(jnp.where(flow.bend != 0, jnp.maximum(stationary, 0.0), 0.0), axis=0)
    damped = square / jnp.where(flow.decay > 0, flow.decay, 1.0) ** 2
    bent = jnp.maximum(2 * jnp.abs(delta / bend), jnp.cbrt(4 * square / bend**2))
    detuned = square / jnp.where(delta != 0, delta, 1.0) ** 2
    bound = jnp.where(flow.decay > 0, damped, jnp.where(flow.bend != 0, bent, jnp.where(delta != 0, detuned, jnp.inf)))
    # The bound is the peak itself on the backbone; stationary points lie below it or do not matter.
    bound = jnp.where(jnp.isfinite(bound), bound * (1 + 1e-12), _LARGEST)
    points = jnp.concatenate([jnp.zeros_like(bound)[None], jnp.minimum(stationary, bound), bound[None]])
    positive = (response_residual(flow, omega, points) > 0) & (points > 0)
    mask = sign_changes(positive, MOST_ROOTS)
    turned = jnp.where(take(mask, positive[1:], 1.0) > 0, 1.0, -1.0)
    found = bisect(
        lambda rho: turned * response_residual(flow, omega, rho), take(mask, points[:-1]), take(mask, points[1:]), 90
    )
    amplitude = jnp.where(jnp.any(mask, axis=1) & (found < _LARGEST / 2), jnp.sqrt(found), jnp.inf)
    # Without drive there is rest alone; without a positive l1 nothing.
    return jnp.where(square == 0, jnp.full_like(amplitude, jnp.inf).at[0].set(0.0), amplitude)


def decay_rate(flow: SlowFlow, omega: Array, amplitude: Array) -> Array:
    """Largest real part of the eigenvalues ``-mu -+ sqrt(-(delta - g rho)(delta - 3 g rho))`` of the averaged motion."""
    delta, rho = omega - flow.frequency, amplitude**2
    product = (delta - flow.bend * rho) * (delta - 3 * flow.bend * rho)
    return -flow.decay + jnp.sqrt(jnp.maximum(-product, 0.0))


def phase_lag(flow: SlowFlow, omega: Array, amplitude: Array) -> Array:
    """``beta``: sin(beta) = mu a/F, cos(beta) = (g rho - delta) a/F."""
    return jnp.arctan2(flow.decay * jnp.ones_like(amplitude), flow.bend * amplitude**2 - (omega - flow.frequency))
