"""Runs whose workers write a Zarr store themselves, so no results pass through the driver.

Workers first store batches of chunks in parts. The chunks of a batch are scattered over a block of the grid, so one worker
assembles a shard from parts when its blocks are complete. Every few seconds unfinished shards are written as well.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
import time
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import failures, labelled, missing_value
from drivetrain_jax.runs.executor import Executor, Results
from drivetrain_jax.runs.growing import ReusedPoints
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.kernel import result_shapes
from drivetrain_jax.runs.pending import PENDING, with_pending
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.scene import result_variables
from drivetrain_jax.runs.shard_writer import PART, SECONDS, Assembly, Batch, ShardWriter, joined_part, points_of
from drivetrain_jax.runs.sink import Sink
from drivetrain_jax.runs.work import Progress, Report
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.files import flush_tree, move_folder
from drivetrain_jax.store.schema import Labelled
from drivetrain_jax.store.zarr_store import Shards

# Most chunks of a batch, and least number of batches where there are enough chunks, to give many workers work.
_MOST_CHUNKS, _FEWEST_BATCHES = 64, 8
# Shortest time in s between two writings of unfinished shards, and the smallest ratio of this time to that of the writing.
_INTERVAL, _RATIO = 2.0, 20.0


class ZarrSink(Sink):
    """The result as a Zarr store. Checksums cover its layout, and its points are not reused."""

    store = "zarr"

    def __init__(self, out: Path, parts: PartsFolder) -> None:
        self._out, self._parts = out, parts

    @property
    def held(self) -> Path:
        """Path of the present result: a run moves this store aside just before it moves the new one into place."""
        former = self._parts.path / zarr_store.FORMER
        return former if not self._out.exists() and former.exists() else self._out

    @property
    def written(self) -> int | None:
        """Time at which the present result was written, by the clock of its file system."""
        file = self.held / "zarr.json"
        return file.stat().st_mtime_ns if file.exists() else None

    def check_place(self) -> None:
        """Raise :class:`InputError` if there is something other than a store at the path."""
        if self.held.is_dir() and not (zarr_store.is_store(self.held) or zarr_store.was_store(self.held)):
            raise InputError(f"out = {str(self._out)!r}: is a folder; allowed is the path of a file")
        if self._out.is_file():
            allowed = "allowed for store = 'zarr' is a new path, or such a store"
            raise InputError(f"out = {str(self._out)!r}: is a file; {allowed}")

    def check_job(self, job: Job) -> None:
        """Raise :class:`InputError` for a job whose points are not solved one by one."""
        if not job.route.is_pointwise:
            allowed = "allowed is hdf5, or a scene with direct solves"
            raise InputError(f"store = 'zarr': not available for an atlas; {allowed}")

    def check_reuse(self) -> None:
        """Raise :class:`InputError`: workers read no other results."""
        raise InputError("reuse: given together with store = 'zarr'; allowed is one of them")

    def attribute(self, name: str) -> Any:
        """A global attribute of the present result."""
        return zarr_store.attributes(self.held).get(name)

    def digest(self) -> Any:
        """Digest of the present result; empty if the metadata of a store are damaged."""
        try:
            return super().digest()
        except InputError:
            if not zarr_store.was_store(self.held):
                raise
            return ""

    def damage(self) -> str:
        """The damaged parts of the present result; empty without damage."""
        return zarr_store.damage(self.held)

    def outcomes(self) -> np.ndarray:
        """Outcomes of all points of the present result."""
        return zarr_store.read_variable(self.held, OUTCOME.name)

    def write(
        self, job: Job, executor: Executor, report: Report | None, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Compute and assemble what is missing, and move the store into place."""
        run = _ShardedRun(job, self._parts, progress, report)
        with closing(executor):
            run.compute(executor)
        self._finish(run)

    def _finish(self, run: _ShardedRun) -> None:
        """Move the store into place. A former one is set aside first, because a directory cannot be replaced in one step.

        Raises :class:`ChunkError` if a shard that a worker reported as written is missing.
        """
        absent = int(np.sum(~zarr_store.done(run.path)))
        if absent:
            raise ChunkError(f"{absent} shards are missing; every worker must see the store at {str(run.path)!r}")
        final = run.template
        attrs = {**final.attrs, "wall_time_s": round(time.monotonic() - run.begin, 3)}
        zarr_store.seal(run.path, attrs, {OUTCOME.name: final.data[OUTCOME.name].attrs})
        flush_tree(run.path)
        former = self._parts.path / zarr_store.FORMER
        if self._out.exists():
            shutil.rmtree(former, ignore_errors=True)
            move_folder(self._out, former)
        move_folder(run.path, self._out)


