"""Decide if the steps resolve the motion; without that exponents are wrong even with small standard errors.

Two tests. The exponents must sum to the mean divergence, which is known without them; steps that damp or excite an
oscillation, or that miss a fast decay, violate this. And the largest exponent must be the same with twice the step: steps
that perturb phases keep the sum, because they hardly change volume.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

import drivetrain_jax.systems  # noqa: F401  double precision

STANDARD_ERRORS = 3.0
# Residual of the sum rule relative to the largest exponent.
SUM_RULE = 1e-3
# Ratio to the largest exponent below which an exponent is zero.
_ZERO = 1e-6
# Largest change of volume within a strobe by rounding and steps, if all exponents are nearly zero.
_VOLUME = 1e-9
# Relative agreement of two step sizes that suffices for any standard error.
_AGREEMENT = 0.1


def adds_up(spectrum: Array, error: Array, residual: Array, period: Any) -> Array:
    """Flags where the residual of the sum rule, shape (...), is small relative to the exponents ``(m, ...)`` or their
    errors.

    Errors of unbounded motions are NaN and are ignored; the flag is false where the residual is NaN.
    """
    largest = jnp.max(jnp.abs(spectrum), axis=0)
    size = jnp.abs(residual)
    return (size <= SUM_RULE * largest) | (size <= jnp.max(error, axis=0)) | (size * period <= _VOLUME)


def same_exponent(value: Array, error: Array, other: Array, other_error: Array) -> Array:
    """Flags where two step sizes give the same exponent: within three combined standard errors or a tenth.

    Within a tenth if an error is NaN, as for an unbounded motion; never if a value is NaN.
    """
    allowed = jnp.fmax(STANDARD_ERRORS * jnp.hypot(error, other_error), _AGREEMENT * jnp.abs(value))
    return jnp.abs(value - other) <= allowed


def zero_floor(spectrum: Array) -> Array:
    """Largest size of a zero exponent for any standard error, shape (...)."""
    return _ZERO * jnp.max(jnp.abs(spectrum), axis=0)


def significant(spectrum: Array, error: Array) -> Array:
    """Flags where the largest exponent, the first of ``(m, ...)``, exceeds three standard errors."""
    return spectrum[0] > STANDARD_ERRORS * error[0] + zero_floor(spectrum)


def resolved(spectrum: Array, error: Array, residual: Array, period: Any, coarse: Array, coarse_error: Array) -> Array:
    """Flags where the exponents sum to the divergence and a positive largest one is confirmed by twice the step; shape
    (...).

    ``coarse`` is the largest exponent found with twice the step, ``coarse_error`` its error. Unbounded motions have no
    significant exponent: only the sum counts for them.
    """
    same = same_exponent(spectrum[0], error[0], coarse, coarse_error)
    return adds_up(spectrum, error, residual, period) & (same | ~significant(spectrum, error))
