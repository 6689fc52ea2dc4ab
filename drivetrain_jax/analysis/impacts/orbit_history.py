"""A motion of a piecewise linear oscillator at equally spaced times, exact up to rounding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.impacts.attractor_lanes import MOST_PERIODS
from drivetrain_jax.analysis.impacts.piecewise_march import (
    Motion,
    advance,
    locate,
    next_step,
    prepare,
    start,
    usual_steps,
)
from drivetrain_jax.systems import PiecewiseLinearOscillator


def history(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, multiple: Array, samples: int
) -> tuple[Array, Array]:
    """Displacement and velocity at ``samples`` times, shape ``(samples, N)`` each, from the state ``(u, v)``.

    The times divide ``multiple`` drive periods (32 where it is 0) into equal parts; the first time is the start. A lane that
    is not finite stops. A lane that needs more steps than any motion over these periods becomes NaN.
    """
    lanes = prepare(oscillator)
    zero = jnp.zeros(u.shape)
    lanes = jax.tree.map(lambda x: x + zero, lanes)
    periods = jnp.where(multiple > 0, multiple, MOST_PERIODS).astype(jnp.int32)
    span = periods * lanes.period / samples
    # Every time costs one more step.
    most = 2 * periods * usual_steps(lanes) + samples

    def to_next(motion: Motion, _: None) -> tuple[Motion, tuple[Array, Array]]:
        def active(moving: Motion, rest: Array) -> Array:
            return (rest > 0) & jnp.isfinite(moving.u) & (moving.steps < most)

        def going(state: tuple[Motion, Array]) -> Array:
            return jnp.any(active(*state))

        def move(state: tuple[Motion, Array]) -> tuple[Motion, Array]:
            moving, rest = state
            here = locate(lanes, moving.u)
            d = jnp.minimum(next_step(lanes, here, moving), rest)
            moved = advance(lanes, here, moving, d)
            now = active(moving, rest)
            kept = jax.tree.map(lambda new, old: jnp.where(now, new, old), moved, moving)
            return kept, jnp.where(now, jnp.maximum(rest - d, 0.0), rest)

        moved, rest = jax.lax.while_loop(going, move, (motion, span))
        late = jnp.where(rest > 0, jnp.nan, 0.0)
        return moved._replace(u=moved.u + late, v=moved.v + late), (motion.u, motion.v)

    _, sampled = jax.lax.scan(to_next, start(lanes, u, v, periods), None, length=samples)
    return sampled
