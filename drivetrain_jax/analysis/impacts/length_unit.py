"""The unit of length of a computation: a power of two near the lengths of the oscillator.

The equation is homogeneous in u, b, B0 and B1, and a power of two causes no rounding. Squares of lengths then neither
underflow (1e-160) nor overflow (1e160).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator

# Results that are lengths, velocities or accelerations.
_LENGTHS = frozenset((
    "u_max", "u_min", "u_mean", "u_rms", "impact_velocity", "orbit_state", "state_error", "u_history", "v_history",
    "branch_u_max", "branch_u_min", "attractor_u_max", "attractor_u_min", "residual", "peak_amplitude",
    "backbone_amplitude", "fit_range",
))  # fmt: skip
# Beyond these exponents a power of two or its inverse is not a normal number.
_LARGEST = 1000


def to_scaled_length(model: PiecewiseLinearOscillator) -> tuple[PiecewiseLinearOscillator, Array | np.ndarray]:
    """``model`` with lengths in its own unit, and this unit [m] in the common shape of all fields but omega."""
    fields = (model.b, model.B0, model.B1, model.stiffness)
    # Fixed values of a scene stay NumPy arrays, constants of the kernel.
    xp = jnp if any(isinstance(x, Array) for x in (*fields, model.unbalance)) else np
    b, B0, B1, stiffness = (xp.asarray(x, float) for x in fields)
    drive = xp.maximum(xp.abs(B0), xp.abs(B1))
    if model.follows:
        drive = xp.maximum(drive, xp.abs(model.unbalance) * xp.max(xp.asarray(model.omega)) ** 2)
    static = xp.frexp(drive)[1] - xp.frexp(stiffness)[1]
    none = -10 * _LARGEST
    exponent = xp.maximum(xp.where(b > 0, xp.frexp(b)[1], none), xp.where(drive > 0, static, none))
    exponent = xp.where(exponent == none, 0, xp.clip(exponent, -_LARGEST, _LARGEST))
    unit, inverse = (xp.ldexp(xp.ones(exponent.shape), power) for power in (exponent, -exponent))
    return replace(
        model,
        b=b * inverse,
        B0=B0 * inverse,
        B1=B1 * inverse,
        unbalance=model.unbalance * inverse if model.follows else 0.0,
    ), unit


def from_scaled_length(results: Mapping[str, Array], unit: Array | np.ndarray) -> dict[str, Array]:
    """``results`` with lengths in metres; their last axis is that of ``unit``."""
    return {name: x * unit if name in _LENGTHS else x for name, x in results.items()}
