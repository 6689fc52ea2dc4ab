"""Frequency response by harmonic balance: sweeps up and down, and all motions on the branch on which the sweeps start.

Results are arrays ``(L, own dimensions, ...)``, the path first, the batch last.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis, balance, contact
from drivetrain_jax.analysis.frequency_response.harmonic_branch import Branch, at_frequency, trace
from drivetrain_jax.analysis.frequency_response.harmonic_stability import half_trace, spectral_radius
from drivetrain_jax.analysis.frequency_response.harmonic_sweep import sweep
from drivetrain_jax.analysis.impacts.motion import ABSENT, STABLE, UNSTABLE, imbalance, phase_lag, regime
from drivetrain_jax.analysis.numerics.amplitude_roots import refined
from drivetrain_jax.analysis.numerics.branch_sections import course, distinct
from drivetrain_jax.systems import PiecewiseLinearOscillator

BRANCHES = 7
_LARGEST_STEP, _MOST_PARTS = 0.02, 8
_EXTREME_STEPS = 3
# The branch begins at the highest frequency over this ratio and ends at the lowest frequency times it, so it crosses both.
_BEFORE = 0.999
# Rounding of a spectral radius: up to 1 plus this number a motion counts as stable.
_MARGIN = 1e-9
# Ratio to the largest coefficient below which a subharmonic is an error of the iterations.
_VANISHING = 1e-8


class Described(NamedTuple):
    """Results of one motion, each of the shape of its lanes."""

    u_max: Array
    u_min: Array
    u_rms: Array
    phase: Array
    regime: Array
    stability: Array
    spectral_radius: Array
    residual: Array


def extreme(basis: Basis, x: Array, samples: Array, sign: float) -> Array:
    """Largest (``sign = 1``) or smallest (-1) value of a motion: Newton iterations for u' = 0 from the best sample."""
    orders = jnp.asarray(basis.orders).reshape(-1, *(1,) * (x.ndim - 1))
    sine = jnp.asarray((np.arange(basis.size) % 2 == 0) & (basis.orders > 0)).reshape(orders.shape)
    best = jnp.argmax(sign * samples, axis=0)

    def value(coefficients: Array, tau: Array) -> Array:
        return jnp.sum(coefficients * jnp.where(sine, jnp.sin(orders * tau), jnp.cos(orders * tau)), axis=0)

    slope, bend = jnp.tensordot(basis.derivative, x, 1), -(orders**2) * x
    spacing = 2 * np.pi / basis.count
    start = best * spacing

    def improve(_: int, tau: Array) -> Array:
        curvature = value(bend, tau)
        step = value(slope, tau) / jnp.where(curvature != 0, curvature, 1.0)
        return jnp.clip(tau - step, start - spacing, start + spacing)

    tau = jax.lax.fori_loop(0, _EXTREME_STEPS, improve, start)
    return sign * jnp.maximum(sign * value(x, tau), jnp.max(sign * samples, axis=0))


def repetitions(basis: Basis, x: Array) -> Array:
    """Number of repetitions of the motion within the base period: more than one if its subharmonics vanish."""
    size = jnp.max(jnp.abs(x[1:]), axis=0)
    times = jnp.ones(x.shape[1:])
    for count in (n for n in range(2, basis.order + 1) if basis.order % n == 0):
        others = jnp.max(jnp.abs(x[1:][basis.orders[1:] % count != 0]), axis=0)
        times = jnp.where(others <= _VANISHING * size, count, times)
    return times


def describe(
    model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array, exists: Array, saddle: Array
) -> Described:
    """Results of the motion with coefficients ``x`` (n, ...); NaN where it does not exist.

    A ``saddle`` of the balance counts as unstable, even if disturbances of the motion do not grow.
    """
    touch = contact(model, basis, x)
    half = half_trace(model, basis, omega, touch)
    radius = spectral_radius(model, basis, omega, half) ** (1 / repetitions(basis, x))
    high, low = (jnp.where(exists, extreme(basis, x, touch.u, sign), jnp.nan) for sign in (1.0, -1.0))
    base = omega / basis.order
    rate = jnp.tensordot(basis.rates, x, 1) * base
    acceleration = jnp.tensordot(-basis.values * basis.orders**2, x, 1) * base**2
    angle = (2 * np.pi * basis.order * np.arange(basis.count) / basis.count).reshape(-1, *(1,) * (x.ndim - 1))
    unbalanced = imbalance(model, (touch.u, rate, acceleration), model.B0 + model.amplitude(omega) * jnp.cos(angle))
    cosine, sine = x[2 * basis.order - 1], x[2 * basis.order]
    rms = jnp.sqrt(x[0] ** 2 + jnp.sum(x[1:] ** 2, axis=0) / 2)
    stability = jnp.where((radius > 1 + _MARGIN) | saddle, UNSTABLE, STABLE)
    phase = phase_lag(cosine, sine, jnp.maximum(jnp.abs(high), jnp.abs(low)))
    rms, phase, radius, unbalanced = (jnp.where(exists, v, jnp.nan) for v in (rms, phase, radius, unbalanced))
    stability = jnp.where(exists, stability, ABSENT).astype(jnp.int8)
    return Described(high, low, rms, phase, regime(model, high, low), stability, radius, unbalanced)


