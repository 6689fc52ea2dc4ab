"""Construction of an atlas, box by box, starting with the whole domain.

The nodes along each coordinate are doubled on the edges of the box until the coefficients have fallen. The tensor of these
degrees grows until its coefficients have fallen too. Direct solves at held-out points test every panel. A box that needs
too many nodes, or where solves fail, is halved. What remains unresolved is a :class:`~drivetrain_jax.atlas.Gap` with its
reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from drivetrain_jax.atlas.interpolation import (
    analysis_matrix,
    coefficients,
    envelope,
    evaluate,
    nodes,
    slabs,
    without_smallest,
)
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, position_between
from drivetrain_jax.systems import Coordinate

MAX_SOLVES = 400_000
# Nodes along a coordinate: at first where they are solved and where they are given, and at most. Numbers at all nodes of a
# panel.
_FIRST, FIRST_GIVEN, _MOST, _MAX_NUMBERS = 16, 48, 128, 30_000_000
# Nodes of a tensor beyond those that the edges need, and times that it may grow.
_MARGIN, _GROWTHS = 2, 4
# Splits of a box along a coordinate where solves fail and where too many nodes would be needed, and along all together.
_FAILED, _UNRESOLVED, _MOST_SPLITS = 2, 6, 8
HELD_OUT = 64
# Ratio of a bound to the largest error at held-out points.
_SAFETY = 8.0
# Fraction of the tolerance that dropped coefficients may take, and that those on edges may have.
_NEGLIGIBLE, _RESOLVED = 1e-3, 1 / 50
# Coefficients that stop falling below this fraction of the largest one are noise of the solves.
_NOISE = 1e-6
# Relative width of a box in a coordinate that does not vary.
_THINNEST = 1e-15

Axes = Sequence[np.ndarray]
# The values ``(N, m)`` on a grid in C order.
Grid = Callable[[Axes], np.ndarray]


@dataclass(frozen=True)
class Function:
    """The m functions that an atlas interpolates; points are in coordinates.

    ``solve(x)``: values ``(N, m)`` at points ``(N, d)`` by direct solves, NaN where they fail, and bounds of the norms of
    their errors ``(N,)``. ``scale(values)`` ``(N,)``: the tolerance of an atlas limits the norm of the error over this.
    ``grid`` computes values on grids by other means than solves, NaN where they fail.
    """

    solve: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    scale: Callable[[np.ndarray], np.ndarray]
    grid: Grid | None = None


@dataclass(frozen=True)
class Box:
    """A box in coordinates, and the number of ``splits`` along each of them."""

    lower: np.ndarray
    upper: np.ndarray
    splits: tuple[int, ...]

    def place(self, t: np.ndarray, k: int | slice = slice(None)) -> np.ndarray:
        """Coordinates of points ``t`` in [-1, 1]^d, or the coordinate ``k`` of positions in [-1, 1]."""
        return (self.lower[k] * (1 - t) + self.upper[k] * (1 + t)) / 2

    def halves(self, axis: int) -> tuple[Box, Box]:
        """The two halves along ``axis``."""
        splits = tuple(s + (k == axis) for k, s in enumerate(self.splits))
        left, right = self.upper.copy(), self.lower.copy()
        left[axis] = right[axis] = (self.lower[axis] + self.upper[axis]) / 2
        return Box(self.lower, left, splits), Box(right, self.upper, splits)


@dataclass(frozen=True)
class Domain:
    """The box ``lower``..``upper`` of ``parameters`` with their ``coordinates``; the other parameters are ``fixed``."""

    parameters: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    coordinates: tuple[Coordinate, ...]
    fixed: Mapping[str, float]

    def box(self) -> Box:
        """The domain in its coordinates."""
        ends = [self._ends(k) for k in range(len(self.parameters))]
        lower, upper = (np.array([of(e) for e in ends], float) for of in (min, max))
        # Different values may have the same coordinate.
        wider = upper + np.maximum(_THINNEST * np.abs(upper), np.finfo(float).tiny)
        return Box(lower, np.where(upper > lower, upper, wider), (0,) * len(ends))

    def points(self, x: np.ndarray) -> np.ndarray:
        """Parameters of points in coordinates, ``(N, d)``, clipped to the domain against rounding."""
        columns = []
        for k, coordinate in enumerate(self.coordinates):
            ends = coordinate.inverse(np.array(self._ends(k)))
            columns.append(np.clip(coordinate.inverse(x[:, k]), ends.min(), ends.max()))
        return np.stack(columns, axis=-1)

    def _ends(self, k: int) -> list[float]:
        """Coordinates between which the domain lies; an even coordinate also includes that of 0."""
        even = self.coordinates[k].even and self.lower[k] < 0 < self.upper[k]
        values = self.lower[k], self.upper[k], *((0.0,) if even else ())
        return [float(self.coordinates[k].forward(value)) for value in values]


class _Unresolved(Exception):
    """A box has no panel: it is halved along ``axis`` (None: the one split least), at most ``most`` times, else a gap."""

    def __init__(self, reason: str, axis: int | None, most: int) -> None:
        super().__init__(reason)
        self.axis, self.most = axis, most


class _Exhausted(Exception):
    """No more solves are allowed."""


def construct(domain: Domain, function: Function, tolerance: float, max_solves: int = MAX_SOLVES) -> Atlas:
    """An atlas of ``function`` over ``domain`` with errors of about ``tolerance`` times its scale.

    Where more than ``max_solves`` would be needed, the boxes that are still open become gaps. Equal values give equal
    requests, so a construction can be repeated from stored answers.
    """
    boxes, panels, gaps = [domain.box()], [], []
    task = _Construction(function, tolerance, max_solves)
    while boxes:
        box = boxes.pop(0)
        try:
            panels.append(task.panel(box))
        except _Exhausted as end:
            gaps += [Gap(open_box.lower, open_box.upper, str(end)) for open_box in (box, *boxes)]
            break
        except _Unresolved as end:
            axis = int(np.argmin(box.splits)) if end.axis is None else end.axis
            if box.splits[axis] < end.most and sum(box.splits) < _MOST_SPLITS:
                boxes += box.halves(axis)
            else:
                gaps.append(Gap(box.lower, box.upper, str(end)))
    frame = domain.parameters, domain.coordinates, np.array(domain.lower, float), np.array(domain.upper, float)
    return Atlas(*frame, dict(domain.fixed), tuple(panels), tuple(gaps), tolerance, task.solves)


class _Construction:
    """Makes the panels of boxes, and counts the solves."""

    def __init__(self, function: Function, tolerance: float, max_solves: int) -> None:
        self._function, self._tolerance, self._most, self.solves = function, tolerance, max_solves, 0
        # Largest error bound of the solves for a box.
        self._error = 0.0

    def panel(self, box: Box) -> Panel:
        """The panel of a box; raises :class:`_Unresolved` if it has none."""
        self._error = 0.0
        x = box.place(_held_out(len(box.lower)))
        checks = x, self._solve(x)
        # Values that are not what is solved are not used.
        grid = self._function.grid
        return (grid and self._fitted(box, checks, grid)) or self._fitted(box, checks, None)  # pyright: ignore[reportReturnType]

    def _solve(self, x: np.ndarray) -> np.ndarray:
        """Values at points ``(N, d)``; raises if solves fail or are too many."""
        if self.solves + len(x) > self._most:
            raise _Exhausted(f"more than {self._most} solves would be needed")
        self.solves += len(x)
        values, errors = self._function.solve(x)
        if lost := int(np.sum(~np.isfinite(values).all(axis=1))):
            raise _Unresolved(f"{lost} of {len(x)} direct solves failed", None, 0 if lost == len(x) else _FAILED)
        self._error = max(self._error, float(errors.max()))
        return values

    def _solved(self, axes: Axes) -> np.ndarray:
        return self._solve(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)))

    def _fitted(self, box: Box, checks: tuple[np.ndarray, np.ndarray], grid: Grid | None) -> Panel | None:
        """The panel from values of ``grid``, or of solves. None if ``grid`` does not compute what is solved.

        ``checks`` are held-out points and their values.
        """
        (x, exact), compute = checks, grid or self._solved
        scale, t = self._function.scale(exact), position_between(box.lower, box.upper, x)
        limit = self._tolerance * float(scale.min())
        counts = [self._needed(box, k, limit, compute) + _MARGIN for k in range(len(box.lower))]
        tails = np.zeros(len(counts))
        for _ in range(_GROWTHS):
            if np.prod(counts, dtype=float) * exact.shape[1] > _MAX_NUMBERS:
                raise _Unresolved("too many nodes would be needed", int(np.argmax(counts)), _UNRESOLVED)
            values = compute([box.place(nodes(n), k) for k, n in enumerate(counts)])
            if not np.isfinite(values).all():
                return None
            tensor = coefficients(values, counts)
            tails = np.array([slabs(tensor, k)[-2:].sum() for k in range(len(counts))]) / (limit / 2)
            # Coefficients far below the error of the values are their noise.
            noise = np.linalg.norm(evaluate(tensor, t) - exact, axis=1).max() / np.prod(counts) ** 0.5
            tensor = without_smallest(tensor, noise, _NEGLIGIBLE * limit)
            errors = np.linalg.norm(evaluate(tensor, t) - exact, axis=1)
            if (errors / scale).max() <= self._tolerance / 2 and tails.max() <= 1:
                # Held-out solves do not show the error that all solved nodes have in common.
                error = _SAFETY * errors.max() + _NEGLIGIBLE * limit + (0.0 if grid else self._error)
                return Panel(box.lower, box.upper, tensor, float(error))
            grows = (tails > 1) | (tails.max() <= 1)
            counts = [n + max(2, n // 6) if more else n for n, more in zip(counts, grows, strict=True)]
        if grid and tails.max() <= 1:
            return None
        raise _Unresolved("not resolved: not smooth", int(np.argmax(tails)) if tails.max() > 1 else None, _FAILED)

    def _needed(self, box: Box, axis: int, limit: float, compute: Grid) -> int:
        """Number of polynomials along a coordinate on all edges of the box."""
        ends = [np.array(pair) for pair in zip(box.lower, box.upper, strict=True)]
        count = _FIRST if compute == self._solved else FIRST_GIVEN
        while True:
            axes = [box.place(nodes(count), k) if k == axis else end for k, end in enumerate(ends)]
            values = compute(axes).reshape(*map(len, axes), -1)
            tail = envelope(slabs(np.tensordot(analysis_matrix(count), values, axes=(1, axis)), 0))
            # Where values are missing, the tensor shows it.
            if not tail[-3] > _RESOLVED * limit:
                return int(np.count_nonzero(tail > _RESOLVED * limit))
            if count >= _MOST:
                if tail[count // 2] < 4 * tail[-count // 8] and tail[count // 2] < _NOISE * tail[0]:
                    level = tail[count // 2] / tail[0]
                    raise _Unresolved(f"the values scatter by {level:.0e}, more than the tolerance allows", axis, 0)
                raise _Unresolved("not resolved: too many nodes would be needed", axis, _UNRESOLVED)
            count = min(2 * count, _MOST)


def _held_out(d: int) -> np.ndarray:
    """Points in [-1, 1]^d for checks: the corners, points on the faces, where errors are largest, and others in between."""
    corners = np.array(list(product((-1.0, 1.0), repeat=d)))
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (d + 1))
    # An additive recurrence, denser near the faces.
    numbers = np.arange(1, HELD_OUT - len(corners) + 1)
    t = np.cos(np.pi * ((0.5 + np.outer(numbers, root ** -np.arange(1, d + 1))) % 1))
    if d > 1:
        faces = numbers[: len(t) // 2] - 1
        t[faces, faces % d] = np.where(faces // d % 2, 1.0, -1.0)
    return np.concatenate([corners, t])
