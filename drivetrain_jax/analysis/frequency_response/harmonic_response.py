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
from drivetrain_jax.analysis.frequency_response.describing_function import refined
from drivetrain_jax.analysis.frequency_response.harmonic_balance import (
    Balanced,
    Basis,
    balance,
    contact,
    drift,
    half_trace,
    jacobian,
    residual,
    spectral_radius,
)
from drivetrain_jax.analysis.impacts.attractor import repeated
from drivetrain_jax.analysis.impacts.motion import ABSENT, STABLE, UNSTABLE, imbalance, phase_lag, regime
from drivetrain_jax.analysis.impacts.piecewise_march import prepare, timed_motion, usual_steps
from drivetrain_jax.analysis.numerics.continuation import Course, Mapped, course, distinct, follow, sections
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Most steps of a branch, failed ones included, and the longest step in scaled units.
_ATTEMPTS, _LONGEST = 1500, 0.04
# Largest last correction of a point of the branch, and corrections of a motion at a frequency of the line.
_CLOSED, _POLISH = 1e-9, 8


def trace(
    model: PiecewiseLinearOscillator, basis: Basis, x: Array, start: float, stop: float, scale: Array
) -> tuple[Array, Array]:
    """The branch through the balanced motion ``x`` (n, N) at the frequency ``start``, continued towards ``stop``.

    Points ``(x, omega)``, shape ``(S, n + 1, N)``, NaN after the last one, and ``units`` that make their components
    comparable. The branch ends where it leaves the range of frequencies on either side.
    """
    lanes = x.shape[1:]
    units = jnp.concatenate([jnp.broadcast_to(scale, x.shape), jnp.full((1, *lanes), abs(stop - start))])

    def mapped(point: Array) -> Mapped:
        """A map whose fixed points are the balanced motions, so that corrections are Newton steps of the balance."""
        touch = contact(model, basis, point[:-1])
        force, by_omega = residual(model, basis, point[:-1], point[-1], touch)
        matrix = jnp.eye(basis.size)[:, :, None] - jacobian(model, basis, point[-1], touch)
        return Mapped(point[:-1] - force, matrix, -by_omega, jnp.zeros(lanes))

    points = follow(
        mapped,
        jnp.concatenate([x, jnp.full((1, *lanes), start)]),
        units,
        direction=jnp.sign(jnp.full(lanes, stop - start)),
        attempts=_ATTEMPTS,
        longest=_LONGEST,
        limits=(min(start, stop) * (1 - 1e-9), max(start, stop) * (1 + 1e-9)),
        converged=_CLOSED,
        special=False,
    ).x
    return points, units


def at_frequency(
    model: PiecewiseLinearOscillator, basis: Basis, branch: Course, omega: Array, count: int
) -> tuple[Array, Array, Array, Array]:
    """Up to ``count`` balanced motions at ``omega`` in the order of the branch, ``(count, n, ...)``, and three flags.

    The flags mark existing motions, saddles of the balance, and lanes whose motions are all found.
    """
    guess, exists, every = sections(branch, omega, count)

    def improved(x: Array) -> tuple[Array, Array, Array]:
        balanced = balance(model, basis, x, omega + jnp.zeros(x.shape[1:]), _POLISH)
        return balanced.x, balanced.converged, balanced.saddle

    motions, converged, saddle = jax.lax.map(improved, guess[:, :-1])
    return motions, exists & converged, saddle, every & jnp.all(converged | ~exists, axis=0)


# Slow sweeps of the drive's frequency by harmonic balance.
#
# At each frequency Newton iterations start from the motion at the previous frequency. As in an experiment, the sweep
# leaves a motion if the iterations diverge, if the motion jumps, or if it becomes unstable within the basis (a fold, or
# a doubled period with subharmonics in the basis). The exact motion then runs until it has settled. From there the drift
# of the balance and Newton iterations lead to a balanced motion. If this fails, the motion of the first Newton iterations
# is kept and marked as unstable.

# Length of transients: until disturbances have decayed by this factor, within limits in drive periods.
_SETTLED, _PERIODS = 1e-4, (24, 400)
# Steps that no transient exceeds; usual gears need a tenth of that.
_MOST_STEPS = 2e6
# Change of the motion between two frequencies, relative to its size, beyond which it is a jump.
_JUMP = 0.35
# Growth of a motion of doubled period above which it is unstable.
_GROWS = 1e-7
_PUSH = 0.05
# Attempts at one frequency: close to a fold the drift is slow.
_WAITS = 8


class Swept(NamedTuple):
    """A motion of the sweep: coefficients ``(n, ...)``, half trace of its transition, and flags of balanced motions and of
    saddles of the balance."""

    x: Array
    half: Array
    balanced: Array
    saddle: Array


