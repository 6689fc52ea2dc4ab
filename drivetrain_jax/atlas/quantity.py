"""The functions that an atlas interpolates, and the norm of their errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.floquet.direct import Monodromy, assemble
from drivetrain_jax.analysis.floquet.multipliers import characteristic_coefficients
from drivetrain_jax.analysis.floquet.results import results
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.systems import FloquetModel, LinearPeriodic


def _norm(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(values**2, axis=-1))


def _largest(values: np.ndarray) -> np.ndarray:
    return np.full(len(values), np.max(_norm(values), initial=0.0))


def distance(fitted: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Euclidean norms of the differences, ``(N, m)`` both, ``(N,)``."""
    return _norm(fitted - exact)


def _nothing(values: np.ndarray) -> np.ndarray:
    return np.empty((len(values), 0))


@dataclass(frozen=True)
class Quantity:
    """``size`` smooth functions of the parameters. All functions below take values ``(N, size)`` of N points.

    ``scale(values)`` ``(N,)``: the tolerance of an atlas limits the error of the values (Euclidean norm) divided by this;
    default: the largest norm among the points. ``derived(values)`` ``(N, k)``: numbers with error bounds of their own,
    because bounds derived from that of the values would be too wide; default: none.
    """

    size: int
    scale: Callable[[np.ndarray], np.ndarray] = _largest
    derived: Callable[[np.ndarray], np.ndarray] = _nothing


# The propagator of a periodic system as the quantity of an atlas, and the decision of single cells.


Build = Callable[[Mapping[str, Any]], FloquetModel]


def floquet_quantity(form: LinearPeriodic) -> Quantity:
    """Entries of ``Phi`` of ``form`` by rows; errors are measured on the monodromy matrix, relative to its size.

    Derived numbers are the coefficients a_k of det(sigma I - Z), without the last one if Liouville's formula gives it.
    """
    x = None if form.reversor is None else np.array(form.reversor)
    n = form.size if x is None else len(x)
    count = n if form.log_determinant is None else n - 1

    def monodromy(values: np.ndarray) -> np.ndarray:
        phi = values.reshape(-1, n, n)
        return phi if x is None else x @ np.swapaxes(phi, 1, 2) @ x @ phi

    def scale(values: np.ndarray) -> np.ndarray:
        # |dZ| <= 2 |Phi| |dPhi| where Z is a product of two factors Phi.
        size = np.linalg.norm(monodromy(values), axis=(1, 2))
        return size if x is None else size / (2 * np.linalg.norm(values, axis=1))

    def derived(values: np.ndarray) -> np.ndarray:
        return _characteristic_coefficients(monodromy(values))[:, :count]

    return Quantity(n * n, scale, derived)


def _characteristic_coefficients(z: np.ndarray) -> np.ndarray:
    """As :func:`characteristic_coefficients`, ``(N, n, n) -> (N, n)``, in NumPy.

    JAX would trace every step, which does not pay for few points.
    """
    power, found = z, []
    for k in range(1, z.shape[1] + 1):
        found.append(-np.trace(power, axis1=1, axis2=2) / k)
        power = z @ power + found[-1][:, None, None] * z
    return np.stack(found, axis=-1)


def results_of_propagator(
    phi: Array, build: Build, values: Mapping[str, Any], errors: Array, outputs: tuple[str, ...], rtol: float
) -> dict[str, Array]:
    """Results of the floquet analysis for lanes of ``Phi``, its entries by rows ``(n n, N)``, by eigenvalues of Z.

    ``values`` holds all parameters, each a number or an array ``(N,)``; ``errors`` ``(k, N)`` the bounds of the a_k.
    """
    model = build(values)
    form, n = model.reduced, model.reduced.size
    matrix = phi.reshape(n, n, -1)
    z = assemble(form.ends(), matrix)
    a = characteristic_coefficients(z)
    spectrum = eigenvalues(z)
    rho = jnp.max(jnp.hypot(*spectrum), axis=0)
    relative = jnp.max(jnp.stack([errors[k] / rho ** (k + 1) for k in range(errors.shape[0])]), axis=0)
    residual = jnp.zeros_like(rho)
    if form.log_determinant is not None:
        residual = ((-1) ** n * a[-1] - jnp.exp(form.log_determinant())) / rho**n
        relative = jnp.maximum(relative, jnp.abs(residual))
    halves = form.halves
    rounding = 4 * np.finfo(float).eps * jnp.sum(matrix**2, axis=(0, 1)) ** (halves / 2) / rho
    monodromy = Monodromy(z, jnp.zeros_like(rho), relative + rounding, relative <= 10 * rtol, residual)
    return results(monodromy, outputs, rtol, model, spectrum=spectrum)
