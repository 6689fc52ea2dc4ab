"""A motion of a piecewise linear oscillator at equally spaced times, exact within rounding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.impacts.attractor_lanes import MOST_PERIODS
from drivetrain_jax.analysis.impacts.piecewise_march import Motion, advance, locate, next_step, prepare, start
from drivetrain_jax.systems import PiecewiseLinearOscillator

_MOST_STEPS = 10_000


def history(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, multiple: Array, samples: int
) -> tuple[Array, Array]:
    """Displacement and velocity at ``samples`` times, shape ``(samples, N)`` each, from the state ``(u, v)``.

    The times divide ``multiple`` drive periods (32 where it is 0) into equal parts and begin with the start. A lane
    that is not finite or needs more than 10,000 steps from one time to the next stays where it is.
    """
    lanes = prepare(oscillator)
    zero = jnp.zeros(u.shape)
    lanes = jax.tree.map(lambda x: x + zero, lanes)
    periods = jnp.where(multiple > 0, multiple, MOST_PERIODS).astype(jnp.int32)
    span = periods * lanes.period / samples

    def to_next(motion: Motion, _: None) -> tuple[Motion, tuple[Array, Array]]:
        def going(state: tuple[Motion, Array, Array]) -> Array:
            moving, rest, count = state
            return (count < _MOST_STEPS) & jnp.any((rest > 0) & jnp.isfinite(moving.u))

        def move(state: tuple[Motion, Array, Array]) -> tuple[Motion, Array, Array]:
            moving, rest, count = state
            here = locate(lanes, moving.u)
            d = jnp.minimum(next_step(lanes, here, moving), rest)
            moved = advance(lanes, here, moving, d)
            active = (rest > 0) & jnp.isfinite(moving.u)
            kept = jax.tree.map(lambda new, old: jnp.where(active, new, old), moved, moving)
            return kept, jnp.where(active, jnp.maximum(rest - d, 0.0), rest), count + 1

        moved, _, _ = jax.lax.while_loop(going, move, (motion, span, jnp.asarray(0)))
        return moved, (motion.u, motion.v)

    _, sampled = jax.lax.scan(to_next, start(lanes, u, v, periods), None, length=samples)
    return sampled
