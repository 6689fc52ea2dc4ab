"""All points of a rectangle where a boundary function and its derivative along one coordinate vanish: f = f_h = 0.

These are the tips of tongues (where h is the speed), the places where tongues close or meet, and nothing else. Boxes are
split until each is disposed of by one of

- the range of f or of f_h does not contain 0, or another boundary function is negative throughout;
- the ridge test: where f_hh > 0, f >= f(h0) - f_h(h0)^2 / (2 min f_hh) on every line v = const, and this is positive; or
  f(h0) < 0 on every line, so that the minimum is negative (the same with all signs reversed);
- exactly one zero: f_hh > 0 makes f_h vanish once on every line, f_v of one sign makes the minimum along h monotone in v;
  f_h < 0 and > 0 at the two ends of h keeps it inside, and it is positive at one end of v and negative at the other.
  Tested on boxes enlarged a little, so that a zero on a common face belongs to both.

Boxes that are undecided at the smallest size are reported. The statements hold for every function within the patch's error
of the surrogate (and its derivatives within ``roughness`` times that); they are as good as this bound, which is statistical.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.patches import Patches

# Smallest box relative to the domain, largest number of boxes in a queue, largest number of final Newton steps.
_SMALLEST = 2.0**-22
_MAX_BOXES = 20_000
_POLISH = 4
# Relative distance from the domain within which a point of its rim may be found.
_RIM = 1e-9


@dataclass(frozen=True)
class Search:
    """Of the function in ``patches``: ``points`` ``(M, 2)``; ``undecided`` boxes ``(K, 2, 2)`` as (lower, upper).

    ``curvature`` ``(M,)`` is f_hh and ``slope`` ``(M,)`` f_v at the points, v the other coordinate.
    """

    patches: Patches
    points: np.ndarray
    curvature: np.ndarray
    slope: np.ndarray
    undecided: np.ndarray


def critical_points(patches: tuple[Patches, ...], number: int, horizontal: int) -> Search:
    """Common zeros of the function ``number`` and its derivative along ``horizontal``, where no other function is negative.

    ``patches`` holds all functions over the same boxes. If another function is negative throughout a box, the system is
    unstable there, and the box is left out.
    """
    lower, upper = patches[0].lower.min(axis=0), patches[0].upper.max(axis=0)
    smallest = _SMALLEST * (upper - lower)
    roots, undecided = [], []
    active, others = patches[number], patches[:number] + patches[number + 1 :]
    while len(active):
        low, high = active.range()
        keep = ~((low > 0) | (high < 0) | np.any([p.range()[1] < 0 for p in others], axis=0))
        active, others = active.take(keep).trim(), tuple(p.take(keep).trim() for p in others)
        bundle = _Bundle(active, horizontal)
        unclear = ~np.isfinite(active.error)
        chosen = np.flatnonzero(~bundle.excluded() & ~unclear)
        enlarged = bundle.take(chosen).enlarged()
        single = enlarged.single()
        roots.append(enlarged.take(single).root())
        rest = np.concatenate([chosen[~single], np.flatnonzero(unclear)])
        active, others = active.take(rest), tuple(p.take(rest) for p in others)
        small = ((active.upper - active.lower) <= smallest).all(axis=1) | ~np.isfinite(active.error)
        # Where a function stays below its error, smaller boxes prove nothing either.
        small |= np.maximum(*(np.abs(end) for end in active.range())) <= 3 * active.error
        small |= len(active) > _MAX_BOXES
        undecided.append(np.stack([active.lower[small], active.upper[small]], axis=1))
        active, others = active.take(~small), tuple(p.take(~small) for p in others)
        axes = active.steepest_axis()
        active, others = active.split(axes), tuple(p.split(axes) for p in others)
    points, curvature, slope, boxes = (np.concatenate(parts) for parts in zip(*roots, strict=True))
    # Boxes at the rim are enlarged beyond it.
    beyond = (np.maximum(lower - points, points - upper) > _RIM * (upper - lower)).any(axis=1)
    points, curvature, slope, boxes = (part[~beyond] for part in (points, curvature, slope, boxes))
    keep = _distinct(points, boxes)
    return Search(patches[number], points[keep], curvature[keep], slope[keep], np.concatenate(undecided))


class _Bundle:
    """f and the derivatives that the tests need, over the same boxes; h and v number the coordinates."""

    def __init__(self, f: Patches, h: int, derived: tuple[Patches, ...] | None = None):
        self.f, self.h, self.v = f, h, 1 - h
        if derived is None:
            f_h = f.derivative(h)
            derived = f_h, f_h.derivative(h), f.derivative(self.v), f_h.derivative(self.v)
        self.f_h, self.f_hh, self.f_v, self.f_hv = self.derived = derived

    def take(self, chosen: np.ndarray) -> _Bundle:
        return _Bundle(self.f.take(chosen), self.h, tuple(p.take(chosen) for p in self.derived))

    def enlarged(self) -> _Bundle:
        return _Bundle(self.f.enlarged(), self.h, tuple(p.enlarged() for p in self.derived))

    def excluded(self) -> np.ndarray:
        """Flags of boxes in which the range of f_h or the ridge test excludes a zero."""
        low, high = self.f_h.range()
        sign, bend = self._bend()
        value, slope = self._along_valley(sign)
        rest = np.abs(value[1:]).sum(axis=0) + self.f.error
        steepest = np.abs(slope).sum(axis=0) + self.f_h.error
        with np.errstate(all="ignore"):
            ridge = (value[0] - rest - steepest**2 / (2 * bend) > 0) | (value[0] + rest < 0)
        return (low > 0) | (high < 0) | ((bend > 0) & ridge)

    def single(self) -> np.ndarray:
        """Boxes with exactly one zero."""
        sign, bend = self._bend()
        left, right = (sign * self.f_h.restrict(self.h, np.full(len(sign), t)).coefficients for t in (-1.0, 1.0))
        inside = (_highest(left) + self.f_h.error < 0) & (_highest(-right) + self.f_h.error < 0)
        low, high = self.f_v.range()
        one_way = (low > 0) | (high < 0)
        # The end of v where the valley is higher, and the values of f and f_h on the line along its floor.
        top = np.where((low > 0) == (sign > 0), 1.0, -1.0)
        value, slope = self._along_valley(sign)
        alternating = (-1.0) ** np.arange(len(value))[:, None]
        ends = [np.sum(c * np.where(top > 0, 1.0, alternating[: len(c)]), axis=0) for c in (value, slope)]
        bottom = np.sum(value * np.where(top > 0, alternating, 1.0), axis=0)
        with np.errstate(all="ignore"):
            least = ends[0] - self.f.error - (np.abs(ends[1]) + self.f_h.error) ** 2 / (2 * bend)
        return (bend > 0) & inside & one_way & (least > 0) & (bottom + self.f.error < 0)

    def _bend(self) -> tuple[np.ndarray, np.ndarray]:
        """Sign of f_hh and a lower bound of |f_hh|, negative if the sign is not certain."""
        low, high = self.f_hh.range()
        return np.where(low + high > 0, 1.0, -1.0), np.maximum(low, -high)

    def _along_valley(self, sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients in v of sign f and of f_h on the line h = const along which f_h is about 0."""
        width = self.f.upper[:, self.h] - self.f.lower[:, self.h]
        middle = np.zeros(len(self.f))
        first, second = (p.restrict(self.h, middle).coefficients[0] for p in (self.f_h, self.f_hh))
        with np.errstate(all="ignore"):
            t = np.clip(np.nan_to_num(-first / second * 2 / width), -1.0, 1.0)
        return sign * self.f.restrict(self.h, t).coefficients, self.f_h.restrict(self.h, t).coefficients

    def root(self) -> tuple[np.ndarray, ...]:
        """The zero of each box by Newton's method on the patches, f_hh and f_v there, and the boxes ``(N, 2, 2)``."""
        t = np.zeros((len(self.f), 2))
        half = (self.f.upper - self.f.lower) / 2
        for _ in range(_POLISH if len(t) else 0):
            f, f_h, f_hh, f_v, f_hv = (p(t) for p in (self.f, *self.derived))
            determinant = f_v * f_hh - f_h * f_hv
            step = np.empty_like(t)
            step[:, self.v], step[:, self.h] = (
                (f * f_hh - f_h * f_h) / determinant,
                (f_v * f_h - f_hv * f) / determinant,
            )
            t = np.clip(t - step / half, -1.0, 1.0)
        x = (self.f.lower + self.f.upper) / 2 + t * half
        return x, self.f_hh(t), self.f_v(t), np.stack([self.f.lower, self.f.upper], axis=1)


def _highest(series: np.ndarray) -> np.ndarray:
    """Upper bound of Chebyshev series ``(n, N)``."""
    return series[0] + np.abs(series[1:]).sum(axis=0)


def _distinct(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Indices without the points in a box (with a single zero) of an earlier point."""
    kept: list[int] = []
    for i, point in enumerate(points):
        if not any(((point >= boxes[j, 0]) & (point <= boxes[j, 1])).all() for j in kept):
            kept.append(i)
    return np.array(kept, int)
