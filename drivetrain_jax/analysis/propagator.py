"""Propagators of linear periodic systems by fixed steps: an explicit scheme of order 8 and an L-stable implicit one.

Both give ``Phi`` over ``[0, span]`` of a :class:`~drivetrain_jax.systems.LinearPeriodic` with the number of steps as a
traced integer, so that one compilation serves every accuracy. The explicit scheme broadcasts over a trailing batch
axis, keeps every matrix as rows of shape ``(n, ...)`` (XLA then fuses whole stages over the batch) and evaluates the
clock functions once for all lanes. The implicit one is for a single point.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.integrate import DOP853

from drivetrain_jax.analysis.linear_algebra import solve
from drivetrain_jax.systems import LinearPeriodic


class Propagator(NamedTuple):
    """``Phi = exp(log_scale) matrix``, shape ``(n, n, ...)``."""

    matrix: Array
    log_scale: Array


def _row_product(rows: tuple, y: list[Array]) -> list[Array]:
    """``A y`` for nested rows with structural zeros and ``y`` as a list of rows."""
    return [sum(a * x for a, x in zip(row, y, strict=True) if not (isinstance(a, int) and a == 0)) for row in rows]


# Order of the explicit scheme; the tableau is Hairer, Norsett & Wanner's DOP853 as kept by SciPy.
EXPLICIT_ORDER = 8


def explicit_propagator(system: LinearPeriodic, steps: Array, shape: tuple[int, ...]) -> Propagator:
    """``Phi`` by ``steps`` equal steps of the 12-stage Runge-Kutta scheme of order 8 (DOP853), batch shape ``shape``."""
    a, b, c = DOP853.A, DOP853.B, DOP853.C
    n = system.size
    h = system.span / steps
    identity = [jnp.zeros((n, *shape)).at[i].set(1.0) for i in range(n)]

    def nodes(step: Array) -> tuple[Array, ...]:
        return system.basis((step + c) * h)

    def body(step: Array, carry: tuple) -> tuple:
        y, basis = carry
        slopes: list[list[Array]] = []
        for stage in range(len(b)):
            weights = [(float(w), k) for w, k in zip(a[stage, :stage], slopes, strict=True) if w != 0]
            state = [x + h * sum(w * k[i] for w, k in weights) for i, x in enumerate(y)] if weights else y
            slopes.append(_row_product(system.rows(*(f[stage] for f in basis)), state))
        total = [sum(float(w) * k[i] for w, k in zip(b, slopes, strict=True) if w != 0) for i in range(n)]
        # The next step's clock functions travel in the carry: computed once per step instead of once per lane.
        return [x + h * dx for x, dx in zip(y, total, strict=True)], nodes(step + 1)

    rows, _ = jax.lax.fori_loop(0, steps, body, (identity, nodes(jnp.zeros((), steps.dtype))))
    return Propagator(jnp.stack(rows), jnp.zeros(shape))


@lru_cache
def radau_iia(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients ``(A, c)`` of the Radau IIA collocation scheme of order ``2 stages - 1``.

    The nodes are the zeros of P_s - P_(s-1) shifted to [0, 1]; A[i, j] = int_0^c_i l_j, by Gauss quadrature of the
    Lagrange polynomials in product form (Hairer & Wanner, Solving ODEs II, IV.5).
    """
    basis = np.polynomial.legendre.Legendre.basis
    polynomial = basis(stages) - basis(stages - 1)
    x = np.sort(polynomial.roots().real)
    for _ in range(3):
        x = x - polynomial(x) / polynomial.deriv()(x)
    c = (x + 1) / 2
    c[-1] = 1.0
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    points = c[:, None] * (nodes + 1) / 2
    lagrange = np.ones((stages, *points.shape))
    for j in range(stages):
        for k in set(range(stages)) - {j}:
            lagrange[j] *= (points - c[k]) / (c[j] - c[k])
    return np.einsum("jiq,q->ij", lagrange, weights / 2) * c[:, None], c


STAGES = 8
# What the errors fall with at least, for stiff problems too (the stage order; the classical order is 15).
IMPLICIT_ORDER = 8


def implicit_propagator(system: LinearPeriodic, steps: Array) -> Propagator:
    """``Phi`` of one point by ``steps`` equal panels of Radau IIA collocation with 8 stages (order 15, L-stable).

    The stage values solve ``Y_i - h sum_j a_ij A(t_j) Y_j = I``; the last one is the panel's propagator. The product
    is rescaled after each panel, so that strong damping does not underflow.
    """
    a, c = radau_iia(STAGES)
    h = system.span / steps
    n = system.size
    right = jnp.tile(jnp.eye(n), (STAGES, 1))
    at_nodes = jax.vmap(system.matrix)

    def body(step: Array, carry: tuple) -> tuple:
        product, log_scale = carry
        blocks = jnp.einsum("ij,jkl->ikjl", h * a, at_nodes((step + c) * h)).reshape(STAGES * n, STAGES * n)
        product = solve(jnp.eye(STAGES * n) - blocks, right)[-n:] @ product
        size = jnp.max(jnp.abs(product))
        size = jnp.where(size > 0, size, 1.0)
        return product / size, log_scale + jnp.log(size)

    return Propagator(*jax.lax.fori_loop(0, steps, body, (jnp.eye(n), jnp.zeros(()))))
