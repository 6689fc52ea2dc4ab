"""Boundary functions as Chebyshev polynomials of low degree over many small boxes, and proofs based on their ranges.

A patch holds f(x) = sum_k c_k T_(k_1)(t_1) ... T_(k_d)(t_d), t in [-1, 1]^d, for d = 1 or 2, with a bound ``error`` of |f -
true function| over the patch. All operations act on an array of patches at once. The range of a polynomial lies within c_0
-+ sum |other c_k|; every exclusion uses this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.chebyshev import chebder

from drivetrain_jax._machine import in_threads
from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.interpolation import analysis_matrix, nodes, on_grid, restriction, slabs
from drivetrain_jax.atlas.panels import Panel, chebyshev, position_between

# Nodes of a patch in each coordinate, tail of the series relative to its size, the multiple of it up to which a tail may be
# rounding, and the largest number of patches.
NODES = 16
_TAIL = 3e-14
_ROUNDING = 1e6
_MAX_PATCHES = 8_000
# Patches at first along a coordinate, as a part of the panel's degree; the functions have four times that degree.
_FIRST = 1 / 3
# Points whose errors are computed together (small enough for the cache).
_TOGETHER = 1 << 14
# Relative enlargement of boxes, so that a root on a face is inside.
MARGIN = 0.25
# Offset of a cut from the middle of a box, relative to half its width: a root is then rarely on the face between two boxes.
_CUT = 0.0271


@dataclass(frozen=True)
class Patches:
    """``coefficients`` ``(n, ..., n, N)`` over boxes ``lower``..``upper`` ``(N, d)``.

    The error is at most ``floor`` ``(N,)`` plus the modulus of a function given by ``lever`` ``(m, ..., m, N)``.

    ``roughness`` ``(N, d)`` bounds how much faster than a polynomial of the patch's degree the error may vary along each
    coordinate: the error of a derivative is ``error`` times ``roughness``.
    """

    lower: np.ndarray
    upper: np.ndarray
    coefficients: np.ndarray
    lever: np.ndarray
    floor: np.ndarray
    roughness: np.ndarray

    def __len__(self) -> int:
        return len(self.lower)

    @cached_property
    def error(self) -> np.ndarray:
        """Bound of the error over each patch, ``(N,)``."""
        return self.floor + np.abs(self.lever).sum(axis=tuple(range(self.dimension)))

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return self.lower.shape[1]

    def take(self, chosen: np.ndarray) -> Patches:
        """The patches ``chosen`` (a mask or indices)."""
        return Patches(
            self.lower[chosen],
            self.upper[chosen],
            self.coefficients[..., chosen],
            self.lever[..., chosen],
            self.floor[chosen],
            self.roughness[chosen],
        )

    def derivative(self, axis: int) -> Patches:
        """The patches of the derivative along a coordinate."""
        # Patches without extent have derivatives that are not finite and decide nothing.
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 2 / (self.upper[:, axis] - self.lower[:, axis])
            coefficients = chebder(self.coefficients, axis=axis) * scale
        nothing = np.zeros((*(1,) * self.dimension, len(self)))
        return replace(self, coefficients=coefficients, lever=nothing, floor=self.error * self.roughness[:, axis])

    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of the true function over each patch, ``(N,)`` each."""
        flat = self.coefficients.reshape(math.prod(self.coefficients.shape[:-1]), len(self))
        rest = np.abs(flat[1:]).sum(axis=0) + self.error
        with np.errstate(invalid="ignore"):
            return flat[0] - rest, flat[0] + rest

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Values at one position ``t`` in [-1, 1]^d per patch, ``(N, d) -> (N,)``."""
        total = self.coefficients
        for axis in range(self.dimension):
            total = np.einsum("i...n,ni->...n", total, chebyshev(t[:, axis], total.shape[0]))
        return total

    def locate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Number of the patch of each point and the position in it, ``(N, d) -> (N,), (N, d)``; the nearest if outside."""
        outside = np.zeros((len(x), len(self)))
        # Axis by axis: NumPy reduces a last axis of length two slowly.
        for point, lower, upper in zip(x.T[..., None], self.lower.T, self.upper.T, strict=True):
            with np.errstate(divide="ignore", invalid="ignore"):
                np.maximum(outside, np.maximum(lower - point, point - upper) / (upper - lower), out=outside)
        number = np.argmin(np.nan_to_num(outside, nan=np.inf, copy=False), axis=1)
        lower, upper = self.lower[number], self.upper[number]
        return number, ((x - lower) - (upper - x)) / (upper - lower)

    def at(self, number: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Values at positions ``t`` in the patches ``number``, as :meth:`locate` gives them; NaN if far outside."""
        inside = (np.abs(t) <= 1 + MARGIN).all(axis=1)
        values = self.take(number)(np.where(inside[:, None], np.clip(t, -1.0, 1.0), 0.0))  # pyright: ignore[reportIndexIssue]
        return np.where(inside, values, np.nan)

    def trim(self) -> Patches:
        """The patches with fewer coefficients, if the dropped ones add less than a hundredth to every error."""
        patches = self
        for axis in range(self.dimension):
            c = np.moveaxis(np.abs(patches.coefficients), axis, 0)
            dropped = np.cumsum(c.sum(axis=tuple(range(1, c.ndim - 1)))[::-1], axis=0)[::-1]
            needed = np.flatnonzero((dropped > patches.error / 100).any(axis=1))
            n = max(4, needed[-1] + 1 if needed.size else 0)
            if n < len(c):
                kept = np.take(patches.coefficients, range(n), axis=axis)
                patches = replace(patches, coefficients=kept, floor=patches.floor + dropped[n])
        return patches

    def restrict(self, axis: int, t: np.ndarray) -> Patches:
        """Patches of the other coordinates at the positions ``t`` ``(N,)`` of the coordinate ``axis``."""

        def contract(c: np.ndarray) -> np.ndarray:
            weights = np.cos(np.arange(c.shape[axis])[:, None] * np.arccos(np.clip(t, -1.0, 1.0)))
            return np.einsum("i...n,in->...n", np.moveaxis(c, axis, 0), weights)

        return Patches(
            np.delete(self.lower, axis, axis=1),
            np.delete(self.upper, axis, axis=1),
            contract(self.coefficients),
            contract(self.lever),
            self.floor,
            np.delete(self.roughness, axis, axis=1),
        )

    def steepest_axis(self) -> np.ndarray:
        """The coordinate along which each patch varies most, ``(N,)``."""
        size = np.abs(self.coefficients)
        axes = tuple(range(self.dimension))
        return np.argmax([np.delete(size, 0, axis=axis).sum(axis=axes) for axis in axes], axis=0)

    def split(self, axes: np.ndarray) -> Patches:
        """Each patch in two, across the coordinate ``axes`` ``(N,)``."""
        return join([half for k in range(self.dimension) for half in self.take(axes == k)._halves(k)])

    def enlarged(self) -> Patches:
        """The same polynomials over boxes larger by ``MARGIN`` about their centres."""
        middle, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 * (1 + MARGIN)
        series = {"coefficients": self.coefficients, "lever": self.lever}
        for name, c in series.items():
            for axis in range(self.dimension):
                c = _apply(_enlargement(c.shape[axis]), c, axis)
            series[name] = c
        return replace(self, lower=middle - half, upper=middle + half, **series)

    def _halves(self, axis: int) -> tuple[Patches, Patches]:
        middle = (self.lower[:, axis] + self.upper[:, axis]) / 2
        middle = middle + _CUT * (self.upper[:, axis] - self.lower[:, axis]) / 2
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[:, axis] = upper[:, axis] = middle
        parts = []
        for side, box in enumerate(({"upper": upper}, {"lower": lower})):
            series = {
                name: _apply(_restrictions(c.shape[axis])[side], c, axis)
                for name, c in (("coefficients", self.coefficients), ("lever", self.lever))
            }
            parts.append(replace(self, **box, **series))
        return tuple(parts)


def join(parts: list[Patches]) -> Patches:
    """Several arrays of patches as one."""
    series = ("coefficients", "lever")
    return Patches(
        *(
            np.concatenate([getattr(p, f.name) for p in parts], axis=-1 if f.name in series else 0)
            for f in fields(Patches)
        )
    )


def patches_of(criteria: Criteria) -> tuple[Patches, ...]:
    """The patches of every function of ``criteria`` over all panels of its atlas (one or two parameters)."""
    parts = [_cover(criteria, panel) for panel in criteria.atlas.panels]
    return tuple(join(list(patches)) for patches in zip(*parts, strict=True))


def _cover(criteria: Criteria, panel: Panel) -> tuple[Patches, ...]:
    """Patches over one panel, refined along each coordinate until all series have converged."""
    sizes = [slabs(panel.coefficients, k) for k in range(len(panel.degrees))]
    counts = [max(1, round(_FIRST * np.max(np.flatnonzero(s > _TAIL * s.max()), initial=0))) for s in sizes]
    before = [np.inf] * len(counts)
    while True:
        coefficients, levers, floor, lower, upper = _sample(criteria, panel, counts)
        tails = [_tail(coefficients, axis) for axis in range(len(counts))]
        size = np.abs(coefficients).sum(axis=tuple(range(1, len(counts) + 1)))
        with np.errstate(all="ignore"):
            excess = [np.nanmax(tail / np.maximum(_TAIL * size, floor / 8)) for tail in tails]
        # A small tail that does not fall with smaller patches is rounding.
        rough = [e > 1 and (e < b / 2 or _ROUNDING < e < np.inf) for e, b in zip(excess, before, strict=True)]
        if not any(rough) or np.prod(counts) * 2 > _MAX_PATCHES:
            break
        before = [e if split else b for e, b, split in zip(excess, before, rough, strict=True)]
        counts = [int(np.ceil(1.5 * count)) if split else count for count, split in zip(counts, rough, strict=True)]
    # The truncated tail is about as large as the last kept coefficients.
    floors = floor + 4 * sum(tails)
    floors = np.where(np.isfinite(floors), floors, np.inf)
    roughness = _roughness(panel, lower, upper)
    return tuple(
        Patches(lower, upper, np.nan_to_num(c), np.nan_to_num(lever), floor, roughness)
        for c, lever, floor in zip(coefficients, levers, floors, strict=True)
    )


def _roughness(panel: Panel, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Bernstein's and Markov's inequalities bound the error of a panel at twice its degree, because Phi enters squared."""
    half = (panel.upper - panel.lower) / 2
    reach = np.maximum(np.abs(lower - panel.lower - half), np.abs(upper - panel.lower - half)) / half
    degree = 2.0 * np.array(panel.degrees)
    return degree / half * np.minimum(degree, 1 / np.sqrt(np.maximum(1 - reach**2, degree**-2)))


def _sample(criteria: Criteria, panel: Panel, counts: list[int]) -> tuple[np.ndarray, ...]:
    """The functions on counts[0] x counts[1] equal patches of one panel.

    Returns: series ``(k, n, ..., n, N)`` of the functions and of their errors' levers, floors ``(k, N)``, and the lower and
    upper ends ``(N, d)`` of the boxes.
    """
    d = len(counts)
    edges = [np.linspace(panel.lower[k], panel.upper[k], counts[k] + 1) for k in range(d)]
    t = nodes(NODES)
    axes = tuple((e[:-1, None] * (1 - t) / 2 + e[1:, None] * (1 + t) / 2).reshape(-1) for e in edges)
    positions = [position_between(*ends) for ends in zip(panel.lower, panel.upper, axes, strict=True)]
    phi = on_grid(panel.coefficients, positions)
    log_determinant = criteria.log_determinant(_mesh(axes)).reshape(phi.shape[1:])
    split = tuple(n for count in counts for n in (count, NODES))
    order = (0, *range(2, 2 * d + 1, 2), *range(1, 2 * d + 1, 2))

    def by_patch(values: np.ndarray) -> np.ndarray:
        values = values.reshape(-1, *split).transpose(order)
        return values.reshape(*values.shape[: d + 1], -1)

    def series(values: np.ndarray) -> np.ndarray:
        values = by_patch(values)
        for axis in range(1, d + 1):
            values = _apply(analysis_matrix(NODES), values, axis)
        return values

    # Whole patches: the errors contain one largest value for all points that are computed together.
    rows = NODES * max(1, _TOGETHER // (NODES * phi[0, 0].size))
    parts = [slice(start, start + rows) for start in range(0, phi.shape[1], rows)]
    bounds = in_threads(parts, lambda part: criteria.errors(panel, phi[:, part], log_determinant[part]))
    floor, lever = (np.concatenate(x, axis=1) for x in zip(*(pair for _, pair in bounds), strict=True))
    return (
        series(criteria.derive(phi, log_determinant)),
        series(lever),
        by_patch(floor).max(axis=tuple(range(1, d + 1))),
        _mesh(tuple(e[:-1] for e in edges)),
        _mesh(tuple(e[1:] for e in edges)),
    )


def _mesh(axes: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _tail(coefficients: np.ndarray, axis: int) -> np.ndarray:
    """Sum of the last two slabs of coefficients along a coordinate, ``(k, n, ..., N) -> (k, N)``."""
    last = np.take(np.abs(coefficients), [-2, -1], axis=axis + 1)
    return last.sum(axis=tuple(range(1, coefficients.ndim - 1)))


def _apply(matrix: np.ndarray, coefficients: np.ndarray, axis: int) -> np.ndarray:
    # Derivatives over patches without extent are not finite.
    with np.errstate(invalid="ignore"):
        return np.moveaxis(np.tensordot(matrix, coefficients, axes=((1,), (axis,))), 0, axis)


@lru_cache
def _enlargement(n: int) -> np.ndarray:
    """Matrix from the coefficients over [-1, 1] to those over an interval larger by ``MARGIN``."""
    return analysis_matrix(n) @ np.polynomial.chebyshev.chebvander((1 + MARGIN) * nodes(n), n - 1)


@lru_cache
def _restrictions(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices from the coefficients over [-1, 1] to those over the two parts left and right of the cut."""
    return restriction(n, -1.0, _CUT), restriction(n, _CUT, 1.0)


# All zeros of a boundary function on a line, by exclusion of intervals.


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
    zeros, undecided = [], []
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
        zeros.append(_bisect(wide.take(crossing), slope.take(crossing)))
        active = active.take(~(monotone & certain))
        small = (active.upper - active.lower)[:, 0] <= smallest
        # Where a function stays below its error, smaller intervals decide nothing either.
        small |= ~(np.maximum(*(np.abs(end) for end in active.range())) > 3 * active.error)
        undecided.append(np.stack([active.lower[small, 0], active.upper[small, 0]], axis=-1))
        active = active.take(~small)
        active = active.split(np.zeros(len(active), int))
    x, error, slope = (np.concatenate(parts) for parts in zip(*zeros, strict=True))
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


# Follow the line f_h = 0 of a tongue from its tip down to the foot, to identify its resonance.


# Steps down the ridge, Newton steps on each, and the largest shift of the ridge in one step relative to the domain.
_STEPS = 40
_NEWTON = 3
_LARGEST_SHIFT = 0.02


def ridge_roots(patches: Patches, tips: np.ndarray, horizontal: int, bottom: float) -> np.ndarray:
    """Coordinate h of the foot of each ridge where the other coordinate is ``bottom``, ``(N,)``; NaN if the ridge is lost.

    ``patches`` hold the function whose tips are ``tips`` ``(N, 2)`` in coordinates.
    """
    h, v = horizontal, 1 - horizontal
    slope = patches.derivative(h)
    curvature = slope.derivative(h)
    width = patches.upper[:, h].max() - patches.lower[:, h].min()
    x = tips.copy()
    for step in range(_STEPS):
        x[:, v] = tips[:, v] + (bottom - tips[:, v]) * (step + 1) / _STEPS
        before = x[:, h].copy()
        for _ in range(_NEWTON if len(x) else 0):
            place = patches.locate(x)
            x[:, h] -= slope.at(*place) / curvature.at(*place)
        x[~(np.abs(x[:, h] - before) <= _LARGEST_SHIFT * width), h] = np.nan
    return x[:, h]
