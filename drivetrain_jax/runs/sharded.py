"""Runs whose workers write whole shards of a Zarr store themselves, so no results pass through the driver."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import failures, missing_value, result_attrs
from drivetrain_jax.runs.executor import Executor
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.kernel import result_shapes
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.scene import result_variables
from drivetrain_jax.runs.work import Progress, Report
from drivetrain_jax.store import shards
from drivetrain_jax.store.chunks import PartsFolder


@dataclass(frozen=True)
class Shard:
    """Shard ``index`` of ``group``, with the chunks of these ``numbers``."""

    number: int
    group: shards.Group
    index: int
    numbers: range


@dataclass(frozen=True)
class Task:
    """A shard and its chunks: with the scene, everything that a worker needs."""

    number: int
    shard: Shard
    chunks: tuple[Chunk, ...]

    @classmethod
    def of(cls, job: Job, shard: Shard) -> Task:
        """The task of computing ``shard``."""
        return cls(shard.number, shard, tuple(map(job.plan.chunk, shard.numbers)))


@dataclass(frozen=True)
class ShardWriter:
    """Computes shards of the store at ``path``, which every worker must see under this name."""

    job: Job
    path: str

    @property
    def digest(self) -> str:
        """Digest of the job."""
        return self.job.digest

    def compute(self, task: Task) -> Mapping[str, np.ndarray]:
        """Compute and write a shard; returns only the outcomes."""
        return _write(self.path, self.job, task, [self.job.compute(chunk) for chunk in task.chunks])


def check(job: Job) -> None:
    """Raise :class:`InputError` for a scene without points to compute one by one."""
    if not job.route.is_pointwise:
        raise InputError("store = 'zarr': not available for an atlas; allowed is hdf5, or a scene with direct solves")


def groups_of(job: Job) -> list[shards.Group]:
    """One group for each solver of the plan."""
    return [shards.Group(f"solver_{g.index}", len(g.efforts), g.chunk) for g in job.plan.groups]


def compute(
    job: Job, out: Path, parts: PartsFolder, progress: Progress, executor: Executor, report: Report | None
) -> None:
    """Fill the store that grows among ``parts``, and move it to ``out`` when it is complete."""
    path, begin = parts.path / shards.UNFINISHED, time.monotonic()
    progress.computed += job.hopeless
    progress.failed += job.hopeless
    if not shards.is_store(path):
        _create(job, path)
    missing = list(_missing(job, path, progress))
    costs = job.plan.costs
    progress.total_cost = float(sum(costs[shard.numbers].sum() for shard in missing))
    _tell(report, progress)
    writer = ShardWriter(job, os.path.abspath(path))
    # Created on demand: the points of all shards may need more memory than the driver has.
    tasks = map(partial(Task.of, job), missing)

    def count(task: Task, outcome: np.ndarray) -> None:
        progress.computed += outcome.size
        progress.failed += failures(outcome)
        progress.cost += float(costs[task.shard.numbers].sum())
        _tell(report, progress)

    with closing(executor):
        crashed = []
        with closing(executor.run(writer, tasks)) as finished:
            for task, results in finished:
                if results is None:
                    crashed.append(task)
                else:
                    count(task, results[OUTCOME.name])
        for task in crashed:
            count(task, _one_by_one(job, executor, path, task))
    _finish(job, path, out, parts, round(time.monotonic() - begin, 3))


def _tell(report: Report | None, progress: Progress) -> None:
    if report:
        report(progress)


def _create(job: Job, path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    # Moved in one step, so the store at this path is always whole.
    half = path.with_name("half")
    shutil.rmtree(half, ignore_errors=True)
    shards.create(half, groups_of(job), _fields(job), _attrs(job))
    half.rename(path)


def _fields(job: Job) -> list[shards.Field]:
    if not job.plan.groups:
        return []
    shapes = result_shapes(job.scene, job.grid, job.solvers[job.plan.groups[0].index])
    return [shards.Field(v.name, v.dtype, shapes[v.name]) for v in result_variables(job.scene)]


def _attrs(job: Job) -> dict[str, str | int]:
    """Attributes that identify the result and its points; points that no solver can compute are in no shard."""
    whose = {"digest": job.digest, **job.numerics_attrs}
    held = {shards.GROUPS: shards.describe(groups_of(job)), shards.HELD: job.plan.size}
    return result_attrs(job.scene) | whose | held


def all_shards(job: Job) -> Iterator[Shard]:
    """The plan in shards."""
    number = first = 0
    for group in groups_of(job):
        for index in range(group.shards):
            start = index * group.per_shard
            yield Shard(number, group, index, range(first + start, first + min(start + group.per_shard, group.count)))
            number += 1
        first += group.count


def _missing(job: Job, path: Path, progress: Progress) -> Iterator[Shard]:
    """Shards that are missing or damaged; the others count as reused."""
    for shard, present in stored(job, path):
        if present is None:
            yield shard
            continue
        outcome = shards.without_padding(present)[1][OUTCOME.name]
        progress.reused += outcome.size
        progress.failed += failures(outcome)


def stored(job: Job, path: Path) -> Iterator[tuple[Shard, Mapping[str, np.ndarray] | None]]:
    """Yield all shards with their contents in the store at ``path``: None if one is missing or damaged.

    Raises :class:`InputError` if the store itself is damaged.
    """
    shards.check_layout(path, groups_of(job), _fields(job))
    names = [shards.POINT, *(variable.name for variable in result_variables(job.scene))]
    marked = {group.name: shards.done(path, group) for group in groups_of(job)}
    for shard in all_shards(job):
        is_done = marked[shard.group.name][shard.index]
        yield shard, shards.read(path, shard.group, shard.index, names) if is_done else None


def _write(path: str | Path, job: Job, task: Task, results: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Write the results of all chunks of a shard, padded to whole chunks; returns the outcomes."""
    shard, width = task.shard, task.shard.group.width
    arrays = {shards.POINT: np.concatenate([_padded(c.points, width, -1) for c in task.chunks])}
    for variable in result_variables(job.scene):
        blank = missing_value(variable)
        arrays[variable.name] = np.concatenate([_padded(r[variable.name], width, blank) for r in results])
    shards.write(Path(path), shard.group, shard.index, arrays)
    return {OUTCOME.name: arrays[OUTCOME.name][arrays[shards.POINT] >= 0]}


