"""Collocation of linear systems: coefficients of Gauss and Radau schemes, and the propagator of one panel.

A panel of length h has s nodes. Let d be the number of unknowns of a node. The unknowns x obey ``M x = R y`` for the state y
at the start, and the state at the end is ``P y`` with

    P = P0 + B M^(-1) R,  M = I - sum_t W_t o E_t.

``E_t`` are the coefficients of the system at the nodes, ``W_t`` matrices of the scheme, and o multiplies blocks. For
``q'' = E1 q' + E0 q`` the unknowns are the second derivatives at the nodes; for ``y' = E y`` they are the slopes. P is the
Schur complement of M. For Gauss nodes the elimination needs no exchange of rows: for damped and for oscillating systems
every pivot is at least 1 (numerically, up to 12 radians in a panel), and the scheme keeps the determinant and symplectic
forms exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel
from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.systems import LinearPeriodic


class Tableau(NamedTuple):
    """Weights ``a`` ``(s, s)`` and ``b`` ``(s,)`` and nodes ``c`` ``(s,)`` on [0, 1] of a collocation scheme."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray


@lru_cache
def gauss(stages: int) -> Tableau:
    """Gauss-Legendre collocation of order ``2 stages``: the nodes are the zeros of P_s."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    c = (nodes + 1) / 2
    return Tableau(_weights(c), weights / 2, c)


@lru_cache
def radau(stages: int) -> Tableau:
    """Radau IIA collocation of order ``2 stages - 1``: the nodes are the zeros of P_s - P_(s-1), of which the last is 1."""
    basis = np.polynomial.legendre.Legendre.basis
    polynomial = basis(stages) - basis(stages - 1)
    x = np.sort(polynomial.roots().real)
    for _ in range(3):
        x = x - polynomial(x) / polynomial.deriv()(x)
    c = (x + 1) / 2
    c[-1] = 1.0
    a = _weights(c)
    return Tableau(a, a[-1], c)


def _weights(c: np.ndarray) -> np.ndarray:
    """``a_ij``, the integral of the Lagrange polynomial l_j from 0 to c_i, by Gauss quadrature of its product form."""
    nodes, weights = np.polynomial.legendre.leggauss(len(c))
    points = c[:, None] * (nodes + 1) / 2
    lagrange = np.ones((len(c), *points.shape))
    for j in range(len(c)):
        for k in set(range(len(c))) - {j}:
            lagrange[j] *= (points - c[k]) / (c[j] - c[k])
    return np.einsum("jiq,q->ij", lagrange, weights / 2) * c[:, None]


class Scheme(NamedTuple):
    """A collocation scheme for linear equations of one order.

    ``nodes`` are c; ``inner`` the matrices W_t; ``right[p, t]`` the factors ``(s,)`` of E_t in the block p of R; ``left[p]``
    the factors ``(s,)`` of the identity in the block p of B; ``start`` the blocks of P0, as multiples of the identity.
    """

    nodes: np.ndarray
    inner: tuple[np.ndarray, ...]
    right: np.ndarray
    left: np.ndarray
    start: np.ndarray


def first_order(tableau: Tableau) -> Scheme:
    """The scheme for ``y' = E y`` with ``E_0 = h E``: the unknowns are ``h y'``."""
    a, b, c = tableau
    return Scheme(c, (a,), np.ones((1, 1, len(c))), b[None], np.eye(1))


def second_order(tableau: Tableau) -> Scheme:
    """The scheme for ``q'' = E1 q' + E0 q`` with ``E_0 = h E1`` and ``E_1 = h^2 E0``.

    The unknowns are ``h^2 q''``, the states ``(q, h q')``.
    """
    a, b, c = tableau
    one, none = np.ones_like(c), np.zeros_like(c)
    right = np.array([[none, one], [one, c]])
    return Scheme(c, (a, a @ a), right, np.array([b @ a, b]), np.array([[1.0, 1.0], [0.0, 1.0]]))


class Factors(NamedTuple):
    """``M = L U`` with ``U`` of unit diagonal: for each pivot the column of L from it on, the row of U after it, the row of
    ``L^(-1) R`` and the column of ``-B U^(-1)``; lanes are the last axis."""

    lower: list[Array]
    upper: list[Array]
    right: list[Array]
    left: list[Array]


def factors(scheme: Scheme, coefficients: Sequence[Array]) -> Factors:
    """The elimination of one panel from ``E_t`` ``(s, d, d, lanes)``, row by row of L and U, without storing M."""
    s, d = coefficients[0].shape[:2]
    computed = Factors([], [], [], [])
    for k in range(s * d):
        step = _Step(scheme, s, d, k)
        lower = stored(step.lower)(coefficients, computed.lower, computed.upper)
        inverse = stored(_inverse)(lower)
        computed.right.append(stored(step.right)(coefficients, computed.lower, computed.right, inverse))
        computed.left.append(stored(step.left)(computed.left, computed.upper) if k else step.left([], []))
        if k + 1 < s * d:
            computed.upper.append(stored(step.upper)(coefficients, computed.lower, computed.upper, inverse))
        computed.lower.append(lower)
    return computed


def _inverse(lower: Array) -> Array:
    return 1 / lower[0]


class _Step(NamedTuple):
    """Number ``k`` of the elimination: the unknown ``k % d`` of the node ``k // d``."""

    scheme: Scheme
    s: int
    d: int
    k: int

    def lower(self, coefficients: Sequence[Array], lower: list[Array], upper: list[Array]) -> Array:
        j, b = divmod(self.k, self.d)
        x = (np.arange(self.k, self.s * self.d) == self.k)[:, None].astype(float)
        for weights, e in zip(self.scheme.inner, coefficients, strict=True):
            factor = np.repeat(weights[:, j], self.d)[self.k :, None]
            x = x - factor * e[:, :, b].reshape(self.s * self.d, -1)[self.k :]
        for i, (column, row) in enumerate(zip(lower, upper, strict=True)):
            x = x - column[self.k - i :] * row[self.k - i - 1]
        return x

    def upper(self, coefficients: Sequence[Array], lower: list[Array], upper: list[Array], inverse: Array) -> Array:
        j, b = divmod(self.k, self.d)
        x: Any = 0
        for weights, e in zip(self.scheme.inner, coefficients, strict=True):
            factor = np.repeat(weights[j], self.d)[self.k + 1 :, None]
            x = x - factor * jnp.tile(e[j, b], (self.s, 1))[self.k + 1 :]
        for i, (column, row) in enumerate(zip(lower, upper, strict=True)):
            x = x - column[self.k - i] * row[self.k - i :]
        return x * inverse

    def right(self, coefficients: Sequence[Array], lower: list[Array], right: list[Array], inverse: Array) -> Array:
        j, b = divmod(self.k, self.d)
        x: Any = 0
        for t, e in enumerate(coefficients):
            factor = np.repeat(self.scheme.right[:, t, j], self.d)[:, None]
            x = x + factor * jnp.tile(e[j, b], (len(self.scheme.right), 1))
        for i, (column, row) in enumerate(zip(lower, right, strict=True)):
            x = x - column[self.k - i] * row
        return x * inverse

    def left(self, left: list[Array], upper: list[Array]) -> Array:
        j, b = divmod(self.k, self.d)
        x = jnp.asarray(-np.kron(self.scheme.left[:, j], np.eye(self.d)[b])[:, None])
        for i, (column, row) in enumerate(zip(left, upper, strict=True)):
            x = x - column * row[self.k - i - 1]
        return x


def panel_propagator(scheme: Scheme, elimination: Factors, d: int) -> Array:
    """P of one panel, ``(n, n, lanes)``."""

    def total(left: list[Array], right: list[Array]) -> Array:
        x = jnp.asarray(np.kron(scheme.start, np.eye(d))[..., None])
        for column, row in zip(left, right, strict=True):
            x = x - column[:, None] * row
        return x

    return stored(total)(elimination.left, elimination.right)


# Unknowns of a node up to which the loop over them is unrolled.
_UNROLLED = 6


def chain_propagator(scheme: Scheme, coefficients: Sequence[Array]) -> Array:
    """P of one panel, ``(n, n, lanes)``, of a chain: ``E_t`` couple each unknown with its neighbours alone.

    M is block tridiagonal if the values of an unknown at all nodes are neighbours. Its blocks are ``(s, s)``, and their
    elimination needs no exchange of rows either, because the rest of the chain held fixed is a system of the same kind.
    """
    s, d = coefficients[0].shape[:2]
    lanes = max(e.shape[-1] for e in coefficients)
    coefficients = [jnp.broadcast_to(e, (*e.shape[:-1], lanes)) for e in coefficients]
    columns = len(scheme.right) * d

    def block(entries: Array) -> Array:
        return sum(weights[..., None] * e[:, None] for weights, e in zip(scheme.inner, entries, strict=True))  # pyright: ignore[reportReturnType]

    def beside(step: int) -> Array:
        places = [(i, min(max(i + step, 0), d - 1)) for i in range(d)]
        return jnp.stack([e[:, i, j] for i, j in places for e in coefficients]).reshape(d, -1, s, lanes)

    def rows() -> tuple[Array, ...]:
        right = [sum(x[:, None, None, None] * e for x, e in zip(f, coefficients, strict=True)) for f in scheme.right]
        return beside(-1), beside(0), beside(1), jnp.moveaxis(jnp.concatenate(right, 2), 1, 0)

    def reduced(before: tuple[Array, Array], below: Array, own: Array, right: Array) -> tuple[Array, Array]:
        left = block(below)
        return jnp.eye(s)[..., None] - block(own) + matmul(left, before[0]), right + matmul(left, before[1])

    def solved(matrix: Array, above: Array, right: Array) -> tuple[Array, Array]:
        return -matmul(matrix, block(above)), matmul(matrix, right)

    def forwards(
        before: tuple[Array, Array], row: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        below, own, above, right = row
        matrix, right = stored(reduced)(before, below, own, right)
        for k in range(s):
            matrix = stored(partial(_turned, k))(matrix)
        now = stored(solved)(matrix, above, right)
        return now, now

    def change(unknowns: Array) -> Array:
        return jnp.stack([sum(w * x for w, x in zip(weights, unknowns, strict=True)) for weights in scheme.left])

    def backwards(after: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        unknowns = stored(lambda x, y: y - matmul(x, after))(*row)
        return unknowns, stored(change)(unknowns)

    start = jnp.zeros((s, s, lanes)), jnp.zeros((s, columns, lanes))
    unroll = d <= _UNROLLED
    steps = jax.lax.scan(forwards, start, stored(rows)(), unroll=unroll)[1]
    changes = jax.lax.scan(backwards, start[1], steps, reverse=True, unroll=unroll)[1]
    whole = jnp.swapaxes(changes, 0, 1).reshape(-1, columns, lanes)
    return whole + np.kron(scheme.start, np.eye(d))[..., None]


def _turned(k: int, matrix: Array) -> Array:
    """A step of the inversion in place of a matrix ``(s, s, lanes)``: the unknown ``k`` and its row change places."""
    here = (np.arange(len(matrix)) == k)[:, None]
    row = jnp.where(here, 1.0, matrix[k]) / matrix[k, k]
    return jnp.where(here[:, None], row, jnp.where(here, 0.0, matrix) - matrix[:, k, None] * row)


def panel(scheme: Scheme, coefficients: Sequence[Array], chain: bool = False) -> Array:
    """P of one panel, ``(n, n, lanes)``, from ``E_t`` ``(s, d, d, lanes)``, with its adjoint as derivative."""

    @jax.custom_vjp
    def propagator(coefficients: tuple[Array, ...]) -> Array:
        return chain_propagator(scheme, coefficients) if chain else forward(coefficients)[0]

    def forward(coefficients: tuple[Array, ...]) -> tuple[Array, Factors]:
        elimination = factors(scheme, coefficients)
        return panel_propagator(scheme, elimination, coefficients[0].shape[1]), elimination

    def backward(elimination: Factors, weights: Array) -> tuple[tuple[Array, ...]]:
        slopes = zip(_by_coefficients(scheme, elimination, weights), coefficients, strict=True)
        # Coefficients that all lanes share.
        return (tuple(jnp.sum(x, -1, keepdims=True) if e.shape[-1] == 1 else x for x, e in slopes),)

    propagator.defvjp(forward, backward)
    return propagator(tuple(coefficients))


def _by_coefficients(scheme: Scheme, elimination: Factors, weights: Array) -> Iterator[Array]:
    """The gradient of ``sum(weights * P)`` by every ``E_t``."""
    s, count = len(scheme.nodes), len(elimination.lower)
    d, n = count // s, len(weights)
    unknowns, multipliers = [jnp.zeros(())] * count, [jnp.zeros(())] * count
    for k in reversed(range(count)):
        later = range(k + 1, count)
        unknowns[k] = elimination.right[k] - sum(elimination.upper[k][i - k - 1] * unknowns[i] for i in later)
        column = elimination.lower[k]
        multipliers[k] = (-elimination.left[k] - sum(column[i - k] * multipliers[i] for i in later)) / column[0]
    x = jnp.stack(unknowns).reshape(s, d, n, -1)
    adjoint = jnp.stack([sum(y[r] * weights[r] for r in range(n)) for y in multipliers]).reshape(s, d, n, -1)
    for t, inner in enumerate(scheme.inner):
        start = np.einsum("pi,bc->ibpc", scheme.right[:, t], np.eye(d)).reshape(s, d, n, 1)
        values = start + sum(inner[:, j, None, None, None] * x[j] for j in range(s))
        yield jnp.sum(adjoint[:, :, None] * values[:, None], axis=3)


def small_panel(scheme: Scheme, coefficients: Sequence[Array]) -> Array:
    """:func:`panel` as a loop over the unknowns: a small program, for few lanes, whose compilation takes longest."""
    s, d = coefficients[0].shape[:2]
    count, n = s * d, d * len(scheme.start)
    inner = jnp.eye(count).reshape(s, d, s, d, 1)
    right: Any = 0
    for t, e in enumerate(coefficients):
        inner = inner - scheme.inner[t][:, None, :, None, None] * e[:, :, None]
        right = right + scheme.right[:, t].T[:, None, :, None, None] * e[:, :, None]
    top = jnp.concatenate([inner.reshape(count, count, -1), right.reshape(count, n, -1)], axis=1)
    bottom = np.concatenate([-np.kron(scheme.left, np.eye(d)), np.kron(scheme.start, np.eye(d))], axis=1)
    bottom = jnp.broadcast_to(bottom[..., None], (n, count + n, top.shape[-1]))

    def eliminated(matrix: Array, k: Array) -> tuple[Array, None]:
        return matrix - matrix[:, k, None] * matrix[k] / matrix[k, k], None

    return jax.lax.scan(eliminated, jnp.concatenate([top, bottom]), jnp.arange(count))[0][count:, count:]


# Propagators of a linear periodic system along a coordinate x, as power series in x: a line costs as much as a few solves.
#
# Let ``y' = x B(t) y``. Over a part of the span the propagator is
#
#     sum_k x^k D_k,  D_k' = B D_(k-1),  D_0 = I and D_k = 0 for k > 0 at the start.
#
# No equation has to be solved. The span is cut into equal parts, so short that few terms are enough. Integrals are those of
# Radau's collocation, whose last node is the end of the part.


# Nodes of a part and powers of x: both have about the same truncation error.
NODES, TERMS = 12, 20


def propagators_along(system: LinearPeriodic, lanes: int, parts: Array, x: Array) -> tuple[Array, Array]:
    """``Phi`` of ``lanes`` lines at the P positions ``x``, ``(P, n, n, lanes)``, and the truncation error, ``(lanes,)``.

    ``system`` is that of ``x = 1``; ``|x| <= 1``. The span is cut into ``parts`` (a traced integer). The truncation error is
    the size of the last term relative to the largest term, in the worst part.
    """
    if system.breakpoints:
        raise InputError(f"breakpoints: got {len(system.breakpoints)}; expected none with a series")
    weights, _, places = radau(NODES)
    size, length = system.size, system.span / parts
    powers = x[:, None] ** jnp.arange(TERMS + 1)
    matrix = partial(_matrix, system, lanes)

    def onward(number: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, left_out = state
        t = ((number + places) * length)[:, None]
        b = (in_one_kernel(matrix) if suits_one_kernel(matrix, t) else matrix)(t)

        def following(before: Array, _: None) -> tuple[Array, Array]:
            term = (length * weights @ _product(b, before).reshape(NODES, -1)).reshape(b.shape)
            return term, term[-1]

        unit = jnp.broadcast_to(jnp.eye(size)[..., None], b.shape)
        terms = jnp.concatenate([unit[-1:], jax.lax.scan(following, unit, length=TERMS)[1]])
        sizes = jnp.max(jnp.abs(terms), axis=(1, 2))
        part = (powers @ terms.reshape(TERMS + 1, -1)).reshape(phi.shape)
        return _product(part, phi), jnp.maximum(left_out, sizes[-1] / jnp.max(sizes, axis=0))

    unit = jnp.broadcast_to(jnp.eye(size)[..., None], (len(x), size, size, lanes))
    return jax.lax.fori_loop(0, parts, onward, (unit, jnp.zeros(lanes)))


def _matrix(system: LinearPeriodic, lanes: int, t: Array) -> Array:
    """``B`` at the times ``t`` ``(NODES, 1)``, ``(NODES, n, n, lanes)``."""
    rows = system.rows(*system.basis(t))
    entries = [[jnp.broadcast_to(jnp.asarray(x, float), (NODES, lanes)) for x in row] for row in rows]
    return jnp.stack([jnp.stack(row, axis=1) for row in entries], axis=1)


def _product(a: Array, b: Array) -> Array:
    """Products of matrices, ``(P, k, l, lanes)`` times ``(P, l, m, lanes)``."""
    return sum(a[:, :, j, None] * b[:, None, j] for j in range(b.shape[1]))  # pyright: ignore[reportReturnType]
