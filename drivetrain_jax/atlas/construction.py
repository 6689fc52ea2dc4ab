"""Adaptive construction of an atlas, as a coroutine that requests solves in rounds.

``construct(...)`` yields arrays of points (parameters, ``(N, d)``) and receives their values ``(N, m)``, NaN where a solve
failed. It returns the :class:`~drivetrain_jax.atlas.Atlas`. Solves may report an error for each entry in further columns;
the bounds of the panels then include it. The construction is deterministic: equal values give equal requests, so a run can
be replayed from stored answers. Every box passes these steps:

1. probes along lines on its edges, refined until the Chebyshev coefficients of each coordinate are resolved;
2. a tensor grid with some more nodes per coordinate than the worst line needs, and held-out points;
3. acceptance, if the truncated tail (extrapolated from the last pairs of slabs) and the errors at all held-out points are
   small enough; else growth by the slope of the tail (at most twice), else a split in two halves.

A cheap ``NodeSource`` replaces the probes: tensors then grow until their coefficients have fallen. Held-out points are
always solved.

A box with failed solves, or with coefficients that fall like a power (a kink), is halved at most twice along each
coordinate. The unresolved rest is a :class:`~drivetrain_jax.atlas.Gap` with its reason.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from drivetrain_jax.atlas.fitting import (
    TROUBLED_DEPTH,
    Box,
    BoxRefinement,
    NodeSource,
    Refinement,
    Settings,
    fit,
    fit_given,
    probe,
)
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, inside
from drivetrain_jax.atlas.quantity import Quantity
from drivetrain_jax.systems import Coordinate

Rounds = Generator[np.ndarray, np.ndarray, Atlas]
# A box, its construction, and the points that it requests, or the values at these points (None at the start).
_Open = tuple[Box, Refinement, np.ndarray]
_Answered = tuple[Box, Refinement, np.ndarray | None]
MAX_SOLVES, MAX_NODES = 400_000, 128
# Relative width of a box in a coordinate that does not vary.
_THINNEST = 1e-15
# Number of the least accurate solves of a panel whose errors enter its bounds.
_MOST_CHANGES = 64


@dataclass(frozen=True)
class Domain:
    """The box ``lower``..``upper`` of ``parameters`` with their ``coordinates``; the other parameters are ``fixed``."""

    parameters: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    coordinates: tuple[Coordinate, ...]
    fixed: Mapping[str, float]

    def box(self) -> Box:
        """The domain in its coordinates."""
        ends = [self._ends(k) for k in range(len(self.parameters))]
        lower, upper = (np.array([of(e) for e in ends], float) for of in (min, max))
        # Different values may have the same coordinate.
        wider = upper + np.maximum(_THINNEST * np.abs(upper), np.finfo(float).tiny)
        return Box(lower, np.where(upper > lower, upper, wider), (0,) * len(ends))

    def points(self, x: np.ndarray) -> np.ndarray:
        """Parameters of points in coordinates, ``(N, d)``, clipped to the domain against rounding."""
        columns = []
        for k, coordinate in enumerate(self.coordinates):
            ends = coordinate.inverse(np.array(self._ends(k)))
            columns.append(np.clip(coordinate.inverse(x[:, k]), ends.min(), ends.max()))
        return np.stack(columns, axis=-1)

    def _ends(self, k: int) -> list[float]:
        """Coordinates between which the domain lies; an even coordinate also includes that of 0."""
        even = self.coordinates[k].even and self.lower[k] < 0 < self.upper[k]
        return [
            float(self.coordinates[k].forward(p)) for p in (self.lower[k], self.upper[k], *((0.0,) if even else ()))
        ]


class SolveCache:
    """Cache of solved points, so that none is solved twice: neighbouring boxes share the lines on their common face."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}
        self._points: list[np.ndarray] = []
        self._values: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._numbers)

    def missing(self, points: np.ndarray) -> np.ndarray:
        """The unknown ones of ``points``, each once, in the order of first appearance."""
        new: dict[bytes, int] = {}
        for k, key in enumerate(_keys(points)):
            if key not in self._numbers:
                new.setdefault(key, k)
        return points[list(new.values())]

    def add(self, points: np.ndarray, values: np.ndarray) -> None:
        """Store the values of unknown ``points``."""
        self._numbers.update(zip(_keys(points), range(len(self), len(self) + len(points)), strict=True))
        self._points.append(points)
        self._values.append(values)

    def values(self, points: np.ndarray) -> np.ndarray:
        """Values of known points."""
        numbers = np.array([self._numbers[key] for key in _keys(points)])
        found, first = np.empty((len(points), self._values[0].shape[1])), 0
        for block in self._values:
            mine = np.flatnonzero((numbers >= first) & (numbers < first + len(block)))
            found[mine] = block[numbers[mine] - first]
            first += len(block)
        return found

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        """All points with finite values, and these values."""
        points, values = np.concatenate(self._points), np.concatenate(self._values)
        finite = np.isfinite(values).all(axis=1)
        return points[finite], values[finite]


def _keys(points: np.ndarray) -> list[bytes]:
    """Keys of points: their bytes."""
    width, content = points.shape[1] * points.itemsize, points.tobytes()
    return [content[start : start + width] for start in range(0, len(content), width)]


