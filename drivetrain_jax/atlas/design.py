"""Design questions answered from an atlas, each answer with a bound of its error and a check by direct solves.

The atlas may have more parameters than a question names: ``at`` gives their values. Which parameter is the speed, the angle
or the damping is a matter of the system (``roles``). ``direct`` is the check: a function from
columns of all parameters, a mapping of names to arrays ``(N,)``, to spectral radii ``(N,)`` computed without the atlas.

All raise ``KeyError`` for parameters that the atlas lacks, ``ValueError`` for values outside its domain, and
:class:`InputError` for an atlas without panels or boundaries, or one that with ``at`` is not over what is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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

Direct = Callable[[Mapping[str, np.ndarray]], np.ndarray]

# A check steps aside from the answer by this many error bounds, and at least by this part of the parameter's range.
_BOUNDS, _PART = 10.0, 1e-6
# Points over a range at which a check solves, and those at which the largest spectral radius of a window is sought.
_SAMPLES, _DENSE = 101, 801
# By how much direct solves may miss the unit circle.
_ON_THE_CIRCLE = 1e-6


@dataclass(frozen=True)
class Check:
    """Direct solves beside an answer: the largest spectral radius ``inside`` the range said to be stable, and ``beyond`` it.

    ``beyond`` is NaN where the range ends with the atlas, or a tongue is too narrow to step into. ``agrees`` if
    inside < 1 < beyond; without damping, where all multipliers of a stable point lie on the circle and two that meet there
    are known to half the digits, inside is 1.
    """

    inside: float
    beyond: float
    solves: int
    conservative: bool = False

    @property
    def agrees(self) -> bool:
        """Whether the direct solves confirm the answer."""
        within = self.inside <= 1 + _ON_THE_CIRCLE if self.conservative else self.inside < 1
        return within and not self.beyond <= 1


@dataclass(frozen=True)
class Answer:
    """``value`` of ``parameter`` with a bound of its ``error``; None if none was found.

    ``limit`` is the crossing that sets it (None: the atlas ends first), ``intervals`` lists all stable and unstable
    ranges, ``undecided`` those that errors leave open; a value is certain only if none of them is on its safe side, and
    that no value in the atlas will do only if none reaches the safe end.
    """

    parameter: str
    value: float | None
    error: float
    limit: Crossing | None
    intervals: tuple[Interval, ...]
    undecided: tuple[Range, ...]
    certain: bool
    check: Check | None = None


@dataclass(frozen=True)
class Window:
    """A stable range of a parameter; ``safe`` is what the margin leaves of it.

    ``largest`` is the largest spectral radius within ``safe`` (sampled) and ``where`` its place.
    """

    interval: Interval
    safe: Range
    largest: float
    where: float
    check: Check | None = None


@dataclass(frozen=True)
class Windows:
    """All ``windows``, and the ``undecided`` ranges, which are in none of them."""

    windows: tuple[Window, ...]
    undecided: tuple[Range, ...]


@dataclass(frozen=True)
class Nearest:
    """The nearest changes of stability ``below`` and ``above`` a value of ``parameter`` whose places are known; None where
    the atlas ends first. Further ones may lie in the ``undecided`` ranges."""

    parameter: str
    value: float
    below: Crossing | None
    above: Crossing | None
    undecided: tuple[Range, ...]


def least_damping(
    atlas: Atlas,
    system: System,
    speeds: Range,
    at: Mapping[str, float],
    *,
    direct: Direct | None = None,
) -> Answer:
    """The least damping from which on, up to the atlas's largest, all ``speeds`` are stable."""
    return _extreme(_over(atlas, system, at, "speed", "damping"), system, speeds, ("damping", 1.0), direct)


def widest_angle(
    atlas: Atlas,
    system: System,
    speeds: Range,
    at: Mapping[str, float],
    *,
    direct: Direct | None = None,
) -> Answer:
    """The widest angle up to which, from the atlas's smallest on, all ``speeds`` are stable."""
    return _extreme(_over(atlas, system, at, "speed", "angle"), system, speeds, ("angle", -1.0), direct)


def speed_windows(
    atlas: Atlas,
    system: System,
    at: Mapping[str, float],
    *,
    margin: float = 0.0,
    direct: Direct | None = None,
) -> Windows:
    """The stable ranges of the speed where the other parameters are ``at``, each shortened by ``margin`` of the speed at
    both ends, unless the atlas ends there. What a margin leaves nothing of is left out."""
    part = _over(atlas, system, at, "speed")
    line = stability_along(part, system)
    criteria = Criteria.of(part, system)
    windows = []
    for interval in _stable_and_decided(line):
        low, high = _shortened(interval, part, margin)
        if low >= high:
            continue
        values = np.linspace(low, high, _DENSE)
        rho = criteria.spectral_radius(part.to_coordinates(values[:, None]))
        k = int(np.argmax(rho))
        window = Window(interval, (low, high), float(rho[k]), float(values[k]))
        window = _checked_window(window, part, system.roles["speed"], line, direct)
        windows.append(replace(window, check=_of_kind(window.check, criteria)))
    return Windows(tuple(windows), line.undecided)


def _over(atlas: Atlas, system: System, at: Mapping[str, float], *roles: str) -> Atlas:
    """``atlas`` where it is ``at``, over the parameters with these ``roles`` and no other."""
    wanted, part = [system.roles[role] for role in roles], atlas.slice(at)
    if set(part.parameters) != set(wanted):
        left = " and ".join(part.parameters) or "nothing"
        raise InputError(f"at = {dict(at)}: leaves an atlas over {left}; allowed is what leaves {' and '.join(wanted)}")
    return part


