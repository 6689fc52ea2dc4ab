"""Panels expanded on small boxes with few polynomials, for fast evaluation of scattered points.

A panel of n polynomials is cut in each coordinate into boxes of equal angle arccos(t). On a box [a, b] its polynomials are
T_j(x(y)) = sum_(k <= j) R_kj T_k(y), and the highest degrees in y can be dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.atlas.interpolation import analysis_matrix, nodes
from drivetrain_jax.atlas.panels import Atlas, Panel, chebyshev, position

# Polynomials of a panel per box and coordinate. Boxes are larger with many coordinates, to limit the memory of all boxes.
_PER_BOX, _PER_LARGE_BOX = 6, 12
_FEW_COORDINATES = 2
# Largest truncation error relative to the panel's error, or to its values if that is more.
_PART, _ROUNDING = 1e-4, np.finfo(float).eps / 8


@dataclass(frozen=True)
class Cell:
    """The points of one box: their numbers ``index`` and their ``place`` in [-1, 1]^d, ``(d, N)``.

    ``tensor`` ``(n_2, ..., n_d, m, n_1)`` holds the coefficients of the box; ``left_out`` bounds the norm of its truncation
    error.
    """

    panel: Panel
    tensor: Array
    left_out: float
    index: np.ndarray
    place: np.ndarray


class Expansion:
    """The boxes of all panels of an atlas, with equal numbers of polynomials, so that one kernel serves all of them."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas = atlas
        largest = np.max([panel.degrees for panel in atlas.panels], axis=0)
        per_box = _PER_BOX if len(largest) <= _FEW_COORDINATES else _PER_LARGE_BOX
        self._edges = [-np.cos(np.pi * np.arange(n + 1) / n) for n in np.maximum(largest // per_box, 1)]
        self._tensors: dict[tuple[int, ...], Array] = {}

    def cells(self, x: np.ndarray) -> Iterator[Cell]:
        """The points ``(N, d)``, in coordinates, that panels cover, box by box."""
        number = self._atlas.find(x)
        for k, panel in enumerate(self._atlas.panels):
            mine = np.flatnonzero(number == k)
            if not mine.size:
                continue
            t = position(panel, x[mine])
            box = [np.searchsorted(edges[1:-1], column) for edges, column in zip(self._edges, t.T, strict=True)]
            flat = np.ravel_multi_index(box, [len(edges) - 1 for edges in self._edges]).astype(np.int32)
            order = np.argsort(flat, kind="stable")
            starts = np.flatnonzero(np.diff(flat[order], prepend=-1))  # pyright: ignore[reportIndexIssue]
            for chosen in np.split(order, starts[1:]):
                corner = tuple(int(b[chosen[0]]) for b in box)
                ends = [(edges[i], edges[i + 1]) for edges, i in zip(self._edges, corner, strict=True)]
                place = [((c - a) - (b - c)) / (b - a) for c, (a, b) in zip(t[chosen].T, ends, strict=True)]
                yield Cell(panel, self._tensor(k, corner), self._left_out[k], mine[chosen], np.array(place))

    def _tensor(self, number: int, corner: tuple[int, ...]) -> Array:
        """The panel's polynomials on one of its boxes."""
        if (number, *corner) not in self._tensors:
            tensor = self._atlas.panels[number].coefficients
            for axis, (i, n) in enumerate(zip(corner, self._degrees, strict=True)):
                matrix = self._restrictions[number][axis][i][:n]
                tensor = np.moveaxis(np.tensordot(matrix, tensor, axes=(1, axis)), 0, axis)
                tensor = np.pad(tensor, [(0, n - len(matrix) if k == axis else 0) for k in range(tensor.ndim)])
            self._tensors[number, *corner] = jnp.asarray(np.moveaxis(tensor, 0, -1))
        return self._tensors[number, *corner]

    @cached_property
    def _restrictions(self) -> list[list[list[np.ndarray]]]:
        """R of every panel, coordinate and box."""
        return [
            [
                [_restriction(n, *ends) for ends in pairwise(edges)]
                for n, edges in zip(panel.degrees, self._edges, strict=True)
            ]
            for panel in self._atlas.panels
        ]

    @cached_property
    def _tails(self) -> list[list[np.ndarray]]:
        """Bounds of the truncation error with k polynomials, k = 0, 1, ..., for every panel and coordinate."""
        found = []
        for panel, restrictions in zip(self._atlas.panels, self._restrictions, strict=True):
            sizes = np.linalg.norm(panel.coefficients, axis=-1)
            tails, spread = [], 1.0
            for axis, boxes in enumerate(restrictions):
                slabs = sizes.sum(axis=tuple(k for k in range(sizes.ndim) if k != axis))
                each = np.max([np.abs(r) @ slabs for r in boxes], axis=0)
                tails.append(np.append(spread * np.cumsum(each[::-1])[::-1], 0.0))
                # Factor by which expanding along this coordinate may amplify the truncation error of the others.
                spread *= max(float(np.abs(r).sum(axis=0).max()) for r in boxes)
            found.append(tails)
        return found

    @cached_property
    def _degrees(self) -> list[int]:
        """Polynomials of a box along each coordinate."""
        needed = []
        for panel, tails in zip(self._atlas.panels, self._tails, strict=True):
            rounding = _ROUNDING * np.linalg.norm(panel.coefficients, axis=-1).max()
            limit = max(_PART * panel.value_error, rounding) / len(tails)
            needed.append([int(np.argmax(tail <= limit)) for tail in tails])
        return np.max(needed, axis=0).tolist()

    @cached_property
    def _left_out(self) -> list[float]:
        return [
            float(sum(tail[min(n, len(tail) - 1)] for tail, n in zip(tails, self._degrees, strict=True)))
            for tails in self._tails
        ]


def _restriction(n: int, lower: float, upper: float) -> np.ndarray:
    """R for [lower, upper] and ``n`` polynomials. R is triangular; rounding errors elsewhere are set to 0."""
    y = nodes(n)
    x = np.clip((lower * (1 - y) + upper * (1 + y)) / 2, -1.0, 1.0)
    return np.triu(analysis_matrix(n) @ chebyshev(x, n))
