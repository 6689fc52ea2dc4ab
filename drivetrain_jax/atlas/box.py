"""One box of an atlas under construction, and what the steps of its exploration share."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from drivetrain_jax.atlas.panels import Gap, Panel
from drivetrain_jax.atlas.quantity import Quantity

# Splits along one coordinate of a box in which something is wrong (failed solves, a kink), and in all of any box.
_TROUBLED_DEPTH, _MAX_DEPTH = 2, 12


@dataclass(frozen=True)
class Settings:
    """What all boxes share."""

    quantity: Quantity
    tolerance: float
    max_nodes: int

    def limit(self, values: np.ndarray) -> float:
        """Largest admissible error of the values, from a sample ``(N, m)`` of them."""
        return self.tolerance * float(np.min(self.quantity.scale(values)))


@dataclass(frozen=True)
class Sample:
    """Solved points ``x`` ``(N, d)`` in coordinates and their values ``(N, m)``."""

    x: np.ndarray
    values: np.ndarray

    def within(self, lower: np.ndarray, upper: np.ndarray) -> Sample:
        """Those that lie in a box."""
        inside = ((self.x >= lower) & (self.x <= upper)).all(axis=1)
        return Sample(self.x[inside], self.values[inside])


@dataclass(frozen=True)
class Box:
    """A box in coordinates, the ``splits`` per coordinate that led to it, and ``known`` solves of its ancestors."""

    lower: np.ndarray
    upper: np.ndarray
    splits: tuple[int, ...]
    known: tuple[Sample, ...] = ()

    def place(self, t: np.ndarray) -> np.ndarray:
        """Coordinates of points ``t`` in [-1, 1]^d."""
        return (self.lower * (1 - t) + self.upper * (1 + t)) / 2

    def position(self, x: np.ndarray) -> np.ndarray:
        """Points ``t`` in [-1, 1]^d of coordinates ``x``."""
        return np.clip(((x - self.lower) - (self.upper - x)) / (self.upper - self.lower), -1.0, 1.0)

    def halves(self, axis: int, solved: list[Sample]) -> tuple[Box, Box]:
        """The two halves along ``axis``."""
        splits = tuple(s + (k == axis) for k, s in enumerate(self.splits))
        left, right = self.upper.copy(), self.lower.copy()
        left[axis] = right[axis] = (self.lower[axis] + self.upper[axis]) / 2
        ends = ((self.lower, left), (right, self.upper))
        return tuple(Box(a, b, splits, tuple(s.within(a, b) for s in (*self.known, *solved))) for a, b in ends)


Parts = tuple[Box | Panel | Gap, ...]
Exploration = Generator[np.ndarray, np.ndarray, Parts]


@dataclass
class Progress:
    """A box that is being explored."""

    box: Box
    settings: Settings
    solved: list[Sample] = field(default_factory=list)

    def ask(self, t: np.ndarray) -> Generator[np.ndarray, np.ndarray, np.ndarray]:
        """Values at points ``t`` in [-1, 1]^d; those that did not fail are remembered."""
        x = self.box.place(t)
        values = yield x
        finite = np.isfinite(values).all(axis=1)
        self.solved.append(Sample(x[finite], values[finite]))
        return values

    def give_up(self, reason: str) -> Parts:
        """Leave a gap."""
        return (Gap(self.box.lower, self.box.upper, reason),)

    def failed(self, values: np.ndarray) -> Parts:
        """What becomes of a box in which solves failed."""
        lost = int(np.sum(~np.isfinite(values).all(axis=1)))
        reason = f"{lost} of {len(values)} direct solves failed"
        return self.give_up(reason) if lost == len(values) else self.trouble(reason)

    def trouble(self, reason: str, axis: int | None = None) -> Parts:
        """Split a troubled box, along ``axis`` or the coordinate that was split least, or give it up."""
        chosen = int(np.argmin(self.box.splits)) if axis is None else axis
        if self.box.splits[chosen] >= _TROUBLED_DEPTH:
            return self.give_up(reason)
        return self.split(chosen, reason)

    def split(self, axis: int, reason: str) -> Parts:
        """The halves along ``axis``; a gap where there have been too many splits."""
        if sum(self.box.splits) >= _MAX_DEPTH:
            return self.give_up(f"{reason} after {_MAX_DEPTH} splits")
        return self.box.halves(axis, self.solved)
