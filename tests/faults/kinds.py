"""Every kind of fault, and how often it is injected."""

from __future__ import annotations

import signal
from collections.abc import Callable

from damage import clock, corrupted, cut, damaged_result, flip
from harness import Bench, Record
from injections import (
    WORKERS,
    cluster,
    file_limit,
    full_disk,
    interrupted,
    kill_idle,
    kill_replacing,
    kill_worker,
    read_only,
    read_only_folder,
    sharded,
    signalled,
    stopped_by,
    two_runs,
    vanished,
)

KILLED = stopped_by(signal.SIGKILL)
# Name, injection, how often in the full suite, whether it is in the short one.
KINDS: tuple[tuple[str, Callable[[Bench, str], Record], int, bool], ...] = (
    ("SIGKILL of the driver, threads", lambda b, k: signalled(b, k, signal.SIGKILL, [], KILLED), 3, True),
    ("SIGKILL of the driver, processes", lambda b, k: signalled(b, k, signal.SIGKILL, WORKERS, KILLED), 2, False),
    ("SIGKILL of a worker process", lambda b, k: kill_worker(b, k, WORKERS), 2, True),
    ("SIGKILL of the only worker process while idle", lambda b, k: kill_idle(b, k, ["--workers", "1"]), 2, False),
    ("SIGKILL of both worker processes while idle", lambda b, k: kill_idle(b, k, WORKERS), 2, False),
    ("SIGKILL while a former result is replaced", kill_replacing, 1, False),
    ("Ctrl-C (SIGINT), threads", lambda b, k: signalled(b, k, signal.SIGINT, [], interrupted), 2, True),
    ("Ctrl-C (SIGINT), processes", lambda b, k: signalled(b, k, signal.SIGINT, WORKERS, interrupted), 1, False),
    ("SIGTERM, threads", lambda b, k: signalled(b, k, signal.SIGTERM, [], interrupted), 1, False),
    ("SIGKILL of the Dask scheduler", lambda b, k: cluster(b, k, "scheduler"), 1, False),
    ("SIGKILL of a Dask worker", lambda b, k: cluster(b, k, "worker"), 1, False),
    ("SIGKILL of the driver of a Dask cluster", lambda b, k: cluster(b, k, "driver"), 1, False),
    ("full disk", full_disk, 2, True),
    ("limit of a file's size", file_limit, 2, False),
    ("file system turns read-only", read_only, 2, False),
    ("read-only folder", read_only_folder, 1, False),
    ("folder of parts vanishes", lambda b, k: vanished(b, k, whole=False), 2, False),
    ("output's folder vanishes", lambda b, k: vanished(b, k, whole=True), 1, False),
    ("two runs on one output", two_runs, 2, False),
    ("bit flips in parts", lambda b, k: corrupted(b, k, flip), 3, False),
    ("truncated parts", lambda b, k: corrupted(b, k, cut), 2, False),
    ("bit flip in the finished file", damaged_result, 3, True),
    ("clock that jumps", clock, 1, False),
    ("SIGKILL of a worker that writes a Zarr store", lambda b, k: sharded(b, k, "worker"), 1, False),
    ("SIGKILL of the driver of a Zarr store", lambda b, k: sharded(b, k, "driver"), 1, False),
)
