"""Adaptive construction of an atlas, as a coroutine that asks for solves in rounds.

``construct(...)`` yields arrays of points (parameters, ``(N, d)``) and is sent their values ``(N, m)``, NaN where a solve
failed; it returns the :class:`~drivetrain_jax.atlas.Atlas`. It is deterministic: the same values give the same questions, so
that a run can be replayed from stored answers. Every box goes through

1. probes along lines on its edges, refined until the Chebyshev coefficients of each coordinate are resolved;
2. a tensor grid with two more nodes per coordinate than the worst line needs, and held-out points;
3. acceptance, if the last two slabs of each coordinate and the errors at all held-out points are small enough,
   else growth by the slope of the tail (twice at most), else a split in two halves.

A box in which solves fail, or whose coefficients fall like a power (a kink), is split three times at most and then left
as a :class:`~drivetrain_jax.atlas.Gap` that says why.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.atlas.box import Box, Exploration, Progress, Settings
from drivetrain_jax.atlas.fitting import fit
from drivetrain_jax.atlas.lines import probe
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel
from drivetrain_jax.atlas.quantity import Quantity
from drivetrain_jax.systems import Coordinate

Rounds = Generator[np.ndarray, np.ndarray, Atlas]
# A box with its exploration and the points that this asks for.
_Open = tuple[Box, Exploration, np.ndarray]
MAX_SOLVES = 400_000


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
        return Box(np.array([min(e) for e in ends]), np.array([max(e) for e in ends]), (0,) * len(ends))

    def points(self, x: np.ndarray) -> np.ndarray:
        """Parameters of points in coordinates, ``(N, d)``, kept inside the domain against rounding."""
        columns = []
        for k, coordinate in enumerate(self.coordinates):
            ends = coordinate.inverse(np.array(self._ends(k)))
            columns.append(np.clip(coordinate.inverse(x[:, k]), ends.min(), ends.max()))
        return np.stack(columns, axis=-1)

    def _ends(self, k: int) -> list[float]:
        """Coordinates between which those of the domain lie; an even one also takes that of 0."""
        even = self.coordinates[k].even and self.lower[k] < 0 < self.upper[k]
        return [
            float(self.coordinates[k].forward(p)) for p in (self.lower[k], self.upper[k], *((0.0,) if even else ()))
        ]


class Ledger:
    """Values of solved points: none is asked for twice (neighbouring boxes share the lines on their common face)."""

    def __init__(self) -> None:
        self._values: dict[bytes, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._values)

    def missing(self, points: np.ndarray) -> np.ndarray:
        """Those of ``points`` that are not known, each once, in the order of their first appearance."""
        new = {row.tobytes(): k for k, row in reversed(list(enumerate(points))) if row.tobytes() not in self._values}
        return points[sorted(new.values())]

    def add(self, points: np.ndarray, values: np.ndarray) -> None:
        """Remember the values of ``points``."""
        self._values.update(zip((row.tobytes() for row in points), values, strict=True))

    def values(self, points: np.ndarray) -> np.ndarray:
        """Values of known points."""
        return np.stack([self._values[row.tobytes()] for row in points])


def construct(
    domain: Domain, quantity: Quantity, tolerance: float, *, max_nodes: int = 128, max_solves: int = MAX_SOLVES
) -> Rounds:
    """An atlas of ``quantity`` over ``domain`` with errors of about ``tolerance`` times its scale.

    ``max_nodes`` bounds the polynomials of one coordinate. When the next round would exceed ``max_solves``, the boxes that
    are still open become gaps.
    """
    settings = Settings(quantity, tolerance, max_nodes)
    active = [_start(domain.box(), settings)]
    done: list[Panel | Gap] = []
    ledger = Ledger()
    while active:
        requests = [request for _, _, request in active]
        points = domain.points(np.concatenate(requests))
        new = ledger.missing(points)
        if len(ledger) + len(new) > max_solves:
            done += [Gap(box.lower, box.upper, f"more than {max_solves} solves would be needed") for box, *_ in active]
            break
        if len(new):
            ledger.add(new, np.asarray((yield new), float))
        answers = np.split(ledger.values(points), np.cumsum([len(x) for x in requests])[:-1])
        active, finished = _answer(active, answers, settings)
        done += finished
    return Atlas(
        parameters=domain.parameters,
        coordinates=domain.coordinates,
        lower=np.array(domain.lower, float),
        upper=np.array(domain.upper, float),
        fixed=dict(domain.fixed),
        panels=tuple(part for part in done if isinstance(part, Panel)),
        gaps=tuple(part for part in done if isinstance(part, Gap)),
        tolerance=tolerance,
        solves=len(ledger),
    )


def _start(box: Box, settings: Settings) -> _Open:
    task = explore(box, settings)
    return box, task, next(task)


def _answer(
    active: list[_Open], answers: list[np.ndarray], settings: Settings
) -> tuple[list[_Open], list[Panel | Gap]]:
    """The boxes that are open after their ``answers``, the parts of those that were split among them, and what is done."""
    going: list[_Open] = []
    done: list[Panel | Gap] = []
    for (box, task, _), answer in zip(active, answers, strict=True):
        try:
            going.append((box, task, task.send(answer)))
        except StopIteration as end:
            going += [_start(part, settings) for part in end.value if isinstance(part, Box)]
            done += [part for part in end.value if not isinstance(part, Box)]
    return going, done


def explore(box: Box, settings: Settings) -> Exploration:
    """Asks for values at points in coordinates; returns what became of the box."""
    progress = Progress(box, settings)
    found = yield from probe(progress)
    return (yield from fit(progress, found)) if isinstance(found, list) else found


def run(rounds: Rounds, solve: Callable[[np.ndarray], np.ndarray]) -> Atlas:
    """Drive ``rounds`` with ``solve(points) -> values``."""
    points = next(rounds)
    while True:
        try:
            points = rounds.send(solve(points))
        except StopIteration as end:
            return end.value
