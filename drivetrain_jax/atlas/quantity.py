"""The functions that an atlas interpolates, and the norm of their errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


def _norm(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(values**2, axis=-1))


def _largest(values: np.ndarray) -> np.ndarray:
    return np.full(len(values), np.max(_norm(values), initial=0.0))


def distance(fitted: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Euclidean norms of the differences, ``(N, m)`` both, ``(N,)``."""
    return _norm(fitted - exact)


def _nothing(values: np.ndarray) -> np.ndarray:
    return np.empty((len(values), 0))


@dataclass(frozen=True)
class Quantity:
    """``size`` smooth functions of the parameters. All functions below take values ``(N, size)`` of N points.

    ``scale(values)`` ``(N,)``: the tolerance of an atlas limits the error of the values (Euclidean norm) divided by this;
    default: the largest norm among the points. ``derived(values)`` ``(N, k)``: numbers with error bounds of their own,
    because bounds derived from that of the values would be too wide; default: none.
    """

    size: int
    scale: Callable[[np.ndarray], np.ndarray] = _largest
    derived: Callable[[np.ndarray], np.ndarray] = _nothing
