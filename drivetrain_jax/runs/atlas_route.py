"""The route of an atlas: a scene of ranges gives a function of the parameters."""

from __future__ import annotations

from pathlib import Path

from drivetrain_jax.runs.atlas_choice import atlas_ranges
from drivetrain_jax.runs.atlas_file import to_labelled
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.reuse import ReusedPoints
from drivetrain_jax.runs.rounds import build_atlas
from drivetrain_jax.runs.routes import Route
from drivetrain_jax.runs.work import Progress, Work
from drivetrain_jax.store.consolidate import write_result
from drivetrain_jax.store.files import ATLAS_PREFACE
from drivetrain_jax.store.schema import Labelled


class AtlasRoute(Route):
    """Builds an atlas; progress counts its solves, which are not points of a grid."""

    name = "an atlas"
    is_pointwise = False

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The atlas; ``progress`` counts the solves."""
        stability, _ = build_atlas(job.scene, atlas_ranges(job.scene), work, progress)
        return to_labelled(stability, job.scene).with_attrs(**job.attrs)

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the atlas from stored and newly computed solves."""
        result = self.in_memory(job, work, progress).with_attrs(wall_time_s=work.elapsed)
        write_result(result, out, temporary, ATLAS_PREFACE)
