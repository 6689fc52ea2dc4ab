"""Code of the workers that write a Zarr store: they store batches of chunks in parts, and assemble shards from parts."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import RetryableError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import missing_value
from drivetrain_jax.runs.executor import Results
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.pending import PENDING
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.scene import result_variables
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.chunks import Part, PartsFolder
from drivetrain_jax.store.zarr_store import Shards

# Names of results of a task: the name of the part of a batch, and the seconds that writing a shard took.
PART, SECONDS = "part", "seconds"


@dataclass(frozen=True)
class Batch:
    """Chunks that one worker computes and stores together."""

    number: int
    chunks: tuple[Chunk, ...]


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
    """Computes batches and assembles shards of the result ``out``, which every worker must see under this name."""

    job: Job
    out: str
    shards: Shards

    @property
    def digest(self) -> str:
        """Digest of the job."""
        return self.job.digest

    def compute(self, task: Batch | Assembly, /) -> Results:
        """Store a batch in a part, and return its outcomes and the name of the part; or write a shard."""
        return self._solve(task) if isinstance(task, Batch) else self._assemble(task)

    def _solve(self, batch: Batch) -> Results:
        begin = time.monotonic()
        results = [self.job.compute(chunk) for chunk in batch.chunks]
        part = joined_part(batch.chunks, results, time.monotonic() - begin)
        name = PartsFolder(Path(self.out)).write(part)
        return {OUTCOME.name: part.results[OUTCOME.name], PART: np.array(name)}

    def _assemble(self, task: Assembly) -> Results:
        parts, grid = PartsFolder(Path(self.out)), self.job.grid
        store, place = parts.path / zarr_store.UNFINISHED, self.shards.place(task.shard)
        started, (begin, count) = time.monotonic(), points_of(self.job, place)
        line = () if grid.path is None else (grid.path_length,)
        rows = {}
        for variable in result_variables(self.job.scene):
            own = zarr_store.result_shapes(store)[variable.name][len(self.shards.shape) :]
            blank = missing_value(variable) if task.whole or variable.name != OUTCOME.name else PENDING
            rows[variable.name] = np.full((count, *line, *own), blank, variable.dtype)
        for name in task.parts:
            part = parts.read_one(name)
            if part is None or part.points is None:
                raise RetryableError(f"{name} among the parts is damaged")
            inside = (begin <= part.points) & (part.points < begin + count)
            for name, values in part.results.items():
                rows[name][part.points[inside] - begin] = values[inside]
        rows[OUTCOME.name][task.lost - begin] = Outcome.LOST
        arrays = {name: _on_grid(self.job, place, values) for name, values in rows.items()}
        zarr_store.write(store, place, arrays, task.shard if task.whole else None)
        return {SECONDS: np.array(time.monotonic() - started)}


def joined_part(chunks: Sequence[Chunk], results: list[Results], seconds: float) -> Part:
    """The part that stores the results of ``chunks``."""
    joined = {name: np.concatenate([found[name] for found in results]) for name in results[0]}
    points = [chunk.points for chunk in chunks]
    return Part([c.number for c in chunks], [p.size for p in points], joined, seconds, np.concatenate(points))


def points_of(job: Job, place: zarr_store.Place) -> tuple[int, int]:
    """First point and number of points of a block of the sweep."""
    block = [part for axis, part in enumerate(place) if axis != job.grid.path_position]
    begin = np.ravel_multi_index([p.start for p in block], job.grid.shape) if block else 0
    return int(begin), int(np.prod([p.stop - p.start for p in block], dtype=int))


def _on_grid(job: Job, place: zarr_store.Place, values: np.ndarray) -> np.ndarray:
    """Results of the points of a block in the layout of the result."""
    grid, position = job.grid, job.grid.path_position
    if grid.path_is_fixed:
        values = values[:, 0]
    block = [part.stop - part.start for axis, part in enumerate(place) if axis != position]
    values = values.reshape((*block, *values.shape[1:]))
    return values if position is None else np.moveaxis(values, len(block), position)
