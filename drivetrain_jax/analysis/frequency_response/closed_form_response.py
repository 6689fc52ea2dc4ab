"""Frequency response in closed form: multiple scales and describing function, with peak, folds, backbone, stability.

Both methods return all amplitudes at a frequency, and the motion ``u = m + A cos(omega t - phi)`` of each amplitude; a
sweep selects one of them. Results are arrays ``(L, own dimensions, ...)``, the path first, the batch last.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.frequency_response import describing_function
from drivetrain_jax.analysis.frequency_response.describing_function import follow, refined, take
from drivetrain_jax.analysis.impacts.motion import ABSENT, imbalance, regime
from drivetrain_jax.analysis.numerics.continuation import bisect, sign_changes
from drivetrain_jax.systems import PiecewiseLinearOscillator

# First-order multiple scales (= averaging) of the oscillator with play, with a cubic polynomial for its spring.
#
# Least squares on ``[-R, R]`` (:func:`cubic_fit`) give ``k'/I f_s(u) ~ l1 u + l2 u^3``, w0 = sqrt(l1). Near ``omega = w0``
# the motion is ``u = a cos(omega t - beta)`` with slowly drifting amplitude and phase,
#
#     a' = -mu a + F sin(beta),   a beta' = (delta - g a^2) a + F cos(beta),
#     mu = c/(2 I),   F = B1/(2 w0),   delta = omega - w0,   g = 3 l2/(8 w0),
#
# and the steady response, with rho = a^2, is cubic: ``[(delta - g rho)^2 + mu^2] rho = F^2`` (eqs (50), (63) of the paper,
# corrected: its parameter epsilon cancels). The mean drive does not enter at this order. Backbone ``omega = w0 + g rho``,
# peak ``a = F/mu`` on it, folds ``4 g^2 rho^3 (F^2 - mu^2 rho) = F^4``. All functions broadcast over a trailing batch.

MOST_ROOTS = 3
_SMALL_RATIO = 1e-8


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
    """Fraction ``(45 r - 50 r^3 + 21 r^5)/16`` that multiplies 1 - alpha in the reduction of l1 by the play; 1 at r = 1."""
    return r * (45 - r**2 * (50 - 21 * r**2)) / 16


def cubic_fit(model: PiecewiseLinearOscillator, fit_range: Array) -> Cubic:
    """Least-squares cubic of the spring on ``[-R, R]``; with r = b/R, or r = 1 for R < b, where the spring is linear:

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


def _turning_ratios(alpha: Array) -> Array:
    """Ratios ``r = b/R`` of the extremes of ``l1/r^2``, ``(2, ...)`` followed by the shape of ``alpha``.

    The ratios are the zeros of ``(1 - alpha)(45 r + 50 r^3 - 63 r^5)/16 - 2``, which is largest at r = 0.8275. If this
    maximum is negative, ``l1/r^2`` falls everywhere.
    """
    soft = 1 - alpha

    def surplus(r: Array) -> Array:
        return soft * r * (45 + r**2 * (50 - 63 * r**2)) / 16 - 2

    middle = jnp.full_like(soft, np.sqrt((150 + np.sqrt(79200)) / 630))
    first = bisect(surplus, jnp.zeros_like(soft), middle)
    return jnp.stack([first, bisect(lambda r: -surplus(r), middle, jnp.ones_like(soft))])


