"""Construction of an atlas, box by box, starting with the whole domain.

- Where the function says how many polynomials a box needs (:attr:`Function.degrees`), and these are not too many, they are
  computed at once; the truncation error is known beforehand.
- Otherwise the nodes along each coordinate are doubled on the edges of the box until the coefficients have fallen. The
  tensor of these degrees grows until its coefficients have fallen too. The truncation error is an estimate.

Direct solves at held-out points test every panel. A box that needs too many nodes, or where solves fail, is halved. What
remains unresolved is a :class:`~drivetrain_jax.atlas.Gap` with its reason.
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
# Nodes along a coordinate: at first, and at most where they are found or known beforehand. Numbers at all nodes of a panel.
_FIRST, _MOST, _MOST_GIVEN, _MAX_NUMBERS = 16, 128, 256, 30_000_000
# Nodes of a tensor beyond those that the edges need, and times that it may grow.
_MARGIN, _GROWTHS = 2, 4
# Splits of a box along a coordinate where solves fail and where too many nodes would be needed, and along all together.
_FAILED, _UNRESOLVED, _MOST_SPLITS = 2, 6, 8
HELD_OUT = 64
# Ratio of a bound to the largest error at held-out points: where these show rounding alone, and where truncation as well.
_SAFETY_KNOWN, _SAFETY = 4.0, 8.0
# Fraction of the tolerance that dropped coefficients may take, and that those on edges may have.
_NEGLIGIBLE, _RESOLVED = 1e-3, 1 / 8
# Coefficients that stop falling below this fraction of the largest one are noise of the solves.
_NOISE = 1e-6
# Relative width of a box in a coordinate that does not vary.
_THINNEST = 1e-15

Axes = Sequence[np.ndarray]
# Starts to compute the values on a grid; returns a function that waits for them, ``(N, m)`` in C order.
Start = Callable[[Axes], Callable[[], np.ndarray]]
# Held-out points in coordinates and their values.
Checks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Function:
    """The m functions that an atlas interpolates; points are in coordinates.

    ``solve(x)``: values ``(N, m)`` at points ``(N, d)`` by direct solves, NaN where they fail, and bounds of the norms of
    their errors ``(N,)``. ``scale(values)`` ``(N,)``: the tolerance of an atlas limits the norm of the error over this.

    ``start`` computes values on grids by other means than solves, NaN where they fail. ``degrees(lower, upper)``: numbers of
    polynomials that a box needs along each coordinate, and the largest truncation error of their interpolant; infinite if
    the numbers are only where a search for smaller ones begins.
    """

    solve: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    scale: Callable[[np.ndarray], np.ndarray]
    start: Start | None = None
    degrees: Callable[[np.ndarray, np.ndarray], tuple[list[int], float]] | None = None


@dataclass(frozen=True)
class Box:
    """A box in coordinates, and the number of ``splits`` along each of them."""

    lower: np.ndarray
    upper: np.ndarray
    splits: tuple[int, ...]

    def place(self, t: np.ndarray) -> np.ndarray:
        """Coordinates of points ``t`` in [-1, 1]^d."""
        return (self.lower * (1 - t) + self.upper * (1 + t)) / 2

    def axes(self, counts: Sequence[int]) -> list[np.ndarray]:
        """Coordinates of the nodes of a tensor, one array per coordinate."""
        return [self.axis(k, count) for k, count in enumerate(counts)]

    def axis(self, k: int, count: int) -> np.ndarray:
        """The coordinate k of ``count`` nodes."""
        t = nodes(count)
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
        return [
            float(self.coordinates[k].forward(p)) for p in (self.lower[k], self.upper[k], *((0.0,) if even else ()))
        ]


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
    return Atlas(
        domain.parameters,
        domain.coordinates,
        np.array(domain.lower, float),
        np.array(domain.upper, float),
        dict(domain.fixed),
        tuple(panels),
        tuple(gaps),
        tolerance,
        task.solves,
    )


class _Construction:
    """Makes the panels of boxes, and counts the solves."""

    def __init__(self, function: Function, tolerance: float, max_solves: int) -> None:
        self._function, self._tolerance, self._most, self.solves = function, tolerance, max_solves, 0
        # Largest error bound of the solves for a box.
        self._error = 0.0

    def panel(self, box: Box) -> Panel:
        """The panel of a box; raises :class:`_Unresolved` if it has none."""
        function, degrees, truncated = self._function, [_FIRST] * len(box.lower), np.inf
        if function.degrees:
            degrees, truncated = function.degrees(box.lower, box.upper)
        if max(degrees) > _MOST_GIVEN:
            degrees, truncated = [_FIRST] * len(degrees), np.inf
        known = function.start is not None and np.isfinite(truncated)
        waiting = function.start(box.axes(degrees)) if known else None  # pyright: ignore[reportOptionalCall]
        # While the nodes are computed.
        x = box.place(_held_out(len(degrees)))
        self._error = 0.0
        checks = x, self._solve(x)
        panel = None
        if waiting is not None:
            panel = self._fit(box, degrees, waiting(), checks, truncated)[0]
        elif function.start:
            panel = self._adapted(box, degrees, checks, function.start)
        return panel or self._adapted(box, [_FIRST] * len(degrees), checks, self._solved)  # pyright: ignore[reportReturnType]

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

    def _solved(self, axes: Axes) -> Callable[[], np.ndarray]:
        values = self._solve(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)))
        return lambda: values

    def _adapted(self, box: Box, counts: list[int], checks: Checks, start: Start) -> Panel | None:
        """The panel whose degrees are found from ``counts`` on; None if ``start`` does not compute what is solved."""
        limit = self._tolerance * float(self._function.scale(checks[1]).min())
        counts = [self._needed(box, k, n, _RESOLVED * limit, start) + _MARGIN for k, n in enumerate(counts)]
        tails = np.zeros(len(counts))
        for _ in range(_GROWTHS):
            if np.prod(counts, dtype=float) * checks[1].shape[1] > _MAX_NUMBERS:
                raise _Unresolved("too many nodes would be needed", int(np.argmax(counts)), _UNRESOLVED)
            values = start(box.axes(counts))()
            panel, tails = self._fit(box, counts, values, checks, None, start == self._solved)
            if panel or not np.isfinite(values).all():
                return panel
            grows = (tails > 1) | (tails.max() <= 1)
            counts = [n + max(2, n // 6) if more else n for n, more in zip(counts, grows, strict=True)]
        if tails.max() <= 1 and start != self._solved:
            return None
        raise _Unresolved("not resolved: not smooth", int(np.argmax(tails)) if tails.max() > 1 else None, _FAILED)

    def _needed(self, box: Box, axis: int, count: int, limit: float, start: Start) -> int:
        """Number of polynomials along a coordinate on all edges of the box, from ``count`` on."""
        ends, count = [np.array(pair) for pair in zip(box.lower, box.upper, strict=True)], max(count, 4)
        while True:
            axes = [box.axis(k, count) if k == axis else end for k, end in enumerate(ends)]
            values = start(axes)().reshape(*map(len, axes), -1)
            sizes = slabs(np.tensordot(analysis_matrix(count), values, axes=(1, axis)), 0)
            tail = envelope(sizes)
            # Where values are missing, the tensor shows it.
            if not tail[-3] > limit:
                return int(np.count_nonzero(tail > limit))
            if count >= _MOST:
                if tail[count // 2] < 4 * tail[-count // 8] and tail[count // 2] < _NOISE * tail[0]:
                    level = tail[count // 2] / tail[0]
                    raise _Unresolved(f"the values scatter by {level:.0e}, more than the tolerance allows", axis, 0)
                raise _Unresolved("not resolved: too many nodes would be needed", axis, _UNRESOLVED)
            count = min(2 * count, _MOST)

    def _fit(
        self,
        box: Box,
        counts: list[int],
        values: np.ndarray,
        checks: Checks,
        truncated: float | None,
        solved: bool = False,
    ) -> tuple[Panel | None, np.ndarray]:
        """The panel from the values at its nodes, None if it is not accurate enough, and the tails relative to their limit.

        ``truncated`` is the largest truncation error, None to estimate it from the last coefficients. Held-out solves do not
        show the error that all ``solved`` nodes have in common.
        """
        (x, exact), scale = checks, self._function.scale(checks[1])
        limit = self._tolerance * scale.min()
        tensor = coefficients(values, counts)
        last = [slabs(tensor, k)[-2:].sum() for k in range(len(counts))] if truncated is None else [truncated]
        tails = np.array(last) / (limit / 2)
        t = position_between(box.lower, box.upper, x)
        # Coefficients far below the error of the values are their noise.
        noise = np.linalg.norm(evaluate(tensor, t) - exact, axis=1).max() / np.prod(counts) ** 0.5
        tensor = without_smallest(tensor, noise, _NEGLIGIBLE * limit)
        errors = np.linalg.norm(evaluate(tensor, t) - exact, axis=1)
        if not ((errors / scale).max() <= self._tolerance / 2 and tails.max() <= 1):
            return None, tails
        error = (_SAFETY if truncated is None else _SAFETY_KNOWN) * errors.max()
        error += (truncated or 0.0) + _NEGLIGIBLE * limit + (self._error if solved else 0.0)
        return Panel(box.lower, box.upper, tensor, float(error)), tails


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
