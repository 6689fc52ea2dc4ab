"""The results of the floquet analysis from a monodromy matrix, however that was obtained."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.analysis.periodic.direct import Monodromy
from drivetrain_jax.analysis.periodic.multipliers import VERDICTS, sort_multipliers, spectral_radius_bound, verdict

VARIABLES = (
    Variable("floquet_multiplier", "1", "Floquet multiplier over one period", ("multiplier",), "complex128"),
    Variable("floquet_exponent", "1/s", "real part of the Floquet exponent", ("multiplier",)),
    Variable("spectral_radius", "1", "largest modulus of the Floquet multipliers"),
    Variable("spectral_radius_error", "1", "bound of the absolute error of spectral_radius"),
    Variable("verdict", "1", "stability of the equilibrium", dtype="int8", flags=VERDICTS),
    Variable(
        "liouville_residual", "1", "determinant of the monodromy matrix minus its exact value, over spectral_radius^n"
    ),
)
NEED_ERROR = {"spectral_radius_error", "verdict"}


def results(z: Monodromy, outputs: tuple[str, ...], rtol: float, period: Any) -> dict[str, Array]:
    """The requested variables and the outcome from a monodromy matrix with trailing batch axes."""
    wanted = set(outputs)
    finite = jnp.all(jnp.isfinite(z.matrix), axis=(0, 1))
    real, imaginary = eigenvalues(jnp.where(finite, z.matrix, jnp.nan))
    size = jnp.exp(z.log_scale)
    rho = jnp.max(jnp.hypot(real, imaginary), axis=0) * size
    found = {"spectral_radius": rho}
    outcome, met = jnp.where(finite, Outcome.SUCCESS, Outcome.NOT_FINITE), z.met
    if wanted & {"floquet_multiplier", "floquet_exponent"}:
        multipliers = sort_multipliers(real, imaginary)
        found["floquet_multiplier"] = multipliers * size
        found["floquet_exponent"] = (jnp.log(jnp.abs(multipliers)) + z.log_scale) / period
    if "liouville_residual" in wanted:
        found["liouville_residual"] = jnp.where(finite, z.residual, jnp.nan)
    if wanted & NEED_ERROR:
        error = spectral_radius_bound(real, imaginary, z.error) * size
        met = error <= 10 * rtol * rho
        found |= {"spectral_radius_error": error, "verdict": verdict(rho, error)}
    outcome = jnp.where(finite & ~met, Outcome.TOLERANCE_NOT_MET, outcome)
    return {name: found[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}
