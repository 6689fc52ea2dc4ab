"""Chebyshev interpolation on tensor grids: nodes, coefficients, tails."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from drivetrain_jax.atlas.panels import chebyshev

# Numbers in the first product of a block of points, which fit into the cache, and fewest points of a block. Size of a
# product below which OpenBLAS starts no threads; these would spin for a tenth of a second on cores that solves need.
_WORKING_SET, _LEAST, _ONE_THREAD = 1 << 17, 32, 1 << 18
# Mean number of points on a line above which points are evaluated line by line.
_SHARED = 4


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


def restriction(n: int, lower: float, upper: float) -> np.ndarray:
    """Matrix ``(n, n)`` from the coefficients of a polynomial over [-1, 1] to those over [lower, upper].

    It is triangular; rounding errors elsewhere are set to 0.
    """
    y = nodes(n)
    x = np.clip((lower * (1 - y) + upper * (1 + y)) / 2, -1.0, 1.0)
    return np.triu(analysis_matrix(n) @ chebyshev(x, n))


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
    """Values ``(N, m)`` at points ``(N, d)`` in [-1, 1]^d; points that share their first coordinate share its products."""
    out = np.empty((len(x), tensor.shape[-1]))
    first, rest = tensor.reshape(len(tensor), -1), tensor.shape[1:]
    block = max(_WORKING_SET // first.shape[1], _LEAST)
    lines, line_of = np.unique(x[:, 0], return_inverse=True)
    if x.shape[1] > 1 and 0 < _SHARED * len(lines) <= len(x):
        chosen = np.split(np.argsort(line_of, kind="stable"), np.cumsum(np.bincount(line_of))[:-1])
        for k, mine in enumerate(chosen):
            row = _product(chebyshev(lines[k : k + 1], len(tensor)), first)
            out[mine] = evaluate(row.reshape(rest), x[mine, 1:])
        return out
    for start in range(0, len(x), block):
        part = x[start : start + block]
        # The first contraction is one matrix product; the others act on each point's remainder.
        rows = _product(chebyshev(part[:, 0], len(tensor)), first)
        for k in range(1, x.shape[1]):
            n = tensor.shape[k]
            rows = np.einsum("pn,pnr->pr", chebyshev(part[:, k], n), rows.reshape(len(part), n, -1))
        out[start : start + block] = rows
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


def without_smallest(tensor: np.ndarray, noise: float, negligible: float) -> np.ndarray:
    """``tensor`` without coefficients below ``noise`` and the smallest others, whose norms add up to ``negligible``."""
    sizes = np.linalg.norm(tensor, axis=-1)
    rising = np.sort(sizes[sizes > noise])
    dropped = int(np.searchsorted(np.cumsum(rising), negligible, side="right"))
    large = sizes > max(noise, rising[dropped - 1] if dropped else 0.0)
    kept = tuple(
        slice(int(np.max(np.flatnonzero(large.any(axis=tuple(set(range(large.ndim)) - {k}))), initial=0)) + 1)
        for k in range(large.ndim)
    )
    return np.where(large[..., None], tensor, 0.0)[kept]
