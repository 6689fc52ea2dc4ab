"""Find the blocks of a run among those of an earlier one, or compute and keep them."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from drivetrain_jax._errors import RetryableError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import ResultBuffer, labelled
from drivetrain_jax.runs.executors import Executor
from drivetrain_jax.runs.job import Block, Job, Results
from drivetrain_jax.runs.reuse import NO_REUSE, ReusedPoints
from drivetrain_jax.runs.stores import BlockStore
from drivetrain_jax.store.consolidate import ResultFile
from drivetrain_jax.store.schema import Labelled


@dataclass
class Progress:
    """Progress of a run: counts of results of this ``kind``; ``note`` is a remark.

    ``failed`` points have no value, ``inaccurate`` ones a value whose error exceeds the target. ``cost`` of ``total_cost``
    points are computed, those of unfinished blocks included.
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
        self.failed += int(np.count_nonzero(outcome >= FIRST_FAILURE))
        self.inaccurate += int(np.count_nonzero(outcome == Outcome.TOLERANCE_NOT_MET))

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


class Work:
    """Runs blocks on the executor and reports progress. Leaving the context ends the workers.

    With a ``store`` finished blocks are kept there, and blocks that it has are not computed again.
    """

    def __init__(self, executor: Executor, report: Report | None = None, store: BlockStore | None = None) -> None:
        self.executor, self.report, self.store = executor, report, store
        self._begin = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Time since the start in s."""
        return round(time.monotonic() - self._begin, 3)

    def __enter__(self) -> Work:
        return self

    def __exit__(self, *_: object) -> None:
        self.executor.close()

    def do(
        self,
        job: Job,
        receiver: Receiver | None,
        progress: Progress,
        first: int = 0,
        points: np.ndarray | None = None,
    ) -> None:
        """Compute or reuse all blocks of ``job``, or of some of its ``points``, and hand their results to ``receiver``.

        Without a receiver they are only stored. Numbers in the store start at ``first``.
        """
        done = set[int]()
        length, left = job.grid.path_length, job.grid.size if points is None else len(points)
        for block, results in self._stored(job, first, points, done):
            done.add(block.number)
            left -= len(results[OUTCOME.name])
            if receiver is not None:
                receiver.fill(job.points(block), results)
            progress.reused += results[OUTCOME.name].size
            progress.count(results[OUTCOME.name])
        progress.cost, progress.total_cost, computed = 0.0, float(left * length), 0
        self._report(progress)

        def tick(count: int) -> None:
            progress.cost += count * length
            self._report(progress)

        missing = (block for block in job.blocks(points) if block.number not in done)
        try:
            # Closed on exit: after an interrupt nothing further starts.
            with closing(self.executor.run(job, missing, self.store, first, tick)) as finished:
                for block, results in finished:
                    results = self._received(job, block, results, first, receiver)
                    done.add(block.number)
                    outcome = results[OUTCOME.name]
                    progress.count(outcome)
                    progress.computed += outcome.size
                    computed += outcome.size
                    progress.cost = max(progress.cost, computed)
                    self._report(progress)
            if computed < progress.total_cost:
                raise RetryableError("some blocks returned no result")
        except KeyboardInterrupt:
            # It may come between storing a block and counting it.
            for _, results in self._stored(job, first, points, done):
                progress.computed += results[OUTCOME.name].size
                progress.count(results[OUTCOME.name])
            raise

    def _received(
        self, job: Job, block: Block, results: Results | None, first: int, receiver: Receiver | None
    ) -> Results:
        """The results of a computed block, handed to ``receiver``; those of a lost one have no values."""
        if results is None:
            results = job.joined(block, (), ())
            results[OUTCOME.name][...] = Outcome.LOST
            if self.store is not None:
                self.store.write(first + block.number, results)
        if receiver is not None:
            if len(results) == 1 and self.store is not None:
                # A worker has stored the block.
                results = self.store.read(first + block.number)
                if results is None:
                    where = f"every worker must see the folder {self.store.place!r}"
                    raise RetryableError(f"block {block.number} is missing after a worker has stored it; {where}")
            receiver.fill(job.points(block), results)
        return results

    def _stored(
        self, job: Job, first: int, points: np.ndarray | None, without: Container[int]
    ) -> Iterator[tuple[Block, Results]]:
        """Yield the intact stored blocks ``without`` these numbers."""
        stored = set(self.store.numbers()) if self.store is not None else set()
        for block in job.blocks(points) if stored else ():
            if self.store is None or first + block.number not in stored or block.number in without:
                continue
            results = self.store.read(first + block.number)
            if results is not None and len(results[OUTCOME.name]) == len(job.points(block)):
                yield block, results

    def _report(self, progress: Progress) -> None:
        if self.report:
            self.report(progress)


class Route:
    """The way from a job to its result, chosen once by :func:`~drivetrain_jax.runs.resolve.resolve`: solves every point."""

    # Name of the route; a part of the digest, because the route affects the bits.
    name = "direct solves"
    # True if points are solved one by one, so that partial results can be opened, reused and written by workers.
    is_pointwise = True

    def fill(
        self, job: Job, buffer: ResultBuffer, work: Work, progress: Progress, reused: ReusedPoints
    ) -> dict[str, str | int]:
        """Copy the points ``reused`` and solve the others; returns attributes of the result."""
        for points, results in reused.blocks():
            buffer.fill(points, results)
            progress.reused += results[OUTCOME.name].size
            progress.count(results[OUTCOME.name])
        work.do(job, buffer, progress, points=reused.others(job.grid.size))
        return reused.attrs

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The result."""
        buffer = ResultBuffer(job.scene, job.grid)
        extra = self.fill(job, buffer, work, progress, NO_REUSE)
        return labelled(job.scene, buffer.lay_out(), job.attrs | extra)

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result from the points ``reused``, the stored blocks, and newly computed ones."""
        with ResultFile(temporary) as file:
            buffer = ResultBuffer(job.scene, job.grid, lambda blank: file.lay_out(blank.with_attrs(**job.attrs)))
            extra = self.fill(job, buffer, work, progress, reused)
            buffer.lay_out()
            file.finish(out, wall_time_s=work.elapsed, **extra)


DIRECT = Route()
