"""Derivatives of Floquet multipliers by the parameters of a system, by the adjoint of the collocation.

A simple multiplier s of ``Z`` moves by ``ds = tr(B dZ) / p'(s)``, where ``p(s) = det(s I - Z)`` and B is the adjugate of
``s I - Z``. The gradient of ``sum(W * Z)`` for given weights W costs about as much for many parameters as for one
(:mod:`~drivetrain_jax.analysis.floquet.adjoint`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet.adjoint import Build, direct_form, propagators, weighted_gradient
from drivetrain_jax.analysis.floquet.direct import assemble
from drivetrain_jax.analysis.floquet.multipliers import sort_multipliers
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues

# Relative difference below which two moduli are equal up to rounding, as all moduli are without damping.
TIED = 1e-11
# Relative error of Z with the panels predicted for 1e-13: the largest at 600 random cardan shafts was 2.2e-12.
_MATRIX_ERROR = 3e-12
# Below this |p'(s)|, in units of the spectral radius, a multiplier s does not count as simple.
_SIMPLE = 1e-7


class DifferentiableMonodromy(NamedTuple):
    """The monodromy matrix ``exp(log_scale) z``, ``(n, n)``.

    ``pull(weights)`` is the gradient ``(F, P)`` of ``sum(weights * z)`` for ``weights`` ``(F, n, n)`` at a fixed log_scale.
    """

    z: Array
    log_scale: Array
    pull: Callable[[Array], Array]


class Multipliers(NamedTuple):
    """Multipliers ``sigma`` by falling modulus, ``(n,)``, and their derivatives by the entries of the matrix, ``(n, n, n)``.

    A derivative is NaN where its multiplier is not simple, or below its error. ``error`` is the relative error of the first
    multiplier, which grows where multipliers coalesce.
    """

    sigma: Array
    by_entry: Array
    error: Array


def monodromy(build: Build, parameters: Any, constants: Constants, panels: Array) -> DifferentiableMonodromy:
    """The monodromy matrix of one point in ``panels`` panels, differentiable by ``parameters``, a pytree of P numbers."""
    parts = propagators(build, parameters, constants, panels)
    phi = parts[0]
    for later in parts[1:]:
        phi = later @ phi
    # Scaled to 1, so that its square, Z, does not overflow.
    size = jnp.max(jnp.abs(phi))

    def z(parameters: Any, phi: Array) -> Array:
        return assemble(direct_form(build, parameters, constants).ends(), phi)

    value, pull_back = jax.vjp(z, parameters, phi / size)
    halves = direct_form(build, parameters, constants).halves

    def pull(weights: Array) -> Array:
        gradient, weights = jax.vmap(pull_back)(weights)
        weights = weights / size
        for number in reversed(range(len(parts))):
            before = jnp.eye(len(phi))
            for earlier in parts[:number]:
                before = earlier @ before
            own = weighted_gradient(build, parameters, constants, number, before, weights, panels)
            gradient = jax.tree.map(jnp.add, gradient, own)
            weights = parts[number].T @ weights
        return jnp.stack(jax.tree.leaves(gradient), axis=1)

    return DifferentiableMonodromy(value, halves * jnp.log(size), pull)


def multipliers(z: Array) -> Multipliers:
    """The multipliers of ``z``, ``(n, n)``."""
    n = len(z)
    sigma = sort_multipliers(*(x[..., None] for x in eigenvalues(z)))[:, 0]
    rho = jnp.abs(sigma[0])
    # Faddeev and Le Verrier: the adjugate of s I - Z is sum_j s^(n-1-j) N_j.
    terms = [jnp.eye(n)]
    for k in range(1, n):
        product = z @ terms[-1]
        terms.append(product - jnp.trace(product) / k * jnp.eye(n))
    adjugate = jnp.stack([sigma[:, None, None] ** (n - 1 - j) * term for j, term in enumerate(terms)]).sum(axis=0)
    slope = jnp.trace(adjugate, axis1=1, axis2=2)
    simple = jnp.abs(slope) > _SIMPLE * rho ** (n - 1)
    error = _MATRIX_ERROR * jnp.linalg.norm(adjugate, axis=(1, 2)) * jnp.linalg.norm(z) / jnp.abs(slope)
    known = simple & (error < jnp.abs(sigma))
    by_entry = jnp.swapaxes(adjugate, 1, 2) / jnp.where(known, slope, jnp.nan)[:, None, None]
    return Multipliers(sigma, by_entry, error[0] / rho)


def shares_modulus(sigma: Array, error: Array | float) -> Array:
    """True where a multiplier besides the first and its conjugate has the largest modulus, within the relative ``error``."""
    modulus = jnp.abs(sigma)
    apart = jnp.abs(sigma - jnp.conj(sigma[0]))
    # Real multipliers are their own conjugate.
    partner = (apart == jnp.min(apart)) & (jnp.abs(sigma[0].imag) > 1e-12 * modulus[0])
    others = jnp.where(partner | (jnp.arange(len(sigma)) == 0), 0.0, modulus)
    return jnp.max(others) > modulus[0] * (1 - jnp.maximum(TIED, error))
