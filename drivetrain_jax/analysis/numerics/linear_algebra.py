"""Small dense linear algebra without LAPACK calls.

LAPACK calls from concurrent kernels can wait for each other forever in XLA's thread pool (seen with jax 0.10.2 on two
cores).

``eigenvalues`` reduces to Hessenberg form by Householder reflections and applies the QR iteration with Wilkinson's
complex shift and deflation from the bottom (Golub & Van Loan, Matrix Computations, 7.4-7.5), which is backward stable. All
lanes of a batch go through the same sweeps, so the arithmetic vectorises. Complex numbers are pairs of real arrays.
"""

from __future__ import annotations

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import stored

# Real and imaginary part.
Complex = tuple[Array, ...]

_EPS = np.finfo(float).eps
_MAX_SWEEPS = 40
# Smallest ratio of a single pivot to the largest entry beside the diagonal (Bunch & Parlett, SIAM J. Numer. Anal. 8, 1971).
_PIVOT = (1 + 17**0.5) / 8


def matmul(a: Array, b: Array) -> Array:
    """Product of matrices whose batch axes trail: ``(n, m, ...)`` times ``(m, k, ...)``."""
    return sum(a[:, j, None] * b[None, j] for j in range(a.shape[1]))  # pyright: ignore[reportReturnType]


def square_sum(a: Array) -> Array:
    """Sum of the squares of all entries, ``(n, m, ...) -> (...)``; unlike ``jnp.sum`` it may be part of a kernel."""
    return sum(a[i, j] ** 2 for i in range(a.shape[0]) for j in range(a.shape[1]))  # pyright: ignore[reportReturnType]


def largest(a: Array) -> Array:
    """Largest modulus of all entries, ``(n, m, ...) -> (...)``, NaN if any is; may be part of a kernel."""
    return reduce(jnp.maximum, (jnp.abs(a[i, j]) for i in range(a.shape[0]) for j in range(a.shape[1])))


def looped_matmul(a: Array, b: Array | np.ndarray) -> Array:
    """:func:`matmul` as a loop, for matrices of ten rows and more, which ``matmul`` would take long to compile."""

    def add(j: Array, total: Array) -> Array:
        column = jax.lax.dynamic_index_in_dim(a, j, 1, keepdims=False)
        return total + column[:, None] * jax.lax.dynamic_index_in_dim(b, j, 0, keepdims=False)

    shape = (a.shape[0], b.shape[1], *jnp.broadcast_shapes(a.shape[2:], b.shape[2:]))
    return jax.lax.fori_loop(0, a.shape[1], add, jnp.zeros(shape))


def solve(a: Array, b: Array) -> Array:
    """Solution of ``a x = b``, ``(n, n, ...), (n, m, ...) -> (n, m, ...)``.

    Gauss-Jordan elimination with row exchanges; a singular matrix gives values that are not finite.
    """
    return solve_oriented(a, b)[0]


def determinant(a: Array) -> Array:
    """Determinant of ``a``, ``(n, n, ...) -> (...)``."""
    if a.shape[0] == 2:
        return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    _, negative, size = _eliminated(a, a[:, :0])
    return jnp.where(negative, -size, size)


def solve_oriented(a: Array, b: Array) -> tuple[Array, Array]:
    """Solution of ``a x = b`` as in :func:`solve`, and flags of a negative determinant of ``a``, ``(...)``."""
    return _eliminated(a, b)[:2]


