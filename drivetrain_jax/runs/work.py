"""The chunks of a run: found among the parts of an earlier one, or computed and kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivetrain_jax._errors import Passing
from drivetrain_jax._wording import counted
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import failures
from drivetrain_jax.runs.engine import Engine
from drivetrain_jax.runs.executor import Where
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.store.chunks import Part, PartsFolder

# Finished chunks are written together: small ones would cost more to write than to compute. Fewest and most seconds
# between two parts, and the share of the time that writing may take in between.
_SHORTEST, _LONGEST, _WRITE_SHARE = 0.25, 2.0, 0.01
# Bytes of results that wait to be written at most.
_MOST_WAITING = 1 << 25


@dataclass
class Progress:
    """How far a run is: ``computed``, ``reused`` and ``failed`` count what ``kind`` says, costs are in the plan's units.

    ``note`` says what the counts do not tell.
    """

    total: int
    computed: int = 0
    reused: int = 0
    failed: int = 0
    cost: float = 0.0
    total_cost: float = 0.0
    kind: str = "points"
    note: str = ""

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
    is there already. ``seconds`` is what those took.

    Leaving it as a context by an exception writes the finished chunks that are still in memory; leaving it normally drops
    them, since the result holds them.
    """

    def __init__(self, where: Where, report: Report | None = None, parts: PartsFolder | None = None) -> None:
        self.where, self.report, self.parts = where, report, parts
        self.seconds = 0.0
        self._counted = False
        self._keeper = _Keeper(parts)

    def __enter__(self) -> Work:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        if failure:
            self._keeper.write()

    def do(self, engine: Engine, sink: Sink, progress: Progress, first: int = 0, where: Where | None = None) -> None:
        """Enter all chunks of ``engine`` into ``sink``; ``first`` is added to their numbers where they are kept.

        Lost ones are not kept: a run that is resumed tries them again.
        """
        progress.computed += engine.hopeless
        progress.failed += engine.hopeless
        if self.parts is None:
            missing = np.arange(len(engine.plan.costs))
        else:
            missing = self._reuse(engine, self.parts, sink, progress, first)
        batch, before = _Batch(sink, self._keeper, first), progress.computed
        try:
            self._compute(engine, missing, batch, progress, where or self.where)
            batch.flush()
        finally:
            batch.keep()
            # An interrupt may come between keeping a chunk and counting it: what counts is what was kept, or is lost.
            progress.computed = before + (batch.kept + batch.lost) * engine.grid.path_length

    def _reuse(self, engine: Engine, parts: PartsFolder, sink: Sink, progress: Progress, first: int) -> np.ndarray:
        """Enter the chunks that are there; the numbers of those that are not."""
        missing = np.ones(len(engine.plan.costs), bool)
        for part in parts.read(repair=True):
            self.seconds += 0.0 if self._counted else part.seconds
            for number, results in part:
                # An interrupt in the middle of writing may have left a chunk in two parts.
                if not (0 <= number - first < missing.size and missing[number - first]):
                    continue
                missing[number - first] = False
                points = engine.plan.chunk(number - first).points
                sink.fill(points, results)
                progress.reused += points.size * engine.grid.path_length
                progress.failed += failures(results[OUTCOME.name])
        self._counted = True
        return np.flatnonzero(missing)

    def _compute(self, engine: Engine, numbers: np.ndarray, batch: _Batch, progress: Progress, where: Where) -> None:
        costs = engine.plan.costs
        progress.cost, progress.total_cost = 0.0, float(costs[numbers].sum())
        self._tell(progress)
        missing = len(numbers)
        # Closed on the way out: after an interrupt no further chunk starts.
        with closing(where.compute(engine, numbers)) as finished:
            for chunk, results in finished:
                missing -= 1
                count = chunk.points.size * engine.grid.path_length
                if results is None:
                    batch.lose(chunk)
                    progress.failed += count
                else:
                    batch.add(chunk, results)
                    progress.failed += failures(results[OUTCOME.name])
                progress.computed += count
                progress.cost += float(costs[chunk.number])
                self._tell(progress)
        if missing:
            raise Passing(f"{counted(missing, 'chunk', 'chunks')} never came back")

    def _tell(self, progress: Progress) -> None:
        if self.report:
            self.report(progress)


class _Keeper:
    """Takes finished chunks and writes those of a quarter of a second, on a slow disk of a longer time, together; without
    ``parts`` it only says when that would be."""

    def __init__(self, parts: PartsFolder | None) -> None:
        self._parts = parts
        self._waiting: list[Part] = []
        self._taken = self._written = time.monotonic()
        self._interval = _SHORTEST

    def due(self) -> bool:
        """Whether it is time to write."""
        return time.monotonic() - self._written >= self._interval

    def take(self, numbers: list[int], sizes: list[int], results: Mapping[str, np.ndarray]) -> None:
        """Have these chunks, to be written if the time has come."""
        now = time.monotonic()
        if self._parts:
            self._waiting.append(Part(numbers, sizes, results, now - self._taken))
        self._taken = now
        if self.due() or sum(part.nbytes for part in self._waiting) >= _MOST_WAITING:
            self.write()

    def write(self) -> None:
        """Write what waits."""
        begin = time.monotonic()
        while self._waiting and self._parts:
            self._parts.write(self._waiting[0])
            del self._waiting[0]
        self._written = time.monotonic()
        self._interval = min(max(_SHORTEST, (self._written - begin) / _WRITE_SHARE), _LONGEST)


class _Batch:
    """Collects finished chunks, which are kept and entered into ``sink`` together: that costs a third of one by one."""

    def __init__(self, sink: Sink, keeper: _Keeper, first: int) -> None:
        self.sink, self._keeper, self._first = sink, keeper, first
        self._waiting: list[tuple[Chunk, Mapping[str, np.ndarray]]] = []
        self._bytes = 0
        self._begun = False
        self.kept = self.lost = 0

    def add(self, chunk: Chunk, results: Mapping[str, np.ndarray]) -> None:
        self._waiting.append((chunk, results))
        self._bytes += sum(values.nbytes for values in results.values())
        if not self._begun:
            # The first results make the room for all: a disk without it is told before more is computed.
            self._begun = True
            self.sink.fill(chunk.points, results)
        if self._bytes >= _MOST_WAITING or self._keeper.due():
            self.flush()

    def lose(self, chunk: Chunk) -> None:
        """Enter that nobody survived the chunk."""
        self.sink.lose(chunk.points)
        self.lost += chunk.points.size

    def flush(self) -> None:
        """Keep and enter what waits."""
        chunks, results = self.keep()
        if chunks:
            self.sink.fill(np.concatenate([chunk.points for chunk in chunks]), results)

    def keep(self) -> tuple[list[Chunk], dict[str, np.ndarray]]:
        """Hand over what waits. Returns it: its chunks, and their results one after the other."""
        chunks = [chunk for chunk, _ in self._waiting]
        if not chunks:
            return [], {}
        all_results = [results for _, results in self._waiting]
        joined = {name: np.concatenate([results[name] for results in all_results]) for name in all_results[0]}
        sizes = [chunk.points.size for chunk in chunks]
        self._keeper.take([self._first + chunk.number for chunk in chunks], sizes, joined)
        self._waiting.clear()
        self._bytes = 0
        self.kept += sum(sizes)
        return chunks, joined
