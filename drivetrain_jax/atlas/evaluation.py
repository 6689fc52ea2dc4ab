"""Values of an atlas at scattered points and on grids, by matrix products panel by panel.

Shapes are fixed, so that each compiled kernel serves all tiles of a chart: tiles are padded, and so are the degrees of
smaller panels (with coefficients 0). The lanes are the last axis of every array.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.atlas.panels import Atlas, Panel, chebyshev, position

# Numbers that the first product of a block of scattered points may make.
_WORKING_SET = 1 << 22


def scattered(tensor: Array, weights: Sequence[Array]) -> Array:
    """Values ``(m, N)`` from ``tensor`` ``(n_1, m, n_2, ..., n_d)`` and T_j of each coordinate, ``(n_k, N)``."""
    n, m, *rest = tensor.shape
    values = (tensor.reshape(n, -1).T @ weights[0]).reshape(m, *rest, -1)
    for w in reversed(weights[1:]):
        values = jnp.sum(values * w, axis=-2)
    return values


def first_product(tensor: Array, rows: Array) -> Array:
    """What is left of ``tensor`` ``(n_1, m, n_2)`` in each row, ``(R, m, n_2)``, with T_j of the rows, ``(R, n_1)``.

    Its product with T_j of the columns, ``(n_2, C)``, gives the values on the grid.
    """
    n, m, k = tensor.shape
    return (rows @ tensor.reshape(n, m * k)).reshape(-1, m, k)


def block_size(atlas: Atlas) -> int:
    """Scattered points to be evaluated at a time."""
    rest = max((int(np.prod(p.coefficients.shape[1:])) for p in atlas.panels), default=1)
    return int(2 ** np.clip(np.floor(np.log2(_WORKING_SET / rest)), 6, 10))


def common_degrees(panels: Sequence[Panel]) -> tuple[int, ...]:
    """The largest degrees among ``panels``."""
    return tuple(np.max([p.degrees for p in panels], axis=0))


def padded_tensor(panel: Panel, degrees: Sequence[int]) -> np.ndarray:
    """Coefficients as ``(n_1, m, n_2, ..., n_d)``, filled up with zeros to ``degrees``."""
    fill = [(0, n - k) for n, k in zip(degrees, panel.degrees, strict=True)]
    return np.ascontiguousarray(np.moveaxis(np.pad(panel.coefficients, [*fill, (0, 0)]), -1, 1))


def point_weights(panel: Panel, x: np.ndarray, degrees: Sequence[int], size: int) -> list[np.ndarray]:
    """``weights`` of :func:`scattered` for points in coordinates ``(N, d)``, filled up to ``size`` with the last one."""
    t = np.pad(position(panel, x), ((0, size - len(x)), (0, 0)), mode="edge")
    return [np.ascontiguousarray(chebyshev(t[:, k], n).T) for k, n in enumerate(degrees)]


@dataclass(frozen=True)
class Tile:
    """A rectangle of a grid within one panel.

    ``index`` are the positions along each axis of the grid: one number for each leading axis, arrays for the last two.
    ``tensor`` ``(n_1, m, n_2)`` is the panel's with its leading coordinates fixed; ``rows`` ``(R, n_1)`` and ``columns``
    ``(n_2, C)`` are T_j there, filled up.
    """

    panel: Panel
    index: tuple[np.ndarray, ...]
    tensor: np.ndarray
    rows: np.ndarray
    columns: np.ndarray


def tiles(atlas: Atlas, axes: Sequence[np.ndarray], shape: tuple[int, int]) -> Iterator[Tile]:
    """Tiles of at most ``shape`` cells that cover what panels cover of the grid of ``axes``, two or more, in coordinates.

    A cell on a face that panels share belongs to the first of them.
    """
    if not atlas.panels:
        return
    degrees = common_degrees(atlas.panels)[-2:]
    for panel, groups in _assigned(atlas, axes):
        for leading in np.ndindex(*(len(g) for g in groups[:-2])):
            fixed = [g[i] for g, i in zip(groups[:-2], leading, strict=True)]
            reduced = panel.coefficients
            for k, i in enumerate(fixed):
                weights = chebyshev(_positions(panel, k, axes[k][i : i + 1]), panel.degrees[k])[0]
                reduced = np.tensordot(weights, reduced, axes=(0, 0))
            tensor = padded_tensor(Panel(panel.lower[-2:], panel.upper[-2:], reduced, 0.0, np.empty(0)), degrees)
            for rows, columns in _rectangles(groups[-2], groups[-1], shape):
                parts = [
                    np.pad(
                        chebyshev(_positions(panel, k, axes[k][chosen]), n), ((0, size - len(chosen)), (0, 0)), "edge"
                    )
                    for k, chosen, n, size in zip((-2, -1), (rows, columns), degrees, shape, strict=True)
                ]
                index = (*(np.array([i]) for i in fixed), rows, columns)
                yield Tile(panel, index, tensor, parts[0], np.ascontiguousarray(parts[1].T))


def _positions(panel: Panel, k: int, x: np.ndarray) -> np.ndarray:
    lower, upper = panel.lower[k], panel.upper[k]
    return np.clip(((x - lower) - (upper - x)) / (upper - lower), -1.0, 1.0)


def _assigned(atlas: Atlas, axes: Sequence[np.ndarray]) -> Iterator[tuple[Panel, list[np.ndarray]]]:
    """For each panel the positions along each axis that it covers. Panels share faces: these are given to all of them,
    which does no harm, as they agree there within their bounds."""
    for panel in atlas.panels:
        slack = 8 * np.finfo(float).eps * np.maximum(np.abs(panel.lower), np.abs(panel.upper))
        groups = [
            np.flatnonzero((x >= panel.lower[k] - slack[k]) & (x <= panel.upper[k] + slack[k]))
            for k, x in enumerate(axes)
        ]
        if all(len(g) for g in groups):
            yield panel, groups


def _rectangles(
    rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for i in range(0, len(rows), shape[0]):
        for j in range(0, len(columns), shape[1]):
            yield rows[i : i + shape[0]], columns[j : j + shape[1]]
