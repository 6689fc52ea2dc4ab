"""All zeros of a boundary function on a line, by exclusion of intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.panels import position_between
from drivetrain_jax.atlas.patches import MARGIN, Patches

# Smallest interval relative to the whole line; number of halvings down to rounding.
_SMALLEST = 2.0**-40
_HALVINGS = 60


@dataclass(frozen=True)
class Roots:
    """``x`` ``(M,)`` in the coordinate, rising, with bounds ``error`` and the function's ``slope`` there.

    ``undecided`` ``(K, 2)`` are intervals in which the error of the function may hide one or two zeros.
    """

    x: np.ndarray
    error: np.ndarray
    slope: np.ndarray
    undecided: np.ndarray


def on_line(patches: Patches, axis: int, value: float) -> Patches:
    """Patches of the other coordinate on the line where the coordinate ``axis`` has ``value``."""
    lower, upper = patches.lower[:, axis], patches.upper[:, axis]
    top = value >= upper.max()
    crossed = patches.take((upper >= value) & (lower < value) if top else (lower <= value) & (value < upper))
    return crossed.restrict(axis, position_between(crossed.lower[:, axis], crossed.upper[:, axis], value))


def roots(patches: Patches) -> Roots:
    """Every zero of a function of one coordinate over all ``patches``."""
    if not len(patches):
        nothing = np.empty(0)
        return Roots(nothing, nothing, nothing, np.empty((0, 2)))
    smallest = _SMALLEST * (patches.upper.max() - patches.lower.min())
    found, undecided = [], []
    active = patches
    while len(active):
        low, high = active.range()
        active = active.take((low <= 0) & (high >= 0)).trim()
        wide = active.enlarged()
        slope = wide.derivative(0)
        low, high = slope.range()
        monotone = (low > 0) | (high < 0)
        ends = [wide(np.full((len(wide), 1), t)) for t in (-1.0, 1.0)]
        certain = np.minimum(np.abs(ends[0]), np.abs(ends[1])) > wide.error
        crossing = monotone & certain & (ends[0] * ends[1] < 0)
        found.append(_bisect(wide.take(crossing), slope.take(crossing)))
        active = active.take(~(monotone & certain))
        small = (active.upper - active.lower)[:, 0] <= smallest
        # Where a function stays below its error, smaller intervals decide nothing either.
        small |= ~(np.maximum(*(np.abs(end) for end in active.range())) > 3 * active.error)
        undecided.append(np.stack([active.lower[small, 0], active.upper[small, 0]], axis=-1))
        active = active.take(~small)
        active = active.split(np.zeros(len(active), int))
    x, error, slope = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.argsort(x)
    x, error, slope = x[order], error[order], slope[order]
    # A zero on a common face was found from both sides.
    new = np.diff(x, prepend=-np.inf) > 2 * error + 4 * np.finfo(float).eps * np.abs(x)
    new |= np.sign(slope) != np.sign(np.roll(slope, 1))
    new[:1] = True
    return Roots(x[new], error[new], slope[new], merge(np.concatenate(undecided)))


def _bisect(patches: Patches, slope: Patches) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b = np.full((len(patches), 1), -1.0), np.full((len(patches), 1), 1.0)
    start = patches(a)
    for _ in range(_HALVINGS if len(patches) else 0):
        middle = (a + b) / 2
        same = (patches(middle) * start > 0)[:, None]
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    t = ((a + b) / 2)[:, 0]
    inside = np.abs(t) <= 1 / (1 + MARGIN) + 1e-6
    x = (patches.lower[:, 0] * (1 - t) + patches.upper[:, 0] * (1 + t)) / 2
    steepness = slope(t[:, None])
    return x[inside], (patches.error / np.abs(steepness))[inside], steepness[inside]


def merge(intervals: np.ndarray) -> np.ndarray:
    """Intervals ``(K, 2)`` in rising order, with those that touch or overlap joined."""
    merged: list[list[float]] = []
    for a, b in intervals[np.argsort(intervals[:, 0])]:
        if merged and a <= merged[-1][1]:
            merged[-1][1] = max(b, merged[-1][1])
        else:
            merged.append([a, b])
    return np.array(merged).reshape(-1, 2)
