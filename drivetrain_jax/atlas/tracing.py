"""Zero curves of a function of two coordinates by pseudo-arclength continuation, many curves at a time.

Predictor: a step along the tangent; corrector: Newton's method along the gradient. All lengths are relative to the domain.
The tangent is the gradient turned by a right angle, so it keeps its sense along a curve and reverses on the other edge of a
narrow tongue. A step that lands there turns by 180 degrees and is rejected.
"""

from __future__ import annotations

import numpy as np

from drivetrain_jax.atlas.patches import Patches

# Longest, shortest and first step, largest turn and correction of a step, growth of the steps. Turn and correction decide if
# a step is accepted. Shortest and first step and growth affect only the number of steps.
_LONGEST, _SHORTEST, _FIRST = 0.015, 1e-7, 1e-5
_TURN, _CORRECTION, _GROWTH = 0.25, 0.15, 1.6
_NEWTON, _MAX_STEPS = 3, 800
# Largest last Newton step of a point on the curve; between the edges of a narrow tongue Newton's method converges slowly.
_SETTLED = 1e-9
# Distances from a tip in the other coordinate at which its flanks are entered: far enough to continue, and near enough for
# a chord to the tip. A factor of ten either way changes nothing.
_APPROACH = 1e-4 * np.array([1 / 64, 1 / 16, 1 / 4, 1.0])


