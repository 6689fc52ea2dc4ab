"""Stability boundaries as curves: zeros of the analytic boundary functions, polished on the surrogate.

All zeros of a function on lines across the rectangle are found by exclusion. Between two lines a curve goes on, turns, or
leaves the rectangle. Lines are densest beside the tips of tongues and the crossings with the rim, where the number of zeros
changes. Curves also continue inside unstable regions; ``limiting`` is true where they bound the stable region.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from drivetrain_jax.atlas.criteria import LIMITING, Criteria, growth, limiting, monodromy_error, parameters_at
from drivetrain_jax.atlas.exclusion import Search, critical_points
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.patches import Patches, join, on_line, patches_of, roots
from drivetrain_jax.atlas.tips import polish
from drivetrain_jax.systems import System

# Longest step of a curve relative to the rectangle, rounds in which lines are added for it, most lines of a round, and lines
# whose zeros are found together.
_LONGEST, _ROUNDS, _MOST, _TOGETHER = 0.015, 12, 400, 32
# Smallest distance of two lines relative to the rectangle.
_NEAR = 1e-9
# Newton steps of the last polish, and their largest relative shift.
_POLISH, _LARGEST_SHIFT = 2, 1e-4


@dataclass(frozen=True)
class Boundary:
    """One curve: ``points`` maps the two parameters to arrays ``(n,)``.

    The ``multiplier`` (``+1``, ``-1`` or ``pair``) crosses the unit circle. ``limiting`` ``(n,)`` is true where no other
    multiplier lies outside.
    """

    multiplier: str
    points: Mapping[str, np.ndarray]
    limiting: np.ndarray

    def segments(self) -> tuple[dict[str, np.ndarray], ...]:
        """The parts that bound the stable region, each as ``points``."""
        marks = np.flatnonzero(np.diff(np.concatenate([[0], self.limiting.astype(int), [0]])))
        return tuple(
            {name: values[a:b] for name, values in self.points.items()}
            for a, b in zip(marks[::2], marks[1::2], strict=True)
            if b - a > 1
        )


def boundaries(atlas: Atlas, system: type[System], searches: Sequence[Search] = ()) -> tuple[Boundary, ...]:
    """All boundary curves within ``atlas``, which has two parameters (``ValueError`` for another number).

    Angles are returned without signs. ``searches``: known searches for the tips of the same atlas.
    """
    atlas = atlas.folded()
    if len(atlas.parameters) != 2:
        raise ValueError(f"parameters = {', '.join(atlas.parameters)}: expected two; slice the atlas first")
    criteria = Criteria.of(atlas, system)
    patches = tuple(search.patches for search in searches) or patches_of(criteria)
    curves: list[Boundary] = []
    horizontal = _narrow_axis(atlas, system)
    for number, kind in enumerate(criteria.multipliers):
        zeros, tips = ZeroSet(patches[number], horizontal), np.empty((0, 2))
        if not criteria.conservative:
            rough = (searches[number] if searches else critical_points(patches, number, horizontal)).points
            fine = polish(criteria, rough, kind, horizontal)[0]
            near = (np.abs(fine - rough) < _LARGEST_SHIFT * zeros.scale).all(axis=1)
            tips = np.where(near[:, None], fine, rough)
        for curve in zeros.curves(tips):
            x = _polish(criteria, zeros, kind, curve)
            points = dict(zip(atlas.parameters, parameters_at(atlas, x).T, strict=True))
            curves.append(Boundary(kind, points, _limiting(criteria, x, kind)))
    return tuple(curves)


def _narrow_axis(atlas: Atlas, system: type[System]) -> int:
    """The coordinate along which tongues are narrow: the axis of the resonances, else the second one."""
    axis = system.resonances.axis if system.resonances else ""
    return atlas.parameters.index(axis) if axis in atlas.parameters else 1


class ZeroSet:
    """The zeros of a function over a rectangle, on lines along the coordinate ``h``."""

    def __init__(self, patches: Patches, h: int) -> None:
        self.lower, self.upper = patches.lower.min(axis=0), patches.upper.max(axis=0)
        self.scale, self.h, self.v = self.upper - self.lower, h, 1 - h
        # Curves are those of the surrogate, also where its error is larger than its values.
        nothing = np.zeros((1, 1, len(patches)))
        self._patches = replace(patches, lever=nothing, floor=np.zeros(len(patches)))

    def curves(self, tips: np.ndarray) -> list[np.ndarray]:
        """The curves ``(n, 2)``; ``tips`` ``(M, 2)`` are points where a curve turns."""
        rim = self._rim()
        breaks = np.unique([0.0, 1.0, *self._height(tips), *self._height(rim)])
        lines = {0.0, 1.0}
        for low, high in pairwise(breaks):
            count = math.ceil((high - low) * math.pi / 2 / _LONGEST) + 1
            lines |= set(low + (high - low) * (1 - np.cos(np.pi * np.arange(1, count) / count)) / 2)
        known: dict[float, np.ndarray] = {}
        for _ in range(_ROUNDS):
            known |= self._on_lines(sorted(lines - known.keys()))
            points, links = self._linked(known, tips, rim)
            lines = known.keys() | set(self._between(points, links, known))
            if len(lines) == len(known) or len(lines) > _MOST + len(breaks):
                break
        return [points[chain] for chain in _chains(len(points), links)]

    def _height(self, points: np.ndarray) -> np.ndarray:
        """Positions of points along v, between 0 and 1."""
        return np.clip((points[:, self.v] - self.lower[self.v]) / self.scale[self.v], 0.0, 1.0)

    def _points(self, height: float, x: np.ndarray) -> np.ndarray:
        value = self.lower[self.v] * (1 - height) + self.upper[self.v] * height
        return np.insert(x[:, None], self.v, value, axis=1)

    def _rim(self) -> np.ndarray:
        """Crossings with the two sides along v, ``(K, 2)``."""
        ends = [self.lower[self.h], self.upper[self.h]]
        crossings = [roots(on_line(self._patches, self.h, float(end))).x for end in ends]
        return np.concatenate(
            [np.insert(x[:, None], self.h, end, axis=1) for x, end in zip(crossings, ends, strict=True)]
        )

    def _on_lines(self, heights: Sequence[float]) -> dict[float, np.ndarray]:
        """The zeros on lines, ``(n, 2)`` by the position of the line; neighbours have slopes of different signs."""
        zeros, width = {}, 2 * self.scale[self.h]
        for part in (heights[i : i + _TOGETHER] for i in range(0, len(heights), _TOGETHER)):
            # All lines one behind the other are one line.
            values = self._points(0.0, np.zeros(len(part)))[:, self.v] + np.array(part) * self.scale[self.v]
            pieces = [on_line(self._patches, self.v, float(value)) for value in values]
            together = [
                replace(piece, lower=piece.lower + k * width, upper=piece.upper + k * width)
                for k, piece in enumerate(pieces)
            ]
            all_zeros = roots(join(together))
            number = np.floor((all_zeros.x - self.lower[self.h]) / width + 0.25)
            for k, height in enumerate(part):
                mine = number == k
                sign = np.sign(all_zeros.slope[mine])
                # A zero on a common face of two patches may be found twice.
                new = sign != np.concatenate([[0.0], sign[:-1]])
                x = np.clip(all_zeros.x[mine][new] - k * width, self.lower[self.h], self.upper[self.h])
                zeros[height] = np.column_stack([self._points(height, x), sign[new]])
        return zeros

    def _linked(
        self, known: Mapping[float, np.ndarray], tips: np.ndarray, rim: np.ndarray
    ) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """All points of the curves, and the pairs of them that follow each other."""
        heights = sorted(known)
        starts = np.cumsum([0, *(len(known[height]) for height in heights)])
        points = np.concatenate([*(known[height][:, :2] for height in heights), tips, rim])
        first_tip, first_rim, links = int(starts[-1]), int(starts[-1]) + len(tips), []
        tip_at, rim_at = self._height(tips), self._height(rim)
        for (k, low), (_, high) in pairwise(enumerate(heights)):
            below, above = known[low], known[high]
            same = _matched(below[:, self.h], below[:, 2], above[:, self.h], above[:, 2])
            links += [(int(starts[k] + i), int(starts[k + 1] + j)) for i, j in same]
            left = [sorted(set(range(len(side))) - {pair[n] for pair in same}) for n, side in enumerate((below, above))]
            for i in np.flatnonzero((low <= rim_at) & (rim_at <= high)):
                far = rim[i, self.h] > self.lower[self.h] + self.scale[self.h] / 2
                ends = [(side, rest[-1 if far else 0]) for side, rest in enumerate(left) if rest]
                if ends:
                    side, end = min(ends, key=lambda e: abs((below, above)[e[0]][e[1], self.h] - rim[i, self.h]))
                    left[side].remove(end)
                    links.append((int(starts[k + side] + end), first_rim + int(i)))
            pairs = [int(starts[k + side]) + np.array(pair) for side in (0, 1) for pair in _neighbours(left[side])]
            middle: dict[int, int] = {}
            for i in np.flatnonzero((low <= tip_at) & (tip_at <= high)) if pairs else ():
                apart = [abs(points[pair, self.h].mean() - tips[i, self.h]) for pair in pairs]
                middle.setdefault(int(np.argmin(apart)), first_tip + int(i))
            for n, (a, b) in enumerate(pairs):
                links += pairwise([int(a), *([middle[n]] if n in middle else []), int(b)])
        return points, links

    def _between(
        self, points: np.ndarray, links: Sequence[tuple[int, int]], known: Mapping[float, np.ndarray]
    ) -> Iterator[float]:
        """Further lines across links that are too long."""
        heights = np.array(sorted(known))
        for pair in links:
            ends = self._height(points[list(pair)])
            length = np.abs(np.diff(points[list(pair)], axis=0)[0] / self.scale).max()
            if length <= _LONGEST:
                continue
            low, high = sorted(ends)
            if high - low <= _NEAR:
                # A turn without a known tip lies between this line and one of its neighbours.
                place = np.searchsorted(heights, low)
                yield from (heights[place - 1 : place + 2][1:] + heights[place - 1 : place + 2][:-1]) / 2
                continue
            # Lines are denser towards the end that is no line: there the curve turns.
            t = np.linspace(0, 1, min(math.ceil(length / _LONGEST), 8) + 1)[1:-1]
            turn = [end not in known for end in (low, high)]
            t = t**2 if turn[0] and not turn[1] else 1 - (1 - t) ** 2 if turn[1] and not turn[0] else t
            yield from low + (high - low) * t


def _matched(x: np.ndarray, sign: np.ndarray, y: np.ndarray, other: np.ndarray) -> list[tuple[int, int]]:
    """Zeros of two neighbouring lines on the same curves: all in order, or else those nearest to each other."""
    if len(x) == len(y) and (sign == other).all():
        return [(i, i) for i in range(len(x))]
    if not len(x) or not len(y):
        return []
    apart = np.where(sign[:, None] == other, np.abs(x[:, None] - y), np.inf)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    return [(i, int(j)) for i, j in enumerate(there) if back[j] == i and np.isfinite(apart[i, j])]


def _neighbours(numbers: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Pairs of consecutive numbers, each number once."""
    k = 0
    while k + 1 < len(numbers):
        if numbers[k + 1] == numbers[k] + 1:
            yield numbers[k], numbers[k + 1]
            k += 1
        k += 1


