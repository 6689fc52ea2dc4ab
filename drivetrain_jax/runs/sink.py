"""A sink: the form in which a result is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from drivetrain_jax.runs.executor import Executor, Results
from drivetrain_jax.runs.growing import NotReusable, ReusableResult, ReusedPoints
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.work import Progress, Report


class Sink(Protocol):
    """Writes the result of a job to a path, and reads the present result there."""

    store: str

    @property
    def held(self) -> Path:
        """Path of the present result."""
        ...

    @property
    def written(self) -> int | None:
        """Time at which the present result was written, by the clock of its file system."""
        return self.held.stat().st_mtime_ns if self.held.exists() else None

    def check_place(self) -> None:
        """Raise :class:`InputError` if something else is at the path."""

    def check_job(self, job: Job) -> None:
        """Raise :class:`InputError` if the result of ``job`` cannot be written."""

    def check_reuse(self) -> None:
        """Raise :class:`InputError` if points of other results cannot be reused."""

    def attribute(self, name: str) -> Any:
        """A global attribute of the present result."""

    def digest(self) -> Any:
        """Digest of the present result; None if that is not a result."""
        return self.attribute("digest")

    def damage(self) -> str:
        """The damaged parts of the present result, by its checksums; empty without damage."""
        ...

    def rearranged(self, job: Job) -> list[str]:
        """Names of the variables of the present result whose layout differs from that of ``job``."""
        return []

    def common_points(self, job: Job) -> ReusableResult | NotReusable | None:
        """Points of ``job`` in the present result, the reason why it has none, or None if they cannot be reused."""
        return None

    def outcomes(self) -> np.ndarray:
        """Outcomes of all points of the present result."""
        ...

    def shards(self, job: Job) -> Iterator[tuple[int, np.ndarray, Results]]:
        """Yield number, points and results of the blocks that unfinished work has written without parts."""
        return iter(())

    def write(
        self, job: Job, executor: Executor, report: Report | None, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result from the points ``reused``, stored work, and newly computed chunks."""
