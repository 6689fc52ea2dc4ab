"""Small dense linear algebra without LAPACK calls.

LAPACK calls from concurrent kernels can wait for each other forever in XLA's thread pool (seen with jax 0.10.2 on two
cores).

``eigenvalues`` reduces to Hessenberg form by Householder reflections and applies the QR iteration with Francis' double
steps (Golub & Van Loan, Matrix Computations, 7.4-7.5), which is backward stable. All lanes of a batch go through the same
reflections, each in its own block of coupled rows, so the arithmetic vectorises.
"""

from __future__ import annotations

from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import any_lane, in_one_kernel, stored
from drivetrain_jax.analysis.numerics.lanes import in_blocks

_EPS = np.finfo(float).eps
# Most double steps of the QR iteration for each row, and lanes of a block: their matrices fit into the innermost cache.
_MAX_SWEEPS, LANES = 30, 32
# Rows of a product up to which it may be fused with other operations.
_FUSED = 8
# Smallest ratio of a single pivot to the largest entry beside the diagonal (Bunch & Parlett, SIAM J. Numer. Anal. 8, 1971).
_PIVOT = (1 + 17**0.5) / 8


def matmul(a: Array, b: Array) -> Array:
    """Product of matrices whose batch axes trail: ``(n, m, ...)`` times ``(m, k, ...)``."""
    return sum(a[:, j, None] * b[None, j] for j in range(a.shape[1]))  # pyright: ignore[reportReturnType]


def product(a: Array, b: Array) -> Array:
    """:func:`matmul`, with large results stored: XLA shares fusions of more than a product among threads, at a loss."""
    return stored(matmul)(a, b) if len(a) > _FUSED else matmul(a, b)


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
    return eliminated(a, b)[0]


def determinant(a: Array) -> Array:
    """Determinant of ``a``, ``(n, n, ...) -> (...)``."""
    if a.shape[0] == 2:
        return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    _, negative, size = eliminated(a, a[:, :0])
    return jnp.where(negative, -size, size)


