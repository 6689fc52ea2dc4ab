"""Routes to values at points; the direct one solves every point."""

from __future__ import annotations

from pathlib import Path

from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.analysis.atlas.analysis import PROPAGATOR
from drivetrain_jax.runs.assemble import ResultBuffer, bytes_per_point, labelled
from drivetrain_jax.runs.growing import NO_REUSE, NotReusable, ReusableResult, ReusedPoints, find, remaining
from drivetrain_jax.runs.job import Job, Route
from drivetrain_jax.runs.layout import rearranged
from drivetrain_jax.runs.work import Progress, Work
from drivetrain_jax.store.chunks import Part
from drivetrain_jax.store.consolidate import ResultFile
from drivetrain_jax.store.schema import Labelled


class PointsRoute(Route):
    """A route to values at points."""

    def fill(
        self, job: Job, buffer: ResultBuffer, work: Work, progress: Progress, reused: ReusedPoints
    ) -> dict[str, str | int]:
        """Fill all points of ``job`` into ``buffer``; returns attributes of the result."""
        raise NotImplementedError

    def total(self, job: Job, done: int) -> int:
        """Number of points."""
        return job.total

    def bytes_needed(self, job: Job, on_disk: bool) -> int:
        """Bytes of the plan, and of the results unless they are in a file."""
        return job.total * bytes_per_point(job.scene, on_disk)

    def progress(self, job: Job) -> Progress:
        """The counts before a run."""
        return Progress(job.total)

    def counts(self, part: Part) -> bool:
        """True for values at points; solves of an atlas are not points of the grid."""
        return PROPAGATOR not in part.results

    def rearranged(self, job: Job, path: Path) -> list[str]:
        """Names of the variables of the result at ``path`` whose layout differs from that of the job."""
        return rearranged(path, job.scene, job.grid)

    def common_points(self, job: Job, path: Path) -> ReusableResult | NotReusable | None:
        """Points of the job in the result at ``path``, or the reason why it has none."""
        try:
            return find(job, path)
        except NotReusable as error:
            return error

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The result."""
        buffer = ResultBuffer(job.scene, job.grid)
        extra = self.fill(job, buffer, work, progress, NO_REUSE)
        return labelled(job.scene, buffer.lay_out(), job.attrs | extra)

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result from the points ``reused``, the existing parts, and newly computed chunks."""
        with ResultFile(temporary) as file:
            buffer = ResultBuffer(job.scene, job.grid, lambda blank: file.lay_out(blank.with_attrs(**job.attrs)))
            extra = self.fill(job, buffer, work, progress, reused)
            buffer.lay_out()
            file.finish(out, wall_time_s=work.elapsed, **extra)


class DirectRoute(PointsRoute):
    """Solves every point."""

    name = "direct solves"
    is_pointwise = True

    def fill(
        self, job: Job, buffer: ResultBuffer, work: Work, progress: Progress, reused: ReusedPoints
    ) -> dict[str, str | int]:
        """Copy the points ``reused`` and solve the others."""
        for points, results in reused.blocks([variable.name for variable in buffer.variables]):
            buffer.fill(points, results)
            progress.reused += results[OUTCOME.name].size
            progress.count(results[OUTCOME.name])
        work.do(remaining(job, reused), buffer, progress)
        return reused.attrs


DIRECT = DirectRoute()