class Field:
    """A function with its gradient over a rectangle, in lengths relative to the rectangle."""

    def __init__(self, patches: Patches):
        self.patches = patches
        self.lower, self.upper = patches.lower.min(axis=0), patches.upper.max(axis=0)
        self.slopes = [patches.derivative(axis) for axis in range(2)]

    def bend(self, axis: int) -> Patches:
        """The second derivative along a coordinate."""
        return self.slopes[axis].derivative(axis)

    def to_unit(self, x: np.ndarray) -> np.ndarray:
        """Position in the unit square of points in coordinates."""
        return (x - self.lower) / (self.upper - self.lower)

    def to_coordinates(self, y: np.ndarray) -> np.ndarray:
        """Coordinates of points of the unit square."""
        return self.lower + y * (self.upper - self.lower)

    def __call__(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values ``(N,)`` and gradients ``(N, 2)``; NaN outside the patches."""
        place = self.patches.locate(self.to_coordinates(y))
        gradient = np.stack([slope.at(*place) for slope in self.slopes], axis=-1) * (self.upper - self.lower)
        return self.patches.at(*place), gradient


def trace(field: Field, seeds: np.ndarray) -> list[np.ndarray]:
    """Points ``(n, 2)`` of the zero curve through each of ``seeds`` ``(M, 2)``, in coordinates, to the rim or all around."""
    start = field.to_unit(np.asarray(seeds, float).reshape(-1, 2))
    both, sense = np.concatenate([start, start]), np.repeat([1.0, -1.0], len(start))
    paths, returned = _follow(field, both, sense)
    curves = []
    for i in range(len(start)):
        ahead, behind = paths[i], paths[i + len(start)]
        points = ahead if returned[i] else np.concatenate([behind[::-1], ahead[1:]])
        curves.append(field.to_coordinates(points))
    return curves


def trace_tips(field: Field, tips: np.ndarray, horizontal: int) -> list[np.ndarray]:
    """Points of the zero curves through ``tips`` ``(M, 2)``, where the derivative along ``horizontal`` vanishes.

    A tip may be so sharp (radius 1e-7 of the domain) that no step leads around it. The flanks are therefore entered a
    little away from it, where f f_hh < 0, by Newton's method along ``horizontal``, and followed from there.
    """
    top = field.to_unit(np.asarray(tips, float).reshape(-1, 2))
    flanks = np.stack([_flank(field, top, horizontal, side) for side in (-1.0, 1.0)])
    start = flanks[:, :, -1].reshape(-1, 2)
    _, gradient = field(start)
    # Away from the tip: the tangent in the direction from the tip to the flank.
    away = start - np.concatenate([top, top])
    sense = np.sign(-gradient[:, 1] * away[:, 0] + gradient[:, 0] * away[:, 1])
    paths, _ = _follow(field, start, sense)
    curves = []
    for i, point in enumerate(top):
        left, right = (np.concatenate([flanks[k, i], paths[i + k * len(top)][1:]]) for k in range(2))
        points = np.concatenate([left[::-1], point[None], right])
        points = points[np.isfinite(points).all(axis=1)]
        curves.append(field.to_coordinates(points))
    return curves


def _flank(field: Field, top: np.ndarray, h: int, side: float) -> np.ndarray:
    """Points on one flank of each tip, ``(M, k, 2)``, at the distances ``_APPROACH`` in the coordinate other than ``h``."""
    v, bend = 1 - h, field.bend(h)

    def curvature(y: np.ndarray) -> np.ndarray:
        return bend.at(*field.patches.locate(field.to_coordinates(y))) * (field.upper - field.lower)[h] ** 2

    inwards = -np.sign(field(top)[1][:, v] * curvature(top))
    points = np.empty((len(top), len(_APPROACH), 2))
    y = top.copy()
    for k, distance in enumerate(_APPROACH):
        y[:, v] = top[:, v] + inwards * distance
        with np.errstate(all="ignore"):
            # A slanted ridge shifts by more than the width of its tongue: start from the ridge there, not from the tip.
            for _ in range(_NEWTON):
                y[:, h] -= field(y)[1][:, h] / curvature(y)
            edge = y.copy()
            edge[:, h] += side * np.sqrt(-2 * field(y)[0] / curvature(y))
            for _ in range(_NEWTON):
                value, gradient = field(edge)
                edge[:, h] -= value / gradient[:, h]
        points[:, k] = edge
    return points


def _follow(field: Field, start: np.ndarray, sense: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Paths from ``start`` along the tangent of ``sense``, and flags of those that returned."""
    y, _, tangent = _correct(field, start, sense)
    step = np.full(len(y), _FIRST)
    first, length = y.copy(), np.zeros(len(y))
    paths = [[point] for point in first]
    returned = np.zeros(len(y), bool)
    alive = np.isfinite(y).all(axis=1) & np.isfinite(tangent).all(axis=1)
    for _ in range(_MAX_STEPS):
        mine = np.flatnonzero(alive)
        if not mine.size:
            break
        ahead = y[mine] + step[mine, None] * tangent[mine]
        new, moved, turned = _correct(field, ahead, sense[mine])
        # Outside there is no curve to correct to.
        gone = _outside(ahead) | _outside(new)
        ends = np.where(_outside(ahead)[:, None], ahead, new)[gone]
        new[gone], moved[gone], turned[gone] = _meet_rim(field, y[mine[gone]], ends, sense[mine[gone]])
        cosine = (turned * tangent[mine]).sum(axis=1)
        good = (moved <= _CORRECTION * step[mine]) & (cosine >= np.cos(_TURN))
        gone &= good
        home = good & ~gone & _passes(first[mine], y[mine], new, length[mine])
        for i, point, back in zip(mine[good], new[good], home[good], strict=True):
            paths[i].append(first[i] if back else point)
        returned[mine[home]] = True
        length[mine[good]] += step[mine[good]]
        y[mine[good]], tangent[mine[good]] = new[good], turned[good]
        easy = good & (cosine > np.cos(_TURN / 3))
        step[mine[easy]] = np.minimum(step[mine[easy]] * _GROWTH, _LONGEST)
        step[mine[~good]] /= 4
        alive[mine] = ~gone & ~home & (step[mine] > _SHORTEST)  # pyright: ignore[reportIndexIssue]
    return [np.stack(path) for path in paths], returned


def _correct(field: Field, y: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the curve near ``y``, their shifts, and the unit tangents there."""
    new = y.copy()
    for _ in range(_NEWTON):
        value, gradient = field(new)
        with np.errstate(all="ignore"):
            last = (value / (gradient**2).sum(axis=1))[:, None] * gradient
        new = new - last
    tangent = _tangent(field(new)[1], sense)
    moved = np.linalg.norm(new - y, axis=1)
    settled = np.isfinite(moved) & (np.linalg.norm(last, axis=1) <= _SETTLED)
    return new, np.where(settled, moved, np.inf), tangent


def _tangent(gradient: np.ndarray, sense: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        normal = gradient / np.linalg.norm(gradient, axis=1)[:, None]
    return np.stack([-normal[:, 1], normal[:, 0]], axis=-1) * sense[:, None]


def _outside(y: np.ndarray) -> np.ndarray:
    return ((y < 0) | (y > 1)).any(axis=1)  # pyright: ignore[reportReturnType]


def _meet_rim(
    field: Field, a: np.ndarray, b: np.ndarray, sense: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The point where the curve meets the rim between ``a`` inside and ``b`` outside, as from :func:`_correct`."""
    new = np.array([_to_rim(field, *ends) for ends in zip(a, b, strict=True)]).reshape(-1, 2)
    value, gradient = field(new)
    way, step = new - a, b - a
    with np.errstate(all="ignore"):
        beside = np.abs(way[:, 0] * step[:, 1] - way[:, 1] * step[:, 0]) / np.linalg.norm(step, axis=1)
        settled = np.abs(value) <= _SETTLED * np.linalg.norm(gradient, axis=1)
    return new, np.where(settled, beside, np.inf), _tangent(gradient, sense)


def _passes(first: np.ndarray, a: np.ndarray, b: np.ndarray, length: np.ndarray) -> np.ndarray:
    """True if the step from ``a`` to ``b`` passes the first point again."""
    step = b - a
    size = np.linalg.norm(step, axis=1)
    # A path that starts on the rim and leads outwards ends at its start.
    with np.errstate(invalid="ignore"):
        along = ((first - a) * step).sum(axis=1) / size
        across = np.linalg.norm(first - a - (along / size)[:, None] * step, axis=1)
    return (length > 4 * size) & (along >= 0) & (along <= size) & (across < 0.1 * size)


def _to_rim(field: Field, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The point of the curve on the rim between ``a`` inside and ``b`` outside."""
    with np.errstate(all="ignore"):
        fractions = np.where(b < 0, a / (a - b), np.where(b > 1, (1 - a) / (b - a), np.inf))
    axis = int(np.argmin(fractions))
    # Along the rim both points may lie outside by rounding, and the line through them meets it far away.
    y = a + np.clip(fractions[axis], 0.0, 1.0) * (b - a)
    y[axis] = float(b[axis] > 1)
    other = 1 - axis
    for _ in range(_NEWTON):
        value, gradient = field(y[None])
        step = value[0] / gradient[0, other] if gradient[0, other] else np.nan
        if not abs(step) < _LONGEST:
            break
        y[other] -= step
    return np.clip(y, 0.0, 1.0)
