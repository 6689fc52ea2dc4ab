"""Design questions answered from an atlas, each answer with an error bound and a check by direct solves.

The atlas may have more parameters than a question names: ``at`` gives their values. The system declares which parameter is
the speed, the angle or the damping (``roles``). The check ``direct`` is a function from columns of all parameters, a
mapping of names to arrays ``(N,)``, to spectral radii ``(N,)`` computed without the atlas.

All questions raise ``KeyError`` for parameters that the atlas lacks, ``ValueError`` for values outside its domain, and
:class:`InputError` for an atlas without panels or boundaries, or with the wrong free parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.windows import (
    Crossing,
    Interval,
    Line,
    Range,
    decided,
    narrow,
    stability_along,
    stability_over_range,
)
from drivetrain_jax.systems import System

# Checks of design answers by direct solves, independent of the atlas.


Direct = Callable[[Mapping[str, np.ndarray]], np.ndarray]

# Distance of a check from the end of a window, in error bounds, and its minimum relative to the range of the parameter. The
# last number is this minimum at the end of an interval, where direct solves must resolve the sign of rho - 1.
_BOUNDS, _PART, _LEAST = 10.0, 1e-6, 1e-9
# Points of a range at which a check solves, and points at which it searches the maximum on the surrogate.
_SAMPLES, DENSE = 101, 801
# Distances of points from a crossing, relative to the range.
_AROUND = np.concatenate([[0.0], *(sign * np.geomspace(1e-11, 1, 400) for sign in (-1, 1))])
# Largest distance of direct solves from the unit circle that counts as on it.
ON_THE_CIRCLE = 1e-6


@dataclass(frozen=True)
class Check:
    """Direct solves for an answer: the largest spectral radius ``inside`` the stable range, and ``beyond`` it.

    ``beyond`` is NaN at an end of the atlas, or if a tongue is too narrow to sample. ``agrees`` if inside < 1 < beyond.
    Without damping all multipliers of a stable point lie on the circle, double ones with half the digits; inside is then 1.
    """

    inside: float
    beyond: float
    solves: int
    conservative: bool = False

    @property
    def agrees(self) -> bool:
        """True if the direct solves confirm the answer."""
        within = self.inside <= 1 + ON_THE_CIRCLE if self.conservative else self.inside < 1
        return within and not self.beyond <= 1


def check_ends(ends: list[tuple[Interval, float]], line: Line, criteria: Criteria, direct: Direct) -> Check | None:
    """Check ``ends`` of stable intervals of ``line``, each with the sign of its inward side, by direct solves just inside
    and just beyond; None without ends.

    Inside, the solves cover the whole range of the other coordinate. On both sides, two lie at the maximum of the surrogate
    over the whole range, and about the crossing.
    """
    part = criteria.atlas
    k = part.parameters.index(line.parameter)
    other, span = part.parameters[1 - k], float(part.upper[k] - part.lower[k])
    within = np.linspace(part.lower[1 - k], part.upper[1 - k], _SAMPLES)
    points, outer = [], []
    for interval, inward in ends:
        end, crossing = interval.ends[0 if inward > 0 else 1]
        error = crossing.error if crossing else 0.0
        step = max(error, _LEAST * span) if math.isfinite(error) else _PART * span
        inner, value = end + inward * min(step, (interval.upper - interval.lower) / 2), end - inward * step
        points += [(x, inner) for x in (*within, *_worst(criteria, k, inner, crossing))]
        if crossing and _unstable(line, value):
            outer += [(x, value) for x in _worst(criteria, k, value, crossing)]
    if not points:
        return None
    columns = np.array(points + outer).T
    rho = _solve(direct, part, {other: columns[0], line.parameter: columns[1]})
    inside, beyond = np.split(rho, [len(points)])
    return _check(inside, beyond.reshape(-1, 2).max(axis=1), criteria, len(rho))


def _worst(criteria: Criteria, k: int, value: float, crossing: Crossing | None) -> list[float]:
    """Positions over the other coordinate than ``k``, which has ``value``, of the surrogate's largest spectral radius: over
    the whole range, and over points ever closer to the ``crossing``, whose tongue may be narrow and slanted."""
    part, lower, upper = criteria.atlas, *(float(end[1 - k]) for end in (criteria.atlas.lower, criteria.atlas.upper))
    ranges = [np.linspace(lower, upper, DENSE)]
    if crossing:
        place = crossing.point[part.parameters[1 - k]]
        ranges.append(np.clip(place + (upper - lower) * _AROUND, lower, upper))
    rho = [criteria.spectral_radius(part.to_coordinates(np.insert(x[:, None], k, value, axis=1))) for x in ranges]
    return [float(x[np.argmax(np.nan_to_num(r))]) for x, r in zip(ranges, rho, strict=True)]


def check_window(safe: Range, interval: Interval, line: Line, criteria: Criteria, direct: Direct) -> Check:
    """Check ``safe``, a part of the stable ``interval``, by direct solves in it and in the unstable intervals next to it."""
    part = criteria.atlas
    span = float(part.upper[0] - part.lower[0])
    outer = []
    for crossing, side in ((interval.lower_end, -1.0), (interval.upper_end, 1.0)):
        if crossing:
            value = crossing.value + side * max(_BOUNDS * crossing.error, _PART * span)
            outer += [value] if _unstable(line, value) else []
    # Without a margin the window ends at the crossings: keep the same distance from them inside.
    step = min(_PART * span, (safe[1] - safe[0]) / 4)
    inner = np.linspace(safe[0] + step, safe[1] - step, _SAMPLES)
    rho = _solve(direct, part, {line.parameter: np.append(inner, outer)})
    return _check(rho[:_SAMPLES], rho[_SAMPLES:], criteria, len(rho))


def _unstable(line: Line, value: float) -> bool:
    """True if ``line`` is unstable at ``value``; a step may cross a narrow tongue."""
    return any(i.lower < value < i.upper and not i.stable for i in line.intervals)


def _check(inside: np.ndarray, beyond: np.ndarray, criteria: Criteria, solves: int) -> Check:
    least = float(beyond.min()) if beyond.size else math.nan
    return Check(float(inside.max()), least, solves, criteria.conservative)


def _solve(direct: Direct, part: Atlas, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    size = len(next(iter(columns.values())))
    fixed = {name: np.full(size, value) for name, value in part.fixed.items()}
    return np.asarray(direct({**fixed, **columns}), float)


# Largest distance, relative, between an undecided range and the end of its covering error that counts as rounding.
_ROUNDING = 4 * np.finfo(float).eps


@dataclass(frozen=True)
class Answer:
    """The ``value`` of ``parameter`` up to which the system is stable from ``safe_end``, with a bound of its ``error``.

    ``safe_end`` is an end of the atlas. If the system is unstable there, the value is None, and ``stable`` may contain other
    intervals.

    ``limit`` is the crossing that determines the value. It is None at the end of the atlas (error 0) and at the start of an
    undecided range (error NaN). ``intervals`` lists all stable and unstable ranges, ``undecided`` those that errors leave
    open. A value is ``certain`` if no undecided range lies on its safe side beyond its error. Without a value it is certain
    if the errors of the ends of the stable intervals cover all undecided ranges.
    """

    parameter: str
    value: float | None
    error: float
    limit: Crossing | None
    intervals: tuple[Interval, ...]
    undecided: tuple[Range, ...]
    certain: bool
    safe_end: float
    check: Check | None = None

    @property
    def stable(self) -> tuple[Interval, ...]:
        """The stable intervals without undecided ranges."""
        return tuple(_stable_and_decided(self.intervals, self.undecided))


@dataclass(frozen=True)
class Window:
    """A stable range of a parameter; ``safe`` is the range within the margin.

    ``largest`` is the largest spectral radius within ``safe`` (sampled) and ``where`` its position.
    """

    interval: Interval
    safe: Range
    largest: float
    where: float
    check: Check | None = None


@dataclass(frozen=True)
class Windows:
    """All ``windows``, the ``unstable`` ranges between them, and the ``undecided`` ranges, which belong to neither."""

    windows: tuple[Window, ...]
    unstable: tuple[Interval, ...]
    undecided: tuple[Range, ...]


@dataclass(frozen=True)
class Nearest:
    """The nearest known changes of stability ``below`` and ``above`` a value of ``parameter``.

    They are None at the end of the atlas. Further changes may lie in the ``undecided`` ranges.
    """

    parameter: str
    value: float
    below: Crossing | None
    above: Crossing | None
    undecided: tuple[Range, ...]


def least_damping(
    atlas: Atlas,
    system: type[System],
    speeds: Range,
    at: Mapping[str, float],
    *,
    vary: str = "",
    direct: Direct | None = None,
) -> Answer:
    """The least damping above which, up to the largest of the atlas, all ``speeds`` are stable; or the least value of the
    parameter ``vary``."""
    return _extreme(
        _over(atlas, at, system.roles["speed"], vary or system.roles["damping"]), system, speeds, 1.0, direct
    )


def widest_angle(
    atlas: Atlas,
    system: type[System],
    speeds: Range,
    at: Mapping[str, float],
    *,
    vary: str = "",
    direct: Direct | None = None,
) -> Answer:
    """The widest angle below which, down to the smallest of the atlas, all ``speeds`` are stable; or the largest value of
    the parameter ``vary``."""
    return _extreme(
        _over(atlas, at, system.roles["speed"], vary or system.roles["angle"]), system, speeds, -1.0, direct
    )


def speed_windows(
    atlas: Atlas,
    system: type[System],
    at: Mapping[str, float],
    *,
    margin: float = 0.0,
    within: Range | None = None,
    direct: Direct | None = None,
) -> Windows:
    """The stable ranges of the speed with the other parameters ``at``.

    Each is shortened by ``margin`` times the speed at both ends, except at the end of the atlas; empty ranges are left out.
    Only what lies ``within`` a range is told, at the margin from boundaries beyond it, too.
    """
    part = _over(atlas, at, system.roles["speed"])
    start, stop = within or (float(part.lower[0]), float(part.upper[0]))
    line = stability_along(part, system)
    criteria = Criteria.of(part, system)
    windows = []
    for interval in _stable_and_decided(line.intervals, line.undecided):
        low, high = _shortened(interval, part, margin)
        if low < start:
            low, interval = start, replace(interval, lower=start, lower_end=None)
        if high > stop:
            high, interval = stop, replace(interval, upper=stop, upper_end=None)
        if low >= high:
            continue
        values = np.linspace(low, high, DENSE)
        rho = criteria.spectral_radius(part.to_coordinates(values[:, None]))
        # Both ends may be equal within their errors: the lower one, on every processor.
        k = int(np.argmax(np.round(rho, 9)))
        check = direct and check_window((low, high), interval, line, criteria, direct)
        windows.append(Window(interval, (low, high), float(rho[k]), float(values[k]), check))
    unstable = [i for i in line.intervals if not i.stable and i.upper > start and i.lower < stop]
    undecided = ((max(a, start), min(b, stop)) for a, b in line.undecided if b > start and a < stop)
    clipped = (replace(i, lower=max(i.lower, start), upper=min(i.upper, stop)) for i in unstable)
    return Windows(tuple(windows), tuple(clipped), tuple(undecided))


def _over(atlas: Atlas, at: Mapping[str, float], *wanted: str) -> Atlas:
    """``atlas`` restricted to ``at``, over exactly the parameters ``wanted``."""
    part = atlas.slice(at)
    if set(part.parameters) != set(wanted):
        left = " and ".join(part.parameters) or "nothing"
        raise InputError(
            f"at = {dict(at)}: leaves an atlas over {left}; expected values that leave {' and '.join(wanted)}"
        )
    return part


def _stable_and_decided(intervals: Iterable[Interval], undecided: Iterable[Range]) -> list[Interval]:
    """The stable ones of ``intervals``, cut at ``undecided`` ranges unless the errors of their ends cover these."""
    return [
        replace(
            interval,
            lower=low,
            upper=high,
            lower_end=interval.lower_end if low == interval.lower else None,
            upper_end=interval.upper_end if high == interval.upper else None,
        )
        for interval in intervals
        if interval.stable
        for low, high in decided(interval.lower, interval.upper, _uncovered(undecided, interval.crossings))
    ]


def _uncovered(undecided: Iterable[Range], crossings: Iterable[Crossing]) -> list[Range]:
    """The undecided ranges that the errors of ``crossings`` do not cover."""
    covered = [(c.value - reach, c.value + reach) for c in crossings for reach in [_reach(c)]]
    return [(a, b) for a, b in undecided if not any(low <= a and b <= high for low, high in covered)]


def _reach(crossing: Crossing) -> float:
    """The error of a crossing, 0 if it is unknown, with a tolerance for rounding."""
    return float(np.nan_to_num(crossing.error)) + _ROUNDING * abs(crossing.value)


def _shortened(interval: Interval, part: Atlas, margin: float) -> Range:
    low, high = interval.lower, interval.upper
    if low > part.lower[0]:
        low = low * (1 + margin) + (interval.lower_end.error if interval.lower_end else 0.0)
    if high < part.upper[0]:
        high = high * (1 - margin) - (interval.upper_end.error if interval.upper_end else 0.0)
    return low, high


def nearest_boundaries(atlas: Atlas, system: type[System], point: Mapping[str, float]) -> tuple[Nearest, ...]:
    """The nearest changes of stability along every parameter of ``atlas`` from ``point``, one parameter at a time."""
    nearest = []
    for name in atlas.parameters:
        others = {other: point[other] for other in atlas.parameters if other != name}
        line = stability_along(atlas.slice(others), system)
        value = float(point[name])
        below = [c for c in line.crossings if c.value <= value]
        above = [c for c in line.crossings if c.value > value]
        nearest.append(
            Nearest(
                name,
                value,
                replace(below[-1], point={**others, name: below[-1].value}) if below else None,
                replace(above[0], point={**others, name: above[0].value}) if above else None,
                line.undecided,
            )
        )
    return tuple(nearest)


def _extreme(atlas: Atlas, system: type[System], speeds: Range, side: float, direct: Direct | None) -> Answer:
    """The limit up to which all ``speeds`` are stable, from the end of the other parameter on that ``side``."""
    speed = system.roles["speed"]
    part = narrow(atlas, {speed: speeds}).folded()
    line = stability_over_range(part, system, speed)
    answer = _from_safe_end(line, part, side)
    if direct is None:
        return answer
    # Ends to check: the end that is the answer; without an answer both ends of every stable interval.
    stated = answer.stable if answer.value is None else (line.intervals[-1 if side > 0 else 0],)
    sides = (1.0, -1.0) if answer.value is None else (side,)
    ends = [(interval, inward) for interval in stated for inward in sides]
    return replace(answer, check=check_ends(ends, line, Criteria.of(part, system), direct))


def _from_safe_end(line: Line, part: Atlas, side: float) -> Answer:
    """The answer without a check: the value up to which ``line`` is stable, from the end on that ``side``."""
    k = part.parameters.index(line.parameter)
    safe, other = (float(x[k]) for x in ((part.upper, part.lower) if side > 0 else (part.lower, part.upper)))
    answer = Answer(line.parameter, None, math.nan, None, line.intervals, line.undecided, False, safe)
    if not line.intervals:
        return answer
    last = line.intervals[-1 if side > 0 else 0]
    if not last.stable:
        return replace(answer, certain=not _uncovered(line.undecided, line.crossings))
    value, limit = last.ends[0 if side > 0 else 1]
    error = limit.error if limit else 0.0 if value == other else math.nan
    return replace(answer, value=value, error=error, limit=limit, certain=not _doubted(line, value, limit, side))


def _doubted(line: Line, value: float, limit: Crossing | None, side: float) -> bool:
    """True if an undecided range reaches the safe side of ``value``, beyond the error of the crossing ``limit`` if given."""
    reached = max((max(side * a, side * b) for a, b in line.undecided), default=-math.inf)
    return reached > side * value + _reach(limit) if limit else reached >= side * value
