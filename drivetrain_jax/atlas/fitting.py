"""The tensor of one box: solve, check, grow or split."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Protocol

import numpy as np

from drivetrain_jax.atlas import interpolation
from drivetrain_jax.atlas.interpolation import (
    analysis_matrix,
    coefficients,
    envelope,
    evaluate,
    nodes,
    slabs,
    tensor_nodes,
)
from drivetrain_jax.atlas.panels import Gap, Panel, position_between
from drivetrain_jax.atlas.quantity import Quantity, distance

# A box of an atlas under construction, and the operations shared by the steps of its construction.


# Splits along one coordinate of a box with failed solves or a kink, and splits of any box in total.
TROUBLED_DEPTH, _MAX_DEPTH = 2, 12


class NodeSource(Protocol):
    """Supplies the values at nodes without solves, in lines along the coordinate ``axis``.

    A line with a multiple of ``positions`` nodes costs no more than one with fewer.
    """

    axis: int
    positions: int

    def radians(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """About half the angle through which values turn on a line between two corners."""
        ...

    def start(self, axes: Sequence[np.ndarray]) -> Callable[[], np.ndarray]:
        """Start computing the grid of ``axes`` (coordinates); returns a function that waits for the values ``(N, m)``.

        Points are in C order; missing values are NaN.
        """
        ...


@dataclass(frozen=True)
class Settings:
    """Settings of all boxes.

    ``value_of`` converts solved numbers to values of the quantity ``(N, m)``. With a ``source`` only held-out points are
    solved.
    """

    quantity: Quantity
    tolerance: float
    max_nodes: int
    value_of: Callable[[np.ndarray], np.ndarray] = lambda solved: solved
    source: NodeSource | None = None

    def limit(self, values: np.ndarray) -> float:
        """Largest allowed error of the values, from a sample ``(N, m)``."""
        return self.tolerance * float(np.min(self.quantity.scale(values)))


@dataclass(frozen=True)
class Sample:
    """Solved points ``x`` ``(N, d)`` in coordinates and their values ``(N, m)``."""

    x: np.ndarray
    values: np.ndarray

    def within(self, lower: np.ndarray, upper: np.ndarray) -> Sample:
        """The sample points inside a box."""
        inside = ((self.x >= lower) & (self.x <= upper)).all(axis=1)
        return Sample(self.x[inside], self.values[inside])


@dataclass(frozen=True)
class Box:
    """A box in coordinates, the number of ``splits`` along each of them, and the ``known`` solves of its ancestors."""

    lower: np.ndarray
    upper: np.ndarray
    splits: tuple[int, ...]
    known: tuple[Sample, ...] = ()

    @classmethod
    def of(cls, part: Panel | Gap, splits: int = 0) -> Box:
        """The box of a panel or gap, as if split ``splits`` times along each coordinate."""
        return cls(part.lower, part.upper, (splits,) * len(part.lower))

    def place(self, t: np.ndarray) -> np.ndarray:
        """Coordinates of points ``t`` in [-1, 1]^d."""
        return (self.lower * (1 - t) + self.upper * (1 + t)) / 2

    def axes(self, degrees: Sequence[int]) -> list[np.ndarray]:
        """Coordinates of the nodes of a tensor, one array per coordinate."""
        ends = zip(self.lower, self.upper, map(nodes, degrees), strict=True)
        return [(lower * (1 - t) + upper * (1 + t)) / 2 for lower, upper, t in ends]

    def position(self, x: np.ndarray) -> np.ndarray:
        """Points ``t`` in [-1, 1]^d of coordinates ``x``."""
        return position_between(self.lower, self.upper, x)

    def halves(self, axis: int, solved: list[Sample]) -> tuple[Box, Box]:
        """The two halves along ``axis``."""
        splits = tuple(s + (k == axis) for k, s in enumerate(self.splits))
        left, right = self.upper.copy(), self.lower.copy()
        left[axis] = right[axis] = (self.lower[axis] + self.upper[axis]) / 2
        ends = ((self.lower, left), (right, self.upper))
        return tuple(Box(a, b, splits, tuple(s.within(a, b) for s in (*self.known, *solved))) for a, b in ends)  # pyright: ignore[reportReturnType]


Parts = tuple[Box | Panel | Gap, ...]
Refinement = Generator[np.ndarray, np.ndarray, Parts]


@dataclass
class BoxRefinement:
    """A box under construction."""

    box: Box
    settings: Settings
    solved: list[Sample] = field(default_factory=list)

    def solve(self, t: np.ndarray) -> Generator[np.ndarray, np.ndarray, np.ndarray]:
        """Solved values at points ``t`` in [-1, 1]^d; successful ones are stored."""
        x = self.box.place(t)
        values = yield x
        finite = np.isfinite(values).all(axis=1)
        self.solved.append(Sample(x[finite], values[finite]))
        return values

    def give_up(self, reason: str) -> Parts:
        """Leave a gap."""
        return (Gap(self.box.lower, self.box.upper, reason),)

    def failed(self, values: np.ndarray) -> Parts:
        """Handle a box with failed solves."""
        lost = int(np.sum(~np.isfinite(values).all(axis=1)))
        reason = f"{lost} of {len(values)} direct solves failed"
        return self.give_up(reason) if lost == len(values) else self.trouble(reason)

    def trouble(self, reason: str, axis: int | None = None) -> Parts:
        """Split an unresolved box along ``axis`` or the coordinate with the fewest splits, or leave a gap."""
        chosen = int(np.argmin(self.box.splits)) if axis is None else axis
        if self.box.splits[chosen] >= TROUBLED_DEPTH:
            return self.give_up(reason)
        return self.split(chosen, reason)

    def split(self, axis: int, reason: str) -> Parts:
        """The halves along ``axis``; a gap after too many splits."""
        if sum(self.box.splits) >= _MAX_DEPTH:
            return self.give_up(f"{reason} after {_MAX_DEPTH} splits")
        return self.box.halves(axis, self.solved)


# Number of nodes that each coordinate of a box needs, from probes along lines on its edges.


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
        return interpolation.line_sizes(self.values)


def _along(corner: np.ndarray, axis: int, t: np.ndarray) -> np.ndarray:
    points = np.repeat(corner[None], len(t), axis=0)
    points[:, axis] = t
    return points


def probe(refinement: BoxRefinement) -> Probe:
    """Number of nodes that each coordinate needs along the edges, or the halves or gap of a box with an unresolved line."""
    d = len(refinement.box.lower)
    places = [(axis, corner) for axis in range(d) for corner in _corners(d, axis)]
    t = np.concatenate([_along(corner, axis, interpolation.lobatto(_LINE)) for axis, corner in places])
    values = yield from refinement.solve(t)
    if not np.isfinite(values).all():
        return refinement.failed(values)
    fraction, margin = _MANY if d > 2 else _THOROUGH
    limit = refinement.settings.limit(values) * fraction
    lines = [_Line(*place, v) for place, v in zip(places, np.split(values, len(places)), strict=True)]

    def cost(line: _Line) -> tuple[float, float]:
        sizes = line.sizes
        return interpolation.needed(sizes, limit) or np.inf, envelope(sizes)[-3]

    worst = [max((line for line in lines if line.axis == axis), key=cost) for axis in range(d)]
    return (yield from _refine(refinement, worst, limit, margin))


def _refine(refinement: BoxRefinement, lines: list[_Line], limit: float, margin: int) -> Probe:
    """Refine the worst line of each coordinate until all are resolved, or one cannot be resolved."""
    while open_lines := [line for line in lines if interpolation.foreseen(line.sizes, limit) is None]:
        for line in open_lines:
            useless = _verdict(line, refinement)
            if useless:
                return useless
        t = [
            _along(line.corner, line.axis, interpolation.lobatto(2 * len(line.values) - 1)[1::2]) for line in open_lines
        ]
        values = yield from refinement.solve(np.concatenate(t))
        if not np.isfinite(values).all():
            return refinement.failed(values)
        for line, new in zip(open_lines, np.split(values, np.cumsum([len(x) for x in t])[:-1]), strict=True):
            merged = np.empty((2 * len(line.values) - 1, values.shape[1]))
            merged[::2], merged[1::2] = line.values, new
            lines[line.axis] = replace(line, values=merged)
    degrees = [interpolation.foreseen(line.sizes, limit) + margin for line in lines]  # pyright: ignore[reportOptionalOperand]
    largest = int(np.argmax(degrees))
    if degrees[largest] > refinement.settings.max_nodes:
        return refinement.split(largest, f"more than {refinement.settings.max_nodes} nodes would be needed")
    return degrees


def _verdict(line: _Line, refinement: BoxRefinement) -> Parts | None:
    """The halves or gap of the box if refining ``line`` is useless; None if it helps."""
    if len(line.values) <= 2 * _LINE:
        return None
    sizes = line.sizes
    if interpolation.is_noise(sizes):
        level = envelope(sizes)[len(sizes) // 2] / sizes[0]
        return refinement.give_up(f"the direct solves scatter by {level:.0e}, more than the tolerance allows")
    if interpolation.is_algebraic(sizes):
        return refinement.trouble("not smooth: the coefficients fall like a power", line.axis)
    if len(line.values) > refinement.settings.max_nodes:
        return refinement.split(line.axis, "not resolved")
    return None


HELD_OUT, _MAX_CHECKS = 64, 512
# Number of nodes from which the scale is estimated.
_SCALES = 128
# Ratio of a bound to the largest error at held-out points.
_SAFETY = 8.0
# Coefficients below this fraction of the tolerance are dropped, because they take most of the space of a large tensor.
_NEGLIGIBLE = 1e-3
_MAX_GROWTHS = 2
# Most nodes of a tensor, and most numbers at all nodes.
_MAX_TENSOR, MAX_NUMBERS = 300_000, 30_000_000


def fit(refinement: BoxRefinement, degrees: list[int]) -> Refinement:
    """A panel of about ``degrees`` nodes, or the halves or gap of the box instead."""
    d = len(degrees)
    most = min(_MAX_TENSOR, MAX_NUMBERS // refinement.settings.quantity.size)
    for growth in range(_MAX_GROWTHS + 1):
        if np.prod(degrees, dtype=float) > most:
            return refinement.split(int(np.argmax(degrees)), f"more than {most} nodes would be needed")
        checks = known_checks(refinement)
        extra = scattered(HELD_OUT, d) if growth == 0 else np.empty((0, d))
        values = yield from refinement.solve(np.concatenate([tensor_nodes(degrees), extra]))
        if not np.isfinite(values).all():
            return refinement.failed(values)
        values, fresh = np.split(values, [len(values) - len(extra)])
        x = np.concatenate([checks.x, refinement.box.place(extra)])
        checks = Sample(x, np.concatenate([checks.values, fresh]))
        tensor = coefficients(values, degrees)
        panel, tails, limit = accept_panel(refinement, tensor, values, checks)
        if panel is not None:
            return (panel,)
        if any(interpolation.is_noise(slabs(tensor, k)) for k in range(d) if tails[k] > 1 and degrees[k] > 24):
            return refinement.give_up("the direct solves scatter more than the tolerance allows")
        degrees = grown(tensor, tails, limit)
    return unresolved(refinement, tails)


def scattered(count: int, d: int) -> np.ndarray:
    """Held-out points in [-1, 1]^d: an additive recurrence, denser near the faces, where errors are largest."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (d + 1))
    fractions = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1, d + 1))) % 1
    return np.cos(np.pi * fractions)


