"""The results of the floquet analysis from a monodromy matrix.

The bound follows from the error of the coefficients of the characteristic polynomial. For four states the closed form of
:mod:`~drivetrain_jax.analysis.floquet.quartic` costs a tenth of the eigenvalues.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis._base import Outcome, finite_results
from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.direct import Monodromy
from drivetrain_jax.analysis.floquet.multipliers import (
    VERDICTS,
    PolynomialError,
    all_on_the_circle,
    characteristic_coefficients,
    graded_multipliers,
    multiplier_errors,
    over_first,
    sort_multipliers,
    spectral_radius_bound,
    verdict,
)
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored
from drivetrain_jax.analysis.numerics.lanes import in_blocks
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, square_sum
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Factored
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Real and imaginary parts of eigenvalues, ``(n, ...)`` each.
Spectrum = tuple[Array, Array]
Radius = tuple[Array, Array]
# Roundings in a coefficient, in units of eps times a power of the matrix's norm.
_ROUNDINGS = 16.0
# Lanes per block of the closed form, and lanes whose eigenvalues are computed together.
_BLOCK, _REPAIRED = 32, 32


def has_closed_form(z: Array) -> bool:
    """True if ``z`` ``(n, n, ...)`` has four states, and lanes as its only batch axis (single points gain nothing)."""
    return len(z) == 4 and z.ndim == 3


def radius_by_eigenvalues(spectrum: Spectrum, error: PolynomialError) -> Radius:
    """Spectral radius and bound."""

    def radius(values: tuple[Spectrum, PolynomialError], _: int) -> Radius:
        spectrum, error = values
        return over_first(jnp.maximum, jnp.hypot(*spectrum)), spectral_radius_bound(*spectrum, error)

    values, lanes = (spectrum, error), error.sizes.shape[-1]
    return in_blocks(radius, values, lanes, _BLOCK, in_one_kernel) if error.sizes.ndim == 2 else radius(values, 1)


def radius_in_closed_form(
    z: Array, error: PolynomialError, scale: Array, undamped: Array, tolerance: float
) -> tuple[Array, Array, Array]:
    """Spectral radius and bound of ``z`` ``(4, 4, N)``, and flags of bounded motion without damping.

    By eigenvalues in lanes that are ``undamped``, or in which the bound of the closed form is not tight, exceeds
    ``tolerance`` rho, or leaves open on which side of 1 ``scale`` rho lies.
    """
    lanes = z.shape[-1]

    def closed(block: tuple[Array, PolynomialError, Array, Array], _: int) -> tuple[Array, Array, Array]:
        z, error, scale, undamped = block
        c, norm = _coefficients(z)
        split = quartic.factors(c)
        errors = stored(_errors)(error, stored(quartic.farthest)(split, error.centre), norm, c.errors[0])
        rho, bound, unsure = stored(quartic.spectral_radius)(c._replace(errors=errors), split)
        clear = ~unsure & (bound <= tolerance * rho) & (jnp.abs(scale * rho - 1) > scale * bound)
        return rho, bound, clear & ~undamped

    def repaired(state: tuple[Array, ...]) -> tuple[Array, ...]:
        """Some more lanes by eigenvalues."""
        certain = state[-1]
        chosen = jnp.nonzero(~certain, size=min(lanes, _REPAIRED), fill_value=jnp.argmin(certain))[0]
        spectrum = eigenvalues(z[..., chosen])
        chosen_error = error.lanes(chosen)
        on_circle = all_on_the_circle(*spectrum, chosen_error, scale[chosen])
        replaced = *radius_by_eigenvalues(spectrum, chosen_error), undamped[chosen] & on_circle, True
        return tuple(x.at[chosen].set(new) for x, new in zip(state, replaced, strict=True))

    rho, bound, certain = in_blocks(closed, (z, error, scale, undamped), lanes, _BLOCK, in_one_kernel)
    start = rho, bound, undamped & False, certain
    rho, bound, bounded, _ = jax.lax.while_loop(lambda state: ~jnp.all(state[-1]), repaired, start)
    return rho, bound, bounded


def _coefficients(z: Array) -> tuple[quartic.Coefficients, Array]:
    """The coefficients of the characteristic polynomial, and the norm of ``z``; ``errors`` are what has been added."""
    a = stored(characteristic_coefficients)(z)
    norm = stored(lambda z: jnp.sqrt(square_sum(z)))(z)
    # Use the determinant of the matrix even if the exact value is known: multipliers that nearly meet move far less with
    # the matrix than with a single coefficient. It is positive, but for rounding.
    d = jnp.maximum(a[3], quartic.EPS * norm**4)
    kappa = stored(lambda x: jnp.sqrt(jnp.sqrt(x)))(d)
    return quartic.Coefficients(-a[0], a[1], -a[2], kappa, (d - a[3],)), norm  # pyright: ignore[reportArgumentType]


def _errors(error: PolynomialError, farthest: Array, norm: Array, moved: Array) -> tuple[Array, ...]:
    # The recursion for a_k multiplies k matrices.
    errors = [_ROUNDINGS * quartic.EPS * norm**k for k in (1, 2, 3, 4)]
    return *errors[:3], errors[3] + moved + error.bound(farthest)


VARIABLES = (
    Variable("floquet_multiplier", "1", "Floquet multiplier over one period", ("multiplier",), "complex128"),
    Variable("floquet_multiplier_error", "1", "bound of the absolute error of floquet_multiplier", ("multiplier",)),
    Variable("floquet_exponent", "1/s", "real part of the Floquet exponent", ("multiplier",)),
    Variable("spectral_radius", "1", "largest modulus of the Floquet multipliers"),
    Variable("spectral_radius_error", "1", "bound of the absolute error of spectral_radius"),
    Variable("verdict", "1", "stability of the equilibrium", dtype="int8", flags=VERDICTS),
    Variable("liouville_residual", "1", "(determinant of the monodromy matrix - exact value) / spectral_radius^n"),
)
MULTIPLIERS = {"floquet_multiplier", "floquet_multiplier_error", "floquet_exponent"}
NEED_ERROR = {"spectral_radius_error", "verdict", *MULTIPLIERS}
_TINY = np.finfo(float).tiny
# Relative error of a spectral radius that is known to be 1.
_ROUNDING = 4 * np.finfo(float).eps


def lacks(system: type[System]) -> dict[str, str]:
    """Results that a system does not support and the reason: ``floquet_exponent`` needs a time in seconds."""
    if system.time_units == "s":
        return {}
    return {"floquet_exponent": f"a rate in 1/s, and the time of {system.name} has no unit"}


def _of_multipliers(
    z: Monodromy,
    finite: Array,
    bounded: Array,
    spectrum: Spectrum,
    system: LinearPeriodic,
    factors: Callable[[], Factored] | None,
) -> dict[str, Array]:
    """Multipliers with their errors and exponents; NaN where the error exceeds the multiplier.

    ``bounded`` ones are known to lie on the unit circle: there the error of the modulus is gone, and the distance from the
    nearest point of the circle is at most twice the error.
    As eigenvalues small multipliers have the absolute errors of large ones. The smaller one of two follows from their
    product, if that is known, where the moduli differ by more than a factor of two; others follow from ``factors`` of the
    matrix, if given.
    """
    multipliers = jnp.where(finite, sort_multipliers(*spectrum), jnp.nan)
    errors = multiplier_errors(multipliers.real, multipliers.imag, z.error)
    multipliers = jnp.where(bounded, jnp.exp(-z.log_scale) * multipliers / jnp.abs(multipliers), multipliers)
    errors = jnp.where(bounded, 2.0, 1.0) * errors
    logarithms = jnp.log(jnp.abs(multipliers))
    if len(multipliers) == 2 and system.log_determinant is not None:
        log_product = system.log_determinant() - 2 * z.log_scale
        smaller = (jnp.arange(2) == 1).reshape(2, *(1,) * (multipliers.ndim - 1))
        apart = smaller & (logarithms[0] - logarithms[1] > math.log(2))
        other = jnp.exp(log_product) / multipliers[0]
        # The last term is the rounding of the logarithm.
        relative = errors[0] / jnp.abs(multipliers[0]) + np.finfo(float).eps * (4 + jnp.abs(log_product))
        errors = jnp.where(apart, relative * jnp.abs(other), errors)
        multipliers = jnp.where(apart, other, multipliers)
        logarithms = jnp.where(apart, log_product - logarithms[0], logarithms)
    if factors is not None:
        lacking = finite & jnp.any(~(errors < jnp.abs(multipliers)), axis=0)
        scale, sigma, wrong = jax.lax.cond(
            jnp.any(lacking), lambda: graded_multipliers(factors()), lambda: (logarithms, multipliers, errors)
        )
        better = ~bounded & (wrong / jnp.abs(sigma) < errors / jnp.abs(multipliers))
        unit = jnp.exp(scale - z.log_scale)
        multipliers, errors = jnp.where(better, unit * sigma, multipliers), jnp.where(better, unit * wrong, errors)
        logarithms = jnp.where(better, scale - z.log_scale + jnp.log(jnp.abs(sigma)), logarithms)
    size, known = jnp.exp(z.log_scale), errors < jnp.abs(multipliers)
    values = {
        "floquet_multiplier": multipliers * size,
        "floquet_multiplier_error": errors * size,
        "floquet_exponent": (logarithms + z.log_scale) / system.span,
    }
    return {name: jnp.where(known, x, jnp.nan) for name, x in values.items()}


def results(
    z: Monodromy,
    outputs: tuple[str, ...],
    rtol: float,
    model: FloquetModel,
    spectrum: Spectrum | None = None,
    factors: Callable[[], Factored] | None = None,
) -> dict[str, Array]:
    """The requested variables and the outcome from a monodromy matrix of ``model`` with trailing batch axes.

    Without damping stable means bounded, and the spectral radius of a stable point is 1.
    ``factors()`` are those of the matrix, computed if multipliers are asked for and lie below the error of the matrix.
    ``spectrum``: real and imaginary parts of the eigenvalues of ``z.matrix``, if known. Otherwise the spectral radius of
    four states comes from the closed form, and from eigenvalues only where the closed form is not accurate enough.
    """
    wanted = set(outputs)
    finite = jnp.all(jnp.isfinite(z.matrix), axis=(0, 1))
    size, balanced = jnp.exp(z.log_scale), z.balanced

    def eigen() -> Spectrum:
        return spectrum or eigenvalues(jnp.where(finite, balanced, jnp.nan))

    undamped = finite & model.is_hamiltonian()
    if wanted & MULTIPLIERS:
        spectrum = eigen()
    if spectrum is None and has_closed_form(balanced):
        rho, error, bounded = radius_in_closed_form(balanced, z.error, size, undamped, 10 * rtol)
    else:
        rho, error = radius_by_eigenvalues(eigen(), z.error)
        none = jnp.zeros_like(finite)
        bounded = undamped & jax.lax.cond(
            jnp.any(undamped), lambda: all_on_the_circle(*eigen(), z.error, size), lambda: none
        )
    # Compiled, the largest of moduli that are all NaN may be -inf.
    rho, error = (jnp.where(finite, x, jnp.nan) for x in (rho, error))
    rho, error = jnp.where(bounded, 1 / size, rho), jnp.where(bounded, _ROUNDING / size, error)
    values: dict[str, Array] = {}
    if spectrum and wanted & MULTIPLIERS:
        values = _of_multipliers(z, finite, bounded, spectrum, model.natural, factors)
    values |= {"spectral_radius": rho * size, "liouville_residual": jnp.where(finite, z.residual, jnp.nan)}
    met = z.met
    if wanted & NEED_ERROR:
        # A value that underflows is not 0, so its error bound is the smallest number.
        met = (error <= 10 * rtol * rho) & (rho * size >= _TINY)
        bound = jnp.maximum(error * size, _TINY)
        values |= {
            "spectral_radius_error": bound,
            "verdict": jnp.where(bounded, 0, verdict(rho * size, bound)).astype(jnp.int8),
        }
    outcome = jnp.where(met, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    outcome = jnp.where(finite, outcome, Outcome.NOT_FINITE)
    values = {name: values[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}
    # An unknown error has an infinite bound, but multipliers beyond the largest number have no value.
    return finite_results(values, gaps=MULTIPLIERS, infinite=("spectral_radius_error",))
