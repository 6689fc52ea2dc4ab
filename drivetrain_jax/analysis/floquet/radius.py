"""Spectral radius of a monodromy matrix with a bound of its error: from its eigenvalues, or in closed form.

The bound follows from the error of the coefficients of the characteristic polynomial. For four states the closed form of
:mod:`~drivetrain_jax.analysis.floquet.quartic` costs a tenth of the eigenvalues.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.multipliers import characteristic_coefficients, spectral_radius_bound
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues

# Real and imaginary parts of eigenvalues, ``(n, ...)`` each.
Spectrum = tuple[Array, Array]
Radius = tuple[Array, Array]
# Roundings in a coefficient, in units of eps times a power of the matrix's norm.
_ROUNDINGS = 16.0


def has_closed_form(z: Array) -> bool:
    """True if ``z`` ``(n, n, ...)`` has four states, and lanes as its only batch axis (single points gain nothing)."""
    return len(z) == 4 and z.ndim == 3


def radius_by_eigenvalues(spectrum: Spectrum, error: Array) -> Radius:
    """Spectral radius and bound; ``error`` bounds the errors of the coefficients a_k in units of rho^k."""
    return jnp.max(jnp.hypot(*spectrum), axis=0), spectral_radius_bound(*spectrum, error)


def radius_in_closed_form(z: Array, error: Array, scale: Array, tolerance: float) -> Radius:
    """Spectral radius and bound of ``z`` ``(4, 4, N)``, by eigenvalues only in lanes where the closed form is insufficient.

    The closed form is insufficient if its bound is not tight, exceeds ``tolerance`` rho, or leaves open on which side of 1
    ``scale`` rho lies.
    """
    a = characteristic_coefficients(z)
    # Use the determinant of the matrix even if the exact value is known: multipliers that nearly meet move far less with
    # the matrix than with a single coefficient.
    c = quartic.Coefficients(-a[0], a[1], -a[2], jnp.sqrt(jnp.sqrt(a[3])), (0.0,) * 4)  # pyright: ignore[reportArgumentType]
    split = quartic.factors(c)
    size, norm = jnp.maximum(split[0].large, split[1].large), jnp.sqrt(jnp.sum(z**2, axis=(0, 1)))
    # The recursion for a_k multiplies k matrices.
    errors = tuple(error * size**k + _ROUNDINGS * quartic.EPS * norm**k for k in (1, 2, 3, 4))
    rho, bound, unsure = quartic.spectral_radius(c._replace(errors=errors), split)
    certain = ~unsure & (bound <= tolerance * rho) & (jnp.abs(scale * rho - 1) > scale * bound)

    def repaired() -> Radius:
        found = radius_by_eigenvalues(eigenvalues(z), error)
        return tuple(jnp.where(certain, *pair) for pair in zip((rho, bound), found, strict=True))  # pyright: ignore[reportReturnType]

    return jax.lax.cond(jnp.all(certain), lambda: (rho, bound), repaired)
