"""Find the blocks of a run among those of an earlier one, or compute and keep them, by threads or Dask workers."""

from __future__ import annotations

import logging
import os
import re
import sys
import time
import uuid
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from drivetrain_jax._errors import ChunkError, InputError, RetryableError, shown
from drivetrain_jax._machine import threads, usable_cores
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import BlockStore, ResultBuffer, labelled, stored_blocks
from drivetrain_jax.runs.job import Block, Chunk, Job
from drivetrain_jax.runs.reuse import NO_REUSE, ReusedPoints
from drivetrain_jax.store.consolidate import Labelled, ResultFile
from drivetrain_jax.store.parts import Arrays
from drivetrain_jax.systems import System

# Tasks per worker: one is computed while the other waits, so no worker idles during writing.
IN_FLIGHT = 2
# Chunks per thread: small ones are computed faster than collected.
_CHUNKS_IN_FLIGHT = 8

# Seconds until a scheduler has answered. A busy one may answer late.
_ANSWERED = 10.0
# Seconds after which a local cluster without workers gets new ones, how often, and seconds between two looks for results.
_PATIENCE, _REPLACED, _POLL = 30.0, 2, 0.02
_LOCAL = re.compile(r"local:([1-9]\d*)")
# Loggers of Dask that report the death of a scheduler or worker; the run reports it in one line.
_TALKATIVE = ("distributed", "tornado", "asyncio")
# Setting of Dask: the environment in which workers start.
_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"

# Blocks and their results in the order of completion.
Finished = Generator[tuple[Block, Arrays | None], None, None]
# A block in work, its chunks, the results of those that are computed, and the position of the chunk to compute.
Task = tuple[Block, tuple[Chunk, ...], dict[int, Arrays], int]


@dataclass
class Progress:
    """Progress of a run: counts of results of this ``kind``; ``note`` is a remark.

    ``failed`` points have no value, ``inaccurate`` ones a value whose error exceeds the target. ``cost`` of ``total_cost``
    points are computed, those of unfinished blocks included.
    """

    total: int
    computed: int = 0
    reused: int = 0
    failed: int = 0
    inaccurate: int = 0
    cost: float = 0.0
    total_cost: float = 0.0
    kind: str = "points"
    note: str = ""

    @classmethod
    def before(cls, job: Job) -> Progress:
        """The counts before a run; those of an atlas are solves, which are not points of a grid."""
        return cls(0, kind="direct solves") if job.scene.analysis.continuous else cls(job.total)

    def __str__(self) -> str:
        return f"points: total={self.total} computed={self.computed} reused={self.reused} failed={self.failed}"

    def count(self, outcome: np.ndarray) -> None:
        """Count the failed and the inaccurate points among these outcomes."""
        self.failed += int(np.count_nonzero(outcome >= FIRST_FAILURE))
        self.inaccurate += int(np.count_nonzero(outcome == Outcome.TOLERANCE_NOT_MET))

    @property
    def exceptions(self) -> str:
        """The points that are no success, as the end of a line: ``, 3 failed, 2 inaccurate``."""
        counts = ((self.failed, "failed"), (self.inaccurate, "inaccurate"))
        return "".join(f", {count} {name}" for count, name in counts if count)


Report = Callable[[Progress], None]


class Threads:
    """Computes blocks by threads of this process (default: one for each usable core), which share the chunks of a block.

    Executors have no effect on the numbers.
    """

    def __init__(self, count: int | None = None) -> None:
        self._count = count

    def check(self, system: type[System]) -> None:
        """Raise :class:`InputError` if no scheduler answers at the address, or its workers cannot import ``system``."""

    def run(
        self, job: Job, blocks: Iterable[Block], store: BlockStore | None, first: int, tick: Callable[[int], None]
    ) -> Finished:
        """Yield blocks and their results, which are also in the ``store``, if any, as number ``first`` + that of the block.

        ``tick`` is called with the number of points of every chunk. Blocks are drawn one by one; the chunks of the next one
        start before the last ones of a block end. After the generator is closed (also by an interrupt) nothing further is
        started.
        """

        def tasks() -> Iterator[Task]:
            for block in blocks:
                chunks = job.plan(block)
                job.prepare(chunks)
                results: dict[int, Arrays] = {}
                # A block without chunks still has a task, because its results must be written.
                yield from ((block, chunks, results, position) for position in range(max(len(chunks), 1)))

        def compute(task: Task) -> Arrays:
            _, chunks, _, position = task
            return job.compute(chunks[position]) if chunks else {}

        with closing(run_threads(tasks(), compute, self._count or usable_cores())) as computed:
            for (block, chunks, results, position), computed_chunk in computed:
                results[position] = computed_chunk
                if chunks:
                    tick(chunks[position].points.size)
                if len(results) >= len(chunks):
                    joined = job.joined(block, chunks, [results[k] for k in range(len(chunks))])
                    if store is not None:
                        store.write(first + block.number, joined)
                    yield block, joined

    def close(self) -> None:
        """End the workers."""