def self_consistent_range(model: PiecewiseLinearOscillator, shape: tuple[int, ...]) -> Array:
    """The range of the fit that equals the resulting peak amplitude: ``R c' sqrt(l1(R)) = B1``, infinite without damping.

    If there are several ranges (alpha near 0), the largest. NaN where l1 is not positive (alpha = 0 within the play).
    """
    target = jnp.abs(model.B1) / jnp.where(model.damping > 0, model.damping, 1.0) + jnp.zeros(shape)
    play = jnp.where(model.b > 0, model.b, 1.0)

    def excess(log_r: Array) -> Array:
        # R^2 l1 in units of b^2, as a function of r = b/R <= 1.
        r = jnp.exp(log_r)
        return model.stiffness * (1 - (1 - model.alpha) * _share(r)) - (target / play * r) ** 2

    # Half the solution for contact alone is below every solution with small r.
    linear = target / jnp.sqrt(model.stiffness * jnp.ones(shape))
    least = jnp.minimum(_SMALL_RATIO, play / jnp.where(linear > 0, linear, play) / 2)
    turning = _turning_ratios(model.alpha + jnp.zeros(shape))
    ends = jnp.concatenate([least[None], turning, jnp.ones((1, *shape))])
    log_r = jnp.log(ends)
    # The excess is positive at the lower end, as for contact alone.
    mask = sign_changes((excess(log_r) > 0).at[0].set(True), 1)
    r = jnp.exp(bisect(lambda x: -excess(x), take(mask, log_r[:-1]), take(mask, log_r[1:]))[0])
    beyond = model.b / jnp.where(r > 0, r, 1.0)
    # Without a change of sign the peak lies within the play, where the spring is linear.
    within = target / jnp.sqrt(model.stiffness * model.alpha)
    fit_range = jnp.where(jnp.any(mask, axis=(0, 1)), beyond, within)
    fit_range = jnp.where(model.b > 0, fit_range, linear)
    return jnp.where(model.damping > 0, fit_range, jnp.inf)


def slow_flow(model: PiecewiseLinearOscillator, fit: Cubic) -> SlowFlow:
    """The averaged equations of the oscillator with the spring ``fit``."""
    frequency = jnp.sqrt(jnp.where(fit.stiffness > 0, fit.stiffness, jnp.nan))
    return SlowFlow(frequency, model.damping / 2, jnp.abs(model.B1) / (2 * frequency), 3 * fit.cubic / (8 * frequency))


def peak(flow: SlowFlow) -> tuple[Array, Array]:
    """Largest amplitude ``F/mu`` (infinite without damping) and its frequency ``w0 + g a^2``.

    A softening spring may make this frequency negative: the result is then the amplitude in the limit ``omega -> 0``, and 0.
    """
    amplitude = jnp.where(flow.decay > 0, flow.drive / jnp.where(flow.decay > 0, flow.decay, 1.0), jnp.inf)
    frequency = flow.frequency + jnp.where(flow.bend != 0, flow.bend * amplitude**2, 0.0)
    below = frequency <= 0
    slow = roots(flow, jnp.zeros_like(flow.frequency))
    largest = jnp.max(jnp.where(jnp.isfinite(slow), slow, 0.0), axis=0)
    return jnp.where(below, largest, amplitude), jnp.where(below, 0.0, frequency)


def folds(flow: SlowFlow) -> tuple[Array, Array]:
    """Squared amplitudes and frequencies ``(2, ...)`` of the folds, NaN where there are none at a positive frequency.

    ``4 g^2 rho^3 (F^2 - mu^2 rho) = F^4`` has two roots, on either side of rho = 3 F^2/(4 mu^2), or none. With
    ``rho = s t``, ``s^3 = F^2/(4 g^2)``, ``p = s mu^2/F^2`` the first is ``t^3 (1 - p t) = 1``, from 1 to 4^(1/3); with
    ``rho = (1 - y) F^2/mu^2`` the second is ``(1 - y)^3 y = p^3``, from p^3 to (64/27) p^3. Without damping it is infinite.
    """
    bends = (flow.bend != 0) & (flow.drive > 0)
    square = jnp.where(bends, flow.drive**2, 1.0)
    size = jnp.cbrt(square / (4 * jnp.where(bends, flow.bend, 1.0) ** 2))
    part = size * flow.decay**2 / square
    t = bisect(lambda t: t**3 * (1 - part * t) - 1, jnp.ones_like(size), jnp.full_like(size, 4 ** (1 / 3)))
    y = part**3 * bisect(lambda z: z * (1 - part**3 * z) ** 3 - 1, jnp.ones_like(size), jnp.full_like(size, 64 / 27))
    peak_square = square / jnp.where(flow.decay > 0, flow.decay, jnp.nan) ** 2
    rho = jnp.stack([size * t, peak_square * (1 - y)])
    half_width = jnp.stack([jnp.sqrt(square / (size * t) * (1 - part * t)), flow.decay * jnp.sqrt(y / (1 - y))])
    frequency = flow.frequency + flow.bend * rho + jnp.sign(flow.bend) * half_width
    exists = bends & (part**3 < 27 / 256) & (frequency > 0)
    return jnp.where(exists, rho, jnp.nan), jnp.where(exists, frequency, jnp.nan)


