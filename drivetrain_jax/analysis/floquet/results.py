"""The results of the floquet analysis from a monodromy matrix."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis._base import Outcome, finite_results
from drivetrain_jax.analysis.floquet.direct import Monodromy
from drivetrain_jax.analysis.floquet.multipliers import (
    VERDICTS,
    all_on_the_circle,
    multiplier_errors,
    sort_multipliers,
    verdict,
)
from drivetrain_jax.analysis.floquet.radius import (
    Spectrum,
    has_closed_form,
    radius_by_eigenvalues,
    radius_in_closed_form,
)
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

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


def _of_multipliers(z: Monodromy, finite: Array, spectrum: Spectrum, system: LinearPeriodic) -> dict[str, Array]:
    """Multipliers with their errors and exponents; NaN where the error exceeds the multiplier.

    As eigenvalues small multipliers have the absolute errors of large ones. The smaller one of two follows from their
    product, if that is known, where the moduli differ by more than a factor of two.
    """
    multipliers = jnp.where(finite, sort_multipliers(*spectrum), jnp.nan)
    errors = multiplier_errors(multipliers.real, multipliers.imag, z.error)
    logarithms = jnp.log(jnp.abs(multipliers))
    if len(multipliers) == 2 and system.log_determinant is not None:
        log_product = system.log_determinant() - 2 * z.log_scale
        apart = (jnp.arange(2) == 1).reshape(2, *(1,) * (multipliers.ndim - 1)) & (
            logarithms[0] - logarithms[1] > math.log(2)
        )
        other = jnp.exp(log_product) / multipliers[0]
        errors = jnp.where(apart, errors[0] / jnp.abs(multipliers[0]) * jnp.abs(other), errors)
        multipliers = jnp.where(apart, other, multipliers)
        logarithms = jnp.where(apart, log_product - logarithms[0], logarithms)
    size, known = jnp.exp(z.log_scale), errors < jnp.abs(multipliers)
    found = {
        "floquet_multiplier": multipliers * size,
        "floquet_multiplier_error": errors * size,
        "floquet_exponent": (logarithms + z.log_scale) / system.span,
    }
    return {name: jnp.where(known, x, jnp.nan) for name, x in found.items()}


def results(
    z: Monodromy,
    outputs: tuple[str, ...],
    rtol: float,
    model: FloquetModel,
    spectrum: Spectrum | None = None,
) -> dict[str, Array]:
    """The requested variables and the outcome from a monodromy matrix of ``model`` with trailing batch axes.

    Without damping stable means bounded, and the spectral radius of a stable point is 1.
    ``spectrum``: real and imaginary parts of the eigenvalues of ``z.matrix``, if known. Otherwise the spectral radius of
    four states comes from the closed form, and from eigenvalues only where the closed form is not accurate enough.
    """
    wanted = set(outputs)
    finite = jnp.all(jnp.isfinite(z.matrix), axis=(0, 1))
    size = jnp.exp(z.log_scale)

    def eigen() -> Spectrum:
        return spectrum or eigenvalues(jnp.where(finite, z.matrix, jnp.nan))

    if wanted & MULTIPLIERS:
        spectrum = eigen()
    if spectrum is None and has_closed_form(z.matrix):
        rho, error = radius_in_closed_form(z.matrix, z.error, size, 10 * rtol)
    else:
        rho, error = radius_by_eigenvalues(eigen(), z.error)
    # Compiled, the largest of moduli that are all NaN may be -inf.
    rho, error = (jnp.where(finite, x, jnp.nan) for x in (rho, error))
    undamped, nowhere = finite & model.is_hamiltonian(), jnp.zeros_like(finite)
    bounded = jax.lax.cond(
        jnp.any(undamped), lambda: undamped & all_on_the_circle(*eigen(), z.error, size), lambda: nowhere
    )
    rho, error = jnp.where(bounded, 1 / size, rho), jnp.where(bounded, _ROUNDING / size, error)
    found: dict[str, Array] = {}
    if spectrum and wanted & MULTIPLIERS:
        # On the circle without the error of the moduli.
        length = jnp.where(bounded, size * jnp.hypot(*spectrum), 1.0)
        found = _of_multipliers(z, finite, (spectrum[0] / length, spectrum[1] / length), model.natural)
    found |= {"spectral_radius": rho * size, "liouville_residual": jnp.where(finite, z.residual, jnp.nan)}
    met = z.met
    if wanted & NEED_ERROR:
        # A value that underflows is not 0, so its error bound is the smallest number.
        met = (error <= 10 * rtol * rho) & (rho * size >= _TINY)
        bound = jnp.maximum(error * size, _TINY)
        found |= {
            "spectral_radius_error": bound,
            "verdict": jnp.where(bounded, 0, verdict(rho * size, bound)).astype(jnp.int8),
        }
    outcome = jnp.where(met, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    outcome = jnp.where(finite, outcome, Outcome.NOT_FINITE)
    found = {name: found[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}
    # An unknown error has an infinite bound, but multipliers beyond the largest number have no value.
    return finite_results(found, gaps=MULTIPLIERS, infinite=("spectral_radius_error",))