def construct(
    domain: Domain,
    quantity: Quantity,
    tolerance: float,
    *,
    source: NodeSource | None = None,
    max_nodes: int = MAX_NODES,
    max_solves: int = MAX_SOLVES,
) -> Rounds:
    """An atlas of ``quantity`` over ``domain`` with errors of about ``tolerance`` times its scale.

    A ``source`` supplies the nodes, and only held-out points are solved; if the two disagree, the nodes are solved too.
    ``max_nodes`` limits the polynomials of one coordinate. If the next round would exceed ``max_solves``, the boxes that
    are still open become gaps.
    """
    cache = SolveCache()
    settings = Settings(quantity, tolerance, max_nodes, lambda solved: solved[:, : quantity.size])
    boxes, done = [domain.box()], []
    if source:
        found = yield from _refined(boxes, domain, replace(settings, source=source), cache, max_solves)
        done = [part for part in found if isinstance(part, Panel)]
        boxes = [Box.of(part, TROUBLED_DEPTH) for part in found if isinstance(part, Gap)]
    done += yield from _refined(boxes, domain, settings, cache, max_solves)
    return _with_solver_errors(_atlas(domain, done, tolerance, cache), settings, cache, quantity.size)


def _refined(
    boxes: Iterable[Box], domain: Domain, settings: Settings, cache: SolveCache, max_solves: int
) -> Generator[np.ndarray, np.ndarray, list[Panel | Gap]]:
    """The panels and gaps of ``boxes``."""
    active, done = _advanced([(box, refine(box, settings), None) for box in boxes], settings)
    while active:
        requests = [request for _, _, request in active]
        points = domain.points(np.concatenate(requests))
        new = cache.missing(points)
        if len(cache) + len(new) > max_solves:
            done += [Gap(box.lower, box.upper, f"more than {max_solves} solves would be needed") for box, *_ in active]
            break
        if len(new):
            cache.add(new, np.asarray((yield new), float))
        values = settings.value_of(cache.values(points))
        answers = np.split(values, np.cumsum([len(x) for x in requests])[:-1])
        answered = [(box, task, answer) for (box, task, _), answer in zip(active, answers, strict=True)]
        active, finished = _advanced(answered, settings)
        done += finished
    return done


def _advanced(tasks: Iterable[_Answered], settings: Settings) -> tuple[list[_Open], list[Panel | Gap]]:
    """The open boxes after their answers, including parts of split ones, and the finished ones."""
    waiting = deque(tasks)
    going: list[_Open] = []
    done: list[Panel | Gap] = []
    while waiting:
        box, task, answer = waiting.popleft()
        try:
            going.append((box, task, task.send(answer)))  # pyright: ignore[reportArgumentType]
        except StopIteration as end:
            waiting += [(part, refine(part, settings), None) for part in end.value if isinstance(part, Box)]
            done += [part for part in end.value if not isinstance(part, Box)]
    return going, done


def _atlas(domain: Domain, done: Iterable[Panel | Gap], tolerance: float, cache: SolveCache) -> Atlas:
    return Atlas(
        parameters=domain.parameters,
        coordinates=domain.coordinates,
        lower=np.array(domain.lower, float),
        upper=np.array(domain.upper, float),
        fixed=dict(domain.fixed),
        panels=tuple(part for part in done if isinstance(part, Panel)),
        gaps=tuple(part for part in done if isinstance(part, Gap)),
        tolerance=tolerance,
        solves=len(cache),
    )


def _with_solver_errors(atlas: Atlas, settings: Settings, cache: SolveCache, size: int) -> Atlas:
    """``atlas`` with bounds that include the errors of the solves, stored after the first ``size`` columns.

    Held-out points do not show errors that all solves have in common.
    """
    if not atlas.panels:
        return atlas
    points, solved = cache.all()
    if solved.shape[1] == size:
        return atlas
    x, changes = atlas.to_coordinates(points), solved[:, size:]
    order = np.argsort(-np.sum(changes**2, axis=1), kind="stable")

    def with_errors(panel: Panel) -> Panel:
        chosen = order[inside(panel, x[order])][:_MOST_CHANGES]
        value, change = settings.value_of(solved[chosen]), changes[chosen]
        derived = np.abs(settings.quantity.derived(value + change) - settings.quantity.derived(value))
        return replace(
            panel,
            value_error=panel.value_error + float(np.linalg.norm(change, axis=1).max(initial=0.0)),
            derived_error=panel.derived_error + derived.max(axis=0, initial=0.0),
        )

    return replace(atlas, panels=tuple(map(with_errors, atlas.panels)))


def refine(box: Box, settings: Settings) -> Refinement:
    """Yield points in coordinates at which values are needed; returns the panel, gap or halves of the box."""
    refinement = BoxRefinement(box, settings)
    if settings.source:
        return (yield from fit_given(refinement, settings.source))
    found = yield from probe(refinement)
    return (yield from fit(refinement, found)) if isinstance(found, list) else found


def run(rounds: Rounds, solve: Callable[[np.ndarray], np.ndarray]) -> Atlas:
    """Drive ``rounds`` with ``solve(points) -> values``."""
    points = next(rounds)
    while True:
        try:
            points = rounds.send(solve(points))
        except StopIteration as end:
            return end.value
