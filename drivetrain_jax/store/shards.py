"""Boxes of a sweep: its blocks, which are the shards of a Zarr store."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

Place = tuple[slice, ...]


@dataclass(frozen=True)
class Shards:
    """The shards of a sweep of this ``shape``, numbered in C order; the last shard along an axis may be shorter.

    A shard has ``lengths`` along the axes. Its points are consecutive in C order; a path axis is whole.
    """

    shape: tuple[int, ...]
    lengths: tuple[int, ...]

    @classmethod
    def of(cls, shape: tuple[int, ...], path: int | None, most: int) -> Shards:
        """Shards of up to ``most`` points, or of lines along axis number ``path``."""
        room, lengths = most, []
        for axis in reversed(range(len(shape))):
            size = shape[axis]
            # Parts of equal length, so that no shard has few points.
            lengths.insert(0, size if axis == path else -(-size // -(-size // min(size, room))))
            room = room if axis == path else max(1, room // size)
        return cls(shape, tuple(lengths))

    @property
    def _counts(self) -> tuple[int, ...]:
        return tuple(-(-size // length) for size, length in zip(self.shape, self.lengths, strict=True))

    @property
    def count(self) -> int:
        """Number of shards."""
        return math.prod(self._counts)

    def place(self, shard: int) -> Place:
        """The box of the sweep that a shard covers."""
        at = np.unravel_index(shard, self._counts) if self.shape else ()
        starts = [int(i) * length for i, length in zip(at, self.lengths, strict=True)]
        return tuple(slice(a, min(a + n, size)) for a, n, size in zip(starts, self.lengths, self.shape, strict=True))

    def starts(self, path: int | None) -> np.ndarray:
        """Number of the first point of every shard, and of all points; with a ``path`` axis these are lines along it."""
        axes = [axis for axis in range(len(self.shape)) if axis != path]
        if not axes:
            return np.array([0, 1])
        at, lines = np.unravel_index(np.arange(self.count), self._counts), [self.shape[axis] for axis in axes]
        firsts = np.ravel_multi_index([at[axis] * self.lengths[axis] for axis in axes], lines)
        return np.append(firsts, math.prod(lines))
