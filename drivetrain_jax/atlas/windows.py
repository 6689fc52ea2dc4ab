"""Intervals of one parameter in which a system is stable, at a point or over a whole range of another parameter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivetrain_jax.atlas.criteria import Criteria, parameters_at
from drivetrain_jax.atlas.exclusion import critical_points
from drivetrain_jax.atlas.interpolation import restriction
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, position_between
from drivetrain_jax.atlas.patches import Patches, merge, on_line, patches_of, roots
from drivetrain_jax.atlas.tips import polish, suspected
from drivetrain_jax.systems import System

Range = tuple[float, float]
# Ratio of the width between two candidates to their errors above which stability is tested between them.
_WIDER = 2.0
# Widest undecided range, relative to the whole range, that counts as the error of a change inside it.
_COVERED = 1e-3


@dataclass(frozen=True)
class Crossing:
    """``value`` of a parameter at which the stability changes, with a bound of its error.

    ``multiplier`` (``+1``, ``-1`` or ``pair``) crosses the unit circle; ``point`` holds all parameters of the atlas there.
    In a narrow undecided range another multiplier may cross first, at another point: the error covers the range.
    """

    value: float
    error: float
    multiplier: str
    point: Mapping[str, float]


@dataclass(frozen=True)
class Interval:
    """An interval of a parameter.

    ``lower_end`` and ``upper_end`` are None at an end of the atlas or of an undecided range.
    """

    lower: float
    upper: float
    stable: bool
    lower_end: Crossing | None
    upper_end: Crossing | None

    @property
    def ends(self) -> tuple[tuple[float, Crossing | None], tuple[float, Crossing | None]]:
        """Both ends, each with its crossing."""
        return (self.lower, self.lower_end), (self.upper, self.upper_end)

    @property
    def crossings(self) -> tuple[Crossing, ...]:
        """The known crossings at its ends."""
        return tuple(end for end in (self.lower_end, self.upper_end) if end)


@dataclass(frozen=True)
class Line:
    """``intervals`` that alternate between stable and unstable, and the ``undecided`` ranges.

    If a change lies in an undecided range that no error covers, one interval ends where that range begins, and the next one
    begins where it ends. An undecided range at an end of the atlas also shortens the first or last interval. Without
    intervals everything is undecided.
    """

    parameter: str
    intervals: tuple[Interval, ...]
    undecided: tuple[Range, ...]

    @property
    def crossings(self) -> tuple[Crossing, ...]:
        """The changes of stability in rising order."""
        return tuple(i.upper_end for i in self.intervals if i.upper_end)


def stability_along(atlas: Atlas, system: type[System]) -> Line:
    """The intervals of stability along the one parameter of ``atlas`` (slice the others away)."""
    part, (lower, upper) = atlas.folded(), (float(atlas.lower[0]), float(atlas.upper[0]))
    criteria = Criteria.of(part, system)
    changes, undecided = [], [_values(part, np.stack([gap.lower, gap.upper])[:, 0], 0) for gap in part.gaps]
    for kind, patches in zip(criteria.multipliers, patches_of(criteria), strict=True):
        zeros = roots(patches)
        changes += _crossings(part, zeros.x[:, None], zeros.error, 0, kind)
        undecided += [_values(part, ends, 0) for ends in zeros.undecided]
    if lower < part.lower[0]:
        # Both signs of the parameter have the same results.
        changes += [
            replace(c, value=-c.value, point={name: -value for name, value in c.point.items()}) for c in changes
        ]
        undecided = [(max(a, lower), min(b, upper)) for low, high in undecided for a, b in ((low, high), (-high, -low))]
        undecided = [(a, b) for a, b in undecided if a <= b]

    def stable(values: np.ndarray) -> np.ndarray:
        return criteria.stable(part.to_coordinates(values[:, None]))

    return _line(part.parameters[0], (lower, upper), changes, undecided, stable)


def _values(atlas: Atlas, ends: np.ndarray, k: int) -> Range:
    """An interval ``(2,)`` of the coordinate ``k`` as a range of its parameter."""
    x = np.tile(atlas.corners[0], (2, 1))
    x[:, k] = ends
    low, high = sorted(map(float, parameters_at(atlas, x)[:, k]))
    return low, high


def stability_over_range(atlas: Atlas, system: type[System], along: str) -> Line:
    """The intervals of the other parameter of ``atlas`` (two) in which all values of ``along`` are stable.

    Angles are returned without signs.
    """
    atlas = atlas.folded()
    h = atlas.parameters.index(along)
    v = 1 - h
    criteria = Criteria.of(atlas, system)
    patches = patches_of(criteria)
    changes: list[Crossing] = []
    suspects: list[Crossing] = []
    undecided: list[Any] = []
    for number, kind in enumerate(criteria.multipliers):
        search = critical_points(patches, number, h)
        if criteria.conservative:
            x, error = search.points, np.full(len(search.points), np.nan)
        else:
            x, rates = polish(criteria, search.points, kind, h)
            error = rates.error / np.abs(rates.gradient[:, v])
            likely, _ = suspected(criteria, kind, h, search.undecided, x)
            # Without an error of their own: `_one_change` takes the undecided range as their error.
            suspects += _crossings(atlas, likely, np.zeros(len(likely)), v, kind)
        changes += _crossings(atlas, x, error, v, kind)
        undecided += [_values(atlas, box[:, v], v) for box in search.undecided]
        for end in atlas.ends[:, h]:
            rim = roots(on_line(patches[number], h, float(end)))
            x = np.insert(rim.x[:, None], h, end, axis=1)
            changes += _crossings(atlas, x, rim.error, v, kind)
            undecided += [_values(atlas, ends, v) for ends in rim.undecided]
    undecided += [_values(atlas, np.stack([gap.lower, gap.upper])[:, v], v) for gap in atlas.gaps]

    def stable(values: np.ndarray) -> np.ndarray:
        return np.array([_all_stable(criteria, patches, h, value) for value in values])

    return _line(atlas.parameters[v], (atlas.lower[v], atlas.upper[v]), changes, undecided, stable, suspects)


def narrow(atlas: Atlas, bounds: Mapping[str, tuple[float, float]]) -> Atlas:
    """The part of ``atlas`` within ``bounds``.

    Raises ``ValueError`` for bounds outside its domain, and ``KeyError`` for unknown names.
    """
    lower, upper = atlas.lower.copy(), atlas.upper.copy()
    for name, (a, b) in bounds.items():
        if name not in atlas.parameters:
            raise KeyError(f"{name}: the atlas has {', '.join(atlas.parameters)}")
        k = atlas.parameters.index(name)
        if not lower[k] <= a < b <= upper[k]:
            raise ValueError(f"{name} = {a!r} to {b!r}: expected a range within {lower[k]:g} to {upper[k]:g}")
        lower[k], upper[k] = a, b
    part = replace(atlas, lower=lower, upper=upper).folded()
    corners = part.corners
    panels = tuple(p for panel in atlas.panels if (p := _part(panel, *corners)) is not None)
    gaps = tuple(g for gap in atlas.gaps if (g := _part(gap, *corners)) is not None)
    return replace(atlas, lower=lower, upper=upper, panels=panels, gaps=gaps)


def _part(box: Panel | Gap, lower: np.ndarray, upper: np.ndarray) -> Panel | Gap | None:
    low, high = np.maximum(box.lower, lower), np.minimum(box.upper, upper)
    if (low >= high).any():
        return None
    if isinstance(box, Gap):
        return replace(box, lower=low, upper=high)
    coefficients = box.coefficients
    for k, n in enumerate(box.degrees):
        matrix = restriction(n, *position_between(box.lower[k], box.upper[k], np.array([low[k], high[k]])))
        coefficients = np.moveaxis(np.tensordot(matrix, coefficients, axes=(1, k)), 0, k)
    # The proof does not cover the rounding of these products.
    return replace(box, lower=low, upper=high, coefficients=coefficients, proved_error=math.inf)


def _crossings(atlas: Atlas, x: np.ndarray, error: np.ndarray, v: int, kind: str) -> list[Crossing]:
    points = parameters_at(atlas, x)
    # At an angle of 0 its square gives no error.
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = error / np.abs(atlas.coordinates[v].slope(points[:, v]))
    return [
        Crossing(float(p[v]), float(e), kind, dict(zip(atlas.parameters, map(float, p), strict=True)))
        for p, e in zip(points, errors, strict=True)
        if np.isfinite(p).all()
    ]


def _all_stable(criteria: Criteria, patches: tuple[Patches, ...], h: int, value: float) -> bool:
    """True if all of ``h`` is stable at this ``value`` of the other parameter: no zero, and one stable point."""
    atlas = criteria.atlas
    point = (atlas.lower + atlas.upper) / 2
    point[1 - h] = value
    x = atlas.to_coordinates(point)
    if not criteria.stable(x[None])[0]:
        return False
    return not any(len(roots(on_line(p, 1 - h, float(x[1 - h]))).x) for p in patches)


def decided(lower: float, upper: float, undecided: Iterable[Range]) -> list[Range]:
    """The range from ``lower`` to ``upper`` without the ``undecided`` ranges."""
    left = []
    for a, b in sorted(undecided):
        left += [(lower, min(a, upper))] if lower < min(a, upper) else []
        lower = max(lower, b)
    return [*left, (lower, upper)] if lower < upper else left


def _line(
    name: str,
    ends: Range,
    changes: list[Crossing],
    undecided: list[Range],
    stable: Callable[[np.ndarray], np.ndarray],
    suspects: Iterable[Crossing] = (),
) -> Line:
    """The line from sorted candidates, with tests between them; ``suspects`` are further candidates in undecided ranges.

    Between two candidates every decided part is tested, because an undecided range may hide a change. Parts too narrow for
    a test are undecided, and so are the ranges before the first and after the last tested part.
    """
    changes = sorted((c for c in changes if ends[0] < c.value < ends[1]), key=lambda c: c.value)
    edges = [(float(ends[0]), 0.0), *((c.value, c.error) for c in changes), (float(ends[1]), 0.0)]
    segments = [_tested(a, b, undecided) for a, b in itertools.pairwise(edges)]
    parts = [(k, *part) for k, (tested, _) in enumerate(segments) for part in tested]
    ranges = [*undecided, *(part for _, narrow in segments for part in narrow)]
    joined = tuple((float(a), float(b)) for a, b in merge(np.array(ranges).reshape(-1, 2)))
    if not parts:
        return Line(name, (), joined)
    states = stable(np.array([(low + high) / 2 for _, low, high in parts]))
    intervals: list[Interval] = []
    start, first = parts[0][1], None
    for (here, _, high), (there, low, _), before, after in zip(parts, parts[1:], states, states[1:], strict=False):
        if before == after:
            continue
        known = changes[here:there] + [c for c in suspects if high <= c.value <= low]
        change = _one_change(known, (high, low), bool(after), _COVERED * (ends[1] - ends[0]))
        intervals.append(Interval(start, change.value if change else high, bool(before), first, change))
        start, first = (change.value, change) if change else (low, None)
    intervals.append(Interval(start, parts[-1][2], bool(states[-1]), first, None))
    return Line(name, tuple(intervals), joined)


def _one_change(candidates: list[Crossing], between: Range, rising: bool, widest: float) -> Crossing | None:
    """The change of stability ``between`` two tested parts, the upper one stable if ``rising``.

    It is the candidate nearest to the stable part, with an error that covers everything between the parts. None without a
    candidate, or if the undecided range is wider than ``widest`` and than the errors of the nearest candidates.
    """
    if not candidates:
        return None
    first = (max if rising else min)(candidates, key=lambda c: c.value)
    near = [c for c in candidates if abs(c.value - first.value) <= _least(_end(c), _end(first))]
    best = min(near, key=lambda c: _end(c)[1])

    def spread(those: list[Crossing]) -> float:
        return max(abs(c.value - best.value) + _end(c)[1] for c in those)

    reach = float(max(spread(candidates), best.value - between[0], between[1] - best.value))
    if reach > max(widest, spread(near)):
        return None
    return replace(best, error=math.nan if any(math.isnan(c.error) for c in candidates) else reach)


def _tested(lower: Any, upper: Any, undecided: Iterable[Range]) -> tuple[list, list]:
    """The decided parts between two candidates (values, bounds of errors): those to test, and those too narrow for it.

    A narrow part that reaches a candidate is extended by the error of this candidate.
    """
    (a, error), (b, other) = lower, upper = [tuple(map(float, np.nan_to_num(end))) for end in (lower, upper)]
    least = _least(lower, upper)
    parts = decided(a, b, undecided)
    wide = [part for part in parts if part[1] - part[0] > least]
    narrow = [part for part in parts if part[1] - part[0] <= least]
    return wide, [(low - error * (low == a), high + other * (high == b)) for low, high in narrow]


def _end(change: Crossing) -> tuple[float, float]:
    return change.value, float(np.nan_to_num(change.error))


def _least(lower: tuple[float, float], upper: tuple[float, float]) -> float:
    """Largest width of a part between two candidates (values, bounds of errors) that is not tested."""
    return _WIDER * max(lower[1], upper[1], np.finfo(float).eps * max(abs(lower[0]), abs(upper[0])))
