"""Stability boundaries as curves: zeros of the analytic boundary functions, traced and polished on the surrogate.

Seeds are the tips of all tongues (found by exclusion, so that none is missed), and the crossings with the rim of the
rectangle and with a few lines across it. Curves also continue inside unstable regions; ``limiting`` is true where they
bound the stable region.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.criteria import LIMITING, Criteria, parameters_at
from drivetrain_jax.atlas.exclusion import Search, critical_points
from drivetrain_jax.atlas.growth import growth, limiting, monodromy_error
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.patches import patches_of
from drivetrain_jax.atlas.roots import on_line, roots
from drivetrain_jax.atlas.tips import polish
from drivetrain_jax.atlas.tracing import Field, trace, trace_tips
from drivetrain_jax.systems import System

# Number of lines across the rectangle in each direction, for seeds.
_LINES = 8
# Newton steps of the last polish, and their largest relative shift.
_POLISH, _LARGEST_SHIFT = 2, 1e-4


@dataclass(frozen=True)
class Boundary:
    """One curve: ``points`` maps the two parameters to arrays ``(n,)``.

    The ``multiplier`` (``+1``, ``-1`` or ``pair``) crosses the unit circle. ``limiting`` ``(n,)`` is true where no other
    multiplier lies outside.
    """

    multiplier: str
    points: Mapping[str, np.ndarray]
    limiting: np.ndarray

    def segments(self) -> tuple[dict[str, np.ndarray], ...]:
        """The parts that bound the stable region, each as ``points``."""
        marks = np.flatnonzero(np.diff(np.concatenate([[0], self.limiting.astype(int), [0]])))
        return tuple(
            {name: values[a:b] for name, values in self.points.items()}
            for a, b in zip(marks[::2], marks[1::2], strict=True)
            if b - a > 1
        )


def boundaries(atlas: Atlas, system: type[System], searches: Sequence[Search] = ()) -> tuple[Boundary, ...]:
    """All boundary curves within ``atlas``, which has two parameters (``ValueError`` for another number).

    Angles are returned without signs. ``searches``: known searches for the tips of the same atlas.
    """
    atlas = atlas.folded()
    if len(atlas.parameters) != 2:
        raise ValueError(f"parameters = {', '.join(atlas.parameters)}: allowed are two; slice the atlas first")
    criteria = Criteria.of(atlas, system)
    patches = patches_of(criteria)
    found: list[Boundary] = []
    horizontal = _narrow_axis(atlas, system)
    for number, kind in enumerate(criteria.multipliers):
        field = Field(patches[number])
        curves: list[np.ndarray] = []
        if not criteria.conservative:
            search = searches[number] if searches else critical_points(patches, number, horizontal)
            rough = search.points
            fine = polish(criteria, rough, kind, horizontal)[0]
            near = np.abs(field.to_unit(fine) - field.to_unit(rough)).max(axis=1, initial=0.0) < _LARGEST_SHIFT
            curves = _distinct(field, np.where(near[:, None], fine, rough), [], horizontal)
        for seeds in _line_seeds(field):
            curves = _distinct(field, seeds, curves)
        found += [_finish(criteria, field, kind, curve) for curve in curves]
    return tuple(found)


def _narrow_axis(atlas: Atlas, system: type[System]) -> int:
    """The coordinate along which tongues are narrow: the axis of the resonances, else the second one."""
    axis = system.resonances.axis if system.resonances else ""
    return atlas.parameters.index(axis) if axis in atlas.parameters else 1


def _distinct(
    field: Field, seeds: np.ndarray, known: list[np.ndarray], horizontal: int | None = None
) -> list[np.ndarray]:
    """``known`` curves, and those through other ``seeds``, which are tips if ``horizontal`` is given."""
    kept = list(known)
    on_curve = np.zeros(len(seeds), bool)
    for curve in kept:
        on_curve |= _contains(field, curve, seeds)
    new = seeds[~on_curve].reshape(-1, 2)
    curves = trace(field, new) if horizontal is None else trace_tips(field, new, horizontal)
    for seed, curve in zip(new, curves, strict=True):
        if len(curve) > 2 and not any(_contains(field, other, seed[None])[0] for other in kept[len(known) :]):
            kept.append(curve)
    return kept


def _contains(field: Field, curve: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Flags of ``seeds`` ``(M, 2)`` that lie on ``curve``."""
    if not len(seeds):
        return np.zeros(0, bool)
    y, target = field.to_unit(curve), field.to_unit(seeds)
    step = np.diff(y, axis=0)
    size = (step**2).sum(axis=1)
    with np.errstate(all="ignore"):
        t = np.clip(np.nan_to_num(((target[:, None] - y[:-1]) * step).sum(axis=2) / size), 0.0, 1.0)
    distance = np.linalg.norm(y[:-1] + t[..., None] * step - target[:, None], axis=2)
    best = np.argmin(distance, axis=1)
    distance, t = (a[np.arange(len(seeds)), best] for a in (distance, t))
    # The chord of a step that turns by less than a quarter is at most a thirtieth of its length away from the curve. The
    # other edge of a narrow tongue may be as near, but has the opposite gradient.
    _, at_seed = field(target)
    _, at_curve = field(y[best + (t > 0.5)])
    near = distance < 0.04 * np.sqrt(size[best]) + 1e-9
    return near & (((at_seed * at_curve).sum(axis=1) > 0) | (distance < 1e-9))