def _eliminated(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Solution of ``a x = b``, and sign (flags of negative ones) and modulus of the determinant of ``a``."""
    n = a.shape[0]
    number = jnp.arange(n).reshape(n, *(1,) * (a.ndim - 2))

    def eliminate(k: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        system, negative, size = state
        column = system[:, k]
        pivot = jnp.argmax(jnp.where(number < k, -1.0, jnp.abs(column)), axis=0)
        row = jnp.take_along_axis(system, pivot[None, None], axis=0)[0]
        turned = negative ^ (row[k] < 0) ^ (pivot != k)
        size = jnp.where(size == 0, 0.0, size * jnp.abs(row[k]))
        row, displaced = row / row[k], system[k]
        at_pivot = number == pivot
        rest = jnp.where(at_pivot[:, None], displaced, system)
        rest = rest - jnp.where(at_pivot, displaced[k], column)[:, None] * row
        return jnp.where((number == k)[:, None], row, rest), turned, size

    start = (jnp.concatenate([a, b], axis=1), jnp.zeros(a.shape[2:], bool), jnp.ones(a.shape[2:]))
    system, negative, size = jax.lax.fori_loop(0, n, eliminate, start)
    return system[:, n:], negative, size


def inertia_and_determinant(matrix: Array) -> tuple[Array, Array]:
    """Number of negative eigenvalues of a symmetric matrix, and its determinant: elimination with the largest pivots."""
    n = len(matrix)
    number, diagonal = np.arange(n), np.eye(n, dtype=bool)

    def eliminate(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        a, negative, determinant = state
        beside = jnp.where(diagonal, 0.0, jnp.abs(a))
        i, (j, k) = jnp.argmax(jnp.abs(jnp.diagonal(a))), jnp.divmod(jnp.argmax(beside), n)
        single = jnp.abs(a[i, i]) >= _PIVOT * jnp.max(beside)
        det = jnp.where(single, a[i, i], a[j, j] * a[k, k] - a[j, k] ** 2)
        done = det == 0
        safe = jnp.where(done, 1.0, det)
        cross = jnp.outer(a[j], a[k])
        two = a[k, k] * jnp.outer(a[j], a[j]) - a[j, k] * (cross + cross.T) + a[j, j] * jnp.outer(a[k], a[k])
        rest = a - jnp.where(single, jnp.outer(a[i], a[i]), two) / safe
        gone = jnp.where(single, number == i, (number == j) | (number == k))
        rest = jnp.where(gone[:, None] | gone, 0.0, rest)
        # A pair of pivots has one negative eigenvalue, and so a negative determinant.
        return jnp.where(done, a, rest), negative + (det < 0), determinant * safe

    _, negative, determinant = jax.lax.fori_loop(0, n, eliminate, (matrix, jnp.zeros(()), jnp.ones(())))
    return negative, determinant


def spectral_norm(a: Array) -> Array:
    """Largest singular value of one matrix, ``(n, m) -> ()``."""
    size = jnp.max(jnp.abs(a))
    scaled = a / jnp.where(size > 0, size, 1.0)
    return size * jnp.sqrt(jnp.max(eigenvalues(scaled.T @ scaled)[0]))


def _multiply(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _conjugate_multiply(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] + a[1] * b[1], a[0] * b[1] - a[1] * b[0]


def _square_root(a: Complex) -> Complex:
    modulus = jnp.hypot(*a)
    real = jnp.sqrt((modulus + jnp.abs(a[0])) / 2)
    other = jnp.where(real > 0, jnp.abs(a[1]) / (2 * jnp.where(real > 0, real, 1.0)), 0.0)
    right = a[0] >= 0
    return jnp.where(right, real, other), jnp.where(a[1] < 0, -1.0, 1.0) * jnp.where(right, other, real)


def hessenberg(a: Array) -> Array:
    """Upper Hessenberg matrix similar to ``a``, ``(n, n, ...) -> (n, n, ...)``."""
    n = a.shape[0]
    for k in range(n - 2):
        x = a[k + 1 :, k]
        norm = jnp.sqrt(jnp.sum(x**2, axis=0))
        v = x.at[0].add(jnp.where(x[0] < 0, -norm, norm))
        size = jnp.sum(v**2, axis=0)
        scale = jnp.where(size > 0, 2 / jnp.where(size > 0, size, 1.0), 0.0)
        a = a.at[k + 1 :].add(-scale * v[:, None] * jnp.sum(v[:, None] * a[k + 1 :], axis=0))
        a = a.at[:, k + 1 :].add(-scale * jnp.sum(a[:, k + 1 :] * v, axis=1)[:, None] * v)
    return a


def _pair(a: Complex, b: Complex, c: Complex, d: Complex) -> tuple[Complex, Complex]:
    """Eigenvalues of [[a, b], [c, d]]; the second one is nearer to ``d``."""
    half = ((a[0] - d[0]) / 2, (a[1] - d[1]) / 2)
    off, square = _multiply(b, c), _multiply(half, half)
    root = _square_root((square[0] + off[0], square[1] + off[1]))
    sign = jnp.where(half[0] * root[0] + half[1] * root[1] < 0, -1.0, 1.0)
    far = (half[0] + sign * root[0], half[1] + sign * root[1])
    # d - bc/far, because d + half - root would cancel.
    size = far[0] ** 2 + far[1] ** 2
    quotient = tuple(x / jnp.where(size > 0, size, 1.0) for x in _conjugate_multiply(far, off))
    return (d[0] + far[0], d[1] + far[1]), (d[0] - quotient[0], d[1] - quotient[1])


def _entry(h: Complex, i: int, j: int) -> Complex:
    return h[0][i, j], h[1][i, j]


def _add_to_diagonal(h: Complex, shift: Complex, active: Array) -> Complex:
    eye = (jnp.eye(len(active)) * active).reshape(*h[0].shape[:2], *(1,) * (h[0].ndim - 2))
    return h[0] + eye * shift[0], h[1] + eye * shift[1]


def _turn_rows(x: Complex, y: Complex, a: Complex, b: Complex, wanted: Array) -> tuple[Complex, ...]:
    """The rotation ``c, s`` that eliminates ``b`` against ``a``, and the rotated rows ``x`` and ``y``; the identity
    unless ``wanted``."""
    norm = jnp.sqrt(a[0] ** 2 + a[1] ** 2 + b[0] ** 2 + b[1] ** 2)
    turns = wanted & (norm > 0)
    scale = jnp.where(turns, 1 / jnp.where(turns, norm, 1.0), 0.0)
    c, s = (jnp.where(turns, a[0] * scale, 1.0), a[1] * scale), (b[0] * scale, b[1] * scale)
    p, q, u, w = _conjugate_multiply(c, x), _conjugate_multiply(s, y), _multiply(c, y), _multiply(s, x)
    return (p[0] + q[0], p[1] + q[1]), (u[0] - w[0], u[1] - w[1]), c, s


def _turn_columns(x: Complex, y: Complex, c: Complex, s: Complex) -> tuple[Complex, Complex]:
    """The columns ``x`` and ``y`` turned back."""
    p, q, u, w = _multiply(x, c), _multiply(y, s), _conjugate_multiply(c, y), _conjugate_multiply(s, x)
    return (p[0] + q[0], p[1] + q[1]), (u[0] - w[0], u[1] - w[1])


def _sweep(h: Complex, shift: Complex, size: Array) -> Complex:
    """One QR step of the leading ``size`` rows: the rotations that make ``h - shift`` triangular, from both sides."""
    n = h[0].shape[0]
    active = jnp.arange(n) < size
    h = _add_to_diagonal(h, (-shift[0], -shift[1]), active)
    rows, rotations = [(h[0][i], h[1][i]) for i in range(n)], []
    # Stored, because XLA would otherwise recompute and recompile each rotation for everything that depends on it.
    for k in range(n - 1):
        x, y = rows[k], rows[k + 1]
        rows[k], rows[k + 1], *rotation = stored(_turn_rows)(x, y, *((r[0][k], r[1][k]) for r in (x, y)), active[k + 1])  # pyright: ignore[reportCallIssue]
        rotations.append(rotation)
    re, im = (jnp.stack([row[part] for row in rows]) for part in (0, 1))
    columns: list[Complex] = [(re[:, j], im[:, j]) for j in range(n)]
    for k, rotation in enumerate(rotations):
        columns[k], columns[k + 1] = stored(_turn_columns)(columns[k], columns[k + 1], *rotation)
    return _add_to_diagonal(tuple(jnp.stack([x[part] for x in columns], axis=1) for part in (0, 1)), shift, active)


def _size(a: Complex) -> Array:
    return jnp.abs(a[0]) + jnp.abs(a[1])


def eigenvalues(a: Array) -> tuple[Array, Array]:
    """Real and imaginary parts of the eigenvalues of ``a``, ``(n, n, ...) -> (n, ...)`` each, in no particular order.

    Lanes that are not finite return NaN and do not delay the others.
    """
    reduced = hessenberg(a)
    h = (reduced, jnp.zeros_like(reduced))
    n = a.shape[0]
    if n > 2:
        h = _deflated(h)
    pairs = [_entry(h, i, i) for i in range(min(n, 2), n)]
    pairs += _pair(*(_entry(h, i, j) for i in (0, 1) for j in (0, 1))) if n > 1 else [_entry(h, 0, 0)]
    return jnp.stack([x for x, _ in pairs]), jnp.stack([y for _, y in pairs])


def _deflated(h: Complex) -> Complex:
    """``h`` after QR steps that decouple one row after the other from below, in every lane, until two rows are left.

    One loop for all sizes, because compiling a loop takes seconds.
    """

    def step(state: tuple) -> tuple:
        size, count, h = state
        corner = tuple(jax.lax.dynamic_slice_in_dim(x, size - 2, 2, axis=0) for x in h)
        corner = tuple(jax.lax.dynamic_slice_in_dim(x, size - 2, 2, axis=1) for x in corner)
        above, last = _entry(corner, 0, 0), _entry(corner, 1, 1)
        coupling = _size(_entry(corner, 1, 0))
        loose = coupling > _EPS * (_size(last) + _size(above))
        done = (count >= _MAX_SWEEPS) | ~jnp.any(loose)

        def sweep() -> tuple:
            shift = _pair(*(_entry(corner, i, j) for i in (0, 1) for j in (0, 1)))[1]
            # An arbitrary shift in every tenth sweep breaks cycles.
            kick = jnp.where(count % 10 == 9, 0.75, 0.0) * coupling
            return size, count + 1, _sweep(h, (shift[0] + kick, shift[1] - kick / 2), size)

        return jax.lax.cond(done, lambda: (size - 1, jnp.int32(0), h), sweep)

    start = (jnp.int32(h[0].shape[0]), jnp.int32(0), h)
    return jax.lax.while_loop(lambda state: state[0] > 2, step, start)[2]
