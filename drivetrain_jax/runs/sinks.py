"""The HDF5 sink, and the choice between that and a Zarr store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.executor import Executor
from drivetrain_jax.runs.growing import NotReusable, ReusableResult, ReusedPoints
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.sink import Sink
from drivetrain_jax.runs.work import Progress, Report, Work
from drivetrain_jax.store import checksums, gate, zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import read_attribute, read_variable

ZARR = "zarr"


class Hdf5Sink(Sink):
    """The result as one netCDF4/HDF5 file, which the driver writes."""

    store = "hdf5"

    def __init__(self, out: Path, parts: PartsFolder) -> None:
        self._out, self._parts = out, parts

    @property
    def held(self) -> Path:
        """Path of the result."""
        return self._out

    def check_place(self) -> None:
        """Raise :class:`InputError` if the path is a folder."""
        if self.held.exists() and not self.held.is_file():
            what = "is a folder" if self.held.is_dir() else "not a regular file"
            raise InputError(f"out = {str(self.held)!r}: {what}; allowed is the path of a file")

    def attribute(self, name: str) -> Any:
        """A global attribute of the present result."""
        with gate.reading(self.held):
            return read_attribute(self.held, name)

    def digest(self) -> Any:
        """Digest of the present result."""
        try:
            return super().digest()
        except InputError:
            what = "not a readable netCDF4/HDF5 file; allowed is a new file or a result of drivetrain_jax"
            raise InputError(f"out = {str(self.held)!r}: {what}") from None

    def damage(self) -> str:
        """The damaged parts of the present result; empty without damage."""
        with gate.reading(self.held):
            changed = checksums.damaged(self.held)
        return "its checksums are gone" if changed is None else checksums.named(changed)

    def rearranged(self, job: Job) -> list[str]:
        """Names of the variables of the present result whose layout differs from that of ``job``."""
        with gate.reading(self.held):
            return job.route.rearranged(job, self.held)

    def common_points(self, job: Job) -> ReusableResult | NotReusable | None:
        """Points of ``job`` in the present result, or the reason why it has none."""
        return job.route.common_points(job, self.held)

    def outcomes(self) -> np.ndarray:
        """Outcomes of all points of the present result."""
        with gate.reading(self.held):
            return read_variable(self.held, OUTCOME.name)

    def write(
        self, job: Job, executor: Executor, report: Report | None, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result from the points ``reused``, stored work, and newly computed chunks."""
        with Work(executor, report, self._parts) as work:
            job.route.into_file(job, self.held, self._parts.result, work, progress, reused)


def make_sink(out: Path, parts: PartsFolder, store: str | None) -> Sink:
    """The sink for ``hdf5`` or ``zarr``; by default the form of the present result."""
    if store is None:
        held = out if out.exists() else parts.path / zarr_store.FORMER
        store = ZARR if zarr_store.is_store(held) or zarr_store.was_store(held) else parts.plan().get("store")
    if store == ZARR:
        from drivetrain_jax.runs.zarr_sink import ZarrSink

        return ZarrSink(out, parts)
    return Hdf5Sink(out, parts)
