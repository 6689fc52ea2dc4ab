"""A grid cut into tiles, each within one panel: the factors whose products are the values of the atlas there.

If cells are dense along the last axis, the needed functions of Phi are smooth over many cells. A tile is then evaluated
only at ``NODES`` Chebyshev nodes, and ``spread`` interpolates to the cells. Shapes are fixed, so that one compiled kernel
serves all tiles of a chart: tiles are padded, and so are the degrees of smaller panels (with coefficients 0).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.atlas.interpolation import analysis_matrix, nodes
from drivetrain_jax.atlas.panels import Atlas, Panel, between, chebyshev, position_between

# Nodes of a dense tile, and its largest angle arccos(t) times the degree of its panel. The highest polynomial runs through
# 5.5 rad to either side of the middle, where the 24th coefficient of an oscillation is 1e-13; the relevant ones run through
# half of it. The truncation error is measured in every tile.
NODES = 24
_SPAN = 11.0
# Fraction of the width of a tile above which nodes are used: other tiles cost half as much again, but are always full.
_DENSE = 2 / 3


@dataclass(frozen=True)
class Tile:
    """A rectangle of a grid within one panel.

    ``index`` holds the positions along each axis of the grid, one along each leading axis. ``first`` ``(R, m, n)`` is the
    contracted tensor of the panel in each row. ``columns`` ``(n, C)`` are T_j at the cells. In a dense tile ``columns``
    ``(n, NODES)`` are T_j at the nodes, and ``spread`` ``(NODES, C)`` interpolates from the nodes to the cells.
    """

    panel: Panel
    index: tuple[np.ndarray, ...]
    first: Array
    columns: np.ndarray
    spread: np.ndarray | None


def tiles(
    atlas: Atlas, axes: Sequence[np.ndarray], most: tuple[int, int], *, rows: int | None = None, dense: bool = True
) -> Iterator[Tile]:
    """Yield tiles that cover the panels' part of the grid of ``axes``, two or more rising arrays in coordinates.

    A tile has at most ``most`` rows and columns. Tiles overlap on faces that panels share: the last tile belongs to the
    panel of :meth:`Atlas.find`. Without ``dense`` no tile has nodes. A part of a chart of ``rows`` rows has tiles of the
    same shape as all other parts.
    """
    if not atlas.panels:
        return
    degrees = np.max([panel.degrees for panel in atlas.panels], axis=0)[-2:]
    # An even number of rows of tiles, so two cores finish at the same time.
    shape = _shared(rows or len(axes[-2]), most[0], 8, 2), _shared(len(axes[-1]), most[1], 16)
    # The last panel comes first, so that the first one keeps the faces that it shares.
    for panel in reversed(atlas.panels):
        groups = [np.flatnonzero(between(*ends)) for ends in zip(panel.lower, panel.upper, axes, strict=True)]
        if not all(map(len, groups)):
            continue
        bands = _bands(panel, axes[-1], groups[-1], degrees[1], shape[1], dense)
        # One band of each kind first, so that their kernels are compiled in parallel.
        first_of_kind = {spread is None: k for k, (*_, spread) in reversed(list(enumerate(bands)))}.values()
        bands = [bands[k] for k in sorted(range(len(bands)), key=lambda k: k not in first_of_kind)]
        for fixed, coefficients in _reductions(panel, axes, groups[:-2]):
            fill = [(0, n - k) for n, k in zip(degrees, coefficients.shape, strict=False)]
            tensor = np.ascontiguousarray(np.moveaxis(np.pad(coefficients, [*fill, (0, 0)]), -1, 1))
            for start in range(0, len(groups[-2]), shape[0]):
                chosen = groups[-2][start : start + shape[0]]
                weights = filled_up(chebyshev(_positions(panel, -2, axes[-2][chosen]), degrees[0]), shape[0])
                first = _first_product(weights, tensor)
                for cells, columns, spread in bands:
                    yield Tile(panel, (*fixed, chosen, cells), first, columns, spread)


@jax.jit
def _first_product(weights: Array, tensor: Array) -> Array:
    """``(R, n_1)`` times ``(n_1, m, n)``. The BLAS threads of NumPy would compete with the worker threads."""
    return jnp.einsum("rn,nx->rx", weights, tensor.reshape(len(tensor), -1)).reshape(-1, *tensor.shape[1:])


def _reductions(
    panel: Panel, axes: Sequence[np.ndarray], groups: Sequence[np.ndarray]
) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yield the position of each cell of the leading axes, and the coefficients of the last two coordinates there.

    Cells that share their first coordinates share the products with the whole tensor, which cost most.
    """

    def reduced(coefficients: np.ndarray, fixed: tuple[np.ndarray, ...]) -> Iterator[Any]:
        k = len(fixed)
        if k == len(groups):
            yield fixed, coefficients
            return
        for i in np.split(groups[k], len(groups[k])):
            weights = chebyshev(_positions(panel, k, axes[k][i]), panel.degrees[k])[0]
            yield from reduced(np.tensordot(weights, coefficients, axes=(0, 0)), (*fixed, i))

    return reduced(panel.coefficients, ())


def _shared(count: int, most: int, step: int, multiple: int = 1) -> int:
    """Size of the pieces of ``count`` cells, a multiple of ``step``, at most ``most``, and with little padding.

    The number of pieces is a multiple of ``multiple``. Padding costs as much as cells.
    """
    pieces = -(-count // (most * multiple)) * multiple
    return -(-count // (pieces * step)) * step


def _bands(
    panel: Panel, axis: np.ndarray, cells: np.ndarray, degree: int, width: int, dense: bool
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """The cells of a panel along the last axis in bands of at most ``width`` neighbours, each with the ``columns`` and the
    ``spread`` of its tiles."""
    t, bands, x, start = _positions(panel, -1, axis[cells]), [], nodes(NODES), 0
    angle = -np.arccos(t)
    # Cells that a band with nodes may span from each cell on, limited by the degree of the panel.
    spans = np.searchsorted(angle, angle + _SPAN / panel.degrees[-1], side="right") - np.arange(len(t))
    count = np.minimum(spans, width)
    while start < len(t):
        with_nodes = dense and count[start] >= max(_DENSE * width, 2 * NODES)
        part = slice(start, start + int(count[start] if with_nodes else width))
        at, spread = t[part], None
        # Cells at one position span no interval for nodes.
        if with_nodes and at[-1] > at[0]:
            place = np.clip(((at - at[0]) - (at[-1] - at)) / (at[-1] - at[0]), -1.0, 1.0)
            spread = np.ascontiguousarray(filled_up(chebyshev(place, NODES) @ analysis_matrix(NODES), width).T)
            columns = chebyshev(np.clip((at[0] * (1 - x) + at[-1] * (1 + x)) / 2, -1.0, 1.0), degree)
        else:
            columns = filled_up(chebyshev(at, degree), width)
        bands.append((cells[part], np.ascontiguousarray(columns.T), spread))
        start = part.stop
    return bands


def filled_up(rows: np.ndarray, size: int) -> np.ndarray:
    """``rows`` with the last one repeated up to ``size`` (``np.pad`` takes as long as a small tile)."""
    return rows if len(rows) == size else np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])


def _positions(panel: Panel, k: int, x: np.ndarray) -> np.ndarray:
    return position_between(panel.lower[k], panel.upper[k], x)
