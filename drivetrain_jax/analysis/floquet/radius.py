"""Spectral radius of a monodromy matrix with a bound of its error: from its eigenvalues, or in closed form.

The bound follows from the error of the coefficients of the characteristic polynomial. For four states the closed form of
:mod:`~drivetrain_jax.analysis.floquet.quartic` costs a tenth of the eigenvalues.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.multipliers import characteristic_coefficients, spectral_radius_bound
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored
from drivetrain_jax.analysis.numerics.lanes import in_blocks
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, square_sum

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


def radius_by_eigenvalues(spectrum: Spectrum, error: Array) -> Radius:
    """Spectral radius and bound; ``error`` bounds the errors of the coefficients a_k in units of rho^k."""
    return jnp.max(jnp.hypot(*spectrum), axis=0), spectral_radius_bound(*spectrum, error)


def radius_in_closed_form(z: Array, error: Array, scale: Array, tolerance: float) -> Radius:
    """Spectral radius and bound of ``z`` ``(4, 4, N)``, by eigenvalues only in lanes where the closed form is insufficient.

    The closed form is insufficient if its bound is not tight, exceeds ``tolerance`` rho, or leaves open on which side of 1
    ``scale`` rho lies.
    """
    lanes = z.shape[-1]

    def closed(given: tuple[Array, Array, Array], _: int) -> tuple[Array, Array, Array]:
        z, error, scale = given
        c, split = _coefficients(z, error)
        rho, bound, unsure = stored(quartic.spectral_radius)(c, split)
        return rho, bound, ~unsure & (bound <= tolerance * rho) & (jnp.abs(scale * rho - 1) > scale * bound)

    def repaired(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Some more lanes by eigenvalues."""
        rho, bound, certain = state
        chosen = jnp.nonzero(~certain, size=min(lanes, _REPAIRED), fill_value=jnp.argmin(certain))[0]
        found = radius_by_eigenvalues(eigenvalues(z[..., chosen]), error[chosen])
        return rho.at[chosen].set(found[0]), bound.at[chosen].set(found[1]), certain.at[chosen].set(True)

    start = in_blocks(closed, (z, error, scale), lanes, _BLOCK, in_one_kernel)
    return jax.lax.while_loop(lambda state: ~jnp.all(state[2]), repaired, start)[:2]


def _coefficients(z: Array, error: Array) -> tuple[quartic.Coefficients, tuple[Any, Any]]:
    """The coefficients of the characteristic polynomial with their errors, and its factors."""
    a = stored(characteristic_coefficients)(z)
    # Use the determinant of the matrix even if the exact value is known: multipliers that nearly meet move far less with
    # the matrix than with a single coefficient.
    c = quartic.Coefficients(-a[0], a[1], -a[2], stored(lambda x: jnp.sqrt(jnp.sqrt(x)))(a[3]), (0.0,) * 4)  # pyright: ignore[reportArgumentType]
    split = quartic.factors(c)
    size, norm = jnp.maximum(split[0].large, split[1].large), stored(lambda z: jnp.sqrt(square_sum(z)))(z)
    return c._replace(errors=stored(_errors)(error, size, norm)), split


def _errors(error: Array, size: Array, norm: Array) -> tuple[Array, ...]:
    # The recursion for a_k multiplies k matrices.
    return tuple(error * size**k + _ROUNDINGS * quartic.EPS * norm**k for k in (1, 2, 3, 4))
