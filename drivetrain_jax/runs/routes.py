"""Routes to a result; the usual one solves every point."""

from __future__ import annotations

from pathlib import Path

from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import ResultBuffer, labelled
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.reuse import NO_REUSE, ReusedPoints
from drivetrain_jax.runs.work import Progress, Work
from drivetrain_jax.store.consolidate import ResultFile
from drivetrain_jax.store.schema import Labelled


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
