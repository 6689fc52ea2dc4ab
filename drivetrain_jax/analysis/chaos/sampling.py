"""The strobes that follow a run: after how many of them the motion repeats, and the 0-1 test."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.chaos.growth import Record, sampled, state_size
from drivetrain_jax.analysis.chaos.section_measures import period_multiple
from drivetrain_jax.analysis.chaos.variational import batch_shape, initial_state
from drivetrain_jax.analysis.chaos.zero_one_test import largest_k01
from drivetrain_jax.systems import Flow

# Strobes that follow the run for the verdict and the 0-1 test, and the longest period looked for among them.
SAMPLES, LONGEST = 1024, 512
# Repetition is judged to this fraction of the motion; that a motion does not repeat, only if less than the second is left
# of its transient.
_REPEATED, _UNSETTLED = 1e-9, 1e-4
# The bound on what is left of the transient is so many times as large as its exponent says: of a near-degenerate pair the
# exponents are known to about the inverse of the time only, whatever the standard error is.
_MARGIN = 1e3
# Times that a motion is followed for as many strobes again, where what is left of the transient could hide or feign a
# repetition.
_MOST_LOOKS = 16


class Sampling(NamedTuple):
    """What the strobes after a run show: K of the 0-1 test, the period in strobes, and whether it could be told."""

    k01: Array
    multiple: Array
    settled: Array


class _Look(NamedTuple):
    """``SAMPLES`` strobes looked at: how many times before, the state after them and its number, the first section of all,
    and what has been found of every member."""

    number: Array
    state: tuple
    strobe: Array
    first: Array
    multiple: Array
    settled: Array


def sample(flow: Flow, steps: Any, record: Record, rate: Array, k01_for: Array) -> Sampling:
    """Follow the motion for ``SAMPLES`` strobes; K of the members of ``k01_for``, otherwise 0.

    ``rate``: the largest exponent that its error allows, shape (...). Motions that decay are followed further until their
    period can be told from what is left of the transient.
    """
    watched = [i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0]
    shape = batch_shape(flow)
    decays = jnp.zeros(shape, bool)
    if flow.turns:
        decays = record.bounded & (rate < 0)

    def look(seen: _Look) -> _Look:
        states, state = sampled(flow, steps, seen.state, seen.strobe, SAMPLES)
        section = states[:, jnp.array(watched)]
        left = transient_left(flow, record, rate, seen.strobe + SAMPLES // 2)
        multiple, settled = repetition(section, left)
        # What has been told stands: no member's result depends on how long its neighbours are followed.
        multiple, settled = (
            jnp.where(seen.settled, *pair) for pair in ((seen.multiple, multiple), (seen.settled, settled))
        )
        first = jnp.where(seen.number == 0, section, seen.first)
        return _Look(seen.number + 1, state, seen.strobe + SAMPLES, first, multiple, settled)

    def unsettled(seen: _Look) -> Array:
        return (seen.number == 0) | ((seen.number < _MOST_LOOKS) & jnp.any(decays & ~seen.settled))

    blank = jnp.zeros((SAMPLES, len(watched), *shape))
    nothing = jnp.zeros(shape, jnp.int64)
    start = _Look(jnp.int64(0), record.state, record.strobe, blank, nothing, jnp.zeros(shape, bool))
    seen = jax.lax.while_loop(unsettled, look, start)
    good = record.bounded & jnp.all(jnp.isfinite(seen.first), axis=(0, 1))
    k01 = jax.lax.cond(jnp.any(k01_for), largest_k01, lambda x: jnp.zeros(x.shape[2:]), seen.first)
    k01 = jnp.where(k01_for, k01, 0.0)
    return Sampling(jnp.where(good, k01, jnp.nan), jnp.where(good, seen.multiple, 0), seen.settled)


def transient_left(flow: Flow, record: Record, rate: Array, strobe: Array) -> Array:
    """Bound on the size that the transient still has at a strobe: a multiple of the largest state, decayed at ``rate``."""
    largest = jnp.maximum(jnp.max(record.size, axis=0), state_size(flow, initial_state(flow)))
    return _MARGIN * largest * jnp.exp(jnp.minimum(rate, 0.0) * strobe * flow.period)


def repetition(section: Array, left: Array) -> tuple[Array, Array]:
    """Strobes after which ``section`` repeats to rounding (0: none), and whether this is more than a transient's doing.

    ``left``: what may be left of the transient. A number of strobes after which the motion repeats to within that only,
    but not to rounding, may be its period or not: a slow drift along a torus looks the same.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    left = left / jnp.where(scale > 0, scale, 1.0)
    tolerance = jnp.stack([jnp.full_like(left, _REPEATED), jnp.maximum(left, _REPEATED)])
    strict, loose = period_multiple(section, tolerance, LONGEST)
    return strict, (strict == loose) & ((strict > 0) | (left < _UNSETTLED))