def run_threads(
    tasks: Iterable[Any], work: Callable[[Any], Arrays], count: int
) -> Generator[tuple[Any, Arrays], None, None]:
    """Yield results from ``count`` threads of this process; compiled code releases the interpreter's lock.

    An exception of a task is raised here. After the iterator is closed (also by an interrupt) no further task starts;
    running ones finish in the background, and their results are dropped.
    """
    pool = threads(count, "chunk")
    remaining = iter(tasks)
    running: dict[Future[Arrays], Any] = {}
    finished: SimpleQueue[Future[Arrays]] = SimpleQueue()
    try:
        while True:
            while len(running) < _CHUNKS_IN_FLIGHT * count and (task := next(remaining, None)) is not None:
                future = pool.submit(work, task)
                running[future] = task
                future.add_done_callback(finished.put)
            if not running:
                return
            future = finished.get()
            yield running.pop(future), future.result()
    finally:
        if running:
            for future in running:
                future.cancel()
            # The next user of the pool must not wait for running tasks.
            threads.cache_clear()


# The job of this worker, the first of equal ones, by its digest: it holds the compiled kernels.
_JOBS: dict[str, Job] = {}


def compute(job: Job, store: BlockStore | None, digest: str, block: Block, number: int) -> Arrays:
    """Compute ``block`` in a worker. The results return to the driver without a store, otherwise the outcomes alone.

    ``digest`` is that of the job in the driver.
    """
    if job.digest != digest:
        raise ChunkError("code, versions or instruction set differ from those of the run")
    if digest not in _JOBS:
        _JOBS.clear()
    results = _JOBS.setdefault(digest, job).compute_block(block)
    if store is None:
        return results
    try:
        store.write(number, results)
    except OSError as error:
        raise RetryableError(str(error)) from None
    return {OUTCOME.name: results[OUTCOME.name]}


