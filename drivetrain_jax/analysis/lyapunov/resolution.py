"""Decide if the steps resolve the motion; otherwise exponents are wrong even with small standard errors.

There are two tests. First, the exponents must sum to the mean divergence, which is known independently. Steps that damp or
excite an oscillation, or that miss a fast decay, fail this test. Second, the largest exponent must be the same with twice
the step. Steps that perturb phases fail only this test, because they hardly change volume.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

import drivetrain_jax.systems  # noqa: F401  double precision

STANDARD_ERRORS = 3.0
# Largest residual of the sum rule relative to the largest exponent.
SUM_RULE = 1e-3
# Ratio to the largest exponent below which an exponent is zero.
_ZERO = 1e-6
# Largest change of volume within a strobe by rounding and steps, if all exponents are nearly zero.
_VOLUME = 1e-9
# Relative difference of two step sizes that counts as agreement, whatever the standard errors.
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

    If an error is NaN, as for an unbounded motion, only the tenth counts. The flag is false if a value is NaN.
    """
    allowed = jnp.fmax(STANDARD_ERRORS * jnp.hypot(error, other_error), _AGREEMENT * jnp.abs(value))
    return jnp.abs(value - other) <= allowed


def zero_floor(spectrum: Array) -> Array:
    """Size up to which an exponent counts as zero, whatever its standard error, shape (...)."""
    return _ZERO * jnp.max(jnp.abs(spectrum), axis=0)


def significant(spectrum: Array, error: Array) -> Array:
    """Flags where the largest exponent, the first of ``(m, ...)``, exceeds three standard errors."""
    return spectrum[0] > STANDARD_ERRORS * error[0] + zero_floor(spectrum)


def resolved(spectrum: Array, error: Array, residual: Array, period: Any, coarse: Array, coarse_error: Array) -> Array:
    """Flags where the exponents sum to the divergence and twice the step confirms a positive largest exponent, shape (...).

    ``coarse`` is the largest exponent with twice the step, ``coarse_error`` its error. Unbounded motions have no significant
    exponent, so only the sum rule applies to them.
    """
    same = same_exponent(spectrum[0], error[0], coarse, coarse_error)
    return adds_up(spectrum, error, residual, period) & (same | ~significant(spectrum, error))
