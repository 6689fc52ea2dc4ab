"""Decay of the Chebyshev coefficients of one line: needed degree, noise, kinks."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from drivetrain_jax.atlas.interpolation import envelope

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
