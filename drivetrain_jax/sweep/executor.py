"""Runs tasks side by side. An executor is an iterator of ``(task, result)`` in the order of completion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

# Tasks handed out per worker: one that runs and one that waits, so that none idles while results are stored.
_IN_FLIGHT = 2


def run_threads(tasks: Iterable[Task], work: Callable[[Task], Result], workers: int) -> Iterator[tuple[Task, Result]]:
    """Threads of this process; compiled code runs without the interpreter's lock.

    An exception of a task is raised here. When the iterator is left (also by an interrupt), no further task starts;
    those that run finish in the background and their results are dropped.
    """
    pool = ThreadPoolExecutor(workers, thread_name_prefix="chunk")
    remaining = iter(tasks)
    running: dict[Future[Result], Task] = {}
    try:
        while True:
            for task in remaining:
                running[pool.submit(work, task)] = task
                if len(running) >= _IN_FLIGHT * workers:
                    break
            if not running:
                return
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
