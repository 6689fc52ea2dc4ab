"""Code of a worker process: it unpacks a computation once and computes its tasks."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from drivetrain_jax._errors import ChunkError
from drivetrain_jax.runs.executor import Computation, Results


class Mismatch(ChunkError):
    """Raised if code, versions or instruction set of a worker differ from those of the run."""


@dataclass(frozen=True)
class Parcel:
    """A pickled computation, and the digest that its driver expects."""

    digest: str
    content: bytes = field(compare=False, repr=False)

    @classmethod
    def of(cls, computation: Computation) -> Parcel:
        """The parcel that sends ``computation`` to workers."""
        return cls(computation.digest, pickle.dumps(computation))


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Computation:
    computation: Computation = pickle.loads(parcel.content)
    if computation.digest != parcel.digest:
        raise Mismatch("code, versions or instruction set differ from those of the run")
    return computation


def prepare(parcel: Parcel) -> int:
    """Unpack the computation; returns the number of this process. Raises :class:`Mismatch`."""
    _unpacked(parcel)
    return os.getpid()


def compute(parcel: Parcel, task: Any) -> Results:
    """Results of ``task``, without planning. Raises :class:`Mismatch`, or any error of the computation."""
    return _unpacked(parcel).compute(task)
