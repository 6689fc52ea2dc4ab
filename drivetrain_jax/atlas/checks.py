"""Checks of design answers by direct solves, independent of the atlas."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.patches import Patches, patches_of
from drivetrain_jax.atlas.ridges import ridge_roots
from drivetrain_jax.atlas.windows import Crossing, Interval, Line, Range

Direct = Callable[[Mapping[str, np.ndarray]], np.ndarray]

# Distance of a check from the end of a window, in error bounds, and its minimum relative to the range of the parameter. The
# last number is this minimum at the end of an interval, where direct solves must resolve the sign of rho - 1.
_BOUNDS, _PART, _LEAST = 10.0, 1e-6, 1e-9
# Points of a range at which a check solves, and points at which it searches the maximum on the surrogate.
_SAMPLES, DENSE = 101, 801
# Largest distance of direct solves from the unit circle that counts as on it.
_ON_THE_CIRCLE = 1e-6


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
        within = self.inside <= 1 + _ON_THE_CIRCLE if self.conservative else self.inside < 1
        return within and not self.beyond <= 1


@dataclass(frozen=True)
class End:
    """An end ``value`` of a stable interval of length ``length`` on the ``inward`` side (a sign)."""

    value: float
    crossing: Crossing | None
    inward: float
    length: float

    @classmethod
    def of(cls, interval: Interval, inward: float) -> End:
        """The lower or the upper end of ``interval``."""
        return cls(*interval.ends[0 if inward > 0 else 1], inward, interval.upper - interval.lower)

    def step(self, span: float) -> float:
        """Distance of the check from the end: outside the error, over a range of length ``span``."""
        error = self.crossing.error if self.crossing else 0.0
        return max(error, _LEAST * span) if math.isfinite(error) else _PART * span


def check_ends(ends: list[End], line: Line, criteria: Criteria, direct: Direct) -> Check | None:
    """Check all ``ends`` of stable intervals of ``line`` by direct solves just inside and just beyond; None without ends.

    Inside, the solves cover the whole range of the other coordinate. Beyond, they lie on the ridge of the tongue at the
    crossing, or at the crossing itself without a ridge. On both sides one solve is at the maximum of the surrogate.
    """
    part = criteria.atlas
    k = part.parameters.index(line.parameter)
    other, span = part.parameters[1 - k], float(part.upper[k] - part.lower[k])
    within = np.linspace(part.lower[1 - k], part.upper[1 - k], _SAMPLES)
    patches = patches_of(criteria) if any(end.crossing for end in ends) else ()
    points, outer = [], []
    for end in ends:
        step = end.step(span)
        inner, value = end.value + end.inward * min(step, end.length / 2), end.value - end.inward * step
        near, far = (_along_ridge(criteria, patches, k, end.crossing, x, other) for x in (inner, value))
        points += [(x, inner) for x in (*within, *near, _worst(criteria, k, inner))]
        if end.crossing and _unstable(line, value):
            outer += [(x, value) for x in (*far, _worst(criteria, k, value))]
    if not points:
        return None
    columns = np.array(points + outer).T
    rho = _solve(direct, part, {other: columns[0], line.parameter: columns[1]})
    inside, beyond = np.split(rho, [len(points)])
    return _check(inside, beyond.reshape(-1, 2).max(axis=1), criteria, len(rho))


def _along_ridge(
    criteria: Criteria, patches: tuple[Patches, ...], k: int, crossing: Crossing | None, value: float, other: str
) -> tuple[float, ...]:
    """Positions over ``other`` at which the tongue of ``crossing`` is expected, at a ``value`` of the coordinate ``k``.

    A slanted ridge leaves the narrow tongue sideways, so the position of the tip does not apply. None without a crossing.
    """
    if crossing is None:
        return ()
    part, place = criteria.atlas, crossing.point[other]
    low, high = part.lower[1 - k], part.upper[1 - k]
    # At the ends of the range a tongue enters from outside; without damping the functions have no ridges.
    if not low < place < high or criteria.conservative:
        return (place,)
    tip, beside = (np.insert([place], k, v)[None] for v in (crossing.value, value))
    function = patches[criteria.multipliers.index(crossing.multiplier)]
    bottom = part.to_coordinates(beside)[0, k]
    foot = ridge_roots(function, part.to_coordinates(tip), 1 - k, bottom)[0]
    if not np.isfinite(foot):
        return (place,)
    found = part.to_parameters(np.insert([foot], k, bottom)[None])[0, 1 - k]
    return (float(np.clip(found, low, high)),)


def _worst(criteria: Criteria, k: int, value: float) -> float:
    """Position of the surrogate's largest spectral radius over the coordinate other than ``k``, which has ``value``."""
    part = criteria.atlas
    others = np.linspace(part.lower[1 - k], part.upper[1 - k], DENSE)
    rho = criteria.spectral_radius(part.to_coordinates(np.insert(others[:, None], k, value, axis=1)))
    return float(others[np.argmax(np.nan_to_num(rho))])


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
    step = _PART * span
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
