"""Spawned processes, one per core. Only a task that crashes its worker repeatedly is lost."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from drivetrain_jax._errors import InputError, RetryableError
from drivetrain_jax.runs import worker
from drivetrain_jax.runs.executor import IN_FLIGHT, Computation, Executor, Results
from drivetrain_jax.runs.worker import Parcel

# Number of crashes after which a task is lost.
ATTEMPTS = 3
# Exit code of a process that the script of its parent would start again.
_NO_GUARD = 78


class Processes(Executor):
    """Spawned processes, each on one core, which stay for the next run until ``close`` or the end of this process."""

    def __init__(self, count: int) -> None:
        if getattr(multiprocessing.current_process(), "_inheriting", False):
            # A process imports the script of its parent. Without a guard the script starts the run again.
            os._exit(_NO_GUARD)
        self._count = count
        self._slots: list[_Slot] = []

    def run(self, computation: Computation, tasks: Iterable[Any]) -> Generator[tuple[Any, Results | None], None, None]:
        """Yield ``(task, results)`` in the order of completion; results are None for a task that crashes every process.

        Exceptions of tasks, and of the start of a process, are raised here. When the iterator is closed (also by an
        interrupt) the processes are killed.
        """
        waiting, deaths = _Tasks(tasks), Counter[int]()
        try:
            self._start(Parcel.of(computation))
            while True:
                for slot in self._slots:
                    slot.fill(waiting)
                futures = [future for slot in self._slots for future in slot.running]
                if not futures:
                    return
                wait(futures, return_when=FIRST_COMPLETED)
                for slot in self._slots:
                    yield from slot.collect(waiting, deaths)
        except BaseException:
            self.close()
            raise

    def _start(self, parcel: Parcel) -> None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
        for slot in self._slots:
            slot.parcel = parcel
        for k in range(len(self._slots), self._count):
            self._slots.append(_Slot(parcel, cores[k % len(cores)]))

    def close(self) -> None:
        """Kill the processes; their running tasks are lost."""
        for slot in self._slots:
            slot.kill()
        self._slots.clear()


class _Tasks:
    """Tasks to compute; those of a dead process come first."""

    def __init__(self, tasks: Iterable[Any]) -> None:
        self._tasks = iter(tasks)
        self._again: deque[Any] = deque()

    def put_back(self, tasks: Iterable[Any]) -> None:
        self._again.extend(tasks)

    def take(self) -> Any:
        return self._again.popleft() if self._again else next(self._tasks, None)


class _Slot:
    """One process, replaced when it dies, and its tasks in order."""

    def __init__(self, parcel: Parcel, core: int | None) -> None:
        self.parcel, self._core = parcel, core
        self.running: dict[Future[Results], Any] = {}
        self._stillborn = 0
        self._start()

    def _start(self) -> None:
        others = set(multiprocessing.active_children())
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, context, initializer=_initialise, initargs=(self._core,))
        self._ready = self._pool.submit(worker.prepare, self.parcel)
        self._processes = set(multiprocessing.active_children()) - others

    def fill(self, waiting: _Tasks) -> None:
        """Send tasks to the process up to its limit."""
        while len(self.running) < IN_FLIGHT and (task := waiting.take()) is not None:
            try:
                self.running[self._pool.submit(worker.compute, self.parcel, task)] = task
            except BrokenProcessPool:
                waiting.put_back([task])
                if self.running:
                    # The process has died; its current task is handled when results are collected.
                    return
                self._was_ready()
                self._restart()

    def collect(self, waiting: _Tasks, deaths: Counter[int]) -> Generator[tuple[Any, Results | None], None, None]:
        """Yield finished results. The task that a dead process was computing is retried, or has no results."""
        while self.running and next(iter(self.running)).done():
            future = next(iter(self.running))
            task = self.running.pop(future)
            try:
                yield task, future.result()
            except BrokenProcessPool:
                ready = self._was_ready()
                waiting.put_back(self.running.values())
                self.running.clear()
                self._restart()
                deaths[task.number] += ready
                if deaths[task.number] < ATTEMPTS:
                    waiting.put_back([task])
                else:
                    yield task, None

    def _restart(self) -> None:
        self._pool.shutdown(wait=False)
        self._start()

    def _was_ready(self) -> bool:
        """True if the process died during a task. If it dies during its start, every process would."""
        try:
            self._ready.result()
        except BrokenProcessPool:
            if any(process.exitcode == _NO_GUARD for process in self._processes):
                where = 'below the line `if __name__ == "__main__":` of the script, which each process imports'
                raise InputError(
                    f"workers: the call starts the run again in each process; allowed is {where}"
                ) from None
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise RetryableError("worker processes crash during their start") from None
            return False
        self._stillborn = 0
        return True

    def kill(self) -> None:
        """Kill the process; its current task is dropped."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._processes:
            process.kill()


def _initialise(core: int | None) -> None:
    """Initialise a new process: use one core, ignore Ctrl-C, and end with the parent."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()  # pyright: ignore[reportOptionalMemberAccess]
    os._exit(1)