def response_residual(flow: SlowFlow, omega: Array, rho: Array) -> Array:
    """``[(delta - g rho)^2 + mu^2] rho - F^2``."""
    return ((omega - flow.frequency - flow.bend * rho) ** 2 + flow.decay**2) * rho - flow.drive**2


def roots(flow: SlowFlow, omega: Array) -> Array:
    """All amplitudes at one frequency, rising, ``(MOST_ROOTS, ...)``, infinite where there are fewer.

    The cubic is monotone between its stationary points, which are known in closed form: one bisection for each piece. The
    bisection is in log rho, because rho may be smaller than its bounds by any factor.
    """
    delta, square = omega - flow.frequency, flow.drive**2
    bends = flow.bend != 0
    bend = jnp.where(bends, flow.bend, 1.0)
    spread = jnp.sqrt(jnp.maximum(delta**2 - 3 * flow.decay**2, 0.0))
    # The smaller stationary point comes from the product of both, so that no digits cancel.
    far = (2 * delta + jnp.where(delta < 0, -spread, spread)) / (3 * bend)
    near = (delta**2 + flow.decay**2) / (3 * bend**2) / jnp.where(far != 0, far, 1.0)
    damped = square / jnp.where(flow.decay > 0, flow.decay, 0.0) ** 2
    high = jnp.minimum(damped, jnp.maximum(2 * jnp.abs(delta / bend), jnp.cbrt(4 * square / bend**2))) * (1 + 1e-12)
    low = square / ((jnp.abs(delta) + jnp.abs(bend) * high) ** 2 + flow.decay**2) * (1 - 1e-12)
    stationary = jnp.sort(jnp.clip(jnp.stack([near, far]), low, high), axis=0)
    points = jnp.log(jnp.concatenate([low[None], stationary, high[None]]))

    def residual(log_rho: Array) -> Array:
        return response_residual(flow, omega, jnp.exp(log_rho))

    # All roots lie between the ends: set the signs there, whatever the rounding.
    positive = (residual(points) > 0).at[0].set(False).at[-1].set(True)
    mask = sign_changes(positive, MOST_ROOTS)
    turned = jnp.where(take(mask, positive[1:], 1.0) > 0, 1.0, -1.0)
    log_square = bisect(lambda x: turned * residual(x), take(mask, points[:-1]), take(mask, points[1:]))
    amplitude = jnp.where(jnp.any(mask, axis=1), jnp.exp(log_square / 2), jnp.inf)
    alone = jnp.full_like(amplitude, jnp.inf)
    # A linear spring has one amplitude, infinite at resonance without damping; without drive the only motion is rest.
    linear = alone.at[0].set(flow.drive / jnp.hypot(delta, flow.decay))
    amplitude = jnp.where(bends, amplitude, linear)
    return jnp.where(square == 0, alone.at[0].set(0.0), amplitude)


def decay_rate(flow: SlowFlow, omega: Array, amplitude: Array) -> Array:
    """Largest real part of the eigenvalues ``-mu -+ sqrt(-(delta - g rho)(delta - 3 g rho))`` of the averaged motion."""
    delta, rho = omega - flow.frequency, amplitude**2
    product = (delta - flow.bend * rho) * (delta - 3 * flow.bend * rho)
    return -flow.decay + jnp.sqrt(jnp.maximum(-product, 0.0))


def phase_lag(flow: SlowFlow, omega: Array, amplitude: Array) -> Array:
    """``beta``: sin(beta) = mu a/F, cos(beta) = (g rho - delta) a/F."""
    return jnp.arctan2(flow.decay * jnp.ones_like(amplitude), flow.bend * amplitude**2 - (omega - flow.frequency))


FOLDS = 4
BRANCHES = {"multiple_scales": MOST_ROOTS, "describing_function": describing_function.MOST_ROOTS}
_SAMPLES = 128
_LARGEST_STEP, _MOST_PARTS = 0.005, 16


class OneTerm(NamedTuple):
    """Motions ``bias + amplitude cos(omega t - phase)``, and the averaged growth ``rate`` of small disturbances."""

    bias: Array
    amplitude: Array
    phase: Array
    rate: Array


