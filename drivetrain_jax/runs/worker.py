"""What another process does for a run: it makes the scene's engine ready once and computes chunks."""

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
    """A worker would compute something else than the run asks for: other code, versions or instruction set."""


@dataclass(frozen=True)
class Job:
    """A scene as text, and the digest of what its driver wants computed."""

    scene: str
    digest: str

    def do(self, engine: Engine, chunk: Any) -> Mapping[str, np.ndarray]:
        """What is computed for ``chunk`` in the process of a worker."""
        return engine.compute_chunk(chunk)


@lru_cache(maxsize=1)
def _engine(job: Job) -> Engine:
    engine = Engine(load_scene(tomllib.loads(job.scene)))
    if engine.digest != job.digest:
        raise Mismatch("code, versions or instruction set differ from those of the run")
    return engine


def prepare(job: Job) -> int:
    """Make the engine ready; returns the number of this process. Raises :class:`Mismatch`."""
    _engine(job)
    return os.getpid()


def compute(job: Job, chunk: Chunk) -> Mapping[str, np.ndarray]:
    """Results of ``chunk``; nothing is planned here. Raises :class:`Mismatch`, or what the computation raises."""
    return job.do(_engine(job), chunk)