class _ShardedRun:
    """Progress of batches and shards, known to the driver alone."""

    def __init__(self, job: Job, parts: PartsFolder, progress: Progress, report: Report | None) -> None:
        self._job, self._parts, self._progress, self._report = job, parts, progress, report
        self.path = parts.path / zarr_store.UNFINISHED
        self.begin = self._shown = time.monotonic()
        self._interval = _INTERVAL
        row = sum(values.nbytes for values in (e.values for e in self.template.data.values())) // max(job.total, 1)
        self._shards = Shards.of(job.grid.result_shape, job.grid.path_position, row)
        self._numbers = itertools.count()
        # For every chunk the position of its part among ``_names``, -1 without one.
        self._part_of, self._names = np.full(len(job.plan.costs), -1), list[str]()
        self._lost: list[np.ndarray] = []
        self._busy = set[int]()

    @cached_property
    def template(self) -> Labelled:
        """The result without its data."""
        job = self._job
        shapes = result_shapes(job.scene, job.grid, job.solvers[0])
        zeros = {}
        for v in result_variables(job.scene):
            own = shapes[v.name][len(shapes[v.name]) - len(v.dims) :]
            zeros[v.name] = np.broadcast_to(np.zeros((), v.dtype), (*job.grid.result_shape, *own))
        return labelled(job.scene, zeros, job.attrs)

    def compute(self, executor: Executor) -> None:
        """Compute the missing chunks, and write all shards."""
        self._create()
        self._reuse()
        job, progress = self._job, self._progress
        progress.computed += job.unsolvable
        progress.failed += job.unsolvable
        missing = np.flatnonzero(self._part_of < 0)
        # Number of missing chunks of each block, and shards with results that are not written yet.
        self._left = np.bincount(job.plan.block_of[missing], minlength=job.plan.blocks.count)
        marked = zarr_store.done(self.path)
        self._unwritten = {
            k
            for k in range(marked.size)
            if not marked[k] or self._left[self._blocks(k)].any() or zarr_store.read(self.path, self._shards, k) is None
        }
        self._changed = set(self._unwritten)
        progress.total_cost = float(job.plan.costs[missing].sum())
        self._report_progress()
        writer = ShardWriter(job, os.path.abspath(self._parts.out), self._shards)
        crashed = self._run(executor, writer, self._tasks(job.plan.ordered(missing)))
        self._one_by_one(executor, [chunk for batch in crashed for chunk in batch.chunks])
        while self._unwritten:
            self._run(executor, writer, self._due(final=True))

    def _create(self) -> None:
        """Create the store from the plan, unless a stopped run has left exactly that."""
        # Moved in one step, so the store at this path is always whole.
        half = self.path.with_name("half")
        shutil.rmtree(half, ignore_errors=True)
        fills = {v.name: missing_value(v) for v in result_variables(self._job.scene)} | {OUTCOME.name: PENDING}
        zarr_store.create(half, with_pending(self.template), self._shards, fills)
        if zarr_store.matches(self.path, half):
            shutil.rmtree(half)
            return
        shutil.rmtree(self.path, ignore_errors=True)
        flush_tree(half)
        move_folder(half, self.path)

    def _reuse(self) -> None:
        for part in self._parts.read(repair=True):
            if part.name is None or (self._part_of[part.chunks] >= 0).any():
                continue
            self._keep(part.chunks, part.name)
            outcome = part.results[OUTCOME.name]
            self._progress.reused += outcome.size
            self._progress.failed += failures(outcome)

    def _keep(self, chunks: np.ndarray, name: str) -> None:
        self._part_of[chunks] = len(self._names)
        self._names.append(name)

    def _tasks(self, numbers: np.ndarray) -> Iterator[Batch | Assembly]:
        """Batches in the order of computation, and shards as soon as they can be written."""
        size = max(1, min(_MOST_CHUNKS, len(numbers) // _FEWEST_BATCHES))
        for start in range(0, len(numbers), size):
            yield from self._due()
            # Created on demand: the points of all chunks may need more memory than the driver has.
            yield Batch(next(self._numbers), tuple(map(self._job.plan.chunk, numbers[start : start + size])))

    def _due(self, final: bool = False) -> Iterator[Assembly]:
        """Yield complete shards, at intervals also incomplete ones; if ``final``, all that are not written."""
        show = time.monotonic() - self._shown >= self._interval
        for shard in sorted((self._unwritten if final else self._changed) - self._busy):
            blocks, (begin, count) = self._blocks(shard), self._ranges[shard]
            whole = final or not self._left[blocks].any()
            if not (whole or show):
                continue
            self._changed.discard(shard)
            parts = np.unique(self._part_of[self._job.plan.chunks_of(blocks)])
            names = tuple(self._names[i] for i in parts if i >= 0)
            if whole or names:
                lost = np.concatenate([np.empty(0, int), *self._lost])
                inside = lost[(begin <= lost) & (lost < begin + count)]
                self._busy.add(shard)
                yield Assembly(next(self._numbers), shard, names, inside, whole)
        if show:
            self._shown = time.monotonic()

    def _run(self, executor: Executor, writer: ShardWriter, tasks: Iterator[Batch | Assembly]) -> list[Batch]:
        """Run ``tasks`` on the executor; returns the batches that crash every process."""
        crashed = []
        with closing(executor.run(writer, tasks)) as finished:
            for task, results in finished:
                if isinstance(task, Assembly):
                    self._assembled(task, results)
                elif results is None:
                    crashed.append(task)
                else:
                    self._keep(np.array([chunk.number for chunk in task.chunks]), results[PART].item())
                    self._count(task.chunks, results[OUTCOME.name])
        return crashed

    def _assembled(self, task: Assembly, results: Results | None) -> None:
        if results is None:
            raise RetryableError(f"processes that write shard {task.shard} crash")
        self._interval = max(self._interval, _RATIO * results[SECONDS].item())
        self._busy.discard(task.shard)
        if task.whole:
            self._unwritten.discard(task.shard)

    def _one_by_one(self, executor: Executor, chunks: list[Chunk]) -> None:
        """Compute chunks of batches that crash their workers one by one, so only the crashing ones are lost."""
        with closing(executor.run(self._job, chunks)) as finished:
            for chunk, results in finished:
                if results is None:
                    self._lost.append(chunk.points)
                    line = self._job.grid.path_length
                    self._count([chunk], np.full(chunk.points.size * line, Outcome.LOST, OUTCOME.dtype))
                else:
                    self._keep(np.array([chunk.number]), self._parts.write(joined_part([chunk], [results], 0.0)))
                    self._count([chunk], results[OUTCOME.name])

    def _count(self, chunks: Sequence[Chunk], outcome: np.ndarray) -> None:
        plan, numbers = self._job.plan, np.array([chunk.number for chunk in chunks])
        blocks = plan.block_of[numbers]
        np.subtract.at(self._left, blocks, 1)
        for block in np.unique(blocks):
            first = bisect_right(self._ranges, (block * plan.block_size, math.inf)) - 1
            self._changed |= set(range(first, bisect_left(self._ranges, ((block + 1) * plan.block_size, 0))))
        self._progress.cost += float(plan.costs[numbers].sum())
        self._progress.computed += outcome.size
        self._progress.failed += failures(outcome)
        self._report_progress()

    def _blocks(self, shard: int) -> slice:
        """The blocks of the plan that a shard overlaps."""
        (begin, count), size = self._ranges[shard], self._job.plan.block_size
        return slice(begin // size, (begin + count - 1) // size + 1)

    @cached_property
    def _ranges(self) -> list[tuple[int, int]]:
        """First point and number of points of every shard, rising."""
        return [points_of(self._job, self._shards.place(k)) for k in range(self._shards.count)]

    def _report_progress(self) -> None:
        if self._report:
            self._report(self._progress)
