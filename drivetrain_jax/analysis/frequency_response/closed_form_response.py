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
from drivetrain_jax.analysis.frequency_response import describing_function, multiple_scales
from drivetrain_jax.analysis.impacts.motion import ABSENT, imbalance, regime
from drivetrain_jax.analysis.numerics.amplitude_roots import follow, refined
from drivetrain_jax.systems import PiecewiseLinearOscillator

FOLDS = 4
BRANCHES = {
    **dict.fromkeys(("multiple_scales", "averaging"), multiple_scales.MOST_ROOTS),
    "describing_function": describing_function.MOST_ROOTS,
}
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
    own = multiple_scales.self_consistent_range(model, shape) if fit_range is None else fit_range
    fit = multiple_scales.cubic_fit(model, jnp.broadcast_to(own, shape))
    flow = multiple_scales.slow_flow(model, fit)

    def motions(omega: Any) -> OneTerm:
        amplitude = multiple_scales.roots(flow, omega + jnp.zeros(shape))
        finite = jnp.where(jnp.isfinite(amplitude), amplitude, 0.0)
        phase = multiple_scales.phase_lag(flow, omega, finite)
        return OneTerm(0 * finite, amplitude, phase, multiple_scales.decay_rate(flow, omega, finite))

    def backbone(omega: Array) -> Array:
        # A linear spring has free motions of any amplitude at one frequency.
        bends = flow.bend != 0
        detuning = omega.reshape(-1, *(1,) * len(shape)) - flow.frequency
        return jnp.where(bends, jnp.sqrt(detuning / jnp.where(bends, flow.bend, 1.0)), jnp.nan)

    return Curves(
        motions, multiple_scales.peak(flow), multiple_scales.folds(flow)[1], backbone, _everywhere(fit.fit_range)
    )


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
    none = jnp.full(jnp.shape(curves_at(model.at(1.0)).peak[0]), jnp.nan)

    def along(part: Callable[[Curves], Callable[[Array], Array]]) -> Callable[[Array], Array]:
        return lambda omega: jax.lax.map(lambda w: part(curves_at(model.at(w)))(w[None])[0], omega)

    return Curves(
        lambda omega: curves_at(model.at(omega)).motions(omega),
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