def _chains(count: int, links: Sequence[tuple[int, int]]) -> list[list[int]]:
    """The paths and cycles of at least three points that ``links`` make of ``count`` points."""
    following: list[list[int]] = [[] for _ in range(count)]
    for a, b in links:
        following[a].append(b)
        following[b].append(a)
    chains, seen = [], set()
    for start in sorted(range(count), key=lambda i: len(following[i])):
        if start in seen or not following[start]:
            continue
        chain = [start]
        seen.add(start)
        while rest := [i for i in following[chain[-1]] if i not in seen]:
            chain.append(rest[0])
            seen.add(rest[0])
        closed = len(chain) > 2 and start in following[chain[-1]]
        chains += [[*chain, start] if closed else chain] if len(chain) > 2 else []
    return chains


def _limiting(criteria: Criteria, x: np.ndarray, kind: str) -> np.ndarray:
    """Flags of the points of a curve that bound the stable region."""
    if not criteria.conservative:
        return limiting(criteria, x, growth(criteria, x, [kind] * len(x)))
    # Where two multipliers coincide without damping, the error of the growth rate is the square root of that of Z.
    error = np.sqrt(monodromy_error(criteria, x, criteria.propagator(x)))
    return np.log(criteria.spectral_radius(x)) <= LIMITING + error


def _polish(criteria: Criteria, zeros: ZeroSet, kind: str, x: np.ndarray) -> np.ndarray:
    """Points of a curve where the multiplier itself is on the unit circle; ``x`` where it is not simple."""
    if criteria.conservative:
        return x
    scale, kinds, best = zeros.scale, [kind] * len(x), x.copy()
    for _ in range(_POLISH):
        rates = growth(criteria, best, kinds)
        gradient = rates.gradient * scale
        with np.errstate(all="ignore"):
            step = (rates.rate / (gradient**2).sum(axis=1))[:, None] * gradient
        good = np.linalg.norm(step, axis=1) < _LARGEST_SHIFT
        best = np.clip(np.where(good[:, None], best - step * scale, best), zeros.lower, zeros.upper)
    good &= np.abs(growth(criteria, best, kinds).rate) < 1e-8
    return np.where(good[:, None], best, x)
