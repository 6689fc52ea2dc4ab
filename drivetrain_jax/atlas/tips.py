"""Tips of the tongues of instability in a rectangle: all tips with names and error bounds, and the undecided boxes.

A tip is a point of the stability boundary where the boundary function and its derivative along the speed (the axis of the
system's predicted resonances) vanish. Tips are found by exclusion (:mod:`~drivetrain_jax.atlas.exclusion`) and polished on
the whole surrogate with the multiplier itself (ln|sigma| = 0, d ln|sigma|/d speed = 0). The name is the resonance at the
foot of the ridge. Along a parameter that moves the resonances a tongue has no foot; its name is the resonance at the tip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivetrain_jax._errors import counted
from drivetrain_jax.atlas.criteria import MINUS, PAIR, PLUS, Criteria, Growth, growth, limiting, parameters_at
from drivetrain_jax.atlas.exclusion import Search, critical_points
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.patches import Patches, patches_of, ridge_roots
from drivetrain_jax.systems import Resonances, System

# Tongues without damping: their tips are the resonances themselves, where they have no width.
#
# With Phi = [[A, B], [C, D]] the two edges of a tongue of multiplier -1 are a zero of det A and one of det D, of +1 those of
# det B and det C; both edges pass through the resonance at the foot. A tongue is confirmed where its edges have separated
# by more than their errors. A pair collides where the discriminant is negative beyond its error on the ridge.


_STEPS = 60
_NEWTON = 4
# Numbers of the criteria that bound the tongue of a multiplier: two edges, or the discriminant.
_EDGES = {MINUS: (0, 1), PLUS: (2, 3), PAIR: (4,)}


def undamped_tips(criteria: Criteria, horizontal: int, resonances: Resonances) -> list[Tip]:
    """The tips of all tongues of resolved width: the resonances from which they grow.

    The resonances are at the angle 0; an atlas that does not start there has none.
    """
    atlas, h, v = criteria.atlas, horizontal, 1 - horizontal
    if atlas.parameters[v] != criteria.system.roles.get("angle", atlas.parameters[v]) or atlas.lower[v] > 0:
        return []
    values = np.asarray(resonances.values({**dict.fromkeys(atlas.parameters, np.nan), **atlas.fixed}))
    patches, end = patches_of(criteria), float(atlas.to_coordinates(atlas.upper)[v])
    tips, exactly = [], dict.fromkeys(atlas.parameters, 0.0)
    for label, kind, speed in zip(resonances.labels, resonances.multipliers, values, strict=True):
        point = atlas.lower.copy()
        point[h] = speed
        inside = atlas.lower[h] <= speed <= atlas.upper[h]
        if inside and _grows([patches[k] for k in _EDGES[kind]], atlas.to_coordinates(point), end, h):
            tips.append(Tip(label, kind, dict(zip(atlas.parameters, map(float, point), strict=True)), exactly, True))
    return tips


def _grows(functions: Sequence[Patches], start: np.ndarray, end: float, h: int) -> bool:
    """True if the tongue above ``start`` opens by more than the errors.

    The zeros of two functions along h, its edges, separate; or a single function becomes negative on its ridge.
    """
    edges = len(functions) > 1
    followed = functions if edges else [functions[0].derivative(h)]
    slopes = [f.derivative(h) for f in followed]
    x = np.tile(start, (len(functions), 1))
    # The other coordinate rises quadratically.
    for fraction in (np.arange(1, _STEPS + 1) / _STEPS) ** 2:
        x[:, 1 - h] = start[1 - h] + (end - start[1 - h]) * fraction
        reach = 0.0
        for k, (function, slope) in enumerate(zip(followed, slopes, strict=True)):
            for _ in range(_NEWTON):
                place = function.locate(x[k : k + 1])
                rate = slope.at(*place)[0]
                x[k, h] -= function.at(*place)[0] / rate
            reach += functions[k].error[place[0][0]] / abs(rate)
        if not np.isfinite(x).all() or not (edges or rate > 0):
            return False
        place = functions[0].locate(x[:1])
        if np.ptp(x[:, h]) > reach if edges else functions[0].at(*place)[0] < -functions[0].error[place[0][0]]:
            return True
    return False


_POLISH = 8
# Largest relative distance of the foot of a ridge from its prediction, and least distance of the next prediction relative
# to the nearest one.
_NEAR, _CLEAR = 0.02, 3.0
_HIGHEST_ORDER = 60
# Number of undecided boxes from which tips are searched, largest error of their tips relative to the rectangle, and
# distance below which two tips are the same.
_MAX_STARTS, _LARGEST_ERROR, _SAME = 200, 0.1, 1e-6

Box = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Tip:
    """``point`` maps the two parameters to their values at the tip, ``error`` to bounds of their errors.

    ``name`` is the resonance of the tongue, empty if its ridge was lost or no resonance is clearly the nearest.
    ``multiplier`` is ``+1``, ``-1`` or ``pair``. ``opens`` is true where a tongue opens
    with the other parameter, false where one closes or two meet. ``proved`` is false for a tip in an undecided box: the
    surrogate has one there, but within its error bound there may be none, or several.
    """

    name: str
    multiplier: str
    point: Mapping[str, float]
    error: Mapping[str, float]
    opens: bool
    proved: bool = True


@dataclass(frozen=True)
class Tips:
    """All tips, in rising order of the other parameter; ``undecided`` boxes of parameters that may contain more.

    At zero damping tongues have no width at their tips: the tips are then predicted by theory. ``searches`` can be
    reused by :func:`~drivetrain_jax.atlas.boundaries.boundaries` of the same atlas.
    """

    tips: tuple[Tip, ...]
    undecided: tuple[Box, ...]
    searches: tuple[Search, ...] = ()

    @property
    def proof(self) -> str:
        """The number of certain tips, and of boxes that may hold more, in one sentence."""
        sure = sum(tip.proved for tip in self.tips)
        more = f", and {len(self.tips) - sure} more may be tips" if sure < len(self.tips) else ""
        hidden = (
            f"; narrow unstable ranges may lie in {counted(len(self.undecided), 'box', 'boxes')}"
            if self.undecided
            else ""
        )
        certain = f"{counted(sure, 'tip is', 'tips are')} certain within the bounds of the atlas"
        return f"{certain}, which are estimates{more}{hidden}."


def find_tips(atlas: Atlas, system: type[System], *, opening: bool = True) -> Tips:
    """The tips of all tongues within ``atlas`` (two parameters, one of them the axis of the system's resonances).

    With ``opening=False`` also the points where tongues close or meet. Angles are returned without signs. Raises
    ``ValueError`` for other atlases.
    """
    atlas = atlas.folded()
    horizontal = _axis_of_resonances(atlas, system)
    criteria = Criteria.of(atlas, system)
    if criteria.conservative:
        undamped = undamped_tips(criteria, horizontal, _predictions(atlas, system))
        return Tips(_sorted(undamped, atlas, horizontal), ())
    patches = patches_of(criteria)
    searches = tuple(critical_points(patches, k, horizontal) for k in range(len(patches)))
    tips: list[Tip] = []
    for kind, patch, search in zip(criteria.multipliers, patches, searches, strict=True):
        x, rates = polish(criteria, search.points, kind, horizontal)
        opens = (search.curvature * search.slope < 0) == (rises(criteria, 1 - horizontal) > 0)
        certain = _describe(criteria, kind, horizontal, (x, rates, _named_at(criteria, patch, x, horizontal)), opens)
        x, rates = suspected(criteria, kind, horizontal, search.undecided, x)
        opens = rates.gradient[:, 1 - horizontal] * rises(criteria, 1 - horizontal) > 0
        likely = _describe(criteria, kind, horizontal, (x, rates, _named_at(criteria, patch, x, horizontal)), opens)
        tips += [*certain, *(replace(tip, proved=False) for tip in likely)]
    undecided = tuple(_box(atlas, box) for search in searches for box in search.undecided)
    undecided += tuple(_box(atlas, np.stack([gap.lower, gap.upper])) for gap in atlas.gaps)
    chosen = tuple(tip for tip in tips if tip.opens or not opening)
    return Tips(_sorted(chosen, atlas, horizontal), undecided, searches)


def polish(criteria: Criteria, x: np.ndarray, kind: str, horizontal: int) -> tuple[np.ndarray, Growth]:
    """Newton's method for ln|sigma| = 0 and its derivative along ``horizontal``, from ``x`` ``(N, 2)``."""
    kinds = [kind] * len(x)
    for _ in range(_POLISH if len(x) else 0):
        rates = growth(criteria, x, kinds, second=True)
        jacobian = np.stack([rates.gradient, rates.hessian[:, horizontal]], axis=1)
        residual = np.stack([rates.rate, rates.gradient[:, horizontal]], axis=-1)
        with np.errstate(all="ignore"):
            x = x - _solve(jacobian, residual)
    return x, growth(criteria, x, kinds, second=True)


def suspected(criteria: Criteria, kind: str, h: int, boxes: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, Growth]:
    """Tips that Newton's method finds from undecided ``boxes``, without the ``known`` ones.

    They are inside the rectangle and have error bounds below ``_LARGEST_ERROR``.
    """
    low, high = criteria.atlas.corners
    starts = boxes[np.linspace(0, len(boxes) - 1, min(len(boxes), _MAX_STARTS)).astype(int)].mean(axis=1)
    x, rates = polish(criteria, starts.reshape(-1, 2), kind, h)
    with np.errstate(invalid="ignore"):
        errors = _errors(rates, h)
        good = (np.abs(rates.rate) <= rates.error) & (rates.hessian[:, h, h] < 0)
        good &= ((x >= low) & (x <= high) & (errors < _LARGEST_ERROR * (high - low))).all(axis=1)
    kept: list[int] = []
    for i in np.flatnonzero(good):
        others = np.concatenate([known, x[kept]])
        if not (np.abs(others - x[i]) <= errors[i] + _SAME * (high - low)).all(axis=1).any():
            kept.append(int(i))
    return x[kept], growth(criteria, x[kept], [kind] * len(kept), second=True)


def _solve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    first = a[:, 1, 1] * b[:, 0] - a[:, 0, 1] * b[:, 1]
    second = a[:, 0, 0] * b[:, 1] - a[:, 1, 0] * b[:, 0]
    return np.stack([first, second], axis=-1) / determinant[:, None]


def _describe(criteria: Criteria, kind: str, h: int, points: tuple, opens: np.ndarray) -> list[Tip]:
    """The tips among the zeros of one function: those where no multiplier grows."""
    x, rates, compared = points
    atlas, system = criteria.atlas, criteria.system
    bounding = limiting(criteria, x, rates)
    errors = _errors(rates, h)
    tips = []
    for i in range(len(x)):
        if not bounding[i]:
            continue
        point, slope = parameters_at(atlas, x[i]), [c.slope for c in atlas.coordinates]
        scale = np.array([abs(float(slope[k](point[k]))) for k in range(2)])
        tips.append(
            Tip(
                _name(atlas, system, kind, compared[i]),
                kind,
                dict(zip(atlas.parameters, map(float, point), strict=True)),
                dict(zip(atlas.parameters, map(float, errors[i] / scale), strict=True)),
                bool(opens[i]),
            )
        )
    return tips


def _errors(rates: Growth, h: int) -> np.ndarray:
    """Bounds of the errors of the coordinates, ``(N, 2)``.

    Along v the bound is the error of the rate over its slope; along h it is the shift of the maximum by that error.
    """
    v = 1 - h
    errors = np.empty(rates.gradient.shape)
    with np.errstate(all="ignore"):
        errors[:, v] = rates.error / np.abs(rates.gradient[:, v])
        # An error e of a function over the width w of its peak moves the maximum by e/(w |f''|); w^2 |f''| is about 1.
        errors[:, h] = rates.error / np.sqrt(np.abs(rates.hessian[:, h, h]))
        errors[:, h] += np.abs(rates.hessian[:, h, v] / rates.hessian[:, h, h]) * errors[:, v]
    return errors


def rises(criteria: Criteria, v: int) -> float:
    """1 if the coordinate v rises with its parameter, else -1."""
    first, last = criteria.atlas.ends[:, v]
    return 1.0 if last > first else -1.0


def _axis_of_resonances(atlas: Atlas, system: type[System]) -> int:
    """The coordinate of the axis of the system's resonances; ``ValueError`` for an atlas without it."""
    axis = system.resonances.axis if system.resonances else ""
    if len(atlas.parameters) != 2 or axis not in atlas.parameters:
        names = ", ".join(atlas.parameters)
        raise ValueError(f"parameters = {names}: expected two, one of them {axis or 'the axis of resonances'}")
    return atlas.parameters.index(axis)


def _predictions(atlas: Atlas, system: type[System]) -> Resonances:
    """The system's resonances up to the order that the lower end of the axis needs."""
    basic = system.resonances
    assert basic is not None
    if basic.up_to is None:
        return basic
    # One of the two ends of a parameter that moves the resonances needs the higher order.
    values = [_predicted(basic, atlas, end) for end in (atlas.lower, atlas.upper)]
    lowest = atlas.lower[atlas.parameters.index(basic.axis)]
    # A sum of two frequencies needs up to twice the order of a single one. NaN: nothing is predicted.
    order = math.ceil(np.fmax.reduce(np.ravel(values), initial=0.0) / max(float(lowest), 1e-300))
    return basic.up_to(min(max(order, 1), _HIGHEST_ORDER))


def _predicted(resonances: Resonances, atlas: Atlas, point: np.ndarray) -> np.ndarray:
    return np.asarray(resonances.values({**dict(zip(atlas.parameters, point, strict=True)), **atlas.fixed}))


def _named_at(criteria: Criteria, patch: Patches, x: np.ndarray, h: int) -> np.ndarray:
    """Points ``(N, 2)`` whose speeds are compared with the predictions, for tips ``x``: the feet of their ridges.

    Along a parameter that moves the resonances a tongue has no foot: the tip is where it shrinks to nothing, and its ridge
    may leave the rectangle or bend too fast to be followed. The point is then the tip.
    """
    atlas, v = criteria.atlas, 1 - h
    if atlas.parameters[v] in criteria.system.resonances.parameters:  # pyright: ignore[reportOptionalMemberAccess]
        return x
    bottom = float(atlas.to_coordinates(atlas.lower)[v])
    points = np.full(x.shape, bottom)
    points[:, h] = ridge_roots(patch, x, h, bottom)
    return points


def _name(atlas: Atlas, system: type[System], kind: str, x: np.ndarray) -> str:
    """The resonance of this multiplier that is clearly the nearest to ``x`` in coordinates, or an empty name."""
    resonances = _predictions(atlas, system)
    if not np.isfinite(x).all() or not resonances.multipliers:
        return ""
    point = atlas.to_parameters(x)
    distance = np.abs(_predicted(resonances, atlas, point) / point[atlas.parameters.index(resonances.axis)] - 1)
    distance[[m != kind for m in resonances.multipliers]] = np.inf
    first, second = np.argsort(distance)[:2]
    clear = distance[first] < _NEAR and distance[second] > _CLEAR * distance[first]
    return resonances.labels[first] if clear else ""


def _box(atlas: Atlas, box: np.ndarray) -> Box:
    ends = np.sort(parameters_at(atlas, box), axis=0)
    return {name: (float(ends[0, k]), float(ends[1, k])) for k, name in enumerate(atlas.parameters)}


def _sorted(tips: Sequence[Tip], atlas: Atlas, horizontal: int) -> tuple[Tip, ...]:
    other = atlas.parameters[1 - horizontal]
    return tuple(sorted(tips, key=lambda tip: tip.point[other]))
