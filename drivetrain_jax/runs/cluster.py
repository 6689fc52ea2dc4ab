"""Workers of a Dask cluster, which return arrays to this process; this process plans and writes."""

from __future__ import annotations

import logging
import re
import socket
import uuid
from collections import deque
from collections.abc import Generator, Iterable
from contextlib import ExitStack
from itertools import islice
from operator import length_hint
from typing import Any

from drivetrain_jax._errors import InputError, RetryableError
from drivetrain_jax.runs import worker
from drivetrain_jax.runs.executor import IN_FLIGHT, Computation, Executor, Results
from drivetrain_jax.runs.worker import Parcel

# Seconds until a scheduler has accepted a connection, and until it has answered. A busy one may answer late.
_ACCEPTED, _ANSWERED = 2.0, 10.0
# Upper limit of the bytes of a scheduler's greeting, which has some hundreds.
_GREETING = 1 << 20
_LOCAL = re.compile(r"local:([1-9]\d*)")
# Loggers of Dask that report the death of a scheduler or worker; the run reports it in one line.
_TALKATIVE = ("distributed", "tornado", "asyncio")
# Seconds of work and bytes of results per request: each request costs client, scheduler and worker some milliseconds.
_SECONDS, _BYTES = 1.0, 1 << 24
# Factor by which requests grow from one to the next.
_GROWTH = 4
# Least number of requests per worker for the remaining tasks, so that all workers end at the same time.
_FEWEST = 4


class Cluster(Executor):
    """A Dask cluster: the scheduler at ``tcp://host:port``, or ``local:N`` processes, connected until ``close``."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._connection = ExitStack()
        self._client: Any = None

    def check(self) -> None:
        """Raise :class:`InputError` if no scheduler answers at the address; a local one starts with the first work."""
        distributed = _distributed()
        if not _LOCAL.fullmatch(self._address):
            with ExitStack() as stack:
                _connect(distributed, self._address, stack)

    def run(self, computation: Computation, tasks: Iterable[Any]) -> Generator[tuple[Any, Results | None], None, None]:
        """Yield ``(task, results)`` in the order of completion.

        A task whose worker died is computed again. Results are None after too many deaths (Dask's setting
        ``distributed.scheduler.allowed-failures``). Exceptions of tasks are raised; a lost scheduler raises
        :class:`RetryableError`.
        """
        distributed = _distributed()
        if self._client is None:
            self._client = _connect(distributed, self._address, self._connection)
        parcel, running = Parcel.of(computation), {}
        workers = max(sum(self._client.nthreads().values()), 1)
        requests = _Requests(tasks, workers)
        finished = distributed.as_completed(loop=self._client.loop)
        # A random part of the key: another run on the same scheduler uses the same numbers.
        run = uuid.uuid4().hex
        while True:
            while len(running) < IN_FLIGHT * workers and (request := requests.take()):
                key = f"chunk-{request[0].number}-{len(request)}-{run}"
                future = self._client.submit(worker.compute_all, parcel, request, key=key)
                running[future.key] = request
                finished.add(future)
            if not running:
                return
            future = next(finished)
            request, found = running.pop(future.key), _result(distributed, future)
            future.release()
            if found is None:
                if len(request) > 1:
                    requests.divide(request)
                else:
                    yield request[0], None
                continue
            layout, data, seconds = found
            requests.learn(len(request), len(data), seconds)
            yield from zip(request, worker.unpacked(layout, data), strict=True)

    def close(self) -> None:
        """Disconnect, and end a local cluster."""
        self._client = None
        self._connection.close()


class _Requests:
    """Tasks in requests of about ``_SECONDS`` of work, fewer towards the end if the number of tasks is known."""

    def __init__(self, tasks: Iterable[Any], workers: int) -> None:
        self._tasks, self._workers = iter(tasks), workers
        self._alone: deque[Any] = deque()
        # Tasks of unknown number are requested one by one.
        self._size, self._most = 1, 1 << 20 if length_hint(self._tasks) else 1

    def take(self) -> tuple[Any, ...]:
        """The tasks of the next request; empty at the end."""
        if self._alone:
            return (self._alone.popleft(),)
        share = -(-length_hint(self._tasks) // (_FEWEST * self._workers))
        return tuple(islice(self._tasks, max(1, min(self._size, share))))

    def divide(self, request: Iterable[Any]) -> None:
        """Request these tasks one by one, because one of them kills workers."""
        self._alone.extend(request)

    def learn(self, count: int, size: int, seconds: float) -> None:
        """Choose the size of the next requests from a finished one, by its tasks, bytes of results, and seconds."""
        wanted = count * min(_SECONDS / max(seconds, 1e-9), _BYTES / max(size, 1))
        # In steps, because the first tasks of a worker compile, and results may differ in size.
        self._size = max(1, min(int(wanted), max(self._size, _GROWTH * count), self._most))


def _result(distributed: Any, future: Any) -> tuple[worker.Layout, bytes, float] | None:
    try:
        return future.result()
    except distributed.KilledWorker:
        return None
    except (distributed.CancelledError, OSError) as error:
        raise RetryableError(f"dask: connection to the scheduler lost ({type(error).__name__})") from error


def _connect(distributed: Any, address: str, stack: ExitStack) -> Any:
    local = _LOCAL.fullmatch(address)
    if local:
        cluster = distributed.LocalCluster(
            n_workers=int(local.group(1)), threads_per_worker=1, processes=True, dashboard_address=None
        )
        address = stack.enter_context(cluster).scheduler_address
    try:
        _listen(distributed, address)
        return stack.enter_context(distributed.Client(address, timeout=_ANSWERED, set_as_default=False))
    except (OSError, ValueError, TypeError) as error:
        # Dask raises TypeError if a TLS address lacks certificates.
        raise InputError(f"dask = {address!r}: no scheduler answers there; {type(error).__name__}") from None


def _listen(distributed: Any, address: str) -> None:
    """Raise ``OSError`` unless something accepts a connection at ``address``, and greets as a scheduler does.

    A client of Dask repeats a refused connection until its time is over, waits without end for a silent server, and takes
    the first bytes of another one for a size in memory.
    """
    if address.startswith(("tcp://", "tls://")):
        place = distributed.comm.get_address_host_port(address)
        with ExitStack() as stack:
            connection = stack.enter_context(socket.create_connection(place, timeout=_ACCEPTED))
            connection.settimeout(_ANSWERED)
            if address.startswith("tls://"):
                context = distributed.Security().get_connection_args("client").get("ssl_context")
                # Without certificates Dask itself refuses the address.
                if context is None:
                    return
                connection = stack.enter_context(context.wrap_socket(connection))
            # Dask sends the size of its greeting, in 8 bytes.
            size = int.from_bytes(stack.enter_context(connection.makefile("rb")).read(8), "little")
            if not 0 < size < _GREETING:
                raise ConnectionError


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