def eliminated(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Solution of ``a x = b`` as in :func:`solve`, and sign (flags of negative ones) and modulus of ``det a``."""
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


@jax.custom_jvp
def spectral_norm(a: Array) -> Array:
    """Largest singular value of one matrix, ``(n, m) -> ()``; its derivative is NaN where it is a multiple one."""
    size = jnp.max(jnp.abs(a))
    scaled = a / jnp.where(size > 0, size, 1.0)
    return size * jnp.sqrt(jnp.max(eigenvalues(scaled.T @ scaled)[0]))


@spectral_norm.defjvp
def _spectral_norm_tangent(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """With the projector P on the vector of the largest eigenvalue of ``a^T a``; the iteration itself has no derivative."""
    (a,), (change,) = primals, tangents
    norm = spectral_norm(a)
    unit = a / norm
    square, eye = unit.T @ unit, jnp.eye(a.shape[1])
    others = jnp.sort(eigenvalues(square)[0])[:-1]
    projector = eye
    for other in others:
        projector = projector @ (square - other * eye) / (1 - other)
    return norm, jnp.sum(unit @ projector * change)


def hessenberg(a: Array) -> Array:
    """Upper Hessenberg matrix similar to ``a``, ``(n, n, ...) -> (n, n, ...)``."""
    for k in range(len(a) - 2):
        a = _reflected(a, a[k + 1 :, k], k + 1)
    return a


def _reflected(h: Array, x: Array, first: int) -> Array:
    """``h`` after a reflection from both sides, which turns ``x`` ``(r, ...)`` in the rows from ``first`` on into its norm.

    None where ``x`` is 0.
    """
    v, c = stored(_reflection)(x)
    rows, columns = stored(partial(_along, first))(h, v, c)
    return stored(partial(_updated, first))(h, v, rows, columns, stored(partial(_twice, first))(columns, v, c))


def _reflection(x: Array) -> tuple[Array, Array]:
    """``v`` and ``c`` of the reflection ``I - c v v^T``."""
    size = sum(jnp.abs(y) for y in x)
    x = x / jnp.where(size > 0, size, 1.0)
    norm = jnp.sqrt(sum(y**2 for y in x))
    v = jnp.concatenate([(x[0] + jnp.where(x[0] < 0, -norm, norm))[None], x[1:]])
    square = sum(y**2 for y in v)
    return v, jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1.0), 0.0)


def _along(first: int, h: Array, v: Array, c: Array) -> tuple[Array, Array]:
    """``c v^T h`` and ``c h v``."""
    return c * sum(x * h[first + i] for i, x in enumerate(v)), c * sum(x * h[:, first + i] for i, x in enumerate(v))


def _twice(first: int, columns: Array, v: Array, c: Array) -> Array:
    return c * sum(x * columns[first + i] for i, x in enumerate(v))


def _updated(first: int, h: Array, v: Array, rows: Array, columns: Array, twice: Array) -> Array:
    zero = jnp.zeros_like(twice)
    v = jnp.stack([*[zero] * first, *v, *[zero] * (len(h) - first - len(v))])
    return h - v[:, None] * (rows - twice * v) - columns[:, None] * v


def _pair(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Eigenvalues of [[a, b], [c, d]]: both real parts, then both imaginary parts."""
    half, product = (a - d) / 2, b * c
    square = half**2 + product
    root = jnp.sqrt(jnp.abs(square))
    far = half + jnp.where(half < 0, -root, root)
    # d - bc/far, because d + half - root would cancel.
    near = d - product / jnp.where(far == 0, 1.0, far)
    real, turn = square >= 0, jnp.where(square >= 0, 0.0, root)
    return jnp.where(real, d + far, d + half), jnp.where(real, near, d + half), turn, -turn


def _coupled(h: Array) -> list[Array]:
    """True for each entry below the diagonal that is not negligible."""
    size = jnp.abs(h)
    return [size[i + 1, i] > _EPS * (size[i, i] + size[i + 1, i + 1]) for i in range(len(h) - 1)]


def _windows(h: Array) -> tuple[Array, Array]:
    """First and last row of the lowest block of more than two coupled rows; 0 and 0 if there is none."""
    start = first = last = jnp.zeros(h.shape[2:], int)
    coupled = _coupled(h)
    for i in range(1, len(h)):
        start = jnp.where(coupled[i - 1], start, i)
        long = start < i - 1
        first, last = jnp.where(long, start, first), jnp.where(long, i, last)
    return first, last


def _shifts(h: Array, last: Array, count: Array) -> tuple[Array, Array]:
    """Sum and product of both shifts: the eigenvalues of the last two rows; arbitrary ones in some sweeps break cycles."""
    chosen = [last == i for i in range(len(h))]

    def entry(row: int, column: int) -> Array:
        return sum(jnp.where(chosen[i], h[i + row, i + column], 0.0) for i in range(2, len(h)))  # pyright: ignore[reportReturnType]

    a, b, c, d = entry(-1, -1), entry(-1, 0), entry(0, -1), entry(0, 0)
    size, odd = jnp.abs(c) + jnp.abs(entry(-1, -2)), count % 11 == 10
    return jnp.where(odd, 1.5 * size, a + d), jnp.where(odd, size**2, a * d - b * c)


def _start(k: int, h: Array, first: Array, last: Array, total: Array, product: Array) -> Array:
    """The column that reflection ``k`` of a sweep turns, ``(r, ...)``; in the first row of the block it has the shifts."""
    bulge = h[k : k + 3, k - 1] if k else jnp.zeros_like(h[:3, 0])
    a, b, c = h[k, k], h[k + 1, k + 1], h[k + 1, k]
    begins, goes = k == first, (k >= first) & (k < last)
    below = h[k + 2, k + 1] if k + 2 < len(h) else jnp.zeros_like(a)
    shifted = jnp.stack(
        [(a * (a - total) + product) / jnp.where(begins & goes, c, 1.0) + h[k, k + 1], a + b - total, below]
    )
    x = jnp.where(begins, shifted[: len(bulge)], bulge)
    inside = goes & (k + jnp.arange(len(bulge)).reshape(-1, *(1,) * goes.ndim) <= last)
    return jnp.where(inside, x, 0.0)


def _cleared(h: Array) -> Array:
    """``h`` without its entries below the diagonal that are negligible or rounding of reflections."""
    n, axes = len(h), (1,) * (h.ndim - 2)
    kept = np.tri(n, k=-1).T + np.eye(n)
    coupled = jnp.stack([*_coupled(h), jnp.zeros(h.shape[2:], bool)])
    return jnp.where(
        (kept > 0).reshape(n, n, *axes) | coupled & np.eye(n, k=-1, dtype=bool).reshape(n, n, *axes), h, 0.0
    )


def _sweep(state: tuple) -> tuple:
    """One double step of the QR iteration in every lane, in its own block of coupled rows."""
    h, (first, last), count = state
    h = stored(_cleared)(h)
    total, product = stored(_shifts)(h, last, count)
    for k in range(len(h) - 1):
        h = _reflected(h, stored(partial(_start, k))(h, first, last, total, product), k)
    return h, stored(_windows)(h), count + 1


def eigenvalues(a: Array) -> tuple[Array, Array]:
    """Real and imaginary parts of the eigenvalues of ``a``, ``(n, n, ...) -> (n, ...)`` each, in no particular order.

    Lanes that are not finite return NaN and do not delay the others.
    """
    n, shape = len(a), a.shape[2:]
    flat = a.reshape(n, n, -1)

    def block(a: Array, lanes: int) -> tuple[Array, Array]:
        h = hessenberg(jnp.where(jnp.isfinite(stored(largest)(a)), a, jnp.nan))
        if n > 2:
            state = h, stored(_windows)(h), jnp.int32(0)
            h = jax.lax.while_loop(lambda s: any_lane(s[1][1] > 0) & (s[2] < _MAX_SWEEPS * n), _sweep, state)[0]
        return stored(_of_blocks)(h)

    real, imaginary = in_blocks(block, flat, flat.shape[-1], LANES, in_one_kernel)
    return real.reshape(n, *shape), imaginary.reshape(n, *shape)


def _of_blocks(h: Array) -> tuple[Array, Array]:
    """The eigenvalues of blocks of one and two rows."""
    n, coupled = len(h), _coupled(h)
    real, imaginary = [h[i, i] for i in range(n)], [jnp.zeros_like(h[0, 0])] * n
    for i in range(n - 1):
        pair = _pair(h[i, i], h[i, i + 1], h[i + 1, i], h[i + 1, i + 1])
        for j in (0, 1):
            real[i + j] = jnp.where(coupled[i], pair[j], real[i + j])
            imaginary[i + j] = jnp.where(coupled[i], pair[2 + j], imaginary[i + j])
    return jnp.stack(real), jnp.stack(imaginary)
