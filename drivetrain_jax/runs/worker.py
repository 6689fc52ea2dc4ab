"""Code of a worker process: it checks a computation once and computes its tasks."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from drivetrain_jax._errors import ChunkError
from drivetrain_jax.runs.executor import Computation, Results


class Mismatch(ChunkError):
    """Raised if code, versions or instruction set of a worker differ from those of the run."""


@dataclass(frozen=True)
class Parcel:
    """A computation on its way to workers, and the digest that its driver expects."""

    digest: str
    computation: Computation = field(compare=False, repr=False)

    @classmethod
    def of(cls, computation: Computation) -> Parcel:
        """The parcel that sends ``computation`` to workers."""
        return cls(computation.digest, computation)


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Computation:
    # The first copy with this digest serves all tasks; it holds the compiled kernels.
    if parcel.computation.digest != parcel.digest:
        raise Mismatch("code, versions or instruction set differ from those of the run")
    return parcel.computation


def prepare(parcel: Parcel) -> int:
    """Unpack the computation; returns the number of this process. Raises :class:`Mismatch`."""
    _unpacked(parcel)
    return os.getpid()


def compute(parcel: Parcel, task: Any) -> Results:
    """Results of ``task``, without planning. Raises :class:`Mismatch`, or any error of the computation."""
    return _unpacked(parcel).compute(task)


def compute_all(parcel: Parcel, tasks: Sequence[Any]) -> tuple[bytes, float]:
    """The results of ``tasks``, pickled as one piece: Dask sends each array of an object by itself. And the seconds."""
    begin = time.monotonic()
    return pickle.dumps([dict(compute(parcel, task)) for task in tasks]), time.monotonic() - begin
