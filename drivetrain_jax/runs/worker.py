"""Code of a worker process: it prepares the engine of the scene once and computes chunks."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from drivetrain_jax._errors import ChunkError
from drivetrain_jax.runs.engine import Engine
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.scene import load_scene


class Mismatch(ChunkError):
    """Raised if code, versions or instruction set of a worker differ from those of the run."""


@dataclass(frozen=True)
class Job:
    """A scene as text, and the digest that its driver expects."""

    scene: str
    digest: str

    def do(self, engine: Engine, chunk: Any) -> Mapping[str, np.ndarray]:
        """The results of ``chunk`` in a worker process."""
        return engine.compute_chunk(chunk)


@lru_cache(maxsize=1)
def _engine(job: Job) -> Engine:
    engine = Engine(load_scene(tomllib.loads(job.scene)))
    if engine.digest != job.digest:
        raise Mismatch("code, versions or instruction set differ from those of the run")
    return engine


def prepare(job: Job) -> int:
    """Prepare the engine; returns the number of this process. Raises :class:`Mismatch`."""
    _engine(job)
    return os.getpid()


def compute(job: Job, chunk: Chunk) -> Mapping[str, np.ndarray]:
    """Results of ``chunk``, without planning. Raises :class:`Mismatch`, or any error of the computation."""
    return job.do(_engine(job), chunk)
