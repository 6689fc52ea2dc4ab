"""Where a system is stable along one parameter, and for which values of one it is stable over a range of another."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from drivetrain_jax.atlas.criteria import Criteria, parameters_at
from drivetrain_jax.atlas.exclusion import critical_points
from drivetrain_jax.atlas.interpolation import analysis_matrix, nodes
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, chebyshev, position_between
from drivetrain_jax.atlas.patches import Patches, patches_of
from drivetrain_jax.atlas.roots import on_line, roots
from drivetrain_jax.atlas.tips import polish
from drivetrain_jax.systems import System

Range = tuple[float, float]


@dataclass(frozen=True)
class Crossing:
    """``value`` of a parameter at which the stability changes, with a bound of its error.

    ``multiplier`` (``+1``, ``-1`` or ``pair``) crosses the unit circle; ``point`` holds all parameters of the atlas there.
    """

    value: float
    error: float
    multiplier: str
    point: Mapping[str, float]


@dataclass(frozen=True)
class Interval:
    """An interval of a parameter; ``lower_end`` and ``upper_end`` are None where the atlas ends, or what follows is
    undecided."""

    lower: float
    upper: float
    stable: bool
    lower_end: Crossing | None
    upper_end: Crossing | None

    @property
    def ends(self) -> tuple[tuple[float, Crossing | None], tuple[float, Crossing | None]]:
        """Both ends, each with its crossing."""
        return (self.lower, self.lower_end), (self.upper, self.upper_end)


@dataclass(frozen=True)
class Line:
    """``intervals`` that alternate between stable and unstable, and the ``undecided`` ones among or next to them."""

    parameter: str
    intervals: tuple[Interval, ...]
    undecided: tuple[Range, ...]

    @property
    def crossings(self) -> tuple[Crossing, ...]:
        """The changes of stability in rising order."""
        return tuple(i.upper_end for i in self.intervals if i.upper_end)


def stability_along(atlas: Atlas, system: System) -> Line:
    """The intervals of stability along the one parameter of ``atlas`` (slice the others away)."""
    criteria = Criteria.of(atlas, system)
    changes, undecided = [], []
    for kind, patches in zip(criteria.multipliers, patches_of(criteria), strict=True):
        found = roots(patches)
        values = parameters_at(atlas, found.x[:, None])[:, 0]
        slopes = np.abs(atlas.coordinates[0].slope(values))
        point = [{atlas.parameters[0]: float(v)} for v in values]
        changes += [
            Crossing(float(v), float(e / s), kind, p)
            for v, e, s, p in zip(values, found.error, slopes, point, strict=True)
        ]
        undecided += [tuple(sorted(map(float, parameters_at(atlas, i[:, None])[:, 0]))) for i in found.undecided]
    undecided += [
        tuple(sorted(map(float, parameters_at(atlas, np.stack([g.lower, g.upper]))[:, 0]))) for g in atlas.gaps
    ]
    return _line(atlas.parameters[0], (atlas.lower[0], atlas.upper[0]), changes, undecided, _stable_at(criteria))


def stability_over_range(atlas: Atlas, system: System, along: str) -> Line:
    """The intervals of the other parameter of ``atlas`` (two) in which all values of ``along`` are stable."""
    h = atlas.parameters.index(along)
    v = 1 - h
    criteria = Criteria.of(atlas, system)
    patches = patches_of(criteria)
    changes: list[Crossing] = []
    undecided: list[tuple[float, float]] = []
    for number, kind in enumerate(criteria.multipliers):
        search = critical_points(patches, number, h)
        if criteria.conservative:
            x, error = search.points, np.full(len(search.points), np.nan)
        else:
            x, rates = polish(criteria, search.points, kind, h)
            error = rates.error / np.abs(rates.gradient[:, v])
        changes += _crossings(atlas, x, error, v, kind)
        undecided += [tuple(sorted(map(float, parameters_at(atlas, box)[:, v]))) for box in search.undecided]
        for end in atlas.to_coordinates(np.stack([atlas.lower, atlas.upper]))[:, h]:
            rim = roots(on_line(patches[number], h, float(end)))
            x = np.insert(rim.x[:, None], h, end, axis=1)
            changes += _crossings(atlas, x, rim.error, v, kind)
            ends = parameters_at(atlas, np.insert(rim.undecided[..., None], h, end, axis=2))[..., v]
            undecided += [tuple(sorted(map(float, pair))) for pair in ends]
    undecided += [
        tuple(sorted(map(float, parameters_at(atlas, np.stack([g.lower, g.upper]))[:, v]))) for g in atlas.gaps
    ]

    def stable(values: np.ndarray) -> np.ndarray:
        return np.array([_all_stable(criteria, patches, h, value) for value in values])

    return _line(atlas.parameters[v], (atlas.lower[v], atlas.upper[v]), changes, undecided, stable)


def narrow(atlas: Atlas, bounds: Mapping[str, tuple[float, float]]) -> Atlas:
    """The part of ``atlas`` within ``bounds``; ``ValueError`` for bounds that leave its domain, ``KeyError`` for names."""
    lower, upper = atlas.lower.copy(), atlas.upper.copy()
    for name, (a, b) in bounds.items():
        if name not in atlas.parameters:
            raise KeyError(f"{name}: the atlas has {', '.join(atlas.parameters)}")
        k = atlas.parameters.index(name)
        if not lower[k] <= a < b <= upper[k]:
            raise ValueError(f"{name} = {a!r} to {b!r}: allowed is a range within {lower[k]:g} to {upper[k]:g}")
        lower[k], upper[k] = a, b
    ends = np.sort(atlas.to_coordinates(np.stack([lower, upper])), axis=0)
    panels = tuple(p for panel in atlas.panels if (p := _part(panel, *ends)) is not None)
    gaps = tuple(g for gap in atlas.gaps if (g := _part(gap, *ends)) is not None)
    return replace(atlas, lower=lower, upper=upper, panels=panels, gaps=gaps)


def _part(box: Panel | Gap, lower: np.ndarray, upper: np.ndarray) -> Panel | Gap | None:
    low, high = np.maximum(box.lower, lower), np.minimum(box.upper, upper)
    if (low >= high).any():
        return None
    if isinstance(box, Gap):
        return replace(box, lower=low, upper=high)
    coefficients = box.coefficients
    for k, n in enumerate(box.degrees):
        y = nodes(n)
        t = position_between(box.lower[k], box.upper[k], (low[k] * (1 - y) + high[k] * (1 + y)) / 2)
        matrix = analysis_matrix(n) @ chebyshev(t, n)
        coefficients = np.moveaxis(np.tensordot(matrix, coefficients, axes=(1, k)), 0, k)
    return replace(box, lower=low, upper=high, coefficients=_without_tail(coefficients, box.value_error / 100))


def _without_tail(coefficients: np.ndarray, limit: float) -> np.ndarray:
    """Coefficients without those at the end that are below ``limit``: a part of a panel needs fewer than the whole."""
    size = np.abs(coefficients)
    for k in range(coefficients.ndim - 1):
        largest = size.max(axis=tuple(j for j in range(size.ndim) if j != k))
        kept = np.flatnonzero(largest > max(limit, 64 * np.finfo(float).eps * largest.max()))
        needed = kept[-1] + 1 if kept.size else 1
        coefficients = np.take(coefficients, range(needed), axis=k)
    return coefficients


def _crossings(atlas: Atlas, x: np.ndarray, error: np.ndarray, v: int, kind: str) -> list[Crossing]:
    points = parameters_at(atlas, x)
    slope = np.abs(atlas.coordinates[v].slope(points[:, v]))
    return [
        Crossing(float(p[v]), float(e / s), kind, dict(zip(atlas.parameters, map(float, p), strict=True)))
        for p, e, s in zip(points, error, slope, strict=True)
        if np.isfinite(p).all()
    ]


def _stable_at(criteria: Criteria):
    def stable(values: np.ndarray) -> np.ndarray:
        return criteria.stable(criteria.atlas.to_coordinates(values[:, None]))

    return stable


def _all_stable(criteria: Criteria, patches: tuple[Patches, ...], h: int, value: float) -> bool:
    """Whether all of ``h`` is stable where the other parameter has ``value``: no zero, and one point that is stable."""
    atlas = criteria.atlas
    point = (atlas.lower + atlas.upper) / 2
    point[1 - h] = value
    x = atlas.to_coordinates(point)
    if not criteria.stable(x[None])[0]:
        return False
    return not any(len(roots(on_line(p, 1 - h, float(x[1 - h]))).x) for p in patches)


def decided(lower: float, upper: float, undecided: Iterable[Range]) -> list[Range]:
    """What ``undecided`` ranges leave of the one from ``lower`` to ``upper``."""
    left = []
    for a, b in sorted(undecided):
        left += [(lower, min(a, upper))] if lower < min(a, upper) else []
        lower = max(lower, b)
    return [*left, (lower, upper)] if lower < upper else left


def _middle(lower: float, upper: float, undecided: Iterable[Range]) -> float:
    """The middle of the widest part that is decided."""
    widest = max(decided(lower, upper, undecided), key=lambda part: part[1] - part[0], default=(lower, upper))
    return (widest[0] + widest[1]) / 2


def _line(name: str, ends: tuple[float, float], changes: list[Crossing], undecided: list, stable) -> Line:
    """Sort candidates, test between them and keep those at which the stability changes."""
    changes = sorted((c for c in changes if ends[0] < c.value < ends[1]), key=lambda c: c.value)
    edges = [float(ends[0]), *(c.value for c in changes), float(ends[1])]
    inside = stable(np.array([_middle(a, b, undecided) for a, b in itertools.pairwise(edges)]))
    intervals: list[Interval] = []
    start, first = edges[0], None
    for k, change in enumerate([*changes, None]):
        if change is not None and inside[k] == inside[k + 1]:
            continue
        end = edges[-1] if change is None else change.value
        intervals.append(Interval(start, end, bool(inside[k]), first, change))
        start, first = end, change
    return Line(name, tuple(intervals), tuple(sorted(undecided)))
