"""The chunks of a run: found among the parts of an earlier one, or computed and kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.store.chunks import Part, PartsFolder
from drivetrain_jax.sweep.assemble import failures
from drivetrain_jax.sweep.engine import Engine
from drivetrain_jax.sweep.executor import Where
from drivetrain_jax.sweep.plan import Chunk

# Finished chunks are written together, this often (seconds): small ones would cost more to write than to compute.
_WRITE_INTERVAL = 0.25


@dataclass
class Progress:
    """How far a run is: ``computed``, ``reused`` and ``failed`` count what ``kind`` says, costs are in the plan's units."""

    total: int
    computed: int = 0
    reused: int = 0
    failed: int = 0
    cost: float = 0.0
    total_cost: float = 0.0
    kind: str = "points"

    def __str__(self) -> str:
        return f"points: total={self.total} computed={self.computed} reused={self.reused} failed={self.failed}"


Report = Callable[[Progress], None]


class Sink(Protocol):
    """Where results go: the table of a scene, or what else asks for solves."""

    def fill(self, points: np.ndarray, results: Mapping[str, np.ndarray]) -> None:
        """Enter the results of ``points``."""

    def lose(self, points: np.ndarray) -> None:
        """Record that nobody survived the computation of ``points``."""


class Work:
    """Computes chunks ``where`` and tells ``report``. With ``parts`` (open) it keeps them there, and computes none that
    is there already. ``seconds`` is what those took."""

    def __init__(self, where: Where, report: Report | None = None, parts: PartsFolder | None = None) -> None:
        self.where, self.report, self.parts = where, report, parts
        self.seconds = 0.0
        self._counted = False

    def do(self, engine: Engine, sink: Sink, progress: Progress, first: int = 0, where: Where | None = None) -> None:
        """Enter all chunks of ``engine`` into ``sink``; ``first`` is added to their numbers where they are kept.

        Lost ones are not kept: a run that is resumed tries them again.
        """
        # Points that no solver can do are done already, without a value.
        hopeless = engine.total - sum(group.order.size for group in engine.plan.groups) * engine.grid.path_length
        progress.computed += hopeless
        progress.failed += hopeless
        numbers = range(len(engine.plan.costs))
        if self.parts is None:
            self._compute(engine, numbers, sink, progress, where or self.where, None)
            return
        missing = self._reuse(engine, sink, progress, first)
        writer, before = _Writer(self.parts, first), progress.computed
        try:
            self._compute(engine, missing, sink, progress, where or self.where, writer)
        finally:
            writer.flush()
            # An interrupt may come between keeping a chunk and counting it: what counts is what was written.
            progress.computed = before + writer.written * engine.grid.path_length

    def _reuse(self, engine: Engine, sink: Sink, progress: Progress, first: int) -> list[int]:
        """Enter the chunks that are there; the numbers of those that are not."""
        missing = set(range(len(engine.plan.costs)))
        for part in self.parts.read(repair=True):
            self.seconds += 0.0 if self._counted else part.seconds
            for number, results in part:
                if number - first not in missing:
                    continue
                missing.remove(number - first)
                points = engine.plan.chunk(number - first).points
                sink.fill(points, results)
                progress.reused += points.size * engine.grid.path_length
                progress.failed += failures(results[OUTCOME.name])
        self._counted = True
        return sorted(missing)

    def _compute(
        self,
        engine: Engine,
        numbers: Iterable[int],
        sink: Sink,
        progress: Progress,
        where: Where,
        writer: _Writer | None,
    ) -> None:
        numbers, costs = list(numbers), engine.plan.costs
        progress.cost, progress.total_cost = 0.0, float(costs[numbers].sum())
        self._tell(progress)
        # Closed on the way out: after an interrupt no further chunk starts.
        with closing(where.compute(engine, numbers)) as finished:
            for chunk, results in finished:
                count = chunk.points.size * engine.grid.path_length
                if results is None:
                    sink.lose(chunk.points)
                    progress.failed += count
                else:
                    if writer:
                        writer.add(chunk, results)
                    sink.fill(chunk.points, results)
                    progress.failed += failures(results[OUTCOME.name])
                progress.computed += count
                progress.cost += float(costs[chunk.number])
                self._tell(progress)

    def _tell(self, progress: Progress) -> None:
        if self.report:
            self.report(progress)


class _Writer:
    """Collects finished chunks and writes those of every quarter of a second as one part."""

    def __init__(self, parts: PartsFolder, first: int) -> None:
        self._parts, self._first = parts, first
        self._waiting: list[tuple[Chunk, Mapping[str, np.ndarray]]] = []
        self._last = time.monotonic()
        self.written = 0

    def add(self, chunk: Chunk, results: Mapping[str, np.ndarray]) -> None:
        self._waiting.append((chunk, results))
        if time.monotonic() - self._last >= _WRITE_INTERVAL:
            self.flush()

    def flush(self) -> None:
        if not self._waiting:
            return
        chunks, results = zip(*self._waiting, strict=True)
        joined = {name: np.concatenate([r[name] for r in results]) for name in results[0]}
        seconds = time.monotonic() - self._last
        numbers = [self._first + c.number for c in chunks]
        self._parts.write(Part(numbers, [c.points.size for c in chunks], joined, seconds))
        self._waiting.clear()
        self.written += sum(c.points.size for c in chunks)
        self._last = time.monotonic()
