"""Executors of chunks: threads of this process, spawned processes, or a Dask cluster."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterable, Mapping
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
# Chunks per worker: one is computed while the other waits, so no worker idles during writing.
IN_FLIGHT = 2
# Upper limits of chunks, and of bytes of results, per thread: small chunks are computed faster than stored.
_MOST_AHEAD, _BYTES_AHEAD = 32, 1 << 23


@dataclass(frozen=True)
class Where:
    """The executor: ``workers`` processes, Dask at ``dask`` (``tcp://host:port`` or ``local:N``), or ``threads``.

    The executor does not affect the numbers. Raises :class:`InputError` for invalid or conflicting settings.
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
        """Raise :class:`InputError` if no scheduler answers at the address, before earlier work is deleted."""
        if self.dask is not None:
            from drivetrain_jax.runs.cluster import check_scheduler

            check_scheduler(self.dask)

    def compute(self, engine: Engine, numbers: Iterable[int]) -> Generator[tuple[Chunk, Results | None], None, None]:
        """Yield ``(chunk, results)`` of the chunks with these numbers in the order of completion, the most expensive first.

        Results are None for a chunk that killed every process that computed it. Other failures are raised.
        """
        numbers = np.fromiter(numbers, np.int64)
        if self.workers is None and self.dask is None:
            engine.prepare(engine.plan.kernels(numbers))
        return self.each(engine.ordered(numbers), engine.compute_chunk, lambda: _job(engine))

    def each(
        self, chunks: Iterable[Any], here: Callable[[Any], Results], job: Callable[[], Job]
    ) -> Generator[tuple[Any, Results | None], None, None]:
        """Like :meth:`compute` for any numbered tasks, done by ``here`` in threads of this process, or by ``job().do``
        elsewhere."""
        if self.workers is None and self.dask is None:
            return run_threads(chunks, here, self.threads or usable_cores())
        if self.workers is not None:
            from drivetrain_jax.runs.processes import run_processes

            return run_processes(chunks, job(), self.workers)
        from drivetrain_jax.runs.cluster import run_cluster

        assert self.dask is not None
        return run_cluster(chunks, job(), self.dask)


def _is_integer(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _job(engine: Engine) -> Job:
    from drivetrain_jax.runs.worker import Job

    return Job(engine.scene.text, engine.digest)


def run_threads(
    chunks: Iterable[Chunk], work: Callable[[Chunk], Results], count: int
) -> Generator[tuple[Chunk, Results], None, None]:
    """Yield results from ``count`` threads of this process; compiled code releases the interpreter's lock.

    An exception of a chunk is raised here. After the iterator is closed (also by an interrupt) no further chunk starts;
    running ones finish in the background, and their results are dropped.
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
            # The next user of the pool must not wait for running chunks.
            threads.cache_clear()


def _ahead(results: Results) -> int:
    """Number of chunks like that of ``results`` to queue per thread."""
    size = sum(values.nbytes for values in results.values())
    return min(max(_BYTES_AHEAD // max(size, 1), IN_FLIGHT), _MOST_AHEAD)
