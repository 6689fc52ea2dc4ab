"""The sink of a Zarr store, which the workers write (:mod:`.sharded_run`), so no results pass through the driver."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.executor import Executor, Results
from drivetrain_jax.runs.growing import ReusedPoints
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.shard_writer import written_shards
from drivetrain_jax.runs.sharded_run import ShardedRun
from drivetrain_jax.runs.sink import Sink
from drivetrain_jax.runs.work import Progress, Report
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.files import flush_tree, move_folder


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

    def shards(self, job: Job) -> Iterator[tuple[int, np.ndarray, Results]]:
        """Yield number, points and results of the shards that unfinished work has written."""
        store = self._parts.path / zarr_store.UNFINISHED
        return written_shards(job, store) if store.is_dir() else iter(())

    def write(
        self, job: Job, executor: Executor, report: Report | None, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Compute and assemble what is missing, and move the store into place."""
        run = ShardedRun(job, self._parts, progress, report)
        with closing(executor):
            run.compute(executor)
        self._finish(run)

    def _finish(self, run: ShardedRun) -> None:
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