def settle(
    model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array, wanted: Array | bool = True
) -> Array:
    """Coefficients of the exact motion after a transient from the state of ``x`` at tau = 0, in the ``wanted`` lanes.

    NaN in other lanes, and where the motion may need too many steps.
    """
    start = basis.functions_at(np.zeros(1))
    u, v = (jnp.tensordot(jnp.asarray(row[0]), x, 1) for row in (start, start @ basis.derivative))
    # An exactly periodic motion never leaves an unstable orbit: a small offset lets disturbances grow.
    u = u + _PUSH * jnp.sqrt(jnp.sum(x[1:] ** 2, axis=0))
    sampled = Basis(basis.harmonics, basis.order, max(64, 1 << (2 * basis.harmonics).bit_length()))
    decay = -np.log(_SETTLED) * omega / (np.pi * jnp.maximum(model.damping, 1e-12 * omega))
    periods = jnp.clip(jnp.ceil(decay / basis.order), *(p // basis.order for p in _PERIODS))
    parts = jnp.arange(sampled.count).reshape(-1, *(1,) * u.ndim) / sampled.count
    oscillator = model.driven_at(omega)
    begun = wanted & (basis.order * periods * usual_steps(prepare(oscillator)) <= _MOST_STEPS)
    turns = jnp.where(begun, basis.order * (periods + parts), 0.0)
    motion, *_ = timed_motion(oscillator, u, v * omega / basis.order, turns)
    return jnp.where(begun, jnp.tensordot(sampled.projection, motion, 1), jnp.nan)


def _checked(model: PiecewiseLinearOscillator, basis: Basis, balanced: Balanced, omega: Array) -> tuple[Swept, Array]:
    """A balanced motion with its half trace, and a flag: true if it is an attractor within the basis."""
    half = half_trace(model, basis, omega, contact(model, basis, balanced.x))
    growth = spectral_radius(model, basis, omega, half)
    # Without subharmonics the basis has no motion of doubled period.
    followed = (half > 1) | (basis.order > 1)
    attracts = balanced.converged & ~balanced.saddle & ~((growth > 1 + _GROWS) & followed)
    return Swept(balanced.x, half, balanced.converged, balanced.saddle), attracts


def _kept(condition: Array, first: Swept, second: Swept) -> Swept:
    return Swept(*(jnp.where(condition, a, b) for a, b in zip(first, second, strict=True)))


def step(model: PiecewiseLinearOscillator, basis: Basis, before: Swept, omega: Array) -> tuple[Swept, Swept]:
    """Two versions of the motion at ``omega``: the start of the next step and the result.

    Both follow from the motion ``before`` at the previous frequency, and differ where the result is not balanced.
    """
    size = jnp.sqrt(jnp.sum(before.x[1:] ** 2, axis=0))

    def waited(count: Array, lost: Array, seed: Array, now: Swept) -> Array:
        # Once only: past a fold of the balance that the exact motion lacks, it would return there every time.
        start = jax.lax.cond(
            (count == 1) & jnp.any(lost), lambda seed: settle(model, basis, seed, omega, lost), lambda seed: seed, seed
        )
        settled = drift(model, basis, jnp.where(jnp.all(jnp.isfinite(start), axis=0), start, seed), omega)
        return jnp.where(lost, jnp.where(jnp.all(jnp.isfinite(settled), axis=0), settled, seed), now.x)

    def attempt(state: tuple[Array, Array, Array, Swept]) -> tuple[Array, Array, Array, Swept]:
        count, lost, seed, now = state
        again = count > 0
        seed = jax.lax.cond(again, waited, lambda count, lost, seed, now: seed, count, lost, seed, now)
        there, attracts = _checked(model, basis, balance(model, basis, seed, omega), omega)
        change = jnp.sqrt(jnp.sum((there.x - before.x)[1:] ** 2, axis=0))
        jumped = ~again & before.balanced & (change > _JUMP * size)
        # The settled motion replaces the lost one if it attracts, or if the lost one is not balanced.
        taken = jnp.where(again, lost & (attracts | ~now.balanced), True)
        return count + 1, lost & (~attracts | jumped), seed, _kept(taken, there, now)

    def unfinished(state: tuple[Array, Array, Array, Swept]) -> Array:
        return (state[0] < _WAITS) & jnp.any(state[1])

    start = (jnp.int32(0), jnp.ones_like(before.balanced), before.x, before)
    *_, after = jax.lax.while_loop(unfinished, attempt, start)
    # A motion that could not be balanced is no start for the next one.
    return after._replace(x=jnp.where(after.balanced, after.x, before.x)), after


def sweep(model: PiecewiseLinearOscillator, basis: Basis, omegas: Array) -> Swept:
    """Motions along ``omegas`` (L, N), a path for each lane, starting from rest; fields ``(L, ...)``."""
    lanes = omegas.shape[1:]
    first = settle(model, basis, jnp.zeros((basis.size, *lanes)), omegas[0])
    first = jnp.where(jnp.isfinite(first), first, 0.0)
    start = Swept(first, jnp.zeros(lanes), jnp.zeros(lanes, bool), jnp.zeros(lanes, bool))
    return jax.lax.scan(lambda before, omega: step(model, basis, before, omega), start, omegas)[1]


BRANCHES = 7
_LARGEST_STEP, _MOST_PARTS = 0.02, 8
_EXTREME_STEPS = 3
# The branch begins at the highest frequency over this ratio and ends at the lowest frequency times it, so it crosses both.
_BEFORE = 0.999
# Rounding of a spectral radius: up to 1 plus this number a motion counts as stable.
_MARGIN = 1e-9
# Ratio to the largest coefficient below which a subharmonic is an error of the iterations.
_VANISHING = 1e-8


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
) -> dict[str, Array]:
    """Results of the motion with coefficients ``x`` (n, ...), each of the shape of its lanes; NaN where it does not exist.

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
    others = {"u_rms": rms, "phase": phase, "spectral_radius": radius, "residual": unbalanced}
    return {name: jnp.where(exists, value, jnp.nan) for name, value in others.items()} | {
        "u_max": high,
        "u_min": low,
        "regime": regime(model, high, low),
        "stability": jnp.where(exists, stability, ABSENT).astype(jnp.int8),
    }


def response(
    model: PiecewiseLinearOscillator, basis: Basis, shape: tuple[int, ...], outputs: tuple[str, ...]
) -> dict[str, Array]:
    """The requested results of a line of frequencies ``model.omega`` (L,) of oscillators of the batch ``shape``.

    The outcome is ``NOT_CONVERGED`` where a sweep has no balanced motion, and ``TOLERANCE_NOT_MET`` where the requested
    branch did not reach the lowest frequency or has more motions than the results hold.
    """
    omega = np.asarray(model.omega)
    lanes = shape or (1,)
    values = {name: value for name, value in vars(model).items() if name not in ("omega", "damps_play")}
    if not model.follows:
        del values["unbalance"]
    fields = {name: jnp.broadcast_to(value, lanes) for name, value in values.items()}
    model = replace(model, **fields, omega=None)
    swept_x, balanced, saddle = _sweeps(model, basis, omega, lanes)

    def directions(at: tuple[Array, Array, Array, Array]) -> dict[str, Array]:
        wide = jnp.broadcast_to(at[0], lanes)
        return jax.vmap(lambda x, *state: describe(model, basis, x, wide, *state))(*at[1:])

    results = jax.lax.map(directions, (jnp.asarray(omega), swept_x, balanced, saddle))
    outcome = jnp.where(jnp.all(balanced, axis=1), Outcome.SUCCESS, Outcome.NOT_CONVERGED)
    if any(name.startswith("branch_") for name in outputs):
        # The branch starts at the highest frequency, where motions are simplest.
        first = swept_x[int(np.argmax(omega)), 1]
        branches, complete = _branches(model, basis, omega, first)
        results |= branches
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
    paths = np.repeat(np.stack([fine, fine[::-1]], axis=1), lanes[0], axis=1)
    swept = sweep(repeated(model, 2), basis, jnp.asarray(paths))
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
    points, units = trace(model, basis, jnp.where(begun.converged, begun.x, jnp.nan), start, stop, scale)
    along, complete = course(points, units), jnp.any(points[:, -1] <= stop, axis=0)

    def motions_at(frequency: Array) -> tuple[Array, Array, Array, Array]:
        x, exists, saddle, every = at_frequency(model, basis, along, frequency, BRANCHES)
        wide = jnp.broadcast_to(frequency, lanes)
        motions = jax.lax.map(lambda one: describe(model, basis, one[0], wide, *one[1:]), (x, exists, saddle))
        order = jnp.argsort(motions["u_max"], axis=0)
        kept = ("u_max", "u_min", "stability")
        high, low, stability = (jnp.take_along_axis(motions[name], order, axis=0) for name in kept)
        return high, low, stability, every & distinct(high, low)

    high, low, stability, every = jax.lax.map(motions_at, jnp.asarray(omega))
    return {"branch_u_max": high, "branch_u_min": low, "branch_stability": stability}, every & complete
