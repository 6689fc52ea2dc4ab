"""Tips of tongues followed as a third parameter of the atlas (mu, alpha, zeta) changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.criteria import Criteria, parameters_at
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.tips import Tip, find_tips, polish
from drivetrain_jax.systems import System

# Newton's steps on the boundary function.
_NEWTON = 8
# Into how many pieces a step is divided, one after the other, for the tips that it loses.
_PIECES = (1, 4, 16)
# The stencil's steps along the speed and along the other parameter, and the largest shift of a polish, of the domain.
_ACROSS, _ALONG = 2e-4, 1e-3
_LARGEST_SHIFT = 1e-3
# Weights of the first and the second derivative, of order 6.
_FIRST = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60
_SECOND = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / 180


@dataclass(frozen=True)
class Path:
    """The way of one tip: ``points`` maps the two parameters to arrays, one entry for each of ``values`` of ``parameter``.

    NaN from where the tip has left the atlas or could not be followed.
    """

    tip: Tip
    parameter: str
    values: np.ndarray
    points: Mapping[str, np.ndarray]


def follow_tips(atlas: Atlas, system: System, parameter: str, values: Sequence[float]) -> tuple[Path, ...]:
    """All tips at the first of ``values`` of ``parameter``, followed through the others in the order given.

    ``atlas`` has ``parameter`` and two more, one of them the axis of the system's resonances. A step on which a tip is lost
    is divided; one that leaves the atlas ends there.

    Raises ``KeyError`` if ``atlas`` lacks ``parameter``, ``ValueError`` for a value outside its domain, for no values and
    for other parameters beside it, :class:`~drivetrain_jax.InputError` for an atlas without panels and a system without
    boundary functions.
    """
    values = np.asarray(values, float)
    if not values.size:
        raise ValueError("values = []: allowed is one value or more")
    first = atlas.slice({parameter: values[0]}).folded()
    tips = find_tips(first, system).tips
    names = first.parameters
    h = names.index(system.resonances.axis)
    track = np.full((len(values), len(tips), 2), np.nan)
    track[0] = [[tip.point[name] for name in names] for tip in tips]
    track[0] = first.to_coordinates(track[0])
    kinds = [tip.multiplier for tip in tips]
    for k in range(1, len(values)):
        for pieces in _PIECES:
            lost = np.isnan(track[k]).any(axis=1) & np.isfinite(track[k - 1]).all(axis=1)
            if lost.any():
                chosen = [kind for kind, mine in zip(kinds, lost, strict=True) if mine]
                between = np.linspace(values[k - 1], values[k], pieces + 1)
                track[k, lost] = _advance(atlas, system, (parameter, between), chosen, track[k - 1, lost], h)
    points = parameters_at(first, track)
    return tuple(
        Path(tip, parameter, values, {name: points[:, i, j] for j, name in enumerate(names)})
        for i, tip in enumerate(tips)
    )


def _advance(atlas: Atlas, system: System, way: tuple, kinds: list[str], start: np.ndarray, h: int) -> np.ndarray:
    """Tips at the last of the values of a parameter, ``way`` = (name, values), from those at the first."""
    parameter, values = way
    before, x = start, start
    for value in values[1:]:
        criteria = Criteria.of(atlas.slice({parameter: value}).folded(), system)
        before, x = x, _step(criteria, kinds, 2 * x - before, h)
    return x


def _step(criteria: Criteria, kinds: list[str], guess: np.ndarray, h: int) -> np.ndarray:
    """Tips near ``guess`` ``(M, 2)``: Newton's method on the boundary functions, then on the multipliers."""
    ends = criteria.atlas.to_coordinates(np.stack([criteria.atlas.lower, criteria.atlas.upper]))
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    size = upper - lower
    numbers = np.array([criteria.multipliers.index(kind) for kind in kinds], int)
    x = guess.copy()
    # The stencil must not leave the atlas.
    rim = np.where(np.arange(2) == h, 3 * _ACROSS, _ALONG) * size
    for _ in range(_NEWTON):
        x = x - _newton(criteria, numbers, np.clip(x, lower + rim, upper - rim), h, size)
    x[((x < lower) | (x > upper)).any(axis=1)] = np.nan
    result = np.full(x.shape, np.nan)
    for kind in set(kinds):
        mine = np.array([k == kind for k in kinds]) & np.isfinite(x).all(axis=1)
        polished, rates = polish(criteria, x[mine], kind, h)
        near = (np.abs(polished - x[mine]) <= _LARGEST_SHIFT * size).all(axis=1) & (np.abs(rates.rate) < 1e-9)
        result[mine] = np.where(near[:, None], polished, np.nan)
    return result


def _newton(criteria: Criteria, numbers: np.ndarray, x: np.ndarray, h: int, size: np.ndarray) -> np.ndarray:
    """The step for f = f_h = 0 with derivatives by differences."""
    v, dh, dv = 1 - h, _ACROSS * size[h], _ALONG * size[1 - h]
    shifts = np.arange(-3, 4)
    points = np.repeat(x[:, None, None], 3, axis=1).repeat(len(shifts), axis=2)
    points[..., h] += dh * shifts
    points[..., v] += dv * np.arange(-1, 2)[:, None]
    values = criteria.values(points.reshape(-1, 2)).reshape(-1, *points.shape[:3])[numbers, np.arange(len(x))]
    f, below, above = values[:, 1, 3], values[:, 0], values[:, 2]
    f_h, f_hh = values[:, 1] @ _FIRST / dh, values[:, 1] @ _SECOND / dh**2
    f_v, f_hv = (above[:, 3] - below[:, 3]) / (2 * dv), (above - below) @ _FIRST / (2 * dv * dh)
    step = np.empty(x.shape)
    with np.errstate(all="ignore"):
        # The value on the ridge and its slope: far from the ridge a plain step of Newton's method overshoots.
        step[:, v] = (f - f_h**2 / (2 * f_hh)) / (f_v - f_h * f_hv / f_hh)
        step[:, h] = (f_h - f_hv * step[:, v]) / f_hh
    return step
