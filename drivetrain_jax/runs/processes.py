"""Compute chunks in spawned processes, one per core. Only a chunk that crashes its worker repeatedly is lost."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from drivetrain_jax._errors import RetryableError
from drivetrain_jax.runs import worker
from drivetrain_jax.runs.executor import IN_FLIGHT, Results
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.worker import Job

# Number of crashes after which a chunk is marked lost.
ATTEMPTS = 3


def run_processes(chunks: Iterable[Chunk], job: Job, count: int) -> Generator[tuple[Chunk, Results | None], None, None]:
    """Yield ``(chunk, results)`` in the order of completion; results are None for a chunk that crashes every process.

    Exceptions of chunks, and of the start of a process, are raised here. When the iterator is closed (also by an interrupt)
    the processes are killed; they also end when this process ends.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
    waiting, deaths = _Tasks(chunks), Counter[int]()
    slots = [_Slot(job, cores[k % len(cores)]) for k in range(count)]
    try:
        while True:
            for slot in slots:
                slot.fill(waiting)
            futures = [future for slot in slots for future in slot.running]
            if not futures:
                return
            wait(futures, return_when=FIRST_COMPLETED)
            for slot in slots:
                yield from slot.collect(waiting, deaths)
    finally:
        for slot in slots:
            slot.kill()


class _Tasks:
    """Chunks to compute; chunks of a dead process come first."""

    def __init__(self, chunks: Iterable[Chunk]) -> None:
        self._chunks = iter(chunks)
        self._again: deque[Chunk] = deque()

    def put_back(self, chunks: Iterable[Chunk]) -> None:
        self._again.extend(chunks)

    def take(self) -> Chunk | None:
        return self._again.popleft() if self._again else next(self._chunks, None)


class _Slot:
    """One process, replaced when it dies, and its chunks in order."""

    def __init__(self, job: Job, core: int | None) -> None:
        self._job, self._core = job, core
        self.running: dict[Future[Results], Chunk] = {}
        self._stillborn = 0
        self._start()

    def _start(self) -> None:
        others = set(multiprocessing.active_children())
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, context, initializer=_initialise, initargs=(self._core,))
        self._ready = self._pool.submit(worker.prepare, self._job)
        self._processes = set(multiprocessing.active_children()) - others

    def fill(self, waiting: _Tasks) -> None:
        """Send chunks to the process up to its limit."""
        while len(self.running) < IN_FLIGHT and (chunk := waiting.take()) is not None:
            try:
                self.running[self._pool.submit(worker.compute, self._job, chunk)] = chunk
            except BrokenProcessPool:
                waiting.put_back([chunk])
                if self.running:
                    # The process has died; its current chunk is handled when results are collected.
                    return
                self._was_ready()
                self._restart()

    def collect(self, waiting: _Tasks, deaths: Counter[int]) -> Generator[tuple[Chunk, Results | None], None, None]:
        """Yield finished results. The chunk that a dead process was computing is retried, or marked lost."""
        while self.running and next(iter(self.running)).done():
            future = next(iter(self.running))
            chunk = self.running.pop(future)
            try:
                yield chunk, future.result()
            except BrokenProcessPool:
                ready = self._was_ready()
                waiting.put_back(self.running.values())
                self.running.clear()
                self._restart()
                deaths[chunk.number] += ready
                if deaths[chunk.number] < ATTEMPTS:
                    waiting.put_back([chunk])
                else:
                    yield chunk, None

    def _restart(self) -> None:
        self._pool.shutdown(wait=False)
        self._start()

    def _was_ready(self) -> bool:
        """True if the process died during a chunk. If it dies during its start, every process would."""
        try:
            self._ready.result()
        except BrokenProcessPool:
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise RetryableError("worker processes crash during their start") from None
            return False
        self._stillborn = 0
        return True

    def kill(self) -> None:
        """Kill the process; its current chunk is dropped."""
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
