"""The strobes after a run: the 0-1 test, and the close returns of a torus."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.growth_record import Record, sampled
from drivetrain_jax.analysis.lyapunov.section_measures import period_multiple
from drivetrain_jax.analysis.lyapunov.zero_one_test import largest_k01
from drivetrain_jax.systems import Flow

# Strobes after the run, and the longest return in strobes that is searched.
SAMPLES, LONGEST = 1024, 512
# Distances of close returns, relative to the motion: a torus comes as close as the smaller ones, but later.
_RETURNS = (0.3, 0.1, 0.03, 0.01)


class Sampling(NamedTuple):
    """K of the 0-1 test, and flags of motions that :func:`returns` finds."""

    k01: Array
    returns: Array


def sample(flow: Flow, steps: Any, record: Record, needed: Array) -> Sampling:
    """Sampling of the motions over ``SAMPLES`` strobes after the run; K of the others is 0, of unbounded ones NaN."""
    watched = [i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0]
    needed = needed & record.bounded

    def look() -> Sampling:
        states, _ = sampled(flow, steps, record.state, record.strobe, SAMPLES)
        section = states[:, jnp.array(watched)]
        finite = jnp.all(jnp.isfinite(section), axis=(0, 1))
        k01 = jnp.where(needed, jnp.where(finite, largest_k01(section), jnp.nan), 0.0)
        return Sampling(k01, needed & finite & returns(section))

    seen = jax.lax.cond(jnp.any(needed), look, lambda: Sampling(jnp.zeros(needed.shape), jnp.zeros_like(needed)))
    return seen._replace(k01=jnp.where(record.bounded, seen.k01, jnp.nan))


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
