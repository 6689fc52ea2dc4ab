"""Executors of chunks and other tasks: the interface, and threads of this process."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np

from drivetrain_jax._machine import usable_cores
from drivetrain_jax._threads import threads

Results = Mapping[str, np.ndarray]
# Tasks per worker: one is computed while the other waits, so no worker idles during writing.
IN_FLIGHT = 2
# Upper limits of queued tasks and of their bytes of results per thread: small chunks are computed faster than stored.
_MOST_AHEAD, _BYTES_AHEAD = 32, 1 << 23


class Computation(Protocol):
    """Computes numbered tasks. Workers receive a pickled copy and compare its ``digest`` with that of the run."""

    @property
    def digest(self) -> str:
        """Digest of everything that affects the results."""
        ...

    def compute(self, task: Any, /) -> Results:
        """The results of one task."""
        ...


class Executor(Protocol):
    """Computes tasks, without effect on the numbers; workers start on first use."""

    # True if the computation itself runs, not a copy of it.
    in_process: bool = False

    def check(self) -> None:
        """Raise :class:`InputError` if no scheduler answers at the address."""

    def run(self, computation: Computation, tasks: Iterable[Any]) -> Generator[tuple[Any, Results | None], None, None]:
        """Yield ``(task, results)`` in the order of completion. Tasks are drawn one by one, as workers get free.

        Results are None for a task that killed every process that computed it. Other failures are raised. After the
        generator is closed (also by an interrupt) no further task starts.
        """
        ...

    def close(self) -> None:
        """End the workers."""


class Threads(Executor):
    """Threads of this process (default: one for each usable core)."""

    in_process = True

    def __init__(self, count: int | None = None) -> None:
        self._count = count

    def run(self, computation: Computation, tasks: Iterable[Any]) -> Generator[tuple[Any, Results], None, None]:
        """Yield ``(task, results)`` in the order of completion."""
        return run_threads(tasks, computation.compute, self._count or usable_cores())


def run_threads(
    tasks: Iterable[Any], work: Callable[[Any], Results], count: int
) -> Generator[tuple[Any, Results], None, None]:
    """Yield results from ``count`` threads of this process; compiled code releases the interpreter's lock.

    An exception of a task is raised here. After the iterator is closed (also by an interrupt) no further task starts;
    running ones finish in the background, and their results are dropped.
    """
    pool = threads(count, "chunk")
    remaining = iter(tasks)
    running: dict[Future[Results], Any] = {}
    finished: SimpleQueue[Future[Results]] = SimpleQueue()
    ahead = IN_FLIGHT
    try:
        while True:
            while len(running) < ahead * count and (task := next(remaining, None)) is not None:
                future = pool.submit(work, task)
                running[future] = task
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
            # The next user of the pool must not wait for running tasks.
            threads.cache_clear()


def _ahead(results: Results) -> int:
    """Number of tasks like that of ``results`` to queue per thread."""
    size = sum(values.nbytes for values in results.values())
    return min(max(_BYTES_AHEAD // max(size, 1), IN_FLIGHT), _MOST_AHEAD)