class Cluster(Threads):
    """A Dask cluster: the scheduler at ``tcp://host:port``, or ``local:N`` processes, connected until ``close``."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._connection = ExitStack()
        self._client: Any = None

    def check(self, system: type[System]) -> None:
        """Raise :class:`InputError` if no scheduler answers at the address, or if no worker can import ``system``.

        A local scheduler starts with the first work, and its workers import the script.
        """
        distributed, local = _distributed(), _LOCAL.fullmatch(self._address)
        script = local and os.path.isfile(getattr(sys.modules["__main__"], "__file__", None) or "")
        if system.__module__ == "__main__" and not script:
            raise InputError(
                f"system = {system.name!r}: workers cannot import a class of this session; "
                "expected a class of a module (a file NAME.py), or a run with threads"
            )
        if not local:
            with ExitStack() as stack:
                _connect(distributed, self._address, stack)

    def run(
        self, job: Job, blocks: Iterable[Block], store: BlockStore | None, first: int, tick: Callable[[int], None]
    ) -> Finished:
        """Yield blocks and their outcomes, without a store their results; every worker stores what it computes.

        A block whose worker died is computed again. Results are None after too many deaths (Dask's setting
        ``distributed.scheduler.allowed-failures``). Exceptions are raised; a lost scheduler raises :class:`RetryableError`.
        """
        distributed = _distributed()
        if self._client is None:
            self._client = _connect(distributed, self._address, self._connection)
        remaining, running = iter(blocks), dict[str, Block]()
        workers = max(sum(self._client.nthreads().values()), 1)
        finished = distributed.as_completed(loop=self._client.loop)
        # A random part of the key: another run on the same scheduler uses the same numbers.
        run = uuid.uuid4().hex
        while True:
            for block in islice(remaining, IN_FLIGHT * workers - len(running)):
                number = first + block.number
                sent = (job, store, job.digest, block, number)
                future = self._client.submit(compute, *sent, key=f"block-{number}-{run}")
                running[future.key] = block
                finished.add(future)
            if not running:
                return
            self._keep_workers(finished)
            future = next(finished)
            block, results = running.pop(future.key), _result(distributed, future)
            future.release()
            yield block, results

    def _keep_workers(self, finished: Any) -> None:
        """Wait for a result. A local cluster without workers gets new ones: Dask restarts none that dies while it starts.

        Raises :class:`ChunkError` if new ones die too.
        """
        cluster, replaced, since = self._client.cluster, 0, time.monotonic()
        while cluster is not None and not finished.has_ready():
            time.sleep(_POLL)
            if time.monotonic() - since > _PATIENCE:
                if not self._client.nthreads():
                    if replaced == _REPLACED:
                        raise ChunkError(
                            "dask: local workers end as soon as they start; a run with threads may say why"
                        )
                    cluster.scale(0)
                    cluster.scale(int(self._address.removeprefix("local:")))
                    replaced += 1
                since = time.monotonic()

    def close(self) -> None:
        """Disconnect, and end a local cluster."""
        self._client = None
        self._connection.close()


def _result(distributed: Any, future: Any) -> Arrays | None:
    try:
        return future.result()
    except distributed.KilledWorker:
        return None
    except (distributed.CancelledError, OSError) as error:
        raise RetryableError(f"dask: connection to the scheduler lost ({type(error).__name__})") from error


def _connect(distributed: Any, address: str, stack: ExitStack) -> Any:
    place: Any = address
    try:
        if local := _LOCAL.fullmatch(address):
            from dask import config

            # Dask lets workers return all memory that they free at once; so kernels take a quarter longer.
            environment = dict(config.get(_ENVIRONMENT, {}))
            environment.pop("MALLOC_TRIM_THRESHOLD_", None)
            with config.set({_ENVIRONMENT: environment}):
                # Without a dashboard; its port of 0 is any free one, where the default would warn beside another cluster.
                cluster = distributed.LocalCluster(
                    n_workers=int(local.group(1)),
                    threads_per_worker=1,
                    silence_logs=logging.CRITICAL,
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard_address": ":0"},
                )
            place = stack.enter_context(cluster)
        return stack.enter_context(distributed.Client(place, timeout=_ANSWERED, set_as_default=False))
    except RuntimeError as error:
        where = 'below the line `if __name__ == "__main__":` of the script, which each worker imports'
        raise InputError(f"workers: do not start ({error}); expected a call {where}") from None
    except (OSError, ValueError, TypeError) as error:
        # Dask raises TypeError if a TLS address lacks certificates.
        raise InputError(f"dask = {address!r}: no scheduler answers there; {type(error).__name__}") from None


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError(
            "dask: the package distributed is not installed; install drivetrain_jax[distributed]"
        ) from None
    for name in (*_TALKATIVE, *logging.root.manager.loggerDict):
        if name.split(".")[0] in _TALKATIVE:
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


def make_executor(threads: int | None = None, workers: int | None = None, dask: str | None = None) -> Threads:
    """The executor: Dask at ``dask`` (``tcp://host:port`` or ``local:N``), ``workers`` for ``local:N``, or ``threads``."""
    settings = {"threads": threads, "workers": workers, "dask": dask}
    named = {name: value for name, value in settings.items() if value is not None}
    for name, value in named.items():
        is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if name != "dask" and not (is_integer and value >= 1):
            raise InputError(f"{name} = {shown(value)}: expected {name} >= 1, an integer")
    if dask is not None and not re.match(r"local:[1-9]\d*$|\w+://", str(dask)):
        raise InputError(f"dask = {dask!r}: expected tcp://HOST:PORT or local:N with N >= 1")
    if len(named) > 1:
        first, second, *_ = named
        raise InputError(f"{first}: given together with {second}; expected one of them")
    return Cluster(dask or f"local:{workers}") if workers or dask else Threads(threads)


# Receives the results of points.
Receive = Callable[[np.ndarray, Arrays], None]


class Work:
    """Runs blocks on the executor and reports progress.

    With a ``store`` finished blocks are kept there, and blocks that it has are not computed again.
    """

    def __init__(self, executor: Threads, report: Report | None = None, store: BlockStore | None = None) -> None:
        self.executor, self.report, self.store = executor, report or (lambda _: None), store
        self._begin = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Time since the start in s."""
        return round(time.monotonic() - self._begin, 3)

    def do(
        self, job: Job, receive: Receive | None, progress: Progress, first: int = 0, points: np.ndarray | None = None
    ) -> None:
        """Compute or reuse all blocks of ``job``, or of some of its ``points``, and hand their results to ``receive``.

        Without it they are only stored. Numbers in the store start at ``first``.
        """
        done, length, left = set[int](), job.grid.path_length, job.grid.size if points is None else len(points)

        def stored() -> Iterator[tuple[Block, Arrays]]:
            if self.store is not None:
                yield from stored_blocks(self.store, job, points, first, done)

        def tick(count: int) -> None:
            progress.cost += count * length
            self.report(progress)

        for block, results in stored():
            done.add(block.number)
            left -= len(results[OUTCOME.name])
            if receive is not None:
                receive(job.points(block), results)
            progress.reused += results[OUTCOME.name].size
            progress.count(results[OUTCOME.name])
        progress.cost, progress.total_cost, computed = 0.0, float(left * length), 0
        self.report(progress)
        missing = (block for block in job.blocks(points) if block.number not in done)
        try:
            # Closed on exit: after an interrupt nothing further starts.
            with closing(self.executor.run(job, missing, self.store, first, tick)) as finished:
                for block, results in finished:
                    outcome = self._received(job, block, results, first, receive)[OUTCOME.name]
                    done.add(block.number)
                    progress.count(outcome)
                    progress.computed += outcome.size
                    computed += outcome.size
                    progress.cost = max(progress.cost, computed)
                    self.report(progress)
            if computed < progress.total_cost:
                raise RetryableError("some blocks returned no result")
        except BaseException:
            # An interrupt may come between storing a block and counting it.
            for _, results in stored():
                progress.computed += results[OUTCOME.name].size
                progress.count(results[OUTCOME.name])
            # If an exception is an interrupt in a library's code, the report raises that again.
            self.report(progress)
            raise

    def _received(self, job: Job, block: Block, results: Arrays | None, first: int, receive: Receive | None) -> Arrays:
        """The results of a computed block, handed to ``receive``; those of a lost one have no values."""
        if results is None:
            results = job.joined(block, (), ())
            results[OUTCOME.name][...] = Outcome.LOST
            if self.store is not None:
                self.store.write(first + block.number, results)
        if receive is not None:
            if len(results) == 1 and self.store is not None:
                # A worker has stored the block.
                results = self.store.read(first + block.number)
                if results is None:
                    where = f"every worker must see the folder {self.store.place!r}"
                    raise RetryableError(f"block {block.number} is missing after a worker has stored it; {where}")
            receive(job.points(block), results)
        return results


class Route:
    """The way from a job to its result, chosen once by :func:`~drivetrain_jax.runs.resolve.resolve`: solves every point."""

    # Name of the route; a part of the digest, because the route affects the bits.
    name = "direct solves"
    # True if points are solved one by one, so that partial results can be opened, reused and written by workers.
    is_pointwise = True

    def fill(
        self, job: Job, buffer: ResultBuffer, work: Work, progress: Progress, reused: ReusedPoints
    ) -> dict[str, str | int]:
        """Copy the points ``reused`` and solve the others; returns attributes of the result."""
        for points, results in chain.from_iterable(source.blocks() for source in reused.sources):
            buffer.fill(points, results)
            progress.reused += results[OUTCOME.name].size
            progress.count(results[OUTCOME.name])
        work.do(job, buffer.fill, progress, points=reused.others(job.grid.size))
        return reused.attrs

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The result."""
        buffer = ResultBuffer(job.scene, job.grid)
        extra = self.fill(job, buffer, work, progress, NO_REUSE)
        return labelled(job.scene, buffer.lay_out(), job.attrs | extra)

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result from the points ``reused``, the stored blocks, and newly computed ones."""
        with ResultFile(temporary) as file:
            buffer = ResultBuffer(
                job.scene, job.grid, lambda blank: file.lay_out(labelled(job.scene, blank, job.attrs))
            )
            extra = self.fill(job, buffer, work, progress, reused)
            buffer.lay_out()
            file.finish(out, wall_time_s=work.elapsed, **extra)


DIRECT = Route()
