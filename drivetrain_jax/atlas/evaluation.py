"""A grid cut into tiles, each within one panel: the factors whose products are the values of the atlas there.

If cells are dense along the last axis, the needed functions of Phi are smooth over many cells. A tile is then evaluated
only at ``NODES`` Chebyshev nodes, and ``spread`` interpolates to the cells. Shapes are fixed, so that one compiled kernel
serves all tiles of a chart: tiles are padded, and so are the degrees of smaller panels (with coefficients 0).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
# Widths are multiples of a step. Cost of a cell with and without nodes, and of a row of a tile, in cells. A width is chosen
# over the one that divides the cells evenly below this ratio of costs, so that most charts of a size share one kernel.
_STEP, _COSTS, _ROW, _WORTH = 16, {True: 1.0, False: 1.6}, 100, 0.95


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


@dataclass(frozen=True)
class _Band:
    """The cells of a tile along the last axis, with its ``columns`` and ``spread``."""

    chosen: np.ndarray
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
    shape = _shared(rows or len(axes[-2]), most[0], 8, 2), _width(atlas, axes[-1], most[1], dense)
    for panel, groups in _assigned(atlas, axes):
        bands = _kinds_first(list(_bands(panel, axes[-1], groups[-1], degrees[1], shape[1], dense)))
        for fixed, reduced in _reductions(panel, axes, groups[:-2]):
            tensor = _padded(reduced, degrees)
            for start in range(0, len(groups[-2]), shape[0]):
                chosen = groups[-2][start : start + shape[0]]
                weights = filled_up(chebyshev(_positions(panel, -2, axes[-2][chosen]), degrees[0]), shape[0])
                first = _first_product(weights, tensor)
                for band in bands:
                    yield Tile(panel, (*fixed, chosen, band.chosen), first, band.columns, band.spread)


def _padded(panel: Panel, degrees: Sequence[int]) -> np.ndarray:
    """Coefficients as ``(n_1, m, n_2, ..., n_d)``, padded with zeros to ``degrees``."""
    fill = [(0, n - k) for n, k in zip(degrees, panel.degrees, strict=True)]
    return np.ascontiguousarray(np.moveaxis(np.pad(panel.coefficients, [*fill, (0, 0)]), -1, 1))


@jax.jit
def _first_product(weights: Array, tensor: Array) -> Array:
    """``(R, n_1)`` times ``(n_1, m, n)``. The BLAS threads of NumPy would compete with the worker threads."""
    return jnp.einsum("rn,nx->rx", weights, tensor.reshape(len(tensor), -1)).reshape(-1, *tensor.shape[1:])


def _reductions(
    panel: Panel, axes: Sequence[np.ndarray], groups: Sequence[np.ndarray]
) -> Iterator[tuple[tuple[np.ndarray, ...], Panel]]:
    """Yield the position of each cell of the leading axes, and the panel of the last two coordinates there.

    Cells that share their first coordinates share the products with the whole tensor, which cost most.
    """

    def reduced(
        coefficients: np.ndarray, fixed: tuple[np.ndarray, ...]
    ) -> Iterator[tuple[tuple[np.ndarray, ...], Panel]]:
        k = len(fixed)
        if k == len(groups):
            yield fixed, Panel(panel.lower[-2:], panel.upper[-2:], coefficients, 0.0)
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


def _width(atlas: Atlas, axis: np.ndarray, most: int, dense: bool) -> int:
    """The cheapest width of tiles for a row of the grid.

    It depends on the last axis alone, so parts of a chart share kernels.
    """
    even = _shared(len(axis), most, _STEP)
    panels = {(panel.lower[-1], panel.upper[-1], panel.degrees[-1]): panel for panel in atlas.panels}.values()
    all_spans = [_spans(panel, _positions(panel, -1, axis[_covered(panel, -1, axis)])) for panel in panels]

    def cost(width: int) -> float:
        cuts = (cut for spans in all_spans for cut in _cuts(spans, width, dense))
        return sum(_COSTS[with_nodes] * width + _ROW for _, _, with_nodes in cuts)

    widths = range(most // 3 // _STEP * _STEP, min(most, even + most // 4) + 1, _STEP)
    best = min([even, *widths], key=cost)
    return best if cost(best) < _WORTH * cost(even) else even


def _spans(panel: Panel, t: np.ndarray) -> np.ndarray:
    """Number of cells that a tile with nodes may span from each cell on, limited by the degree of the panel."""
    angle = -np.arccos(t)
    return np.searchsorted(angle, angle + _SPAN / panel.degrees[-1], side="right") - np.arange(len(t))


def _cuts(spans: np.ndarray, width: int, dense: bool) -> Iterator[tuple[int, int, bool]]:
    """Yield ``start, end`` of ranges of at most ``width`` neighbouring cells, and whether a range has nodes."""
    count = np.minimum(spans, width)
    with_nodes = dense & (count >= max(_DENSE * width, 2 * NODES))
    start = 0
    while start < len(spans):
        end = min(start + int(count[start] if with_nodes[start] else width), len(spans))
        yield start, end, bool(with_nodes[start])
        start = end


def _bands(panel: Panel, axis: np.ndarray, cells: np.ndarray, degree: int, width: int, dense: bool) -> Iterator[_Band]:
    """Yield the cells of a panel along the last axis, cut into bands."""
    t = _positions(panel, -1, axis[cells])
    for start, end, with_nodes in _cuts(_spans(panel, t), width, dense):
        # Cells at one position span no interval for nodes.
        band = _dense if with_nodes and t[end - 1] > t[start] else _sparse
        yield band(cells[start:end], t[start:end], degree, width)


def _kinds_first(bands: list[_Band]) -> list[_Band]:
    """One band of each kind first, so that their kernels are compiled in parallel."""
    first = list({band.spread is None: band for band in reversed(bands)}.values())
    return first + [band for band in bands if all(band is not other for other in first)]


def _sparse(cells: np.ndarray, t: np.ndarray, degree: int, width: int) -> _Band:
    return _Band(cells, np.ascontiguousarray(filled_up(chebyshev(t, degree), width).T), None)


def _dense(cells: np.ndarray, t: np.ndarray, degree: int, width: int) -> _Band:
    x = nodes(NODES)
    low, high = t[0], t[-1]
    place = np.clip(((t - low) - (high - t)) / (high - low), -1.0, 1.0)
    spread = filled_up(chebyshev(place, NODES) @ analysis_matrix(NODES), width).T
    at_nodes = np.clip((low * (1 - x) + high * (1 + x)) / 2, -1.0, 1.0)
    return _Band(cells, np.ascontiguousarray(chebyshev(at_nodes, degree).T), np.ascontiguousarray(spread))


def filled_up(rows: np.ndarray, size: int) -> np.ndarray:
    """``rows`` with the last one repeated up to ``size`` (``np.pad`` takes as long as a small tile)."""
    return rows if len(rows) == size else np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])


def _positions(panel: Panel, k: int, x: np.ndarray) -> np.ndarray:
    return position_between(panel.lower[k], panel.upper[k], x)


def _assigned(atlas: Atlas, axes: Sequence[np.ndarray]) -> Iterator[tuple[Panel, list[np.ndarray]]]:
    """Yield the panels, last one first, with the positions along each axis that the panel covers, faces included."""
    for panel in reversed(atlas.panels):
        groups = [_covered(panel, k, x) for k, x in enumerate(axes)]
        if all(len(g) for g in groups):
            yield panel, groups


def _covered(panel: Panel, k: int, x: np.ndarray) -> np.ndarray:
    """Positions in ``x``, along the coordinate k, that a panel covers."""
    return np.flatnonzero(between(panel.lower[k], panel.upper[k], x))