class Curves(NamedTuple):
    """A response as a whole.

    ``motions(omega)`` (K, ...) have rising amplitudes, infinite after the last motion. ``peak`` holds amplitude and
    frequency, ``folds`` frequencies. ``backbone(omega)`` (L, ...) is the largest amplitude of the backbone at every
    frequency, ``fit_range(omega)`` the range of the fit there.
    """

    motions: Callable[[Any], OneTerm]
    peak: tuple[Array, Array]
    folds: Array
    backbone: Callable[[Array], Array]
    fit_range: Callable[[Array], Array]


def of_multiple_scales(model: PiecewiseLinearOscillator, shape: tuple[int, ...], fit_range: Array | None) -> Curves:
    """Response by the corrected closed form of the paper, for ``fit_range`` [m] or else the self-consistent range."""
    chosen = self_consistent_range(model, shape) if fit_range is None else fit_range
    fit = cubic_fit(model, jnp.broadcast_to(chosen, shape))
    flow = slow_flow(model, fit)

    def motions(omega: Any) -> OneTerm:
        amplitude = roots(flow, omega + jnp.zeros(shape))
        finite = jnp.where(jnp.isfinite(amplitude), amplitude, 0.0)
        phase = phase_lag(flow, omega, finite)
        return OneTerm(0 * finite, amplitude, phase, decay_rate(flow, omega, finite))

    def backbone(omega: Array) -> Array:
        # A linear spring has free motions of any amplitude at one frequency.
        bends = flow.bend != 0
        detuning = omega.reshape(-1, *(1,) * len(shape)) - flow.frequency
        return jnp.where(bends, jnp.sqrt(detuning / jnp.where(bends, flow.bend, 1.0)), jnp.nan)

    return Curves(motions, peak(flow), folds(flow)[1], backbone, _everywhere(fit.fit_range))


def of_describing_function(model: PiecewiseLinearOscillator, shape: tuple[int, ...]) -> Curves:
    """Response by the describing function: bias and fundamental."""
    bones = describing_function.skeleton(model, shape)

    def motions(omega: Any) -> OneTerm:
        amplitude, point = describing_function.roots(model, bones, omega)
        finite = jnp.where(jnp.isfinite(amplitude), amplitude, 0.0)
        rate = describing_function.decay_rate(model, omega, finite, point)
        return OneTerm(point.bias, amplitude, describing_function.phase_lag(model, omega, point), rate)

    return Curves(
        motions,
        describing_function.peak_of(model, bones),
        describing_function.fold_frequencies(model, bones),
        partial(describing_function.backbone, model, shape),
        _everywhere(jnp.full(shape, jnp.nan)),
    )


def _everywhere(value: Array) -> Callable[[Array], Array]:
    return lambda omega: jnp.broadcast_to(value, (omega.size, *value.shape))


def _of_each(curves_at: Callable[[PiecewiseLinearOscillator], Curves], model: PiecewiseLinearOscillator) -> Curves:
    """Every frequency with its own amplitude of the drive. Peak and folds belong to curves of one amplitude: NaN."""
    none = jnp.full(jnp.shape(curves_at(model.driven_at(1.0)).peak[0]), jnp.nan)

    def along(part: Callable[[Curves], Callable[[Array], Array]]) -> Callable[[Array], Array]:
        return lambda omega: jax.lax.map(lambda w: part(curves_at(model.driven_at(w)))(w[None])[0], omega)

    return Curves(
        lambda omega: curves_at(model.driven_at(omega)).motions(omega),
        (none, none),
        none[None],
        along(lambda curves: curves.backbone),
        along(lambda curves: curves.fit_range),
    )


