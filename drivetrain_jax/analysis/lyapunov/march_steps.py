"""Steps per strobe for a march of tangent vectors, and the number of orthonormalisations within a strobe.

Both numbers are predicted before the march from the largest angular frequency of the flow and its divergence at the start.
A step of length h turns by y = rho h at the fastest rate rho. By its stability function on the imaginary axis, DOP853
changes the logarithm of an amplitude by 2.4e-8 y^10 with little damping, and by less than 4e-7 of the decay with strong
damping. For exponents only the ratio to the decay matters.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.variational import batch_shape, divergence, initial_state
from drivetrain_jax.systems import Flow

# Fewest steps per strobe, also those of a flow without a known frequency; most steps unless the option `steps` is given.
LEAST, MOST = 48, 100_000
# Damping of an amplitude by one step that turns by a radian; it grows with the tenth power of the angle.
_DAMPING, _POWER = 2.4e-8, 10
# Largest change by the steps: of an exponent relative to its size, and of the logarithm of an amplitude within a strobe.
# Both are a hundredth of the errors that ``resolution`` detects.
_CHANGE, _ROUNDING = 1e-5, 1e-11
# Longest step in radians of the fastest motion.
_LONGEST = 1.4
# Logarithm of the largest ratio of two vectors before an orthonormalisation, to keep the shorter one clear of rounding.
_PARTING = 12.0


def contraction(flow: Flow) -> Array:
    """Contraction rate of volume (minus the divergence of the field) at the start of the motion, shape (...)."""
    rate = -jnp.asarray(divergence(flow, flow.angles(0, 0.0), initial_state(flow)), float)
    return jnp.broadcast_to(rate, batch_shape(flow))


def needed_steps(flow: Flow) -> Array:
    """Equal steps per strobe for exponents accurate to 1e-5, at least ``LEAST``, as numbers of shape (...)."""
    if flow.fastest is None:
        return jnp.full(batch_shape(flow), float(LEAST))
    volume = jnp.abs(contraction(flow))
    rate = jnp.maximum(flow.fastest, volume)
    angle = rate * flow.period
    # Tolerated change of the logarithm of an amplitude per radian.
    tolerated = jnp.maximum(_CHANGE * volume / flow.size / rate, _ROUNDING / angle)
    longest = jnp.minimum((tolerated / _DAMPING) ** (1 / (_POWER - 1)), _LONGEST)
    steps = jnp.ceil(angle / longest)
    # A field of NaN is marched too, and ends as NOT_FINITE.
    return jnp.where(jnp.isnan(steps), LEAST, jnp.maximum(steps, LEAST))


def needed_parts(flow: Flow, steps: Any, active: Array) -> Array:
    """Parts of a strobe after which vectors are orthonormalised, an integer for all ``active`` members, at most ``steps``.

    If no vector grows, vectors separate no faster than volume contracts.
    """
    parts = jnp.ceil(jnp.abs(contraction(flow)) * flow.period / _PARTING)
    return jnp.clip(jnp.max(jnp.where(jnp.isnan(parts) | ~active, 1.0, parts)), 1, steps).astype(jnp.int64)
