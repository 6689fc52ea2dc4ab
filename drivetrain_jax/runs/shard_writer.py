"""Code of the workers that write a Zarr store: they plan blocks, store finished chunks in parts, and assemble shards."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import RetryableError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import failures, inaccurate, missing_value
from drivetrain_jax.runs.executor import Results
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.pending import PENDING
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.scene import result_variables
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.chunks import Part, PartsFolder
from drivetrain_jax.store.shards import Place

# Numbers that a block reserves for its chunks, more than it can have.
NUMBERS = 1 << 20
# Names of the results of each share.
FOUND = ("next", "chunks", "part", "written", "points", "failed", "inaccurate")


@dataclass(frozen=True)
class Share:
    """The chunks ``start``, ``start + step``, ... of a block of the plan, without those in ``finished``.

    ``points`` is an estimate of their number of results.
    """

    block: int
    start: int
    step: int
    points: int
    finished: Collection[int] = ()


@dataclass(frozen=True)
class Shares:
    """Shares that a worker computes one after the other. After ``seconds`` it stores what is finished, and returns."""

    number: int
    shares: tuple[Share, ...]
    seconds: float


@dataclass(frozen=True)
class Assembly:
    """A shard to assemble from ``parts``, and its ``lost`` points. It is unfinished unless ``whole``."""

    number: int
    shard: int
    parts: tuple[str, ...]
    lost: np.ndarray
    whole: bool


@dataclass(frozen=True)
class ShardWriter:
    """Computes shares and assembles shards of the result ``out``, which every worker must see under this name.

    A block of the plan is a shard of the store. Only counts and names of files return to the driver.
    """

    job: Job
    out: str

    @property
    def digest(self) -> str:
        """Digest of job and path: a worker keeps the writer for other runs of the same job."""
        return f"{self.job.digest} {self.out}"

    def compute(self, task: Shares | Assembly, /) -> Results:
        """Compute chunks of shares and store them in parts, or write a shard."""
        return self._solve(task) if isinstance(task, Shares) else self._assemble(task)

    def _solve(self, task: Shares) -> Results:
        """The results ``FOUND`` for each of the first shares, and the ``seconds`` of all."""
        begin, found = time.monotonic(), []
        for share in task.shares:
            if found and time.monotonic() - begin > task.seconds:
                break
            found.append(self._solve_share(share, begin + task.seconds))
        joined = {name: np.array(column) for name, column in zip(FOUND, zip(*found, strict=True), strict=True)}
        return joined | {"seconds": np.array(time.monotonic() - begin)}

    def _solve_share(self, share: Share, end: float) -> tuple[int, int, str, bool, int, int, int]:
        """Next chunk, number of chunks of the block, name of the part (empty without one), ``written``, counts of points.

        A share that is a whole block is ``written``: its shard is in the store.
        """
        begin, plan = time.monotonic(), self.job.block_plan(share.block)
        chunks, results, position = [], [], share.start
        while position < len(plan.costs) and not (results and time.monotonic() > end):
            if position not in share.finished:
                chunks.append(chunk_of(self.job, share.block, position))
                results.append(self.job.compute(chunks[-1]))
            position += share.step
        part = joined_part(chunks, results, time.monotonic() - begin) if chunks else None
        alone = (share.start, share.step, len(share.finished)) == (0, 1, 0)
        if written := alone and position >= len(plan.costs):
            self._write(share.block, [part] if part else [], np.empty(0, int), whole=True)
        # A resumed run counts the points of a written shard from the store.
        name = PartsFolder(Path(self.out)).write(part) if part and not written else ""
        outcome = part.results[OUTCOME.name] if part else np.empty(0, OUTCOME.dtype)
        unsolvable = count_unsolvable(self.job, share)
        counts = outcome.size + unsolvable, failures(outcome) + unsolvable, inaccurate(outcome)
        return position, len(plan.costs), name, written, *counts

    def _assemble(self, task: Assembly) -> Results:
        begin, parts = time.monotonic(), PartsFolder(Path(self.out))
        self._write(task.shard, map(parts.read_one, task.parts), task.lost, task.whole)
        return {"seconds": np.array(time.monotonic() - begin)}

    def _write(self, shard: int, parts: Iterable[Part | None], lost: np.ndarray, whole: bool) -> None:
        """Write a shard from parts of its block, with the outcome "pending" for missing points unless it is ``whole``."""
        grid, store = self.job.grid, PartsFolder(Path(self.out)).path / zarr_store.UNFINISHED
        place, (begin, stop) = grid.shards.place(shard), grid.block(shard)
        line = () if grid.path is None else (grid.path_length,)
        rows, shapes = {}, zarr_store.result_shapes(store)
        for variable in result_variables(self.job.scene):
            own = shapes[variable.name][len(grid.result_shape) :]
            blank = missing_value(variable) if whole or variable.name != OUTCOME.name else PENDING
            rows[variable.name] = np.full((stop - begin, *line, *own), blank, variable.dtype)
        for part in parts:
            if part is None or part.points is None:
                raise RetryableError("one of the parts is damaged")
            for name, values in part.results.items():
                rows[name][part.points - begin] = values
        rows[OUTCOME.name][lost - begin] = Outcome.LOST
        arrays = {name: _on_grid(self.job, place, values) for name, values in rows.items()}
        zarr_store.write(store, place, arrays, shard if whole else None)


def chunk_of(job: Job, block: int, position: int) -> Chunk:
    """A chunk of a block, with a number that no other block uses."""
    return replace(job.block_plan(block).chunk(position), number=block * NUMBERS + position)


def block_of(part: Part) -> int:
    """The block of the chunks of a part."""
    return int(part.chunks[0]) // NUMBERS


def written_shards(job: Job, store: Path) -> Iterator[tuple[int, np.ndarray, Results]]:
    """Yield number, points and results of the intact shards of a store that is not finished."""
    for shard in np.flatnonzero(zarr_store.done(store)).tolist():
        found = zarr_store.read(store, job.grid.shards, shard)
        if found is not None:
            results = {name: _off_grid(job, job.grid.shards.place(shard), values) for name, values in found.items()}
            yield shard, np.arange(*job.grid.block(shard)), results


def count_unsolvable(job: Job, share: Share) -> int:
    """Number of results of a block that no solver can compute; they belong to its first share."""
    first, stop = job.grid.block(share.block)
    return 0 if share.start else (stop - first - job.block_plan(share.block).size) * job.grid.path_length


def joined_part(chunks: Sequence[Chunk], results: list[Results], seconds: float) -> Part:
    """The part that stores the results of ``chunks``."""
    joined = {name: np.concatenate([found[name] for found in results]) for name in results[0]}
    points = [chunk.points for chunk in chunks]
    return Part([c.number for c in chunks], [p.size for p in points], joined, seconds, np.concatenate(points))


def _on_grid(job: Job, place: Place, values: np.ndarray) -> np.ndarray:
    """Results of the points of a block in the layout of the result."""
    grid, position = job.grid, job.grid.path_position
    if grid.path_is_fixed:
        values = values[:, 0]
    block = [part.stop - part.start for axis, part in enumerate(place) if axis != position]
    values = values.reshape((*block, *values.shape[1:]))
    return values if position is None else np.moveaxis(values, len(block), position)


def _off_grid(job: Job, place: Place, values: np.ndarray) -> np.ndarray:
    """The inverse of :func:`_on_grid`."""
    grid, position = job.grid, job.grid.path_position
    block = [axis for axis in range(len(place)) if axis != position]
    if position is not None:
        values = np.moveaxis(values, position, len(block))
    values = values.reshape(-1, *values.shape[len(block) :])
    return values[:, None] if grid.path_is_fixed else values
