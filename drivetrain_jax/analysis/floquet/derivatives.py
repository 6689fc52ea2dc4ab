"""Derivatives of Floquet multipliers by the parameters of a system.

With ``Phi' = A Phi`` the derivative by a parameter p obeys ``(d Phi/dp)' = A d Phi/dp + (dA/dp) Phi``. Both equations
together are a linear periodic system of twice the size, integrated like any other system, with the parameters as lanes.
A simple multiplier s moves by ``ds = tr(B dZ) / p'(s)``, where ``p(s) = det(s I - Z)`` and B is the adjugate of
``s I - Z``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet.direct import assemble
from drivetrain_jax.analysis.floquet.multipliers import sort_multipliers
from drivetrain_jax.analysis.floquet.propagator import EqualSteps, Order8, through
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Relative difference below which two moduli are equal up to rounding, as all moduli are without damping.
TIED = 1e-11
# Relative error of Z with the steps predicted for 1e-11: the largest at 600 random cardan shafts was 2.5e-12.
_MATRIX_ERROR = 3e-12
# Below this |p'(s)|, in units of the spectral radius, a multiplier s does not count as simple.
_SIMPLE = 1e-7

Build = Callable[[Any], FloquetModel]


class Change(NamedTuple):
    """The monodromy matrix ``exp(log_scale) z``, ``(n, n)``, and its derivatives ``exp(log_scale) dz``, ``(P, n, n)``."""

    z: Array
    dz: Array
    log_scale: Array


class _Varied(eqx.Module):
    """One linear system of twice the size: a system and its derivative along ``direction``, between two breakpoints.

    The unit of time is the span of the ``part``, so that derivatives include the motion of its ends.
    """

    parameters: Any
    direction: Any
    build: Build = eqx.field(static=True)
    constants: Constants = eqx.field(static=True)
    part: int = eqx.field(static=True)

    def rows(self, s: Any) -> tuple[tuple[Any, ...], ...]:
        """``((A, 0), (dA, A))`` at the fraction s of the span."""
        sizes: list[int] = []

        def entries(parameters: Any) -> dict[tuple[int, int], Array]:
            form = reduced_form(self.build, parameters, self.constants).parts[self.part]
            sizes.append(form.size)
            return {place: form.span * x for place, x in form.entries(*form.basis(s * form.span)).items()}

        both = jax.tree.map(lambda x, dx: tuple(jnp.broadcast_arrays(x, dx)), self.parameters, self.direction)
        given, along = (
            jax.tree.map(lambda pair, i=i: pair[i], both, is_leaf=lambda x: isinstance(x, tuple) and len(x) == 2)
            for i in (0, 1)
        )
        a, da = jax.jvp(entries, (given,), (along,))
        states = range(sizes[0])
        upper, lower = ([[x.get((i, j), 0) for j in states] for i in states] for x in (a, da))
        nothing = [0] * len(states)
        changed = [(*change, *row) for change, row in zip(lower, upper, strict=True)]
        return (*((*row, *nothing) for row in upper), *changed)


def reduced_form(build: Build, parameters: Any, constants: Constants) -> LinearPeriodic:
    """The reduced form of the system with these ``parameters`` (arrays) and ``constants`` (all else)."""
    return build(eqx.combine(parameters, constants.tree)).reduced


def monodromy_change(
    build: Build, parameters: Any, constants: Constants, steps: Array, solver: type[EqualSteps] = Order8
) -> Change:
    """The monodromy matrix of one point in ``steps`` steps, and its derivatives by ``parameters``, a pytree of P numbers."""
    leaves, tree = jax.tree.flatten(parameters)
    parts = len(reduced_form(build, parameters, constants).breakpoints) + 1

    def along(direction: Array) -> Change:
        direction = jax.tree.unflatten(tree, list(direction))
        varied = [_Varied(parameters, direction, build, constants, part).rows for part in range(parts)]
        found = through([LinearPeriodic(rows, 1.0) for rows in varied], steps, 1, solver)
        n = len(found.matrix) // 2
        phi, change = found.matrix[:n, :n], found.matrix[n:, :n]

        def z(parameters: Any, phi: Array) -> Array:
            return assemble(reduced_form(build, parameters, constants), phi)

        halves = reduced_form(build, parameters, constants).halves
        return Change(*jax.jvp(z, (parameters, phi), (direction, change)), halves * found.log_scale)  # pyright: ignore[reportCallIssue]

    found = jax.vmap(along)(jnp.eye(len(leaves)))
    return Change(found.z[0], found.dz, found.log_scale[0])


def multiplier_change(change: Change) -> tuple[Array, Array, Array]:
    """Multipliers by falling modulus ``(n,)``, their derivatives ``(n, P)``, and the relative error of the first multiplier.

    Multipliers and derivatives are in units of ``exp(log_scale)``. A derivative is NaN where its multiplier is not simple.
    The error grows where multipliers coalesce.
    """
    z, n = change.z, len(change.z)
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
    moved = jnp.einsum("sij,pji->sp", adjugate, change.dz)
    condition = jnp.linalg.norm(adjugate[0]) * jnp.linalg.norm(z) / jnp.abs(slope[0])
    slopes = jnp.where(simple[:, None], moved / jnp.where(simple, slope, 1.0)[:, None], jnp.nan)
    return sigma, slopes, _MATRIX_ERROR * condition / rho


def radius_change(sigma: Array, moved: Array, error: Array | float) -> Array:
    """Derivatives of the spectral radius ``(P,)`` from the multipliers ``sigma`` and their derivatives ``moved``.

    NaN where the largest modulus is shared, within the relative ``error``, by more than one multiplier and its conjugate.
    """
    modulus = jnp.abs(sigma)
    apart = jnp.abs(sigma - jnp.conj(sigma[0]))
    # Real multipliers are their own conjugate.
    partner = (apart == jnp.min(apart)) & (jnp.abs(sigma[0].imag) > 1e-12 * modulus[0])
    others = jnp.where(partner | (jnp.arange(len(sigma)) == 0), 0.0, modulus)
    tied = jnp.max(others) > modulus[0] * (1 - jnp.maximum(TIED, error))
    slope = (jnp.conj(sigma[0]) * moved[0]).real / modulus[0]
    return jnp.where(tied, jnp.nan, slope)
