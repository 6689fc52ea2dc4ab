"""Whether the steps resolve what they march: only then are exponents those of the field, whatever their standard errors.

Two tests. The exponents add up to the mean divergence, which is known without them; steps that damp or feed an
oscillation, or that miss a fast decay, break this. And the largest exponent is the same with twice the step: a motion
that the steps stir keeps the sum, for volume changes little where errors are those of phases.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

STANDARD_ERRORS = 3.0
# Residual of the sum rule over the largest exponent.
SUM_RULE = 1e-3
# An exponent that is zero over the largest one.
_ZERO = 1e-6
# What rounding and the steps may change the volume by within a strobe where all exponents are nearly zero.
_VOLUME = 1e-9
# Two step sizes agree to this part of the exponent, however small the standard errors are.
_AGREEMENT = 0.1


def adds_up(spectrum: Array, error: Array, residual: Array, period: Any) -> Array:
    """Whether the residual of the sum rule, shape (...), is small against the exponents ``(m, ...)`` or their errors.

    Errors of motions that left are NaN and excuse nothing; nothing adds up where the residual is NaN.
    """
    largest = jnp.max(jnp.abs(spectrum), axis=0)
    size = jnp.abs(residual)
    return (size <= SUM_RULE * largest) | (size <= jnp.max(error, axis=0)) | (size * period <= _VOLUME)


def same_exponent(value: Array, error: Array, other: Array, other_error: Array) -> Array:
    """Whether two step sizes give the same exponent: to three combined standard errors or to a tenth.

    To a tenth if an error is NaN, as of a motion that left; never if a value is.
    """
    allowed = jnp.fmax(STANDARD_ERRORS * jnp.hypot(error, other_error), _AGREEMENT * jnp.abs(value))
    return jnp.abs(value - other) <= allowed


def zero_floor(spectrum: Array) -> Array:
    """Size that an exponent that is zero may have, whatever its standard error says, shape (...)."""
    return _ZERO * jnp.max(jnp.abs(spectrum), axis=0)


def significant(spectrum: Array, error: Array) -> Array:
    """Whether the largest exponent, the first of ``(m, ...)``, is positive beyond three standard errors."""
    return spectrum[0] > STANDARD_ERRORS * error[0] + zero_floor(spectrum)


def resolved(spectrum: Array, error: Array, residual: Array, period: Any, coarse: Array, coarse_error: Array) -> Array:
    """Whether the exponents add up and, if the largest one is positive, twice the step has it, too; shape (...).

    ``coarse``, ``coarse_error``: the largest one with twice the step. Motions that left have no significant exponent: they
    are judged by the sum.
    """
    same = same_exponent(spectrum[0], error[0], coarse, coarse_error)
    return adds_up(spectrum, error, residual, period) & (same | ~significant(spectrum, error))
