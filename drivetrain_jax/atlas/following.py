"""Follow tips of tongues as a third parameter of the atlas (mu, alpha, gamma, zeta) changes.

On every step a tip is predicted from its slope at the start and found by Newton's method. It is accepted if the slopes at
both ends agree with the displacement; otherwise the step is halved. Newton's method alone, started too far away, would
converge to the tip of another tongue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.criteria import Criteria, parameters_at
from drivetrain_jax.atlas.growth import growth, limiting
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.patches import Patches, patches_of
from drivetrain_jax.atlas.tips import Tip, find_tips, polish, rises
from drivetrain_jax.systems import Coordinate, System

# Newton steps on the boundary function and on the multiplier, and the largest number of halvings of a step.
_NEWTON, _POLISH, _HALVINGS = 8, 4, 6
# Step of difference quotients relative to a step.
_PART = 1e-3
# Largest deviation of a step from its slopes, relative to its length and to the domain.
_BEND, _SMALL = 0.2, 1e-3
# Largest shift of a polish relative to the domain, and largest growth rate after it.
_LARGEST_SHIFT, _LARGEST_RATE = 1e-3, 1e-9


@dataclass(frozen=True)
class Path:
    """The path of one tip: ``points`` maps the two parameters to arrays, one entry for each of ``values`` of ``parameter``.

    NaN after the tip has left the atlas, met another one, or been lost. ``limiting`` is false also inside another tongue,
    where the tip bounds no stable region.
    """

    tip: Tip
    parameter: str
    values: np.ndarray
    points: Mapping[str, np.ndarray]
    limiting: np.ndarray


def follow_tips(atlas: Atlas, system: type[System], parameter: str, values: Sequence[float]) -> tuple[Path, ...]:
    """All tips at the first of ``values`` of ``parameter``, followed through the others in the given order.

    ``atlas`` has ``parameter`` and two more, one of them the axis of the system's resonances. A step that loses a tip is
    divided; one that leaves the atlas ends there. At zero damping tongues have no width at their tips, so on a step from or
    to zero damping tips are matched by name.

    Raises ``KeyError`` if ``atlas`` lacks ``parameter``; ``ValueError`` for a value outside its domain, for no values and
    for further parameters; :class:`~drivetrain_jax.InputError` for an atlas without panels and a system without boundary
    functions.
    """
    places = np.asarray(values, float)
    if not places.size:
        raise ValueError("values = []: allowed is one value or more")
    way = _Way(atlas, system, parameter)
    first = way.criteria(places[0]).atlas
    names = first.parameters
    # Tongues widen with the angle. They close with increasing damping, at their tip.
    tips = find_tips(first, system, opening=system.roles.get("angle") in names).tips
    criteria = [way.criteria(value) for value in places]
    track = np.full((len(places), len(tips), 2), np.nan)
    track[0] = _places(first, tips)
    for k in range(1, len(places)):
        if criteria[k - 1].conservative or criteria[k].conservative:
            alive = np.isfinite(track[k - 1]).all(axis=1)
            track[k] = np.where(alive[:, None], _by_name(criteria[k], tips), np.nan)
        else:
            track[k] = way.advance(tips, track[k - 1], (places[k - 1], places[k]))
    bounding = np.stack([_bounding(c, tips, x) for c, x in zip(criteria, track, strict=True)])
    points = parameters_at(first, track)
    return tuple(
        Path(tip, parameter, places, {name: points[:, i, j] for j, name in enumerate(names)}, bounding[:, i])
        for i, tip in enumerate(tips)
    )


@dataclass(frozen=True)
class _Way:
    """Tips along ``parameter`` of ``atlas``, in coordinates ``(M, 2)`` of its two others."""

    atlas: Atlas
    system: type[System]
    parameter: str

    def criteria(self, value: float) -> Criteria:
        """The criteria of the two other parameters at a value."""
        return Criteria.of(self.atlas.slice({self.parameter: float(value)}).folded(), self.system)

    def advance(
        self, tips: Sequence[Tip], start: np.ndarray, ends: tuple[float, float], halvings: int = 0
    ) -> np.ndarray:
        """Positions of ``tips`` at the second of the values ``ends``, from ``start`` at the first; NaN for lost ones."""
        result = np.full(start.shape, np.nan)
        alive = np.flatnonzero(np.isfinite(start).all(axis=1))
        if not alive.size:
            return result
        found, followed = self._step([tips[i] for i in alive], start[alive], ends)  # pyright: ignore[reportArgumentType, reportCallIssue]
        result[alive[followed]] = found[followed]
        lost = alive[~followed]
        if lost.size and halvings < _HALVINGS:
            chosen = [tips[i] for i in lost]
            middle = self._between(ends, 0.5)
            half = self.advance(chosen, start[lost], (ends[0], middle), halvings + 1)
            result[lost] = self.advance(chosen, half, (middle, ends[1]), halvings + 1)
        return result

    def _step(self, tips: list[Tip], x: np.ndarray, ends: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Positions of ``tips`` at the end of one step from ``x``, and flags where the slopes agree."""
        size = np.ptp(self._others(self.atlas.folded().corners), axis=0)
        slope = (self._near(self._between(ends, _PART), tips, x) - x) / _PART
        found = self._near(ends[1], tips, x + slope)
        before = self._near(self._between(ends, 1 - _PART), tips, found - _PART * slope)
        way = (found - x) / size
        bends = [np.abs(way - each / size).max(axis=1) for each in (slope, (found - before) / _PART)]
        return found, np.maximum(*bends) <= _BEND * np.abs(way).max(axis=1) + _SMALL

    def _near(self, value: float, tips: list[Tip], guess: np.ndarray) -> np.ndarray:
        """Tips like ``tips`` near ``guess``: Newton's method on the boundary functions, then on the multipliers. NaN if
        it fails, or converges to a point where a tongue closes instead of opening."""
        result = np.full(guess.shape, np.nan)
        if not np.isfinite(guess).all(axis=1).any():
            return result
        criteria = self.criteria(value)
        h = criteria.atlas.parameters.index(self.system.resonances.axis)  # pyright: ignore[reportOptionalMemberAccess]
        lower, upper = corners = criteria.atlas.corners
        patches = patches_of(criteria)
        for alike in sorted({(tip.multiplier, tip.opens) for tip in tips}):
            kind, opens = alike
            mine = [(tip.multiplier, tip.opens) == alike for tip in tips] & np.isfinite(guess).all(axis=1)  # pyright: ignore[reportOperatorIssue]
            x, mine = _newton(patches[criteria.multipliers.index(kind)], guess[mine], corners, h), np.flatnonzero(mine)
            mine, x = (part[((x >= lower) & (x <= upper)).all(axis=1)] for part in (mine, x))
            polished, rates = polish(criteria, x, kind, h, _POLISH)
            good = (np.abs(polished - x) <= _LARGEST_SHIFT * (upper - lower)).all(axis=1)
            good &= (np.abs(rates.rate) < _LARGEST_RATE) & (rates.hessian[:, h, h] < 0)
            good &= (rates.gradient[:, 1 - h] * rises(criteria, 1 - h) > 0) == opens
            result[mine[good]] = polished[good]
        return result

    def _between(self, ends: tuple[float, float], part: float) -> float:
        """The value at a fraction ``part`` of the step, in the coordinate."""
        coordinate: Coordinate = self.atlas.coordinates[self.atlas.parameters.index(self.parameter)]
        a, b = (float(coordinate.forward(end)) for end in ends)
        value = float(coordinate.inverse(a + part * (b - a)))
        low, high = sorted(map(abs, ends) if coordinate.even else ends)
        return float(np.copysign(np.clip(value, low, high), sum(ends)))

    def _others(self, columns: np.ndarray) -> np.ndarray:
        return np.delete(columns, self.atlas.parameters.index(self.parameter), axis=1)


