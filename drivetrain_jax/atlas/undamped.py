"""Tongues without damping: their tips are the resonances themselves, where they have no width.

With Phi = [[A, B], [C, D]] the two edges of a tongue of multiplier -1 are a zero of det A and one of det D, of +1 those of
det B and det C; both edges pass through the resonance at the foot. A tongue is confirmed where its edges have separated
by more than their errors. A pair collides where the discriminant is negative beyond its error on the ridge.
"""

from __future__ import annotations

import numpy as np

from drivetrain_jax.atlas.criteria import MINUS, PAIR, PLUS, Criteria
from drivetrain_jax.atlas.patches import Patches, patches_of
from drivetrain_jax.systems import Resonances

_STEPS = 60
_NEWTON = 4
# Numbers of the two criteria that bound the tongue of a multiplier.
_EDGES = {MINUS: (0, 1), PLUS: (2, 3)}
_PAIR = 4


def undamped_tips(criteria: Criteria, horizontal: int, resonances: Resonances) -> list[tuple]:
    """(name, multiplier, parameters) of every resonance from which a tongue of resolved width grows.

    The resonances are at the angle 0; an atlas that does not start there has none.
    """
    atlas, h, v = criteria.atlas, horizontal, 1 - horizontal
    if atlas.parameters[v] != criteria.system.roles.get("angle", atlas.parameters[v]) or atlas.lower[v] > 0:
        return []
    lower, upper = atlas.lower[h], atlas.upper[h]
    values = np.asarray(resonances.values({**dict.fromkeys(atlas.parameters, np.nan), **atlas.fixed}))
    patches = patches_of(criteria)
    found = []
    for label, kind, speed in zip(resonances.labels, resonances.multipliers, values, strict=True):
        if not lower <= speed <= upper:
            continue
        point = atlas.lower.copy()
        point[h] = speed
        start = atlas.to_coordinates(point)
        end = float(atlas.to_coordinates(atlas.upper)[v])
        if kind == PAIR:
            grows = _collides(patches[_PAIR], start, end, h)
        else:
            grows = _separates([patches[k] for k in _EDGES[kind]], start, end, h)
        if grows:
            found.append((label, kind, point))
    return found


def _ascend(start: np.ndarray, end: float, v: int) -> np.ndarray:
    """Points above the foot, ``(steps, 2)``, with the coordinate v rising quadratically."""
    fraction = (np.arange(1, _STEPS + 1) / _STEPS) ** 2
    x = np.repeat(start[None], _STEPS, axis=0)
    x[:, v] += (end - start[v]) * fraction
    return x


def _separates(edges: list[Patches], start: np.ndarray, end: float, h: int) -> bool:
    """True if the zeros of the two functions along h, followed from ``start``, separate by more than their errors."""
    positions = np.full(2, start[h])
    slopes = [edge.derivative(h) for edge in edges]
    for x in _ascend(start, end, 1 - h):
        errors = np.empty(2)
        for k, (edge, slope) in enumerate(zip(edges, slopes, strict=True)):
            for _ in range(_NEWTON):
                x[h] = positions[k]
                place = edge.locate(x[None])
                rate = slope.at(*place)[0]
                positions[k] -= edge.at(*place)[0] / rate
            errors[k] = edge.error[place[0][0]] / abs(rate)
        if not np.isfinite(positions).all():
            return False
        if abs(positions[0] - positions[1]) > errors.sum():
            return True
    return False


def _collides(discriminant: Patches, start: np.ndarray, end: float, h: int) -> bool:
    """True if the discriminant on the ridge above ``start`` becomes negative by more than its error."""
    slope = discriminant.derivative(h)
    curvature = slope.derivative(h)
    position = start[h]
    for x in _ascend(start, end, 1 - h):
        for _ in range(_NEWTON):
            x[h] = position
            place = discriminant.locate(x[None])
            position = position - slope.at(*place)[0] / curvature.at(*place)[0]
        value = discriminant.at(*place)[0]
        if not (np.isfinite(position) and curvature.at(*place)[0] > 0):
            return False
        if value < -discriminant.error[place[0][0]]:
            return True
    return False
