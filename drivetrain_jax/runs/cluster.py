"""Workers of a Dask cluster: this process plans and writes, they return arrays."""

from __future__ import annotations

import logging
import re
import uuid
from collections.abc import Generator, Iterable
from contextlib import ExitStack
from typing import Any

from drivetrain_jax._errors import InputError, RetryableError
from drivetrain_jax.runs import worker
from drivetrain_jax.runs.executor import IN_FLIGHT, Computation, Executor, Results
from drivetrain_jax.runs.worker import Parcel

_PATIENCE = "10s"
_LOCAL = re.compile(r"local:([1-9]\d*)")
# Loggers of Dask that report the death of a scheduler or worker; the run reports it in one line.
_TALKATIVE = ("distributed", "tornado", "asyncio")


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
        parcel, remaining, running = Parcel.of(computation), iter(tasks), {}
        finished = distributed.as_completed(loop=self._client.loop)
        room = IN_FLIGHT * max(sum(self._client.nthreads().values()), 1)
        # A random part of the key: another run on the same scheduler uses the same numbers.
        run = uuid.uuid4().hex
        while True:
            while len(running) < room and (task := next(remaining, None)) is not None:
                future = self._client.submit(worker.compute, parcel, task, key=f"chunk-{task.number}-{run}")
                running[future.key] = task
                finished.add(future)
            if not running:
                return
            future = next(finished)
            yield running.pop(future.key), _result(distributed, future)
            future.release()

    def close(self) -> None:
        """Disconnect, and end a local cluster."""
        self._client = None
        self._connection.close()


def _result(distributed: Any, future: Any) -> Results | None:
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
        return stack.enter_context(distributed.Client(address, timeout=_PATIENCE, set_as_default=False))
    except (OSError, ValueError) as error:
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
