"""Find the chunks of a run among the parts of an earlier one, or compute and keep them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivetrain_jax._errors import RetryableError
from drivetrain_jax._wording import counted
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import failures, inaccurate
from drivetrain_jax.runs.executor import Executor
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.store.chunks import Part, PartsFolder

# Shortest and longest time in s between two parts, and the largest share of time for writing.
_SHORTEST, _LONGEST, _WRITE_SHARE = 0.25, 2.0, 0.01
# Most bytes of results that wait to be written.
_MOST_WAITING = 1 << 25


@dataclass
class Progress:
    """Progress of a run: counts of results of this ``kind``, and costs in units of the plan; ``note`` is a remark.

    ``failed`` points have no value, ``inaccurate`` ones a value whose error exceeds the target.
    """

    total: int
    computed: int = 0
    reused: int = 0
    failed: int = 0
    inaccurate: int = 0
    cost: float = 0.0
    total_cost: float = 0.0
    kind: str = "points"
    note: str = ""

    def __str__(self) -> str:
        return f"points: total={self.total} computed={self.computed} reused={self.reused} failed={self.failed}"

    def count(self, outcome: np.ndarray) -> None:
        """Count the failed and the inaccurate points among these outcomes."""
        self.failed += failures(outcome)
        self.inaccurate += inaccurate(outcome)

    @property
    def exceptions(self) -> str:
        """The points that are no success, as the end of a line: ``, 3 failed, 2 inaccurate``."""
        counts = ((self.failed, "failed"), (self.inaccurate, "inaccurate"))
        return "".join(f", {count} {name}" for count, name in counts if count)


Report = Callable[[Progress], None]


class Receiver(Protocol):
    """Receives results: the buffer of a scene, or a collector of solves."""

    def fill(self, points: np.ndarray, results: Mapping[str, np.ndarray]) -> None:
        """Write the results of ``points``."""

    def lose(self, points: np.ndarray) -> None:
        """Mark these points as lost: their worker crashed three times."""


class Work:
    """Runs chunks on the executor and reports progress.

    With ``parts`` (open) it stores finished chunks there and reuses stored ones. Leaving the context ends the workers. After
    an exception it also writes the chunks in memory; otherwise the result contains them.
    """

    def __init__(self, executor: Executor, report: Report | None = None, parts: PartsFolder | None = None) -> None:
        self.executor, self.report, self.parts = executor, report, parts
        self._seconds, self._begin = 0.0, time.monotonic()
        self._counted = False
        self._writer = _PartWriter(parts)

    @property
    def elapsed(self) -> float:
        """Computing time in s, including the time that reused parts took."""
        return round(self._seconds + time.monotonic() - self._begin, 3)

    def __enter__(self) -> Work:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        try:
            if failure:
                self._writer.write()
        finally:
            self.executor.close()

    def do(self, job: Job, receiver: Receiver, progress: Progress, first: int = 0) -> None:
        """Compute or reuse all chunks of ``job`` into ``receiver``; stored chunk numbers start at ``first``.

        Lost chunks are not stored, so a resumed run computes them again.
        """
        progress.computed += job.unsolvable
        progress.failed += job.unsolvable
        if self.parts is None:
            missing = np.arange(len(job.plan.costs))
        else:
            missing = self._reuse(job, self.parts, receiver, progress, first)
        batch, before = _Batch(receiver, self._writer, first), progress.computed
        try:
            self._compute(job, missing, batch, progress)
            batch.flush()
        finally:
            batch.keep()
            # An interrupt may come between storing a chunk and counting it: count what is stored or lost.
            progress.computed = before + (batch.kept + batch.lost) * job.grid.path_length

    def _reuse(self, job: Job, parts: PartsFolder, receiver: Receiver, progress: Progress, first: int) -> np.ndarray:
        """Copy the stored chunks; returns the numbers of the missing ones."""
        missing = np.ones(len(job.plan.costs), bool)
        for part in parts.read(repair=True):
            self._seconds += 0.0 if self._counted else part.seconds
            for number, results in part:
                # An interrupt during writing may leave a chunk in two parts.
                if not (0 <= number - first < missing.size and missing[number - first]):
                    continue
                missing[number - first] = False
                points = job.plan.chunk(number - first).points
                receiver.fill(points, results)
                progress.reused += points.size * job.grid.path_length
                progress.count(results[OUTCOME.name])
        self._counted = True
        return np.flatnonzero(missing)

    def _compute(self, job: Job, numbers: np.ndarray, batch: _Batch, progress: Progress) -> None:
        costs = job.plan.costs
        progress.cost, progress.total_cost = 0.0, float(costs[numbers].sum())
        self._report(progress)
        missing = len(numbers)
        if self.executor.in_process:
            job.prepare(job.plan.kernels(numbers))
        # Closed on exit: after an interrupt no further chunk starts.
        with closing(self.executor.run(job, job.ordered(numbers))) as finished:
            for chunk, results in finished:
                missing -= 1
                count = chunk.points.size * job.grid.path_length
                if results is None:
                    batch.lose(chunk)
                    progress.failed += count
                else:
                    batch.add(chunk, results)
                    progress.count(results[OUTCOME.name])
                progress.computed += count
                progress.cost += float(costs[chunk.number])
                self._report(progress)
        if missing:
            raise RetryableError(f"{counted(missing, 'chunk', 'chunks')} returned no result")

    def _report(self, progress: Progress) -> None:
        if self.report:
            self.report(progress)


class _PartWriter:
    """Writes finished chunks in a part every quarter of a second, or less often on a slow disk.

    Without ``parts`` it writes nothing, and only reports when a part is due.
    """

    def __init__(self, parts: PartsFolder | None) -> None:
        self._parts = parts
        self._waiting: list[Part] = []
        self._added = self._written = time.monotonic()
        self._interval = _SHORTEST

    def due(self) -> bool:
        """True if a part is due."""
        return time.monotonic() - self._written >= self._interval

    def add(self, numbers: list[int], sizes: list[int], results: Mapping[str, np.ndarray]) -> None:
        """Queue these chunks, and write if a part is due."""
        now = time.monotonic()
        if self._parts:
            self._waiting.append(Part(numbers, sizes, results, now - self._added))
        self._added = now
        if self.due() or sum(part.nbytes for part in self._waiting) >= _MOST_WAITING:
            self.write()

    def write(self) -> None:
        """Write the queued chunks."""
        begin = time.monotonic()
        while self._waiting and self._parts:
            self._parts.write(self._waiting[0])
            del self._waiting[0]
        self._written = time.monotonic()
        self._interval = min(max(_SHORTEST, (self._written - begin) / _WRITE_SHARE), _LONGEST)


class _Batch:
    """Collects finished chunks and enters them together, which costs a third of entering them one by one."""

    def __init__(self, receiver: Receiver, writer: _PartWriter, first: int) -> None:
        self.receiver, self._writer, self._first = receiver, writer, first
        self._waiting: list[tuple[Chunk, Mapping[str, np.ndarray]]] = []
        self._bytes = 0
        self._begun = False
        self.kept = self.lost = 0

    def add(self, chunk: Chunk, results: Mapping[str, np.ndarray]) -> None:
        self._waiting.append((chunk, results))
        self._bytes += sum(values.nbytes for values in results.values())
        if not self._begun:
            # The first results allocate the whole output, so a full disk is reported before more is computed.
            self._begun = True
            self.receiver.fill(chunk.points, results)
        if self._bytes >= _MOST_WAITING or self._writer.due():
            self.flush()

    def lose(self, chunk: Chunk) -> None:
        """Mark the points of a chunk as lost."""
        self.receiver.lose(chunk.points)
        self.lost += chunk.points.size

    def flush(self) -> None:
        """Store and enter the queued chunks."""
        chunks, results = self.keep()
        if chunks:
            self.receiver.fill(np.concatenate([chunk.points for chunk in chunks]), results)

    def keep(self) -> tuple[list[Chunk], dict[str, np.ndarray]]:
        """Store the queued chunks; returns the chunks and their concatenated results."""
        chunks = [chunk for chunk, _ in self._waiting]
        if not chunks:
            return [], {}
        all_results = [results for _, results in self._waiting]
        joined = {name: np.concatenate([results[name] for results in all_results]) for name in all_results[0]}
        sizes = [chunk.points.size for chunk in chunks]
        self._writer.add([self._first + chunk.number for chunk in chunks], sizes, joined)
        self._waiting.clear()
        self._bytes = 0
        self.kept += sum(sizes)
        return chunks, joined
