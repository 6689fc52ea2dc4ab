"""Chebyshev interpolation on tensor grids: nodes, coefficients, tails."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from drivetrain_jax.atlas.panels import chebyshev

# Most numbers in the first product of a block of points. Size of a product below which OpenBLAS starts no threads; these
# would spin for a tenth of a second on cores that solves and charts need.
_WORKING_SET, _ONE_THREAD = 1 << 22, 1 << 18


def nodes(n: int) -> np.ndarray:
    """The ``n`` zeros of T_n, falling."""
    return np.cos(np.pi * (np.arange(n) + 0.5) / n)


@lru_cache(maxsize=256)
def analysis_matrix(n: int) -> np.ndarray:
    """Matrix ``(n, n)`` from values at ``nodes(n)`` to Chebyshev coefficients; read-only.

    Multiples of the angles are integers modulo a turn, so their cosines are exact to the last bit but one.
    """
    quarters = np.outer(np.arange(n), 2 * np.arange(n) + 1) % (4 * n)
    matrix = 2 / n * np.cos(np.pi / (2 * n) * quarters)
    matrix[0] /= 2
    return matrix


def tensor_nodes(degrees: Sequence[int]) -> np.ndarray:
    """All points of the tensor grid in [-1, 1]^d in C order, ``(prod(degrees), d)``."""
    grid = np.meshgrid(*(nodes(n) for n in degrees), indexing="ij")
    return np.stack([x.reshape(-1) for x in grid], axis=-1)


def coefficients(values: np.ndarray, degrees: Sequence[int]) -> np.ndarray:
    """Coefficients ``(n_1, ..., n_d, m)`` from the values at ``tensor_nodes(degrees)``, ``(prod(degrees), m)``."""
    axes = tuple(range(len(degrees)))
    # Matrix products are faster, but their rounding keeps tails from falling: up to five times the solves at 1e-11.
    from scipy.fft import dctn  # Local import: a quarter of a second that readers of an atlas do not need.

    tensor = dctn(values.reshape(*degrees, -1), axes=axes) / np.prod(degrees)  # pyright: ignore[reportOperatorIssue]
    for axis in axes:
        first = [slice(None)] * tensor.ndim
        first[axis] = slice(0, 1)
        tensor[tuple(first)] /= 2
    return tensor


def evaluate(tensor: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Values ``(N, m)`` at points ``(N, d)`` in [-1, 1]^d."""
    out = np.empty((len(x), tensor.shape[-1]))
    first = tensor.reshape(tensor.shape[0], -1)
    block = max(_WORKING_SET // first.shape[1], 1)
    for start in range(0, len(x), block):
        part = x[start : start + block]
        # The first contraction is one matrix product; the others act on each point's remainder.
        rest = _product(chebyshev(part[:, 0], tensor.shape[0]), first)
        for k in range(1, x.shape[1]):
            rest = np.einsum(
                "pn,pnr->pr", chebyshev(part[:, k], tensor.shape[k]), rest.reshape(len(part), tensor.shape[k], -1)
            )
        out[start : start + block] = rest
    return out


def on_grid(tensor: np.ndarray, axes: Sequence[np.ndarray]) -> np.ndarray:
    """Values ``(m, N_1, ..., N_d)`` on the grid of ``axes``, arrays ``(N_k,)`` in [-1, 1]."""
    values = tensor
    for t, n in zip(axes, tensor.shape, strict=False):
        values = _product(chebyshev(t, n), values.reshape(n, -1)).T
    return values.reshape(tensor.shape[-1], *map(len, axes))


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a @ b`` in this thread."""
    out = np.empty((len(a), b.shape[1]))
    block = max(_ONE_THREAD // a.size, 1)
    for start in range(0, b.shape[1], block):
        np.matmul(a, b[:, start : start + block], out=out[:, start : start + block])
    return out


def slabs(tensor: np.ndarray, axis: int) -> np.ndarray:
    """Size of the coefficients of T_j along ``axis``, ``(n,)``: root of the sum of squares over all others."""
    others = tuple(k for k in range(tensor.ndim) if k != axis)
    return np.sqrt(np.sum(tensor**2, axis=others))


def envelope(sizes: np.ndarray) -> np.ndarray:
    """Largest of ``sizes`` from each index on."""
    return np.maximum.accumulate(sizes[::-1])[::-1]


# Decay of the Chebyshev coefficients of one line: needed degree, noise, kinks.


# Coefficients that stop falling below this fraction of the largest one are rounding or noise, not an oscillation.
_NOISE = 1e-6
# The last coefficients of a tensor are rounding below this fraction of the allowed truncation error.
_ROUNDING = 1e-2


def lobatto(n: int) -> np.ndarray:
    """The ``n`` extrema of T_(n-1), rising from -1 to 1: every second one belongs to the next finer set."""
    return -np.cos(np.pi * np.arange(n) / (n - 1))


def line_sizes(values: np.ndarray) -> np.ndarray:
    """Sizes of the coefficients ``(n,)`` from values ``(n, m)`` at the Lobatto points (norm over the m functions)."""
    return np.sqrt(np.sum((_transform(len(values)) @ values) ** 2, axis=1))


@lru_cache(maxsize=8)
def _transform(n: int) -> np.ndarray:
    """Coefficients from values at the ``n`` Lobatto points, in O(n^2): lines are short."""
    angle = np.pi * np.arange(n) / (n - 1)
    matrix = 2 / (n - 1) * np.cos(np.outer(np.arange(n), np.pi - angle))
    matrix[:, [0, -1]] /= 2
    matrix[[0, -1]] /= 2
    return matrix


def needed(sizes: np.ndarray, limit: float) -> int | None:
    """Number of polynomials with all truncated coefficients below ``limit``; None if the last three are not."""
    tail = envelope(sizes)
    if tail[-3] > limit:
        return None
    return int(np.argmax(tail <= limit))


def foreseen(sizes: np.ndarray, limit: float) -> int | None:
    """Number of polynomials as of :func:`needed`, else extrapolated by the slope of the last half.

    None if the extrapolation adds a third or more. It overestimates the number for superexponential decay.
    """
    tail, n = envelope(sizes), len(sizes)
    if tail[-3] <= limit:
        return needed(sizes, limit)
    start, end = n // 2, n - 3
    # The limit is relative to the values, and underflows with them.
    if not 0 < tail[end] < tail[start] or limit <= 0:
        return None
    rate = math.log(tail[start] / tail[end]) / (end - start)
    count = end + math.ceil((math.log(tail[end]) - math.log(limit)) / rate)
    return count if count < n + n // 3 else None


def is_noise(sizes: np.ndarray) -> bool:
    """True if the coefficients stopped falling far below the first ones: more of them resolve nothing."""
    tail, n = envelope(sizes), len(sizes)
    return bool(tail[n // 2] < 4 * tail[-n // 8] and tail[n // 2] < _NOISE * tail[0])


def is_algebraic(sizes: np.ndarray) -> bool:
    """True if the coefficients fall like a power of their number, as for a function with a kink or a jump.

    The exponent is measured over n/4..n/2 and n/2..7n/8: for a smooth function it nearly doubles.
    """
    tail, n = envelope(sizes), len(sizes)
    marks = (n // 4, n // 2, 7 * n // 8)
    a, b, c = (tail[k] for k in marks)
    if a > 0.3 * tail[0] or c == 0:
        return False
    first = math.log(a / b) / math.log(marks[1] / marks[0])
    second = math.log(b / c) / math.log(marks[2] / marks[1])
    return second < 1.4 * max(first, 0.5)


def remainder(sizes: np.ndarray, limit: float) -> float:
    """Sum of the truncated coefficients, extrapolated from the last pairs; inf if these do not fall.

    Last coefficients far below ``limit`` are rounding: the result is then the larger one of the last two.
    """
    before, last = max(sizes[-4:-2], default=np.inf), max(sizes[-2:])
    if last < _ROUNDING * limit:
        return float(last)
    ratio = last / before if before > 0 else 0.0
    return float(last * ratio / (1 - ratio)) if ratio < 1 else math.inf


def extrapolated(sizes: np.ndarray, limit: float) -> int:
    """Number of polynomials at which the tail, continued with its present slope, falls below ``limit``."""
    tail, n = envelope(sizes), len(sizes)
    start, end = 2 * n // 3, n - 2
    rate = math.log(max(tail[start], 1e-300) / max(tail[end], 1e-300)) / max(end - start, 1)
    missing = math.log(max(tail[end], limit) / limit)
    grown = n + (math.ceil(missing / rate) if rate > 0 else n)
    return min(max(grown, n + 2), n + max(4, n // 2))
