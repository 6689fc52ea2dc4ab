"""An atlas: smooth functions of parameters as Chebyshev tensors over boxes (panels) that tile a domain.

Boxes and coefficients are in the coordinates of the atlas (1/Omega, ...), one per parameter; the interface converts
parameters. With x in [-1, 1]^d the position within a panel,

    f_e(x) = sum_k coefficients[k_1, ..., k_d, e] T_(k_1)(x_1) ... T_(k_d)(x_d).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivetrain_jax.systems import Coordinate

# Relative tolerance for points outside the domain by rounding of their coordinate.
_SLACK = 8 * np.finfo(float).eps


@dataclass(frozen=True)
class Panel:
    """One box ``lower``..``upper``, both ``(d,)`` in the coordinates, with ``coefficients`` ``(n_1, ..., n_d, m)``.

    ``value_error`` bounds the Euclidean norm of the error of the m values. It is statistical (from held-out solves), not
    proved, and excludes rounding at evaluation. ``proved_error`` is a proved bound of the same (``atlas.proof``), infinite
    where there is none.
    """

    lower: np.ndarray
    upper: np.ndarray
    coefficients: np.ndarray
    value_error: float
    proved_error: float = math.inf

    @property
    def degrees(self) -> tuple[int, ...]:
        """Number of Chebyshev polynomials in each coordinate."""
        return self.coefficients.shape[:-1]


@dataclass(frozen=True)
class Gap:
    """A box, in the coordinates, without a panel, and the reason."""

    lower: np.ndarray
    upper: np.ndarray
    reason: str


@dataclass(frozen=True)
class Atlas:
    """Panels over the box ``lower``..``upper`` (in parameters, ``(d,)``) of ``parameters``; the others are ``fixed``.

    ``coordinates`` has one entry per parameter. ``tolerance`` is the target of the construction, relative to the size of
    the values; ``solves`` the number of direct solves. Panels and gaps together tile the domain.
    """

    parameters: tuple[str, ...]
    coordinates: tuple[Coordinate, ...]
    lower: np.ndarray
    upper: np.ndarray
    fixed: Mapping[str, float]
    panels: tuple[Panel, ...]
    gaps: tuple[Gap, ...]
    tolerance: float
    solves: int

    @property
    def ends(self) -> np.ndarray:
        """Coordinates of ``lower`` and of ``upper``, ``(2, d)``; a coordinate may fall where its parameter rises."""
        return self.to_coordinates(np.stack([self.lower, self.upper]))

    @property
    def corners(self) -> np.ndarray:
        """Least and largest coordinates, ``(2, d)``."""
        return np.sort(self.ends, axis=0)

    def to_coordinates(self, points: np.ndarray) -> np.ndarray:
        """Coordinates of points given by their parameters, ``(..., d)``."""
        points = np.asarray(points, float)
        columns = [c.forward(points[..., k]) for k, c in enumerate(self.coordinates)]
        return np.stack(columns, axis=-1) if columns else np.empty(points.shape)

    def to_parameters(self, points: np.ndarray) -> np.ndarray:
        """Parameters of points given by their coordinates, ``(..., d)``."""
        columns = [c.inverse(points[..., k]) for k, c in enumerate(self.coordinates)]
        return np.stack(columns, axis=-1) if columns else np.empty(np.shape(points))

    def find(self, x: np.ndarray) -> np.ndarray:
        """Number of the panel of each point in coordinates, ``(N, d) -> (N,)``; -1 in a gap or outside the domain."""
        numbers = np.full(len(x), -1)
        for number, panel in reversed(list(enumerate(self.panels))):
            numbers[between(panel.lower, panel.upper, x).all(axis=-1)] = number
        return numbers

    def folded(self) -> Atlas:
        """The atlas over the moduli of the parameters whose coordinates are even."""
        lower, upper = self.lower.copy(), self.upper.copy()
        for k, coordinate in enumerate(self.coordinates):
            if coordinate.even and lower[k] < 0:
                ends = sorted((abs(lower[k]), abs(upper[k])))
                lower[k], upper[k] = 0.0 if upper[k] > 0 else ends[0], ends[1]
        return replace(self, lower=lower, upper=upper)

    def slice(self, values: Mapping[str, float]) -> Atlas:
        """The atlas of the remaining parameters, with those in ``values`` fixed.

        Raises ``KeyError`` for a parameter that the atlas lacks and ``ValueError`` for a value outside the domain.
        """
        atlas = self
        for name, value in values.items():
            atlas = atlas._without(name, float(value))
        return atlas

    def ordered(self, parameters: Sequence[str]) -> Atlas:
        """The atlas with the parameters in this order."""
        if tuple(parameters) == self.parameters:
            return self
        order = [self.parameters.index(name) for name in parameters]

        def turned(box: Panel | Gap) -> Panel | Gap:
            box = replace(box, lower=box.lower[order], upper=box.upper[order])
            if isinstance(box, Gap):
                return box
            return replace(box, coefficients=np.transpose(box.coefficients, (*order, len(order))))

        return replace(
            self,
            parameters=tuple(parameters),
            coordinates=tuple(self.coordinates[k] for k in order),
            lower=self.lower[order],
            upper=self.upper[order],
            panels=tuple(map(turned, self.panels)),
            gaps=tuple(map(turned, self.gaps)),
        )

    def _without(self, name: str, value: float) -> Atlas:
        if name not in self.parameters:
            raise KeyError(f"{name}: the atlas has {', '.join(self.parameters)}")
        k = self.parameters.index(name)
        if not self.lower[k] <= value <= self.upper[k]:
            raise ValueError(f"{name} = {value!r}: expected {self.lower[k]:g} to {self.upper[k]:g}")
        x = float(self.coordinates[k].forward(value))
        boxes = [box for box in (*self.panels, *self.gaps) if between(box.lower[k], box.upper[k], x)]
        # On a common face the first of two neighbours is used.
        kept: dict[tuple, Panel | Gap] = {}
        for box in boxes:
            reduced = _fix(box, k, x)
            kept.setdefault((*reduced.lower, *reduced.upper), reduced)
        return replace(
            self,
            parameters=_drop(self.parameters, k),
            coordinates=_drop(self.coordinates, k),
            lower=np.delete(self.lower, k),
            upper=np.delete(self.upper, k),
            fixed={**self.fixed, name: value},
            panels=tuple(box for box in kept.values() if isinstance(box, Panel)),
            gaps=tuple(box for box in kept.values() if isinstance(box, Gap)),
        )


def position(panel: Panel | Gap, x: np.ndarray) -> np.ndarray:
    """Position in [-1, 1]^d of points given by their coordinates, ``(..., d)``."""
    return position_between(panel.lower, panel.upper, x)


def position_between(lower: np.ndarray, upper: np.ndarray, x: np.ndarray | float) -> np.ndarray:
    """-1 where ``x`` is ``lower``, 1 where it is ``upper``."""
    return np.clip(((x - lower) - (upper - x)) / (upper - lower), -1.0, 1.0)


def derivative(panel: Panel, order: Sequence[int]) -> np.ndarray:
    """Coefficients of the derivative of ``order`` per coordinate; order 0 is the function itself."""
    coefficients = panel.coefficients
    for axis, times in enumerate(order):
        if times:
            scale = 2 / (panel.upper[axis] - panel.lower[axis])
            coefficients = np.polynomial.chebyshev.chebder(coefficients, times, scl=scale, axis=axis)
    return coefficients


def chebyshev(x: np.ndarray, n: int) -> np.ndarray:
    """``T_0 .. T_(n-1)`` at ``x`` in [-1, 1], shape ``(*x.shape, n)``."""
    return np.cos(np.arccos(x)[..., None] * np.arange(n))


def between(lower: np.ndarray, upper: np.ndarray, x: np.ndarray | float) -> np.ndarray:
    """Flags of ``x`` between ``lower`` and ``upper``, up to rounding."""
    slack = _SLACK * np.maximum(np.abs(lower), np.abs(upper))
    return (x >= lower - slack) & (x <= upper + slack)


def _drop(entries: tuple, k: int) -> tuple:
    return entries[:k] + entries[k + 1 :]


def _fix(box: Panel | Gap, k: int, x: float) -> Panel | Gap:
    lower, upper = np.delete(box.lower, k), np.delete(box.upper, k)
    if isinstance(box, Gap):
        return Gap(lower, upper, box.reason)
    weights = chebyshev(position_between(box.lower[k], box.upper[k], x), box.degrees[k])
    before, after = box.coefficients.shape[:k], box.coefficients.shape[k + 1 :]
    # Unlike `tensordot`, it copies nothing.
    coefficients = weights @ box.coefficients.reshape(*before, len(weights), -1)
    coefficients = coefficients.reshape(*before, *after)
    # The proof does not cover the rounding of this product.
    return replace(box, lower=lower, upper=upper, coefficients=coefficients, proved_error=math.inf)


# Convert an atlas to plain arrays and words, and back.


Arrays = dict[str, np.ndarray]


def to_arrays(atlas: Atlas) -> Arrays:
    """Arrays by name. With p panels, g gaps, d parameters and m values:

    ``lower``, ``upper`` (d,): the domain in parameters; ``panel_lower``, ``panel_upper``, ``panel_degrees`` (p, d),
    ``value_error`` (p,), ``proved_error`` (p,) if any is finite; ``gap_lower``, ``gap_upper`` (g, d), ``gap_reason`` (g,);
    ``coefficients`` (c, m): the kept ones, in C order, panel after panel; ``kept``: the bits that mark them
    (``numpy.packbits`` of all panels together).
    """
    d, proved = len(atlas.parameters), np.array([p.proved_error for p in atlas.panels])
    flat = [p.coefficients.reshape(-1, p.coefficients.shape[-1]) for p in atlas.panels]
    kept = [np.any(c != 0, axis=1) for c in flat]
    m = flat[0].shape[1] if flat else 0

    def table(boxes: tuple, name: str) -> np.ndarray:
        return np.array([getattr(box, name) for box in boxes], float).reshape(len(boxes), d)

    return {
        "lower": atlas.lower,
        "upper": atlas.upper,
        "panel_lower": table(atlas.panels, "lower"),
        "panel_upper": table(atlas.panels, "upper"),
        "panel_degrees": np.array([p.degrees for p in atlas.panels], np.int32).reshape(-1, d),
        "value_error": np.array([p.value_error for p in atlas.panels]),
        "proved_error": proved if np.isfinite(proved).any() else np.empty(0),
        "gap_lower": table(atlas.gaps, "lower"),
        "gap_upper": table(atlas.gaps, "upper"),
        "gap_reason": np.array([gap.reason for gap in atlas.gaps], dtype=object),
        "coefficients": np.concatenate([c[k] for c, k in zip(flat, kept, strict=True)]) if flat else np.empty((0, m)),
        "kept": np.packbits(np.concatenate(kept)) if flat else np.empty(0, np.uint8),
    }


def from_arrays(
    arrays: Mapping[str, Any],
    parameters: tuple[str, ...],
    coordinates: tuple[Coordinate, ...],
    fixed: Mapping[str, Any],
    tolerance: float,
    solves: int,
) -> Atlas:
    """The atlas from the arrays of :func:`to_arrays`, with its words and numbers given separately."""
    degrees = np.asarray(arrays["panel_degrees"])
    sizes = np.prod(degrees, axis=1, dtype=int)
    kept = np.unpackbits(np.asarray(arrays["kept"]), count=int(sizes.sum())).astype(bool)
    coefficients = np.asarray(arrays["coefficients"], float)
    dense = np.zeros((len(kept), coefficients.shape[1]))
    dense[kept] = coefficients
    proved = np.asarray(arrays.get("proved_error", ()))
    columns = arrays["panel_lower"], arrays["panel_upper"], arrays.get("value_error", ())
    parts = np.split(dense, np.cumsum(sizes)[:-1]) if len(sizes) else []
    panels = [
        Panel(np.asarray(lower), np.asarray(upper), part.reshape(*n, -1), float(error), float(bound))
        for lower, upper, error, bound, part, n in zip(
            *columns, proved if proved.size else np.full(len(sizes), math.inf), parts, degrees, strict=True
        )
    ]
    gaps = [
        Gap(np.asarray(lower), np.asarray(upper), str(reason))
        for lower, upper, reason in zip(arrays["gap_lower"], arrays["gap_upper"], arrays["gap_reason"], strict=True)
    ]
    lower, upper = np.asarray(arrays["lower"], float), np.asarray(arrays["upper"], float)
    return Atlas(
        parameters, coordinates, lower, upper, dict(fixed), tuple(panels), tuple(gaps), float(tolerance), int(solves)
    )
