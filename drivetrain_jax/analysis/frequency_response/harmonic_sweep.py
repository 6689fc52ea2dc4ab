"""Slow sweeps of the drive's frequency by harmonic balance.

At each frequency Newton iterations start from the motion at the previous frequency. As in an experiment, the sweep leaves a
motion if the iterations diverge, if the motion jumps, or if it becomes unstable within the basis (a fold, or a doubled
period with subharmonics in the basis). The equation of motion is then integrated until it has settled. From the settled
motion the drift of the balance and Newton iterations lead to a balanced motion. If this fails, the motion of the first
Newton iterations is kept and marked as unstable.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.frequency_response.harmonic_balance import Balanced, Basis, balance, contact, drift
from drivetrain_jax.analysis.frequency_response.harmonic_stability import half_trace, spectral_radius
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Length of transients: until disturbances have decayed by this factor, within limits in drive periods. Steps: per radian of
# the stiffest motion, within limits per drive period. Low accuracy is enough to reach the right basin.
_SETTLED, _PERIODS = 1e-4, (24, 400)
_PER_RADIAN, _STEPS = 4.0, (64, 4000)
# Steps for each frequency of a path after which no further transient of a lane begins. A transient of a usual oscillator
# takes up to 6e4 steps, of an extreme one 1.6e6.
_MOST_WORK = 100_000
# Change of the motion between two frequencies, relative to its size, beyond which it is a jump.
_JUMP = 0.35
_MARGIN = 1e-7
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


def _effort(model: PiecewiseLinearOscillator, basis: Basis, omega: Array) -> tuple[Array, Array]:
    """Base periods for settling, and steps between two samples; both depend on the lane alone, not on its batch."""
    fastest = jnp.sqrt(model.stiffness * jnp.maximum(model.alpha, 1.0)) / omega
    steps = jnp.clip(2 * np.pi * _PER_RADIAN * fastest, *_STEPS)
    decay = -np.log(_SETTLED) * omega / (np.pi * jnp.maximum(model.damping, 1e-12 * omega))
    periods = jnp.clip(jnp.ceil(decay / basis.order), *(p // basis.order for p in _PERIODS))
    return periods.astype(jnp.int32), jnp.ceil(steps * basis.order / basis.count).astype(jnp.int32)


def settle(
    model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array, wanted: Array | bool = True
) -> Array:
    """Coefficients of the motion after a transient from the state of ``x`` at tau = 0, in the ``wanted`` lanes."""
    lanes = x.shape[1:]
    start = jnp.asarray(basis.at(np.zeros(1))[0]), jnp.asarray((basis.at(np.zeros(1)) @ basis.derivative)[0])
    u, v = jnp.tensordot(start[0], x, 1), jnp.tensordot(start[1], x, 1) * omega / basis.order
    # An exactly periodic motion never leaves an unstable orbit: a small offset lets disturbances grow.
    u = u + _PUSH * jnp.sqrt(jnp.sum(x[1:] ** 2, axis=0))
    sampled = Basis(basis.harmonics, basis.order, max(_STEPS[0], 1 << (2 * basis.harmonics).bit_length()))
    effort = (jnp.where(wanted, number, 0) for number in _effort(model, sampled, omega))
    periods, parts = (jnp.broadcast_to(number, lanes) for number in effort)
    turn = parts * sampled.count
    h = 2 * np.pi * basis.order / (jnp.maximum(turn, 1) * omega)

    def advance(number: Array, until: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        moved = _runge_kutta(model, omega, (number % jnp.maximum(turn, 1)) * h, h, state)
        return tuple(jnp.where(number < until, new, old) for new, old in zip(moved, state, strict=True))  # pyright: ignore[reportReturnType]

    def project(sample: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        u, v, total = carry
        total = total + jnp.asarray(sampled.projection)[:, sample].reshape(-1, *(1,) * len(lanes)) * u
        first, last = sample * parts, (sample + 1) * parts
        u, v = jax.lax.fori_loop(0, jnp.max(parts), lambda i, state: advance(first + i, last, state), (u, v))
        return u, v, total

    whole = periods * turn
    u, v = jax.lax.fori_loop(0, jnp.max(whole), lambda i, state: advance(i, whole, state), (u, v))
    return jax.lax.fori_loop(0, sampled.count, project, (u, v, jnp.zeros_like(x)))[2]


def _runge_kutta(
    model: PiecewiseLinearOscillator, omega: Array, t: Array, h: Array, state: tuple[Array, Array]
) -> tuple[Array, Array]:
    """One step of the classical Runge-Kutta scheme."""

    def rate(t: Array, u: Array, v: Array) -> tuple[Array, Array]:
        drive = model.B0 + model.amplitude(omega) * jnp.cos(omega * t)
        return v, drive - model.damping * v - model.stiffness * model.restoring(u)

    u, v = state
    total_u, total_v, du, dv = 0.0, 0.0, 0.0, 0.0
    for lead, weight in ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)):
        du, dv = rate(t + lead * h, u + lead * h * du, v + lead * h * dv)
        total_u, total_v = total_u + weight * du, total_v + weight * dv
    return u + h * total_u, v + h * total_v


def _checked(model: PiecewiseLinearOscillator, basis: Basis, found: Balanced, omega: Array) -> tuple[Swept, Array]:
    """A balanced motion with its half trace, and a flag: true if it is an attractor within the basis."""
    half = half_trace(model, basis, omega, contact(model, basis, found.x))
    growth = spectral_radius(model, basis, omega, half)
    # Without subharmonics the basis has no motion of doubled period.
    followed = (half > 1) | (basis.order > 1)
    attracts = found.converged & ~found.saddle & ~((growth > 1 + _MARGIN) & followed)
    return Swept(found.x, half, found.converged, found.saddle), attracts


def _kept(condition: Array, first: Swept, second: Swept) -> Swept:
    return Swept(*(jnp.where(condition, a, b) for a, b in zip(first, second, strict=True)))


def _work(model: PiecewiseLinearOscillator, basis: Basis, omega: Array) -> Array:
    """Steps of a transient."""
    periods, steps = _effort(model, basis, omega)
    return 1.0 * periods * steps * basis.count


def step(
    model: PiecewiseLinearOscillator, basis: Basis, before: Swept, omega: Array, may_settle: Array
) -> tuple[Swept, Swept, Array]:
    """Two versions of the motion at ``omega``: the start of the next step and the result; and flags of transients.

    Both follow from the motion ``before`` at the previous frequency, and differ where the result is not balanced. Only lanes
    that ``may_settle`` have transients.
    """
    size = jnp.sqrt(jnp.sum(before.x[1:] ** 2, axis=0))

    def waited(count: Array, lost: Array, seed: Array, now: Swept) -> Array:
        # Integrate once only: past a fold of the balance that the exact motion lacks, it would return there every time.
        start = jax.lax.cond(
            (count == 1) & jnp.any(lost & may_settle),
            lambda seed: jnp.where(may_settle, settle(model, basis, seed, omega, lost & may_settle), seed),
            lambda seed: seed,
            seed,
        )
        found = drift(model, basis, jnp.where(jnp.all(jnp.isfinite(start), axis=0), start, seed), omega)
        return jnp.where(lost, jnp.where(jnp.all(jnp.isfinite(found), axis=0), found, seed), now.x)

    def attempt(state: tuple[Array, Array, Array, Array, Swept]) -> tuple[Array, Array, Array, Array, Swept]:
        count, lost, settled, seed, now = state
        again = count > 0
        seed = jax.lax.cond(again, waited, lambda count, lost, seed, now: seed, count, lost, seed, now)
        there, attracts = _checked(model, basis, balance(model, basis, seed, omega), omega)
        change = jnp.sqrt(jnp.sum((there.x - before.x)[1:] ** 2, axis=0))
        jumped = ~again & before.balanced & (change > _JUMP * size)
        # The settled motion replaces the lost one if it attracts, or if the lost one is not balanced.
        taken = jnp.where(again, lost & (attracts | ~now.balanced), True)
        settled |= (count == 1) & lost & may_settle
        return count + 1, lost & (~attracts | jumped), settled, seed, _kept(taken, there, now)

    def unfinished(state: tuple[Array, Array, Array, Array, Swept]) -> Array:
        return (state[0] < _WAITS) & jnp.any(state[1])

    start = (jnp.int32(0), jnp.ones_like(before.balanced), jnp.zeros_like(before.balanced), before.x, before)
    _, _, settled, _, after = jax.lax.while_loop(unfinished, attempt, start)
    # A motion that could not be balanced is no start for the next one.
    carried = after._replace(x=jnp.where(after.balanced, after.x, before.x))
    return carried, after, settled


def sweep(model: PiecewiseLinearOscillator, basis: Basis, omegas: Array) -> Swept:
    """Motions along ``omegas`` (L, N), a path for each lane, starting from rest; fields ``(L, ...)``."""
    lanes = omegas.shape[1:]
    first = settle(model, basis, jnp.zeros((basis.size, *lanes)), omegas[0])
    first = jnp.where(jnp.isfinite(first), first, 0.0)
    start = Swept(first, jnp.zeros(lanes), jnp.zeros(lanes, bool), jnp.zeros(lanes, bool))
    most = _MOST_WORK * len(omegas)

    def onwards(carry: tuple[Swept, Array], omega: Array) -> tuple[tuple[Swept, Array], Swept]:
        before, spent = carry
        carried, after, settled = step(model, basis, before, omega, spent < most)
        return (carried, spent + jnp.where(settled, _work(model, basis, omega), 0.0)), after

    return jax.lax.scan(onwards, (start, jnp.zeros(lanes)), omegas)[1]