def _padded(values: np.ndarray, count: int, blank: float) -> np.ndarray:
    full = np.full((count, *values.shape[1:]), blank, values.dtype)
    full[: len(values)] = values
    return full


def _one_by_one(job: Job, executor: Executor, path: Path, task: Task) -> np.ndarray:
    """Compute the chunks of a shard that crashes its workers one by one, so only the crashing chunk is lost; the driver
    writes."""
    found = {chunk.number: results for chunk, results in executor.run(job, task.chunks)}
    shapes = result_shapes(job.scene, job.grid, job.solvers[task.chunks[0].solver])
    lost = {
        v.name: np.full((task.shard.group.width, *shapes[v.name]), missing_value(v), v.dtype)
        for v in result_variables(job.scene)
    }
    lost[OUTCOME.name][...] = Outcome.LOST
    results = [found[c.number] or {n: a[: c.points.size] for n, a in lost.items()} for c in task.chunks]
    return _write(path, job, task, results)[OUTCOME.name]


def _finish(job: Job, path: Path, out: Path, parts: PartsFolder, seconds: float) -> None:
    """Move the store into place. A former one is set aside first, because a directory cannot be replaced in one step.

    Raises :class:`ChunkError` if a shard that a worker reported as written is missing.
    """
    absent = sum(int(np.sum(~shards.done(path, group))) for group in groups_of(job))
    if absent:
        raise ChunkError(f"{absent} shards are missing; every worker must see the store at {str(path)!r}")
    # Written again, because the attributes of a growing store have no checksum.
    shards.seal(path, _attrs(job) | {"wall_time_s": seconds})
    former = parts.path / shards.FORMER
    if out.exists():
        shutil.rmtree(former, ignore_errors=True)
        out.rename(former)
    path.rename(out)