def _stable_and_decided(line: Line) -> list[Interval]:
    return [
        replace(
            interval,
            lower=low,
            upper=high,
            lower_end=interval.lower_end if low == interval.lower else None,
            upper_end=interval.upper_end if high == interval.upper else None,
        )
        for interval in line.intervals
        if interval.stable
        for low, high in decided(interval.lower, interval.upper, line.undecided)
    ]


def _shortened(interval: Interval, part: Atlas, margin: float) -> Range:
    low, high = interval.lower, interval.upper
    if low > part.lower[0]:
        low = low * (1 + margin) + (interval.lower_end.error if interval.lower_end else 0.0)
    if high < part.upper[0]:
        high = high * (1 - margin) - (interval.upper_end.error if interval.upper_end else 0.0)
    return low, high


def nearest_boundaries(atlas: Atlas, system: System, point: Mapping[str, float]) -> tuple[Nearest, ...]:
    """For every parameter of ``atlas`` the nearest changes of stability when it alone is varied from ``point``."""
    found = []
    for name in atlas.parameters:
        others = {other: point[other] for other in atlas.parameters if other != name}
        line = stability_along(atlas.slice(others), system)
        value = float(point[name])
        below = [c for c in line.crossings if c.value <= value]
        above = [c for c in line.crossings if c.value > value]
        found.append(
            Nearest(
                name,
                value,
                replace(below[-1], point={**others, name: below[-1].value}) if below else None,
                replace(above[0], point={**others, name: above[0].value}) if above else None,
                line.undecided,
            )
        )
    return tuple(found)


def _extreme(atlas: Atlas, system: System, speeds: Range, sought: tuple[str, float], direct: Direct | None) -> Answer:
    """Up to where, from the last value of ``sought`` (role, side) on that side, all ``speeds`` are stable."""
    role, side = sought
    name, speed = system.roles[role], system.roles["speed"]
    part = narrow(atlas, {speed: speeds}).folded()
    line = stability_over_range(part, system, speed)
    value, limit, certain = _from_safe_end(line, part, side)
    answer = Answer(name, value, limit.error if limit else 0.0, limit, line.intervals, line.undecided, certain)
    found = _checked(answer, part, speed, side, direct)
    return replace(found, check=_of_kind(found.check, Criteria.of(part, system)))


def _from_safe_end(line: Line, part: Atlas, side: float) -> tuple[float | None, Crossing | None, bool]:
    """Up to where, and to which crossing, it is stable from the end on that ``side`` on, and whether that is certain."""
    if not line.intervals:
        return None, None, False
    end = line.intervals[-1] if side > 0 else line.intervals[0]
    v = part.parameters.index(line.parameter)
    reached = end.upper == part.upper[v] if side > 0 else end.lower == part.lower[v]
    if not end.stable:
        return None, None, bool(reached)
    value, limit = (end.lower, end.lower_end) if side > 0 else (end.upper, end.upper_end)
    return value, limit, not any(max(side * a, side * b) >= side * value for a, b in _apart(line, limit))


def _apart(line: Line, limit: Crossing | None) -> list[Range]:
    """The undecided ranges that are not merely the surroundings of the answer itself."""
    reach = _BOUNDS * limit.error if limit else 0.0
    return [
        r for r in line.undecided if limit is None or not limit.value - reach <= r[0] <= r[1] <= limit.value + reach
    ]


def _checked(answer: Answer, part: Atlas, speed: str, safe: float, direct: Direct | None) -> Answer:
    """``answer`` with direct solves over the range of speeds on its safe side, and at the limit beyond it."""
    if direct is None or answer.value is None:
        return answer
    h = part.parameters.index(speed)
    v = 1 - h
    span = part.upper[v] - part.lower[v]
    step = max(_BOUNDS * answer.error, _PART * span)
    speeds = np.linspace(part.lower[h], part.upper[h], _SAMPLES)
    inner = float(np.clip(answer.value + safe * step, part.lower[v], part.upper[v]))
    if answer.limit:
        speeds = np.append(speeds, answer.limit.point[speed])
    values = np.append(np.full(len(speeds), inner), answer.value - safe * step)
    speeds = np.append(speeds, speeds[-1])
    count = len(speeds) if answer.limit else len(speeds) - 1
    rho = _solve(direct, part, {speed: speeds[:count], answer.parameter: values[:count]})
    beyond = float(rho[-1]) if answer.limit else np.nan
    inside = float(np.max(rho[: len(speeds) - 1]))
    return replace(answer, check=Check(inside, beyond, count))


def _checked_window(window: Window, part: Atlas, speed: str, line: Line, direct: Direct | None) -> Window:
    if direct is None:
        return window
    span = part.upper[0] - part.lower[0]
    outer = []
    for crossing, side in ((window.interval.lower_end, -1.0), (window.interval.upper_end, 1.0)):
        if crossing:
            value = crossing.value + side * max(_BOUNDS * crossing.error, _PART * span)
            # Not where the step leads across a narrow tongue.
            outer += [value] if any(i.lower < value < i.upper and not i.stable for i in line.intervals) else []
    # The crossings are part of the window if there is no margin: step inside by as much.
    step = _PART * span
    inner = np.linspace(window.safe[0] + step, window.safe[1] - step, _SAMPLES)
    rho = _solve(direct, part, {speed: np.append(inner, outer)})
    beyond = float(np.min(rho[_SAMPLES:])) if outer else np.nan
    return replace(window, check=Check(float(np.max(rho[:_SAMPLES])), beyond, len(rho)))


def _of_kind(check: Check | None, criteria: Criteria) -> Check | None:
    return check and replace(check, conservative=criteria.conservative)


def _solve(direct: Direct, part: Atlas, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    size = len(next(iter(columns.values())))
    fixed = {name: np.full(size, value) for name, value in part.fixed.items()}
    return np.asarray(direct({**fixed, **columns}), float)
