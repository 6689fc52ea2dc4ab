"""Code of a worker process, which checks a computation once and computes its tasks."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import prod
from typing import Any

import numpy as np

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


# Name, type and shape of every array of the results of each task.
Layout = list[list[tuple[str, str, tuple[int, ...]]]]


def compute_all(parcel: Parcel, tasks: Sequence[Any]) -> tuple[Layout, bytes, float]:
    """The results of ``tasks`` as layout and one piece of bytes, and the seconds; Dask would send each array separately."""
    begin = time.monotonic()
    found = [compute(parcel, task) for task in tasks]
    layout = [[(name, array.dtype.str, array.shape) for name, array in results.items()] for results in found]
    data = b"".join(array.tobytes() for results in found for array in results.values())
    return layout, data, time.monotonic() - begin


def unpacked(layout: Layout, data: bytes) -> Iterator[Results]:
    """The results that :func:`compute_all` sent."""
    buffer, at = bytearray(data), 0
    for arrays in layout:
        results = {}
        for name, kind, shape in arrays:
            results[name] = np.frombuffer(buffer, kind, prod(shape), at).reshape(shape)
            at += results[name].nbytes
        yield results