def known_checks(refinement: BoxRefinement) -> Sample:
    """Solves that are not nodes of the next tensor, thinned evenly."""
    d = len(refinement.box.lower)
    none = Sample(np.empty((0, d)), np.empty((0, refinement.settings.quantity.size)))
    samples = [none, *refinement.box.known, *refinement.solved]
    x = np.concatenate([s.x for s in samples])
    values = np.concatenate([s.values for s in samples])
    chosen = np.linspace(0, len(x) - 1, min(len(x), _MAX_CHECKS)).astype(int)
    return Sample(x[chosen], values[chosen])


def accept_panel(
    refinement: BoxRefinement, tensor: np.ndarray, values: np.ndarray, checks: Sample, spare: float = 0.5
) -> tuple[Panel | None, np.ndarray, float]:
    """The panel (None if inaccurate), the truncation error of each coordinate relative to its limit, and this limit.

    The limit is half the allowed error of the values. Errors at the held-out points may use the fraction ``spare`` of the
    tolerance.
    """
    quantity, tolerance = refinement.settings.quantity, refinement.settings.tolerance
    t = refinement.box.position(checks.x)
    few = values[:: -(-len(values) // _SCALES)]
    scale = quantity.scale(np.concatenate([few, checks.values]))
    limit = tolerance * scale.min()
    tails = np.array([interpolation.remainder(slabs(tensor, k), limit) for k in range(tensor.ndim - 1)]) / (limit / 2)
    tensor = _without(tensor, _NEGLIGIBLE * limit)
    fitted = evaluate(tensor, t)
    errors = distance(fitted, checks.values)
    if (errors / scale[len(few) :]).max() > spare * tolerance or tails.max() > 1:
        return None, tails, limit / 2
    derived = np.abs(quantity.derived(fitted) - quantity.derived(checks.values))
    bounds = float(_SAFETY * errors.max()), _SAFETY * derived.max(axis=0, initial=0.0)
    return Panel(refinement.box.lower, refinement.box.upper, tensor, *bounds), tails, limit / 2


def _without(tensor: np.ndarray, negligible: float) -> np.ndarray:
    """``tensor`` without the coefficients below ``negligible``, as small as possible."""
    large = np.max(np.abs(tensor), axis=-1) > negligible
    kept = tuple(
        slice(int(np.max(np.flatnonzero(large.any(axis=tuple(set(range(large.ndim)) - {k}))), initial=0)) + 1)
        for k in range(large.ndim)
    )
    return np.where(large[..., None], tensor, 0.0)[kept]


def grown(tensor: np.ndarray, tails: np.ndarray, limit: float) -> list[int]:
    """Numbers of nodes, larger where the tail is too large; all a little larger if only held-out points exceed the limit."""
    degrees = list(tensor.shape[:-1])
    if tails.max() <= 1:
        return [n + max(2, n // 10) for n in degrees]
    sizes = [slabs(tensor, k) for k in range(len(degrees))]
    return [
        interpolation.extrapolated(s, limit) if tail > 1 else n
        for n, s, tail in zip(degrees, sizes, tails, strict=True)
    ]


def unresolved(refinement: BoxRefinement, tails: np.ndarray) -> Parts:
    """The halves or gap of a box whose tensor has grown often enough."""
    axis = int(np.argmax(tails)) if tails.max() > 1 else None
    return refinement.trouble("not resolved where its edges are: not smooth", axis)


# The panel of a box whose nodes come from a cheap source in lines; only held-out points are solved.
#
# With one or two coordinates the tensor starts with enough nodes for most boxes, and grows until its coefficients have
# fallen. With more coordinates there are many lines, so the edges are probed first.


# Number of lines at the start, and of lines that probe the need of a coordinate.
_LINES, _PROBES = 32, 64
# Further nodes beyond those that the edges need, because edges do not show everything. Further nodes along lines beyond one
# per radian, in units of the cube root of the radians.
_SPARE, _BEYOND = 2, 10.0
# Most boxes along a line: cutting a box into more of them does not pay.
_MOST_BOXES = 100
_SOURCE_GROWTHS = 8


def fit_given(refinement: BoxRefinement, source: NodeSource) -> Refinement:
    """A panel with nodes from ``source`` that agrees with solves, or the halves or gap of the box instead."""
    d, most = len(refinement.box.lower), MAX_NUMBERS // refinement.settings.quantity.size
    most_along, checks = refinement.settings.max_nodes, None
    radians = source.radians(refinement.box.lower, refinement.box.upper)
    if not radians < _MOST_BOXES * most_along:
        return refinement.give_up("too many nodes would be needed")
    if radians > most_along:
        return refinement.split(source.axis, "not resolved")
    # Along lines cos(r x) and sin(r x) have coefficients J_n(r), which fall beyond n = r.
    along = min(round(radians + _BEYOND * np.cbrt(radians)), most_along)
    degrees = [max(along, 1) if k == source.axis else _LINES for k in range(d)]
    if d > 2:
        degrees = _probed(refinement, source, _suited(degrees, source))
    for _ in range(_SOURCE_GROWTHS + 1):
        largest = int(np.argmax(degrees))
        if degrees[largest] > most_along or np.prod(degrees, dtype=float) > most:
            return refinement.split(largest, "not resolved")
        degrees = _suited(degrees, source)
        waiting = source.start(refinement.box.axes(degrees))
        if checks is None:
            # Held-out points are solved while the source computes the nodes.
            solved = yield from refinement.solve(_held_out(d))
            if not np.isfinite(solved).all():
                return refinement.failed(solved)
            checks = known_checks(refinement)
        values = waiting()
        if not np.isfinite(values).all():
            return refinement.trouble("no values at the nodes")
        tensor = coefficients(values, degrees)
        panel, tails, limit = accept_panel(refinement, tensor, values, checks, spare=1.0)
        if panel is not None:
            return (panel,)
        if tails.max() <= 1:
            return refinement.give_up("the nodes are not what is solved")
        degrees = _resized(tensor, tails, limit)
    return unresolved(refinement, tails)


def _held_out(d: int) -> np.ndarray:
    """The corners of [-1, 1]^d, where propagators are largest, and scattered points."""
    corners = np.array(list(product((-1.0, 1.0), repeat=d)))
    return np.concatenate([corners, scattered(HELD_OUT - len(corners), d)])


def _suited(degrees: list[int], source: NodeSource) -> list[int]:
    """``degrees``, rounded up where more nodes cost nothing."""
    return [-(-n // source.positions) * source.positions if k == source.axis else n for k, n in enumerate(degrees)]


def _probed(refinement: BoxRefinement, source: NodeSource, degrees: list[int]) -> list[int]:
    """Number of nodes that each coordinate needs along the edges of the box; ``degrees`` if values are missing."""
    box, d = refinement.box, len(refinement.box.lower)
    ends = [np.array(pair) for pair in zip(box.lower, box.upper, strict=True)]
    counts = [degrees[k] if k == source.axis else _PROBES for k in range(d)]
    along = box.axes(counts)
    found = [1] * d
    started = []
    for k in set(range(d)) - {source.axis}:
        axes = [along[j] if j in (k, source.axis) else ends[j] for j in range(d)]
        started.append((k, [len(axis) for axis in axes], source.start(axes)))
    for k, shape, waiting in started:
        values = waiting()
        if not np.isfinite(values).all():
            return degrees
        limit = refinement.settings.limit(values) / 2
        tensor = values.reshape(*shape, -1)
        for axis in (k, source.axis):
            sizes = slabs(np.tensordot(analysis_matrix(shape[axis]), tensor, axes=(1, axis)), 0)
            needed = _needed(sizes, limit) if sizes[-3:].max() <= limit else interpolation.extrapolated(sizes, limit)
            found[axis] = max(found[axis], needed + _SPARE)
    return found


def _resized(tensor: np.ndarray, tails: np.ndarray, limit: float) -> list[int]:
    """Numbers of nodes: larger where the tail is too large, only as large as needed elsewhere."""
    more = zip(tensor.shape, grown(tensor, tails, limit), tails, strict=False)
    return [
        count if tail > 1 else min(n, _needed(slabs(tensor, k), limit) + _SPARE)
        for k, (n, count, tail) in enumerate(more)
    ]


def _needed(sizes: np.ndarray, limit: float) -> int:
    """Number of polynomials whose truncated coefficients are all below ``limit``."""
    return int(np.count_nonzero(envelope(sizes) > limit))
