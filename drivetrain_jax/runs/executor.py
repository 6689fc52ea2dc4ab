"""Where chunks are computed: in threads of this process, in processes of their own, or on a Dask cluster."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._machine import usable_cores
from drivetrain_jax._threads import threads
from drivetrain_jax._wording import shown
from drivetrain_jax.runs.engine import Engine
from drivetrain_jax.runs.plan import Chunk

if TYPE_CHECKING:
    from drivetrain_jax.runs.worker import Job

Results = Mapping[str, np.ndarray]
# Chunks handed out per worker: one that is computed and one that waits, so that none idles while results are stored.
IN_FLIGHT = 2
# Small chunks are computed faster than results are stored: threads are handed up to this many, and bytes of results.
_MOST_AHEAD, _BYTES_AHEAD = 32, 1 << 23


@dataclass(frozen=True)
class Where:
    """``workers`` processes, the Dask cluster at ``dask`` (``tcp://host:port`` or ``local:N``), or else ``threads``.

    None of them decides any number. Raises :class:`InputError` where they are out of range or exclude each other.
    """

    threads: int | None = None
    workers: int | None = None
    dask: str | None = None

    def __post_init__(self) -> None:
        for name in ("threads", "workers"):
            value = getattr(self, name)
            if value is not None and not (_is_integer(value) and value >= 1):
                raise InputError(f"{name} = {shown(value)}: allowed is {name} >= 1, an integer")
        if self.dask is not None and not re.match(r"local:[1-9]\d*$|\w+://", str(self.dask)):
            raise InputError(f"dask = {self.dask!r}: allowed is tcp://HOST:PORT or local:N with N >= 1")
        given = [name for name in ("threads", "workers", "dask") if getattr(self, name) is not None]
        if len(given) > 1:
            raise InputError(f"{given[0]}: given together with {given[1]}; allowed is one of them")

    def check(self) -> None:
        """Raises :class:`InputError` if no scheduler answers at the address: before earlier work is given up for a run."""
        if self.dask is not None:
            from drivetrain_jax.runs.cluster import check_scheduler

            check_scheduler(self.dask)

    def compute(self, engine: Engine, numbers: Iterable[int]) -> Iterator[tuple[Chunk, Results | None]]:
        """``(chunk, results)`` of the chunks with these numbers in the order of completion, the costliest begun first.

        Results are None for a chunk that killed every process which computed it. What fails otherwise is raised.
        """
        numbers = np.fromiter(numbers, np.int64)
        if self.workers is None and self.dask is None:
            engine.prepare(engine.plan.kernels(numbers))
        return self.each(engine.ordered(numbers), engine.compute_chunk, lambda: _job(engine))

    def each(
        self, chunks: Iterable[Any], here: Callable[[Any], Results], job: Callable[[], Job]
    ) -> Iterator[tuple[Any, Results | None]]:
        """``(chunk, results)`` like :meth:`compute` for any numbered pieces of work: done by ``here`` in threads of this
        process, else by ``job().do`` elsewhere."""
        if self.workers is None and self.dask is None:
            return run_threads(chunks, here, self.threads or usable_cores())
        if self.workers is not None:
            from drivetrain_jax.runs.processes import run_processes

            return run_processes(chunks, job(), self.workers)
        from drivetrain_jax.runs.cluster import run_cluster

        return run_cluster(chunks, job(), self.dask)


def _is_integer(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _job(engine: Engine) -> Job:
    from drivetrain_jax.runs.worker import Job

    return Job(engine.scene.text, engine.digest)


def run_threads(
    chunks: Iterable[Chunk], work: Callable[[Chunk], Results], count: int
) -> Iterator[tuple[Chunk, Results]]:
    """``count`` threads of this process; compiled code runs without the interpreter's lock.

    An exception of a chunk is raised here. When the iterator is left (also by an interrupt), no further chunk starts;
    those that run finish in the background and their results are dropped.
    """
    pool = threads(count, "chunk")
    remaining = iter(chunks)
    running: dict[Future[Results], Chunk] = {}
    finished: SimpleQueue[Future[Results]] = SimpleQueue()
    ahead = IN_FLIGHT
    try:
        while True:
            while len(running) < ahead * count and (chunk := next(remaining, None)) is not None:
                future = pool.submit(work, chunk)
                running[future] = chunk
                future.add_done_callback(finished.put)
            if not running:
                return
            future = finished.get()
            results = future.result()
            ahead = _ahead(results)
            yield running.pop(future), results
    finally:
        if running:
            for future in running:
                future.cancel()
            # What still runs is not to be waited for by whoever comes next.
            threads.cache_clear()


def _ahead(results: Results) -> int:
    """Chunks like that of ``results`` to be handed out per thread."""
    size = sum(values.nbytes for values in results.values())
    return min(max(_BYTES_AHEAD // max(size, 1), IN_FLIGHT), _MOST_AHEAD)
