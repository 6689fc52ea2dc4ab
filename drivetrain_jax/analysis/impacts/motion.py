"""Quantities of a periodic motion of the oscillator with play, for all methods."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
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


# Linear maps of the plane over lanes: matrices as four arrays ``(m11, m12, m21, m22)`` of shape ``(N,)``.

# Four entries, row by row.
Matrix = tuple[Array, ...]


def spectral_radius(matrix: Matrix, log_determinant: Array) -> Array:
    """Largest modulus of the eigenvalues, from the trace and the exact determinant."""
    half = (matrix[0] + matrix[3]) / 2
    gap = half**2 - jnp.exp(log_determinant)
    return jnp.where(gap > 0, jnp.abs(half) + jnp.sqrt(jnp.maximum(gap, 0.0)), jnp.exp(log_determinant / 2))


def log_determinant(oscillator: PiecewiseLinearOscillator, matrix: Matrix, span: Array) -> Array:
    """Logarithm of the determinant of the transition over ``span``: exact if the damper always acts, else by the matrix."""
    if oscillator.damps_play:
        return -oscillator.damping * span
    return jnp.log(jnp.maximum(matrix[0] * matrix[3] - matrix[1] * matrix[2], np.finfo(float).tiny))


def newton_correction(matrix: Matrix, du: Array, dv: Array) -> tuple[Array, Array]:
    """``(1 - M)^-1 (du, dv)``; not finite if M has the multiplier 1."""
    a, b, c, d = 1 - matrix[0], -matrix[1], -matrix[2], 1 - matrix[3]
    determinant = a * d - b * c
    return (d * du - b * dv) / determinant, (a * dv - c * du) / determinant


def apply(matrix: Matrix, u: Array, v: Array) -> tuple[Array, Array]:
    """``M (u, v)``."""
    return matrix[0] * u + matrix[1] * v, matrix[2] * u + matrix[3] * v
