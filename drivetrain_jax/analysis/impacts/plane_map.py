"""Linear maps of the plane over lanes: matrices as four arrays ``(m11, m12, m21, m22)`` of shape ``(N,)``."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator

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
