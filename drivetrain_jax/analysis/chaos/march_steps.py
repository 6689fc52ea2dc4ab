"""Steps per strobe that a march of tangent vectors needs, and how often within a strobe they are made orthonormal.

Predicted from what a flow tells of itself before anything is marched: its largest angular frequency and, where it starts,
its divergence. A step of length h turns by y = rho h at the fastest rate rho. DOP853 then changes the logarithm of an
amplitude by 2.4e-8 y^10 where little is damped (its stability function on the imaginary axis), and by less than 4e-7 of
the decay where much is. Only how much that is beside the decay itself matters for exponents.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.chaos.variational import batch_shape, divergence, initial_state
from drivetrain_jax.systems import Flow

# Steps per strobe of a flow that does not tell how fast it is, the fewest of one that does; and those beyond which a march
# is not worth beginning unless somebody asks for them.
LEAST, MOST = 48, 100_000
# Damping of an amplitude by one step that turns by a radian; it grows with the tenth power of the angle.
_DAMPING, _POWER = 2.4e-8, 10
# What steps may change an exponent by, over its size, or the logarithm of an amplitude within a strobe, however small
# exponents are: a hundredth of what would be told (see ``resolution``).
_CHANGE, _ROUNDING = 1e-5, 1e-11
# Longest step in radians of the fastest motion.
_LONGEST = 1.4
# Of vectors that part by more than e to this power, the shorter one is lost in the rounding of the longer one.
_PARTING = 12.0


def contraction(flow: Flow) -> Array:
    """Rate at which volume shrinks where the motion starts, minus the divergence of the field, shape (...)."""
    rate = -jnp.asarray(divergence(flow, flow.angles(0, 0.0), initial_state(flow)), float)
    return jnp.broadcast_to(rate, batch_shape(flow))


def needed_steps(flow: Flow) -> Array:
    """Equal steps per strobe that leave exponents right to 1e-5, at least ``LEAST``, as numbers of shape (...)."""
    if flow.fastest is None:
        return jnp.full(batch_shape(flow), float(LEAST))
    volume = jnp.abs(contraction(flow))
    rate = jnp.maximum(flow.fastest, volume)
    angle = rate * flow.period
    # Of all steps of a strobe together, over its angle.
    tolerated = jnp.maximum(_CHANGE * volume / flow.size / rate, _ROUNDING / angle)
    longest = jnp.minimum((tolerated / _DAMPING) ** (1 / (_POWER - 1)), _LONGEST)
    steps = jnp.ceil(angle / longest)
    # A field without a value is marched all the same: that makes the outcome NOT_FINITE.
    return jnp.where(jnp.isnan(steps), LEAST, jnp.maximum(steps, LEAST))


def needed_parts(flow: Flow, steps: Any) -> Array:
    """Parts of a strobe after each of which vectors are made orthonormal, an integer for the batch, at most ``steps``.

    They part no faster than volume shrinks if none of them grows.
    """
    parts = jnp.ceil(jnp.abs(contraction(flow)) * flow.period / _PARTING)
    return jnp.clip(jnp.max(jnp.where(jnp.isnan(parts), 1.0, parts)), 1, steps).astype(jnp.int64)
