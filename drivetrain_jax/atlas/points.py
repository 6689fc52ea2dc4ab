"""Closed-form results at scattered points, box by box, on all cores."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._machine import in_threads
from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.numerics.kernels import compiler_options, in_one_kernel, options_for_few
from drivetrain_jax.atlas.charts import Build, Cells, exact_verdict, results_of_coefficients
from drivetrain_jax.atlas.interpolation import restriction
from drivetrain_jax.atlas.panels import Atlas, Panel, position

# Panels expanded on small boxes with few polynomials, for fast evaluation of scattered points.
#
# A panel of n polynomials is cut in each coordinate into boxes of equal angle arccos(t). On a box [a, b] its polynomials are
# T_j(x(y)) = sum_(k <= j) R_kj T_k(y), and the highest degrees in y can be dropped.


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
                [restriction(n, *ends) for ends in pairwise(edges)]
                for n, edges in zip(panel.degrees, self._edges, strict=True)
            ]
            for panel in self._atlas.panels
        ]

    @cached_property
    def _tails(self) -> list[list[np.ndarray]]:
        """Bounds of the truncation error with k polynomials, k = 0, 1, ..., for every panel and coordinate."""
        of_panels = []
        for panel, restrictions in zip(self._atlas.panels, self._restrictions, strict=True):
            sizes = np.linalg.norm(panel.coefficients, axis=-1)
            tails, spread = [], 1.0
            for axis, boxes in enumerate(restrictions):
                slabs = sizes.sum(axis=tuple(k for k in range(sizes.ndim) if k != axis))
                largest = np.max([np.abs(r) @ slabs for r in boxes], axis=0)
                tails.append(np.append(spread * np.cumsum(largest[::-1])[::-1], 0.0))
                # Factor by which expanding along this coordinate may amplify the truncation error of the others.
                spread *= max(float(np.abs(r).sum(axis=0).max()) for r in boxes)
            of_panels.append(tails)
        return of_panels

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


# Points of a row, whose intermediate results fit into the cache, and rows of a block.
LANES, ROWS = 128, 16


def evaluated_cells(
    expansion: Expansion, points: np.ndarray, x: np.ndarray, atlas: Atlas, kernel: Any, rtol: float
) -> Iterator[tuple[np.ndarray, Cells]]:
    """Yield numbers of points and their results, block by block.

    ``points`` ``(N, d)`` are the parameters, ``x`` ``(N, d)`` the coordinates; ``kernel`` comes from :func:`point_kernel`.
    """
    block = LANES * ROWS

    def work(part: tuple[Cell, int]) -> Cells:
        cell, start = part
        # The last block is padded with its last point.
        numbers = np.minimum(np.arange(start, start + block), cell.index.size - 1)
        columns = points[cell.index[numbers]].T
        values, rows = dict(zip(atlas.parameters, columns, strict=True)), -(-(cell.index.size - start) // LANES)
        results = kernel(
            cell.tensor,
            cell.place[:, numbers],
            np.int32(min(rows, ROWS)),
            cell.panel.value_error + cell.left_out,
            values,
            atlas.fixed,
            rtol,
        )
        return {name: np.asarray(x)[: cell.index.size - start] for name, x in results.items()}

    parts = ((cell, start) for cell in expansion.cells(x) for start in range(0, cell.index.size, block))
    for (cell, start), results in in_threads(parts, work):
        yield cell.index[start : start + block], results


@lru_cache(maxsize=16)
def point_kernel(build: Build, undamped: bool, few: bool) -> Any:
    """The kernel of the results ``(LANES ROWS,)`` of a block of points, see :func:`charts.results_of_coefficients`.

    It fills the first ``rows`` rows. ``undamped``: points may be Hamiltonian; ``few``: a block has one row at most.
    """

    def kernel(tensor, place, rows, error, values, fixed, rtol):
        count = max((*tensor.shape[:-2], tensor.shape[-1]))
        polynomials = in_one_kernel(partial(_chebyshev, count=count))

        def row(i: Array) -> dict[str, Array]:
            def cut(array: Array) -> Array:
                return jax.lax.dynamic_slice_in_dim(array, i * LANES, LANES, axis=-1)

            phi = _values(tensor, polynomials(cut(place)))
            model = build({**fixed, **{name: cut(column) for name, column in values.items()}})
            log_d = jnp.broadcast_to(model.reduced.log_determinant(), (LANES,))  # pyright: ignore[reportOptionalCall]
            parts = quartic.blocks(phi)
            exact = exact_verdict(model, parts, error) if undamped else None
            return results_of_coefficients(in_one_kernel(quartic.coefficients)(parts, log_d, error), rtol, exact)

        def store(i: Array, results: dict[str, Array]) -> dict[str, Array]:
            return {
                name: jax.lax.dynamic_update_slice_in_dim(results[name], new, i * LANES, axis=0)
                for name, new in row(i).items()
            }

        shapes = jax.eval_shape(row, jnp.int32(0))
        blank = {name: jnp.zeros(place.shape[1], shape.dtype) for name, shape in shapes.items()}
        return jax.lax.fori_loop(0, rows, store, blank)

    return jax.jit(kernel, compiler_options=options_for_few() if few else compiler_options())


def _chebyshev(x: Array, count: int) -> Array:
    """``T_0 .. T_(count - 1)`` at ``x``, ``(count, *x.shape)``. The recurrence is accurate enough for few of them."""

    def step(pair: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        return (pair[1], 2 * x * pair[1] - pair[0]), pair[0]

    return jax.lax.scan(step, (jnp.ones_like(x), x), None, length=count)[1]


def _values(tensor: Array, polynomials: Array) -> Array:
    """Values ``(m, N)`` from ``tensor`` ``(n_2, ..., n_d, m, n_1)`` and T_j of each coordinate, ``(n, d, N)``."""
    *others, m, first = tensor.shape
    values = (tensor.reshape(-1, first) @ polynomials[:first, 0]).reshape(*others, m, -1)
    for k, n in enumerate(others, start=1):
        # Term by term, because the compiler does not vectorise a sum over a middle axis.
        values = sum(values[j] * polynomials[j, k] for j in range(n))  # pyright: ignore[reportIndexIssue]
    return values  # pyright: ignore[reportReturnType]
