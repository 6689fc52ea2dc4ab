"""Propagators of linear periodic systems by fixed steps: an explicit scheme of order 8 and an L-stable implicit one.

Both give ``Phi`` over ``[0, span]`` of a :class:`~drivetrain_jax.systems.LinearPeriodic` with the number of steps as a
traced integer, so that one compilation serves every accuracy. The explicit scheme marches over a trailing batch axis as
one kernel, keeps every matrix as rows of shape ``(n, ...)`` and evaluates the entries of ``A`` at all stages of a step
together, what they share once (:mod:`~drivetrain_jax.analysis.numerics.staged`). The implicit one is for a single point.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics import dop853
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel
from drivetrain_jax.analysis.numerics.linear_algebra import matmul, solve
from drivetrain_jax.analysis.numerics.staged import staged
from drivetrain_jax.systems import LinearPeriodic


class Propagator(NamedTuple):
    """``Phi = exp(log_scale) matrix``, shape ``(n, n, ...)``.

    ``growth`` is how much larger at the end an error is that was made on the way than one made there, the root of the mean
    square of ``|Phi(T, t)| |Phi(t, 0)| / |Phi(T, 0)|`` (1 at t = T) over some instants; None if none were looked at.
    """

    matrix: Array
    log_scale: Array
    growth: Array | None = None


# Order of the explicit scheme.
EXPLICIT_ORDER = 8
# Lanes that should march together: what a step reads and writes stays in the innermost caches.
LANES = 32
# Pieces of the span between which the growth of errors is looked at, at most.
PIECES = 16

Rows = list[Array]


def explicit_propagator(
    system: LinearPeriodic, steps: Array, shape: tuple[int, ...], pieces: Array | int = 1
) -> Propagator:
    """``Phi`` by ``steps`` equal steps of the 12-stage Runge-Kutta scheme of order 8 (DOP853), batch shape ``shape``.

    Fastest for batches of up to about ``LANES``. The growth is looked at between so many ``pieces`` of the span, up to
    ``PIECES``.
    """
    zeros: list[list[bool]] = []

    def entries(*basis: Array) -> list[Array]:
        rows = system.rows(*basis)
        zeros[:] = [[isinstance(entry, int) and entry == 0 for entry in row] for row in rows]
        return [
            jnp.asarray(x, float)
            for row, no in zip(rows, zeros, strict=True)
            for x, z in zip(row, no, strict=True)
            if not z
        ]

    times = jnp.zeros((dop853.STAGES, 1))
    split = staged(entries, *jax.eval_shape(system.basis, times))
    suits = suits_one_kernel(lambda t: system.rows(*system.basis(t)), times)
    mark = in_one_kernel if suits else lambda function: function

    def march(first: Array, last: Array, h: Array, fixed: list[Array]) -> Rows:
        step = partial(_explicit_step, system.basis, partial(split.moving, fixed), tuple(map(tuple, zeros)), h)
        return jax.lax.fori_loop(first, last, step, _identity(len(zeros), shape[0] if shape else 1))

    def part(first: Array, last: Array) -> Propagator:
        rows = mark(march)(first, last, system.span / steps, split.fixed)
        return Propagator(jnp.stack(rows).reshape(len(zeros), len(zeros), *shape), jnp.zeros(shape))

    return _in_pieces(part, len(zeros), shape, steps, pieces)


def _in_pieces(
    part: Callable[[Array, Array], Propagator], n: int, shape: tuple[int, ...], steps: Array, pieces: Array | int
) -> Propagator:
    """``part(first, last)`` over all steps, as the product of what it is over ``pieces`` of them, and the growth; of batch
    shape ``shape`` for ``n`` states.

    ``C' = P C P^T + |Phi(t, 0)|^2 I`` sums that up over the ends t of the pieces P: the covariance of errors that are as
    large as ``Phi`` where they are made, and know nothing of each other.
    """
    pieces = jnp.asarray(pieces, steps.dtype)
    unit = jnp.broadcast_to(jnp.eye(n).reshape(n, n, *(1,) * len(shape)), (n, n, *shape))

    def onward(k: Array, state: tuple) -> tuple:
        product, log_scale, covariance = state
        own = part(k * steps // pieces, (k + 1) * steps // pieces)
        product, moved = stored(_moved)(own.matrix, product, covariance)
        size = jnp.max(jnp.abs(product), axis=(0, 1))
        size = jnp.where((pieces > 1) & (size > 0), size, 1.0)
        product = product / size
        covariance = moved / size**2 + jnp.sum(product**2, axis=(0, 1)) * unit
        return product, log_scale + own.log_scale + jnp.log(size), covariance

    start = unit, jnp.zeros(shape), jnp.zeros(unit.shape)
    product, log_scale, covariance = jax.lax.fori_loop(0, pieces, onward, start)
    trace = sum(covariance[i, i] for i in range(n))
    growth = jnp.sqrt(trace / (n * pieces * jnp.sum(product**2, axis=(0, 1))))
    return Propagator(product, log_scale, growth=growth)


def _moved(piece: Array, product: Array, covariance: Array) -> tuple[Array, Array]:
    return matmul(piece, product), matmul(matmul(piece, covariance), jnp.swapaxes(piece, 0, 1))


def _identity(n: int, lanes: int) -> Rows:
    return [jnp.concatenate([jnp.full((1, lanes), float(i == j)) for j in range(n)]) for i in range(n)]


def _explicit_step(
    basis: Callable[[Array], tuple[Array, ...]],
    entries: Callable[..., list[Array]],
    zeros: tuple[tuple[bool, ...], ...],
    h: Array,
    number: Array,
    y: Rows,
) -> Rows:
    """One step from ``number * h``: the entries at all stages first, then stage after stage."""
    at_stages = entries(*basis((number + jnp.asarray(dop853.C)[:, None]) * h))
    slopes: list[Rows] = []
    for stage, weights in enumerate(dop853.A):
        state = _advanced(y, h, weights[:stage], slopes)
        slopes.append(stored(partial(_slopes, zeros, stage))(at_stages, state))
    return _advanced(y, h, dop853.B, slopes)


def _slopes(zeros: tuple[tuple[bool, ...], ...], stage: int, at_stages: list[Array], state: Rows) -> Rows:
    """``A y`` at one stage; entries that vanish identically are left out."""
    entries = iter(at_stages)
    return [sum(_at(next(entries), stage) * x for x, zero in zip(state, row, strict=True) if not zero) for row in zeros]


def _at(entry: Array, stage: int) -> Array:
    return entry[min(stage, entry.shape[0] - 1)] if entry.ndim > 1 else entry


def _advanced(y: Rows, h: Array, weights: Any, slopes: list[Rows]) -> Rows:
    """``y + h sum(weights * slopes)``."""
    terms = [(float(w), slope) for w, slope in zip(weights, slopes, strict=True) if w != 0]
    if not terms:
        return y

    def moved(y: Rows, h: Array, *used: Rows) -> Rows:
        return [x + h * sum(w * k[i] for (w, _), k in zip(terms, used, strict=True)) for i, x in enumerate(y)]

    return stored(moved)(y, h, *(slope for _, slope in terms))


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

    def part(first: Array, last: Array) -> Propagator:
        return Propagator(*jax.lax.fori_loop(first, last, body, (jnp.eye(n), jnp.zeros(()))))

    return _in_pieces(part, n, (), steps, PIECES)