def _line_seeds(field: Field) -> Iterator[np.ndarray]:
    """Crossings with the four sides of the rim, then with lines across the rectangle."""
    across = np.arange(1, _LINES) / _LINES
    for fractions in ([1.0], [0.0], across):
        for axis in range(2):
            seeds = []
            for value in field.lower[axis] + np.array(fractions) * (field.upper[axis] - field.lower[axis]):
                x = roots(on_line(field.patches, axis, float(value))).x
                seeds.append(np.insert(x[:, None], axis, value, axis=1))
            yield np.clip(np.concatenate(seeds), field.lower, field.upper)


def _finish(criteria: Criteria, field: Field, kind: str, curve: np.ndarray) -> Boundary:
    """Polish the points of a curve with the multiplier itself."""
    # Rounding of Newton's method may move points of the rim outside.
    x = _polish(criteria, field, kind, np.clip(curve, field.lower, field.upper))
    points = dict(zip(criteria.atlas.parameters, parameters_at(criteria.atlas, x).T, strict=True))
    return Boundary(kind, points, _limiting(criteria, x, kind))


def _limiting(criteria: Criteria, x: np.ndarray, kind: str) -> np.ndarray:
    """Flags of the points of a curve that bound the stable region."""
    if not criteria.conservative:
        return limiting(criteria, x, growth(criteria, x, [kind] * len(x)))
    # Where two multipliers coincide without damping, the error of the growth rate is the square root of that of Z.
    error = np.sqrt(monodromy_error(criteria, x, criteria.propagator(x)))
    return np.log(criteria.spectral_radius(x)) <= LIMITING + error


def _polish(criteria: Criteria, field: Field, kind: str, x: np.ndarray) -> np.ndarray:
    """Points with ln|sigma| = 0 near ``x``; ``x`` itself if the multiplier is not simple there."""
    if criteria.conservative:
        return x
    scale = field.upper - field.lower
    kinds = [kind] * len(x)
    best = x.copy()
    for _ in range(_POLISH):
        rates = growth(criteria, best, kinds)
        gradient = rates.gradient * scale
        with np.errstate(all="ignore"):
            step = (rates.rate / (gradient**2).sum(axis=1))[:, None] * gradient
        good = np.linalg.norm(step, axis=1) < _LARGEST_SHIFT
        best = np.clip(np.where(good[:, None], best - step * scale, best), field.lower, field.upper)
    good &= np.abs(growth(criteria, best, kinds).rate) < 1e-8
    return np.where(good[:, None], best, x)
