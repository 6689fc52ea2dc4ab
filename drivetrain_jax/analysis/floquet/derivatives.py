"""Derivatives of Floquet multipliers by the parameters of a system, by the adjoint of the collocation.

A simple multiplier s of ``Z`` moves by ``ds = tr(B dZ) / p'(s)``, where ``p(s) = det(s I - Z)`` and B is the adjugate of
``s I - Z``. The gradient of ``sum(W * Z)`` for given weights W costs about as much for many parameters as for one, by the
discrete adjoint of the march.

With the propagators ``P_k`` of the panels the change of ``sum(W * Phi)`` is the sum over k of
``(P_K ... P_{k+1})^T W (P_{k-1} ... P_1)^T * dP_k``, entry by entry. The factors on the right are marched forwards and those
on the left backwards; states are kept on two levels.

A panel is ``P = P0 + B M^(-1) R``. With the unknowns ``X = M^(-1) R`` of unit states, the multipliers ``L = (B M^(-1))^T W``
and the stage values ``V_t`` that the coefficients ``E_t`` multiply, ``dP = B M^(-1) sum_t dE_t V_t``: the gradient of
``sum(W * P)`` by ``E_t`` at a node is ``L V_t^T`` there. Gauss schemes are self-adjoint, so L is the same scheme's solution
of the adjoint equation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from math import isqrt
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet.direct import assemble
from drivetrain_jax.analysis.floquet.effort import MAX_PANELS
from drivetrain_jax.analysis.floquet.multipliers import sort_multipliers
from drivetrain_jax.analysis.floquet.propagator import ORDER, Panels
from drivetrain_jax.analysis.numerics.kernels import FULL_WIDTH
from drivetrain_jax.analysis.numerics.lanes import Constants, lanes_last
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, matmul
from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# States kept on each of two levels, enough for the most panels, and lanes per block.
_KEPT, _LANES = 1 + isqrt(MAX_PANELS), 32

Build = Callable[[Any], FloquetModel]


def direct_form(build: Build, parameters: Any, constants: Constants) -> LinearPeriodic:
    """The marched form of the system with these ``parameters`` (arrays) and ``constants`` (all else)."""
    return build(eqx.combine(parameters, constants.tree)).direct


def propagators(build: Build, parameters: Any, constants: Constants, count: Array) -> Array:
    """The propagators of one point between its breakpoints, in ``count`` panels each, ``(parts, n, n)``."""
    return lanes_last(_marched, Constants((build, constants)), parameters, count, _LANES)


def _marched(fixed: Constants, parameters: Any, count: Array) -> Array:
    build, constants = fixed.tree
    form = direct_form(build, parameters, constants)
    lanes = max((x.shape[-1] for x in jax.tree.leaves(parameters) if x.ndim), default=1)
    unit = jnp.broadcast_to(jnp.eye(form.size)[..., None], (form.size, form.size, lanes))

    def through(part: LinearPeriodic) -> Array:
        panels = Panels(part)
        factor = partial(panels.propagator, panels.fixed, count, few=lanes <= FULL_WIDTH)
        return jax.lax.fori_loop(0, count, lambda k, y: matmul(factor(k), y), unit)

    return jnp.stack([through(part) for part in form.parts])


def weighted_gradient(
    build: Build, parameters: Any, constants: Constants, number: int, before: Array, weights: Array, count: Array
) -> Any:
    """The gradient ``(F,)`` of ``sum(weights * (Phi before))`` by each parameter, in ``count`` panels.

    Phi is the propagator of the part ``number`` between breakpoints; ``before`` is ``(n, n)`` and ``weights`` ``(F, n, n)``.
    """
    fixed = Constants((build, constants, number))
    return lanes_last(_pulled, fixed, (parameters, before, weights), count, _LANES)


def _pulled(fixed: Constants, arrays: tuple[Any, Array, Array], count: Array) -> Any:
    """The :func:`weighted_gradient` of all lanes, which are the last axis of each array."""
    parameters, before, weights = arrays
    lanes = max(x.shape[-1] for x in jax.tree.leaves(arrays) if x.ndim)
    parameters = jax.tree.map(lambda x: jnp.broadcast_to(x, lanes), parameters)
    before, weights = (jnp.broadcast_to(x, (*x.shape[:-1], lanes)) for x in (before, weights))
    build, constants, number = fixed.tree
    long = -(-count // _KEPT)
    short = -(-count // long)
    count = long * short

    def factor(k: Array, parameters: Any) -> Array:
        panels = Panels(direct_form(build, parameters, constants).parts[number])
        return panels.propagator(panels.fixed, count, k, lanes <= FULL_WIDTH)

    def onward(start: Array, length: Array, y: Array) -> Array:
        return jax.lax.fori_loop(start, start + length, lambda k, y: matmul(factor(k, parameters), y), y)

    def interval(step: Array, carry: tuple[Array, Any, Array]) -> tuple[Array, Any, Array]:
        """First the states before the long intervals; then, for each of these from the last, before its panels."""
        kept, gradient, weights = carry
        first = step == 0
        level, k = jnp.where(first, 0, 1), jnp.where(first, 0, long - step)
        number, length = jnp.where(first, long, short), jnp.where(first, short, 1)

        def forwards(i: Array, kept: Array) -> Array:
            return kept.at[level, i + 1].set(onward(k * short + i * length, length, kept[level, i]))

        def back(j: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            i = short - 1 - j
            matrix, pull = jax.vjp(partial(factor, k * short + i), parameters)
            weight = jnp.sum(carry[1][:, :, None] * kept[1, i][None, None], axis=3)
            (more,) = jax.vmap(pull)(weight)
            earlier = jax.vmap(matmul, (None, 0))(jnp.swapaxes(matrix, 0, 1), carry[1])
            return jax.tree.map(jnp.add, carry[0], more), earlier

        kept = jax.lax.fori_loop(0, number - 1, forwards, kept.at[level, 0].set(kept[0, k]))
        gradient, weights = jax.lax.fori_loop(0, jnp.where(first, 0, short), back, (gradient, weights))
        return kept, gradient, weights

    kept = jnp.zeros((2, _KEPT, *before.shape)).at[0, 0].set(before)
    none = jax.tree.map(lambda x: jnp.zeros((len(weights), *x.shape)), parameters)
    return jax.lax.fori_loop(0, long + 1, interval, (kept, none, weights))[1]


# Relative difference below which two moduli are equal up to rounding, as all moduli are without damping.
TIED = 1e-11
# Least relative error of Z: with the panels predicted for 1e-13 the largest at 600 random cardan shafts was 2.2e-12.
_MATRIX_ERROR = 3e-12
# Ratio of the errors of half as many panels and all, with three orders in reserve.
_GAIN = 2.0 ** (ORDER - 3)
# Change of the propagator by the last doubling of the panels, and most doublings, counted from half of the predicted panels.
_CONVERGED, _MOST_DOUBLINGS = 1e-7, 7
# Below this |p'(s)|, in units of the spectral radius, a multiplier s does not count as simple.
_SIMPLE = 1e-7


def monodromy(
    build: Build, parameters: Any, constants: Constants, panels: Array
) -> tuple[Array, Array, Array, Callable[[Array], Array]]:
    """The monodromy matrix ``exp(log_scale) z`` of one point, in at least ``panels`` panels: ``z``, ``log_scale``, error,
    gradient.

    The error is the relative one of z. The last result maps ``weights`` ``(F, n, n)`` to the gradient ``(F, P)`` of
    ``sum(weights * z)`` at a fixed log_scale by ``parameters``, a pytree of P numbers.
    """
    panels, parts, phi, change = _refined(partial(propagators, build, parameters, constants), panels)
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
            gradient_of_part = weighted_gradient(build, parameters, constants, number, before, weights, panels)
            gradient = jax.tree.map(jnp.add, gradient, gradient_of_part)
            weights = parts[number].T @ weights
        return jnp.stack(jax.tree.leaves(gradient), axis=1)

    error = jnp.maximum(_MATRIX_ERROR, halves * change / _GAIN)
    return value, halves * jnp.log(size), error, pull


def _refined(factors: Callable[[Array], Array], panels: Array) -> tuple[Array, Array, Array, Array]:
    """The number of panels, ``factors`` of it ``(parts, n, n)``, their product, and its relative change by a doubling.

    Half of the predicted number shows the error, because nothing else checks the prediction, and so do further doublings.
    """
    shape = jax.eval_shape(factors, panels)

    def unfinished(state: tuple[Array, ...]) -> Array:
        doublings, count, *_, change = state
        return (doublings < 1) | ((doublings < _MOST_DOUBLINGS) & (2 * count <= MAX_PANELS) & (change > _CONVERGED))

    def double(state: tuple[Array, ...]) -> tuple[Array, ...]:
        doublings, count, _, before, _ = state
        # The first time, half of the predicted number.
        count = jnp.where(doublings < 0, (panels + 1) // 2, jnp.where(doublings == 0, panels, 2 * count))
        parts = factors(count)
        phi = reduce(lambda earlier, later: later @ earlier, parts)
        return doublings + 1, count, parts, phi, jnp.linalg.norm(phi - before) / jnp.linalg.norm(phi)

    start = jnp.int32(-1), panels, jnp.zeros(shape.shape), jnp.zeros(shape.shape[1:]), jnp.asarray(jnp.inf)
    _, count, parts, phi, change = jax.lax.while_loop(unfinished, double, start)
    return count, parts, phi, change


def multipliers(z: Array, matrix_error: Array) -> tuple[Array, Array, Array]:
    """The multipliers of ``z``, ``(n, n)``, whose relative error is ``matrix_error``, by falling modulus, ``(n,)``; their
    derivatives by the entries of z, ``(n, n, n)``; and the relative error of the first one.

    A derivative is NaN where its multiplier is not simple, or below its error, which grows where multipliers coalesce.
    """
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
    error = matrix_error * jnp.linalg.norm(adjugate, axis=(1, 2)) * jnp.linalg.norm(z) / jnp.abs(slope)
    known = simple & (error < jnp.abs(sigma))
    by_entry = jnp.swapaxes(adjugate, 1, 2) / jnp.where(known, slope, jnp.nan)[:, None, None]
    return sigma, by_entry, error[0] / rho


def shares_modulus(sigma: Array, error: Array | float) -> Array:
    """True where a multiplier besides the first and its conjugate has the largest modulus, within the relative ``error``."""
    modulus = jnp.abs(sigma)
    apart = jnp.abs(sigma - jnp.conj(sigma[0]))
    # Real multipliers are their own conjugate.
    partner = (apart == jnp.min(apart)) & (jnp.abs(sigma[0].imag) > 1e-12 * modulus[0])
    others = jnp.where(partner | (jnp.arange(len(sigma)) == 0), 0.0, modulus)
    return jnp.max(others) > modulus[0] * (1 - jnp.maximum(TIED, error))
