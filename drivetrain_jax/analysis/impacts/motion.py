"""Quantities of a periodic motion of the oscillator with play, for all methods."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator

REGIMES = ("no_separation", "single_sided", "double_sided", "non_periodic")
REGIME = "flanks at which contact is made and lost (non_periodic within the time limit: possibly a transient)"
STABILITY = ("stable", "unstable", "absent")
STABLE, UNSTABLE, ABSENT = range(3)
PHASE = "lag of the fundamental behind the drive (NaN without a fundamental)"
# Relative size below which a fundamental is rounding: a motion at rest has 1e-14.
_ROUNDING = 1e-13


def regime(model: PiecewiseLinearOscillator, high: Array, low: Array) -> Array:
    """Number of flanks (u = b, u = -b) at which contact is made and lost between the extremes, as int8.

    0 is motion without separation or, without contact, within the play; 1 is single-sided and 2 double-sided rattle.
    """
    drive_side = (low < model.b) & (model.b < high) & (model.b > 0)
    back_side = (low < -model.b) & (-model.b < high) & (model.b > 0)
    return (drive_side.astype(jnp.int8) + back_side.astype(jnp.int8)).astype(jnp.int8)


def phase_lag(cosine: Array, sine: Array, size: Array) -> Array:
    """Lag of the fundamental ``cosine cos(omega t) + sine sin(omega t)`` of a motion with displacements up to ``size``.

    NaN where the fundamental is rounding.
    """
    return jnp.where(jnp.hypot(cosine, sine) > _ROUNDING * size, jnp.arctan2(sine, cosine), jnp.nan)


def imbalance(model: PiecewiseLinearOscillator, motion: tuple[Array, Array, Array], drive: Array) -> Array:
    """Rms over the first axis (samples of a period) of the residual of the equation of motion for ``(u, u', u'')``."""
    u, rate, acceleration = motion
    rest = acceleration + model.damping * rate + model.stiffness * model.restoring(u) - drive
    return jnp.sqrt(jnp.mean(rest**2, axis=0))
