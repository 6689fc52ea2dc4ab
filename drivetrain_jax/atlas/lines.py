"""Number of nodes that each coordinate of a box needs, from probes along lines on its edges."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from drivetrain_jax.atlas import decay
from drivetrain_jax.atlas.box import BoxRefinement, Parts
from drivetrain_jax.atlas.interpolation import envelope

# Points of a line at first; each refinement doubles the intervals.
_LINE = 17
# Resolution of a line relative to the tolerance, and number of further nodes of the tensor, because lines along the edges do
# not show everything. The second pair is for three or more coordinates, with more lines and costlier nodes.
_THOROUGH, _MANY = (1 / 8, 2), (1 / 2, 0)
# Most lines along which a coordinate is probed.
_MAX_LINES = 8

Probe = Generator[np.ndarray, np.ndarray, Parts | list[int]]


def _corners(d: int, axis: int) -> list[np.ndarray]:
    """Ends of the other coordinates at which a line along ``axis`` is probed."""
    others = [k for k in range(d) if k != axis]
    corners = []
    for ends in product((-1.0, 1.0), repeat=len(others)):
        corner = np.zeros(d)
        corner[others] = ends
        corners.append(corner)
    return corners[:: max(1, len(corners) // _MAX_LINES)]


@dataclass(frozen=True)
class _Line:
    """A line through the box along ``axis``: values at ``len(values)`` Lobatto points."""

    axis: int
    corner: np.ndarray
    values: np.ndarray

    @cached_property
    def sizes(self) -> np.ndarray:
        return decay.line_sizes(self.values)


def _along(corner: np.ndarray, axis: int, t: np.ndarray) -> np.ndarray:
    points = np.repeat(corner[None], len(t), axis=0)
    points[:, axis] = t
    return points


def probe(refinement: BoxRefinement) -> Probe:
    """Number of nodes that each coordinate needs along the edges, or the halves or gap of a box with an unresolved line."""
    d = len(refinement.box.lower)
    places = [(axis, corner) for axis in range(d) for corner in _corners(d, axis)]
    t = np.concatenate([_along(corner, axis, decay.lobatto(_LINE)) for axis, corner in places])
    values = yield from refinement.solve(t)
    if not np.isfinite(values).all():
        return refinement.failed(values)
    fraction, margin = _MANY if d > 2 else _THOROUGH
    limit = refinement.settings.limit(values) * fraction
    lines = [_Line(*place, v) for place, v in zip(places, np.split(values, len(places)), strict=True)]

    def cost(line: _Line) -> tuple[float, float]:
        sizes = line.sizes
        return decay.needed(sizes, limit) or np.inf, envelope(sizes)[-3]

    worst = [max((line for line in lines if line.axis == axis), key=cost) for axis in range(d)]
    return (yield from _refine(refinement, worst, limit, margin))


def _refine(refinement: BoxRefinement, lines: list[_Line], limit: float, margin: int) -> Probe:
    """Refine the worst line of each coordinate until all are resolved, or one cannot be resolved."""
    while open_lines := [line for line in lines if decay.foreseen(line.sizes, limit) is None]:
        for line in open_lines:
            useless = _verdict(line, refinement)
            if useless:
                return useless
        t = [_along(line.corner, line.axis, decay.lobatto(2 * len(line.values) - 1)[1::2]) for line in open_lines]
        values = yield from refinement.solve(np.concatenate(t))
        if not np.isfinite(values).all():
            return refinement.failed(values)
        for line, new in zip(open_lines, np.split(values, np.cumsum([len(x) for x in t])[:-1]), strict=True):
            merged = np.empty((2 * len(line.values) - 1, values.shape[1]))
            merged[::2], merged[1::2] = line.values, new
            lines[line.axis] = replace(line, values=merged)
    degrees = [decay.foreseen(line.sizes, limit) + margin for line in lines]  # pyright: ignore[reportOptionalOperand]
    largest = int(np.argmax(degrees))
    if degrees[largest] > refinement.settings.max_nodes:
        return refinement.split(largest, f"more than {refinement.settings.max_nodes} nodes would be needed")
    return degrees


def _verdict(line: _Line, refinement: BoxRefinement) -> Parts | None:
    """The halves or gap of the box if refining ``line`` is useless; None if it helps."""
    if len(line.values) <= 2 * _LINE:
        return None
    sizes = line.sizes
    if decay.is_noise(sizes):
        level = envelope(sizes)[len(sizes) // 2] / sizes[0]
        return refinement.give_up(f"the direct solves scatter by {level:.0e}, more than the tolerance allows")
    if decay.is_algebraic(sizes):
        return refinement.trouble("not smooth: the coefficients fall like a power", line.axis)
    if len(line.values) > refinement.settings.max_nodes:
        return refinement.split(line.axis, "not resolved")
    return None