def _newton(f: Patches, x: np.ndarray, corners: np.ndarray, h: int) -> np.ndarray:
    """Zeros of f and f_h from ``x`` ``(M, 2)``. Outside the domain the function has its values on the rim."""
    v, f_h = 1 - h, f.derivative(h)
    derived = f, f_h, f_h.derivative(h), f.derivative(v), f_h.derivative(v)
    for _ in range(_NEWTON if len(x) else 0):
        x = np.clip(x, *corners)
        place = f.locate(x)
        value, slope, bend, rise, twist = (each.at(*place) for each in derived)
        with np.errstate(all="ignore"):
            # Uses the value on the ridge and its slope; far from the ridge a plain Newton step overshoots.
            step = (value - slope**2 / (2 * bend)) / (rise - slope * twist / bend)
            x = x - np.stack([step, (slope - twist * step) / bend], axis=1)[:, [v, h]]
    return x


def _places(atlas: Atlas, tips: Sequence[Tip]) -> np.ndarray:
    """Tips in coordinates, ``(M, 2)``."""
    points = np.array([[tip.point[name] for name in atlas.parameters] for tip in tips])
    return atlas.to_coordinates(points.reshape(-1, 2))


def _by_name(criteria: Criteria, tips: Sequence[Tip]) -> np.ndarray:
    """The tips of the same names; NaN for unnamed tips and for names that are not unique."""
    others = find_tips(criteria.atlas, criteria.system).tips
    same = [[other for other in others if other.name == tip.name != ""] for tip in tips]
    places = [_places(criteria.atlas, those)[0] if len(those) == 1 else np.full(2, np.nan) for those in same]
    return np.array(places).reshape(-1, 2)


def _bounding(criteria: Criteria, tips: Sequence[Tip], x: np.ndarray) -> np.ndarray:
    """Flags of ``tips`` at ``x`` where no other multiplier grows."""
    alive = np.isfinite(x).all(axis=1)
    if criteria.conservative:
        return alive  # pyright: ignore[reportReturnType]
    return alive & limiting(criteria, x, growth(criteria, x, [tip.multiplier for tip in tips]))