def response(
    model: PiecewiseLinearOscillator, basis: Basis, shape: tuple[int, ...], outputs: tuple[str, ...]
) -> dict[str, Array]:
    """The requested results of a line of frequencies ``model.omega`` (L,) of oscillators of the batch ``shape``.

    The outcome is ``NOT_CONVERGED`` where a sweep has no balanced motion, and ``TOLERANCE_NOT_MET`` where the requested
    branch did not reach the lowest frequency or has more motions than the results hold.
    """
    omega = np.asarray(model.omega)
    lanes = shape or (1,)
    own = {name: value for name, value in vars(model).items() if name not in ("omega", "damps_play")}
    if not model.follows:
        del own["unbalance"]
    fields = {name: jnp.broadcast_to(value, lanes) for name, value in own.items()}
    model = replace(model, **fields, omega=None)
    swept_x, balanced, saddle = _sweeps(model, basis, omega, lanes)

    def directions(at: tuple[Array, Array, Array, Array]) -> Described:
        wide = jnp.broadcast_to(at[0], lanes)
        return jax.vmap(lambda x, *state: describe(model, basis, x, wide, *state))(*at[1:])

    described = jax.lax.map(directions, (jnp.asarray(omega), swept_x, balanced, saddle))
    outcome = jnp.where(jnp.all(balanced, axis=1), Outcome.SUCCESS, Outcome.NOT_CONVERGED)
    results = described._asdict()
    if any(name.startswith("branch_") for name in outputs):
        # The branch starts at the highest frequency, where motions are simplest.
        first = swept_x[int(np.argmax(omega)), 1]
        found, complete = _branches(model, basis, omega, first)
        results |= found
        outcome = jnp.where(~complete & (outcome == Outcome.SUCCESS), Outcome.TOLERANCE_NOT_MET, outcome)
    results = {name: results[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}
    return results if shape else {name: value[..., 0] for name, value in results.items()}


def _sweeps(
    model: PiecewiseLinearOscillator, basis: Basis, omega: np.ndarray, lanes: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Coefficients ``(L, 2, n, N)`` of the sweeps up and down, with flags of balanced motions and of saddles.

    Both sweeps run in parallel.
    """
    fine, places = refined(omega, _LARGEST_STEP, _MOST_PARTS)
    twice = {name: jnp.tile(value, 2) for name, value in vars(model).items() if name != "omega" and jnp.ndim(value)}
    both = replace(model, **twice)
    paths = np.repeat(np.stack([fine, fine[::-1]], axis=1), lanes[0], axis=1)
    swept = sweep(both, basis, jnp.asarray(paths))
    x = swept.x.reshape(len(fine), basis.size, 2, *lanes)
    back = len(fine) - 1 - places
    x = jnp.stack([x[places, :, 0], x[back, :, 1]], axis=1)
    flags = (flag.reshape(len(fine), 2, *lanes) for flag in (swept.balanced, swept.saddle))
    return x, *(jnp.stack([flag[places, 0], flag[back, 1]], axis=1) for flag in flags)  # pyright: ignore[reportReturnType]


def _branches(
    model: PiecewiseLinearOscillator, basis: Basis, omega: np.ndarray, first: Array
) -> tuple[dict[str, Array], Array]:
    """Extremes and stability ``(L, branch, N)`` of the motions on the branch of ``first``, by rising extremes.

    The second result ``(L, N)`` is true if these are all motions of the branch at a frequency. The continuation runs from
    the highest frequency to the lowest.
    """
    lanes = first.shape[1:]
    start, stop = float(omega.max()) / _BEFORE, _BEFORE * float(omega.min())
    begun = balance(model, basis, first, jnp.full(lanes, start))
    size = jnp.sqrt(jnp.sum(begun.x**2, axis=0))
    scale = jnp.maximum(model.b, size)
    scale = jnp.where(scale > 0, scale, 1.0)
    curve: Branch = trace(model, basis, jnp.where(begun.converged, begun.x, jnp.nan), start, stop, scale)

    width = jnp.full((1, *lanes), start - stop)
    units = jnp.concatenate([jnp.broadcast_to(scale, (basis.size, *lanes)), width])
    along = course(jnp.concatenate([curve.x, curve.omega[:, None]], axis=1), units)

    def at(frequency: Array) -> tuple[Array, Array, Array, Array]:
        x, exists, saddle, every = at_frequency(model, basis, along, frequency, BRANCHES)
        wide = jnp.broadcast_to(frequency, lanes)
        found = jax.lax.map(lambda one: describe(model, basis, one[0], wide, *one[1:]), (x, exists, saddle))
        order = jnp.argsort(found.u_max, axis=0)
        high, low, stability = (
            jnp.take_along_axis(v, order, axis=0) for v in (found.u_max, found.u_min, found.stability)
        )
        return high, low, stability, every & distinct(high, low)

    high, low, stability, every = jax.lax.map(at, jnp.asarray(omega))
    return {"branch_u_max": high, "branch_u_min": low, "branch_stability": stability}, every & curve.complete
