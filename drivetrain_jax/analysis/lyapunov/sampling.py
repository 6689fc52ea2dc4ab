"""The strobes after a run: the period of the motion, and the 0-1 test."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.forcing import FRACTIONS
from drivetrain_jax.analysis.lyapunov.growth_record import Record, sampled, state_size
from drivetrain_jax.analysis.lyapunov.section_measures import period_multiple
from drivetrain_jax.analysis.lyapunov.variational import batch_shape, initial_state
from drivetrain_jax.analysis.lyapunov.verdict import TELLING
from drivetrain_jax.analysis.lyapunov.zero_one_test import largest_k01
from drivetrain_jax.systems import Flow

# Strobes after the run for the verdict and the 0-1 test, and the longest period in strobes that is searched.
SAMPLES, LONGEST = 1024, 512
# Relative tolerance for repetition; relative transient below which a motion counts as not repeating.
_REPEATED, _UNSETTLED = 1e-9, 1e-4
# Distances of close returns, relative to the motion: a torus comes as close as the smaller ones, but later.
_RETURNS = (0.3, 0.1, 0.03, 0.01)
# Factor on the bound of the transient from its exponent: the exponents of a near-degenerate pair are known only to about the
# inverse of the time, whatever their standard errors.
_MARGIN = 1e3
# Largest number of samples; more than one are taken if the transient could hide or imitate a repetition.
_MOST_LOOKS = 16
# Steps after which no further sample begins: 16 samples have less up to 1200 steps per strobe.
_MOST_SAMPLED = 20_000_000


class Sampling(NamedTuple):
    """Results of the strobes after a run: K of the 0-1 test, the period in strobes, and flags if the period is certain and
    if the motion :func:`returns`."""

    k01: Array
    multiple: Array
    settled: Array
    returns: Array


class _Look(NamedTuple):
    """State of the loop over samples of ``SAMPLES`` strobes: number of samples, state and strobe after the last sample,
    section of the first sample, and results of every member."""

    number: Array
    state: tuple
    strobe: Array
    first: Array
    multiple: Array
    settled: Array


def sample(flow: Flow, steps: Any, record: Record, rate: Array, k01_for: Array, members: Array) -> Sampling:
    """Period and K of the motion over ``SAMPLES`` strobes after the run; K is 0 for members without ``k01_for``.

    ``rate`` is an upper bound of the largest exponent, shape (...). For decaying ``members``, samples continue until the
    transient is small enough to determine the period, or up to a number of steps. Without a bounded member there is no
    sample.
    """
    watched = [i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0]
    shape = batch_shape(flow)
    most = jnp.clip(_MOST_SAMPLED // (steps * SAMPLES), 1, _MOST_LOOKS)
    decays = jnp.zeros(shape, bool)
    if flow.turns:
        decays = members & record.bounded & (rate < 0)

    def look(seen: _Look) -> _Look:
        states, state = sampled(flow, steps, seen.state, seen.strobe, SAMPLES)
        section = states[:, jnp.array(watched)]
        left = transient_left(flow, record, rate, seen.strobe + SAMPLES // 2)
        multiple, settled = repetition(section, left)
        # At rest the section repeats in the limit only: its own size decays.
        rests = decays & _comes_to_rest(flow, record, rate, jnp.max(jnp.abs(section), axis=(0, 1)), seen.strobe)
        multiple, settled = jnp.where(rests, 1, multiple), settled | rests
        # Settled results stay, so a member does not depend on the number of samples for the others.
        multiple, settled = (
            jnp.where(seen.settled, *pair) for pair in ((seen.multiple, multiple), (seen.settled, settled))
        )
        first = jnp.where(seen.number == 0, section, seen.first)
        return _Look(seen.number + 1, state, seen.strobe + SAMPLES, first, multiple, settled)

    def unsettled(seen: _Look) -> Array:
        again = (seen.number < most) & jnp.any(decays & ~seen.settled)
        return jnp.where(seen.number == 0, jnp.any(members & record.bounded), again)

    blank = jnp.zeros((SAMPLES, len(watched), *shape))
    nothing = jnp.zeros(shape, jnp.int64)
    start = _Look(jnp.int64(0), record.state, record.strobe, blank, nothing, jnp.zeros(shape, bool))
    seen = jax.lax.while_loop(unsettled, look, start)
    good = record.bounded & jnp.all(jnp.isfinite(seen.first), axis=(0, 1))
    k01 = jax.lax.cond(jnp.any(k01_for), largest_k01, lambda x: jnp.zeros(x.shape[2:]), seen.first)
    k01 = jnp.where(k01_for, k01, 0.0)
    multiple = jnp.where(good, seen.multiple, 0)
    back = jax.lax.cond(jnp.any(k01_for), returns, lambda x: jnp.zeros(x.shape[2:], bool), seen.first)
    return Sampling(jnp.where(good, k01, jnp.nan), multiple, seen.settled, good & (multiple == 0) & back)


def transient_left(flow: Flow, record: Record, rate: Array, strobe: Array) -> Array:
    """Bound on the size of the transient at a strobe: a multiple of the largest state, decayed at ``rate``."""
    largest = jnp.maximum(jnp.max(record.size, axis=0), state_size(flow, initial_state(flow)))
    return _MARGIN * largest * jnp.exp(jnp.minimum(rate, 0.0) * strobe * flow.period)


def _comes_to_rest(flow: Flow, record: Record, rate: Array, size: Array, strobe: Array) -> Array:
    """Flags of motions towards a rest at 0: the field vanishes there, and the motion has shrunk by at least half the decay
    that the bound ``rate`` of the largest exponent says. ``size`` is that at ``strobe``, shape (...)."""
    still = [x if i in flow.phases else jnp.zeros_like(x) for i, x in enumerate(record.state)]
    rates = jnp.stack([flow.vector(0, fraction, jnp.stack(still)) for fraction in FRACTIONS])
    moving = jnp.array([i for i in range(flow.size) if i not in flow.phases])
    first = record.used // 4
    begin = jnp.take_along_axis(record.size, first[None], axis=0)[0]
    decay = -rate * (strobe * flow.period - first * record.span)
    shrunk = jnp.where(begin > 0, size / jnp.where(begin > 0, begin, 1.0), 0.0)
    return jnp.all(rates[:, moving] == 0, axis=(0, 1)) & (decay > TELLING) & (shrunk < jnp.exp(-decay / 2))


def returns(section: Array) -> Array:
    """Flags of motions whose close returns take the longer, the closer they are, shape (...).

    A slow decay towards a period is as close to itself after this period as after any other time.
    """
    tolerance = jnp.broadcast_to(
        jnp.array(_RETURNS).reshape(-1, *(1,) * (section.ndim - 2)), (len(_RETURNS), *section.shape[2:])
    )
    after = period_multiple(section, tolerance, LONGEST)
    first = jnp.min(jnp.where(after > 0, after, LONGEST), axis=0)
    return jnp.max(after, axis=0) > first


def repetition(section: Array, left: Array) -> tuple[Array, Array]:
    """Strobes after which ``section`` repeats to rounding (0: none), and a flag if a transient cannot explain this.

    ``left`` is a bound of the transient. A repetition within this bound, but not to rounding, is uncertain: a slow drift
    along a torus looks the same.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    left = left / jnp.where(scale > 0, scale, 1.0)
    tolerance = jnp.stack([jnp.full_like(left, _REPEATED), jnp.maximum(left, _REPEATED)])
    strict, loose = period_multiple(section, tolerance, LONGEST)
    return strict, (strict == loose) & ((strict > 0) | (left < _UNSETTLED))