def response(
    model: PiecewiseLinearOscillator,
    method: str,
    fit_range: Array | None,
    shape: tuple[int, ...],
    outputs: tuple[str, ...],
) -> dict[str, Array]:
    """The requested results of a line of frequencies ``model.omega`` (L,) of oscillators of the batch ``shape``.

    Outcome ``NOT_CONVERGED`` where no amplitude exists: resonance without damping, or a fit without stiffness.
    """
    omega = np.asarray(model.omega)
    scales = method != "describing_function"

    def curves_at(model: PiecewiseLinearOscillator) -> Curves:
        return of_multiple_scales(model, shape, fit_range) if scales else of_describing_function(model, shape)

    curves = _of_each(curves_at, model) if model.follows else curves_at(model)
    fine, places = refined(omega, _LARGEST_STEP, _MOST_PARTS)
    every = jax.lax.map(curves.motions, jnp.asarray(fine))
    index = follow(every.amplitude)[places]
    at_values = OneTerm(*(part[places] for part in every))
    chosen = OneTerm(*(jnp.take_along_axis(part, index, axis=1) for part in at_values))
    frequency = jnp.asarray(omega).reshape(-1, 1, *(1,) * len(shape))
    # A drive of negative amplitude is a positive drive that lags by half a period.
    late = jnp.where(chosen.phase > 0, chosen.phase - jnp.pi, chosen.phase + jnp.pi)
    chosen = chosen._replace(phase=jnp.where(jnp.asarray(model.amplitude(frequency)) < 0, late, chosen.phase))
    results = _of_sweeps(model, chosen, index, frequency, outputs) | _of_branches(at_values)
    results |= _of_curves(curves, jnp.asarray(omega), shape)
    exists = jnp.all(jnp.isfinite(chosen.amplitude), axis=1)
    outcome = jnp.where(exists, Outcome.SUCCESS, Outcome.NOT_CONVERGED)
    return {name: results[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}


def _of_sweeps(
    model: PiecewiseLinearOscillator, motion: OneTerm, index: Array, omega: Array, outputs: tuple[str, ...]
) -> dict[str, Array]:
    """Results of the motions of the sweeps up and down, ``(L, 2, ...)``."""
    exists = jnp.isfinite(motion.amplitude)
    bias, amplitude = (jnp.where(exists, x, jnp.nan) for x in (motion.bias, motion.amplitude))
    high, low = bias + amplitude, bias - amplitude
    results = {
        "u_max": high,
        "u_min": low,
        "u_rms": jnp.sqrt(bias**2 + amplitude**2 / 2),
        "phase": jnp.where(exists & (motion.amplitude > 0), motion.phase, jnp.nan),
        "regime": regime(model, high, low),
        # Every second amplitude is a saddle.
        "stability": jnp.where(exists, index % 2, ABSENT).astype(jnp.int8),
        "spectral_radius": jnp.where(exists, jnp.exp(motion.rate * 2 * jnp.pi / omega), jnp.nan),
    }
    if "residual" in outputs:
        angle = (2 * np.pi * np.arange(_SAMPLES) / _SAMPLES).reshape(-1, *(1,) * amplitude.ndim)
        cosine, sine = (amplitude * f(angle - motion.phase) for f in (jnp.cos, jnp.sin))
        drive = model.B0 + model.amplitude(omega) * jnp.cos(angle)
        results["residual"] = imbalance(model, (bias + cosine, -omega * sine, -(omega**2) * cosine), drive)
    return results


def _of_branches(motions: OneTerm) -> dict[str, Array]:
    """Extremes and stability of all motions, ``(L, branch, ...)``."""
    exists = jnp.isfinite(motions.amplitude)
    bias, amplitude = (jnp.where(exists, x, jnp.nan) for x in (motions.bias, motions.amplitude))
    number = jnp.arange(amplitude.shape[1]).reshape(1, -1, *(1,) * (amplitude.ndim - 2))
    return {
        "branch_u_max": bias + amplitude,
        "branch_u_min": bias - amplitude,
        "branch_stability": jnp.where(exists, number % 2, ABSENT).astype(jnp.int8),
    }


def _of_curves(curves: Curves, omega: Array, shape: tuple[int, ...]) -> dict[str, Array]:
    """Quantities of the response as a whole, equal at every frequency."""

    def along(value: Array) -> Array:
        return jnp.broadcast_to(value, (omega.size, *value.shape))

    folds = jnp.sort(curves.folds, axis=0)[:FOLDS]
    missing = jnp.full((FOLDS - folds.shape[0], *shape), jnp.nan)
    return {
        "peak_amplitude": along(curves.peak[0]),
        "peak_frequency": along(curves.peak[1]),
        "fold_frequency": along(jnp.concatenate([folds, missing])),
        "backbone_amplitude": curves.backbone(omega),
        "fit_range": curves.fit_range(omega),
    }
