"""Separation margins of critical speeds against a range of operating speeds: actual, and required by API 617."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

# Amplification factor below which a critical speed counts as critically damped (API 617, API 684).
_DAMPED = 2.5
# Factor of the formula, largest margin of a speed below the range, and the addition for a speed above it.
_FACTOR, _LARGEST, _ABOVE = 0.17, 0.16, 0.1


def separation_margin(speed: Any, lowest: float, highest: float) -> Array:
    """Distance of ``speed`` from the operating range [lowest, highest] over its nearer end; 0 within.

    A critical speed below gives ``(lowest - n)/lowest``, one above ``(n - highest)/highest`` (as in API 617).
    """
    speed = jnp.asarray(speed, float)
    below = (lowest - speed) / (lowest if lowest > 0 else 1.0)
    return jnp.maximum(jnp.maximum(below, (speed - highest) / highest), 0.0)


def required_margin(speed: Any, lowest: float, amplification: Any) -> Array:
    """The margin that API 617 requires of a critical ``speed`` with this ``amplification`` factor AF.

    ``17 (1 - 1/(AF - 1.5))`` percent, at most 16, below the operating range; 10 more within and above it; none for AF < 2.5.
    Models of this package have no damping; a factor comes from a measurement or a damped model.

    >>> print(required_margin([1000.0, 9000.0], lowest=3000.0, amplification=10.0))
    [0.15 0.25]
    """
    factor, above = jnp.asarray(amplification, float), jnp.asarray(speed, float) >= lowest
    below = jnp.minimum(_FACTOR * (1 - 1 / jnp.maximum(factor - 1.5, 1.0)), _LARGEST)
    return jnp.where(factor < _DAMPED, 0.0, below + jnp.where(above, _ABOVE, 0.0))
