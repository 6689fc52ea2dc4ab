"""Runs whose workers write a Zarr store themselves, so no results pass through the driver.

A worker plans a block of points by itself, and stores the chunks that it computes within some seconds in a part. The driver
divides the remaining chunks of the block among more workers. The chunks of a part are scattered over the block, so one
worker assembles the shard of a block from its parts. Every few seconds unfinished shards are written as well.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import cached_property

import numpy as np

from drivetrain_jax._errors import RetryableError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import dimension_sizes, labelled, missing_value
from drivetrain_jax.runs.executor import Executor, Results
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.pending import PENDING, with_pending
from drivetrain_jax.runs.scene import result_variables
from drivetrain_jax.runs.shard_writer import (
    FOUND,
    NUMBERS,
    Assembly,
    ShardWriter,
    Share,
    Shares,
    block_of,
    chunk_of,
    count_unsolvable,
    joined_part,
    written_shards,
)
from drivetrain_jax.runs.work import Progress, Report
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.files import flush_tree, move_folder
from drivetrain_jax.store.schema import Labelled

# Least number of shares at the start, to give several workers work, and most shares of the remaining chunks of one share.
_FEWEST_SHARES, _MOST_PIECES = 8, 64
# Shortest duration of a task in s, and most tasks per second (two for each worker are in flight).
SECONDS, PER_SECOND = 2.0, 200.0
# Shortest time in s between two writings of unfinished shards, and the smallest ratio of this time to that of the writing.
_INTERVAL, _RATIO = 2.0, 20.0


class ShardedRun:
    """Progress of shares and shards, known to the driver alone. A block of the plan is a shard of the store."""

    def __init__(self, job: Job, parts: PartsFolder, progress: Progress, report: Report | None) -> None:
        self._job, self._parts, self._progress, self._report = job, parts, progress, report
        self.path = parts.path / zarr_store.UNFINISHED
        self.begin = self._shown = time.monotonic()
        self._interval = _INTERVAL
        self._numbers = itertools.count()
        # Blocks that are not begun, shares that wait for a worker, and shares one of which has crashed its worker.
        self._blocks, self._waiting, self._suspects = deque[int](), deque[Share](), deque[Share]()
        self._running, self._seconds_per_point = 0, math.inf
        # By block, if not 0 or empty: shares that are not finished; finished chunks of a stopped run; names of parts.
        self._open = defaultdict[int, int](int)
        self._finished = defaultdict[int, set[int]](set)
        self._names = defaultdict[int, list[str]](list)
        self._lost = defaultdict[int, list[np.ndarray]](list)
        # Blocks without open shares, blocks with new parts, those of them to write now, and those that a worker is writing.
        self._complete, self._changed, self._due, self._busy = set[int](), set[int](), set[int](), set[int]()

    @cached_property
    def template(self) -> Labelled:
        """The result without its data."""
        job, zeros = self._job, {}
        sizes = dimension_sizes(job.scene, job.grid)
        for v in result_variables(job.scene):
            shape = (*job.grid.result_shape, *(sizes[dim] for dim in v.dims))
            zeros[v.name] = np.broadcast_to(np.zeros((), v.dtype), shape)
        return labelled(job.scene, zeros, job.attrs)

    def compute(self, executor: Executor) -> None:
        """Compute the missing chunks, and write all shards."""
        self.create()
        written = self._reuse_shards()
        self._reuse_parts(written)
        self._blocks.extend(np.flatnonzero(~written).tolist())
        progress = self._progress
        progress.total_cost = float(progress.total - progress.reused)
        self._report_progress()
        writer = ShardWriter(self._job, os.path.abspath(self._parts.out))
        while crashed := self._run(executor, writer):
            for share in crashed:
                self._one_by_one(executor, share)

    def create(self) -> None:
        """Create the store from the plan, unless a stopped run has left exactly that."""
        # Moved in one step, so the store at this path is always whole.
        half = self.path.with_name("half")
        shutil.rmtree(half, ignore_errors=True)
        fills = {v.name: missing_value(v) for v in result_variables(self._job.scene)} | {OUTCOME.name: PENDING}
        zarr_store.create(half, with_pending(self.template), self._job.grid.shards, fills)
        if zarr_store.matches(self.path, half):
            shutil.rmtree(half)
            return
        shutil.rmtree(self.path, ignore_errors=True)
        flush_tree(half)
        move_folder(half, self.path)

    def _reuse_shards(self) -> np.ndarray:
        """Count the intact shards of a stopped run; returns their flags."""
        written = np.zeros(self._job.grid.shards.count, bool)
        for shard, _, results in written_shards(self._job, self.path):
            written[shard] = True
            self._progress.reused += results[OUTCOME.name].size
            self._progress.count(results[OUTCOME.name])
        return written

    def _reuse_parts(self, written: np.ndarray) -> None:
        """Count the chunks of a stopped run in blocks whose shards are not ``written``."""
        for part in self._parts.read(repair=True):
            block, chunks = block_of(part), set((part.chunks % NUMBERS).tolist())
            # A worker that died after writing a part leaves chunks that another one computes again.
            if part.name is None or written[block] or chunks & self._finished[block]:
                continue
            self._finished[block] |= chunks
            self._names[block].append(part.name)
            outcome = part.results[OUTCOME.name]
            self._progress.reused += outcome.size
            self._progress.count(outcome)

    def __iter__(self) -> Iterator[Shares | Assembly]:
        return self

    def __next__(self) -> Shares | Assembly:
        """The next task. Results of running tasks may make more, so a later call may return one after StopIteration."""
        task = self._shard_task() or self._shares_task()
        if task is None:
            raise StopIteration
        return task

    def _shares_task(self) -> Shares | None:
        """Shares of about :attr:`_seconds` of work, fewer towards the end."""
        if self._suspects:
            return self._task(self._suspects.popleft())
        most = (len(self._waiting) + len(self._blocks)) // max(_FEWEST_SHARES, 2 * self._running)
        shares, points = list[Share](), self._seconds / self._seconds_per_point
        while self._fill() and (not shares or (points > 0 and len(shares) < most)):
            shares.append(self._waiting.popleft())
            points -= shares[-1].points
        return self._task(*shares) if shares else None

    def _task(self, *shares: Share) -> Shares:
        self._running += 1
        return Shares(next(self._numbers), shares, self._seconds)

    def _fill(self) -> bool:
        """Begin a block if no share waits; returns whether one waits."""
        if not self._waiting and self._blocks:
            block = self._blocks.popleft()
            first, stop = self._job.grid.block(block)
            points = (stop - first) * self._job.grid.path_length
            whole = Share(block, 0, 1, points, frozenset(self._finished.pop(block, ())))
            self._divide(whole, 0, max(1, min(_FEWEST_SHARES // self._job.grid.shards.count, stop - first)))
        return bool(self._waiting)

    @property
    def _seconds(self) -> float:
        """Duration of a task: with many workers so long that the scheduler keeps up."""
        return max(SECONDS, self._running / PER_SECOND)

    def _divide(self, share: Share, begin: int, count: int) -> None:
        """Queue ``count`` shares of the chunks of ``share`` from ``begin`` on."""
        self._open[share.block] += count
        for piece in range(count):
            start, step = begin + piece * share.step, count * share.step
            self._waiting.append(replace(share, start=start, step=step, points=-(-share.points // count)))

    def _shard_task(self) -> Assembly | None:
        """A complete shard, at intervals also one that is not."""
        if time.monotonic() - self._shown >= self._interval:
            self._shown, self._due, self._changed = time.monotonic(), self._due | self._changed, set()
        for blocks in (self._complete, self._due):
            # Two workers must not write the same shard.
            if (shard := next((block for block in blocks if block not in self._busy), None)) is not None:
                return self._assembly(shard, whole=blocks is self._complete)
        return None

    def _assembly(self, shard: int, whole: bool) -> Assembly:
        for blocks in (self._changed, self._due, self._complete):
            blocks.discard(shard)
        self._busy.add(shard)
        lost = np.concatenate([np.empty(0, int), *self._lost[shard]])
        return Assembly(next(self._numbers), shard, tuple(self._names[shard]), lost, whole)

    def _run(self, executor: Executor, writer: ShardWriter) -> list[Share]:
        """Run all tasks on the executor; returns the shares that crash every process."""
        crashed = []
        with closing(executor.run(writer, self)) as finished:
            for task, results in finished:
                if isinstance(task, Assembly):
                    self._assembled(task, results)
                    continue
                self._running -= 1
                if results is not None:
                    self._computed(task, results)
                elif len(task.shares) > 1:
                    self._suspects.extend(task.shares)
                else:
                    crashed += task.shares
        return crashed

    def _computed(self, task: Shares, results: Results) -> None:
        """Count the chunks that a worker has computed, and queue the remaining ones."""
        rows = list(zip(*(results[name].tolist() for name in FOUND), strict=True))
        if points := int(results["points"].sum()):
            self._seconds_per_point = float(results["seconds"]) / points
        for share, (begin, chunks, part, written, *counts) in zip(task.shares, rows, strict=False):
            if part:
                self._names[share.block].append(part)
                self._changed.add(share.block)
            if left := len(range(begin, chunks, share.step)):
                points = share.points * left // len(range(share.start, chunks, share.step))
                pieces = round(points * self._seconds_per_point / self._seconds)
                self._divide(replace(share, points=points), begin, min(left, max(1, pieces), _MOST_PIECES))
            self._count(*counts)
            self._close(share, written=bool(written))
        self._waiting.extendleft(reversed(task.shares[len(rows) :]))

    def _close(self, share: Share, written: bool = False) -> None:
        """Count a finished share. The last one of a block completes its shard."""
        self._open[share.block] -= 1
        if self._open[share.block]:
            return
        del self._open[share.block]
        if written:
            self._forget(share.block)
        else:
            self._complete.add(share.block)

    def _assembled(self, task: Assembly, results: Results | None) -> None:
        if results is None:
            raise RetryableError(f"processes that write shard {task.shard} crash")
        self._interval = max(self._interval, _RATIO * float(results["seconds"]))
        self._busy.discard(task.shard)
        if task.whole:
            self._forget(task.shard)

    def _forget(self, block: int) -> None:
        """Release what is known of a block whose shard is written."""
        for known in (self._names, self._lost):
            known.pop(block, None)
        for blocks in (self._changed, self._due):
            blocks.discard(block)

    def _one_by_one(self, executor: Executor, share: Share) -> None:
        """Compute the chunks of a share that crashes its workers one by one, so only the crashing ones are lost."""
        job, block = self._job, share.block
        positions = range(share.start, len(job.block_plan(block).costs), share.step)
        chunks = (chunk_of(job, block, position) for position in positions if position not in share.finished)
        with closing(executor.run(job, chunks)) as finished:
            for chunk, results in finished:
                if results is None:
                    self._lost[block].append(chunk.points)
                    lost = chunk.points.size * job.grid.path_length
                    self._count(lost, lost)
                else:
                    self._names[block].append(self._parts.write(joined_part([chunk], [results], 0.0)))
                    self._progress.count(results[OUTCOME.name])
                    self._count(results[OUTCOME.name].size)
        unsolvable = count_unsolvable(job, share)
        self._count(unsolvable, unsolvable)
        self._close(share)

    def _count(self, points: int, failed: int = 0, inaccurate: int = 0) -> None:
        self._progress.cost += points
        self._progress.computed += points
        self._progress.failed += failed
        self._progress.inaccurate += inaccurate
        self._report_progress()

    def _report_progress(self) -> None:
        if self._report:
            self._report(self._progress)
