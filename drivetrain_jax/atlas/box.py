"""A box of an atlas under construction, and the operations shared by the steps of its construction."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from drivetrain_jax.atlas.interpolation import nodes
from drivetrain_jax.atlas.panels import Gap, Panel, position_between
from drivetrain_jax.atlas.quantity import Quantity

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
