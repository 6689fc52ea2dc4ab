"""Cost of the engine in addition to its kernels: time, memory, bytes, and the cost of other executors.

``python -m benchmarks.scaling`` runs these measurements and writes docs/scaling.md.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import distributed
import numpy as np

from benchmarks.timing import PROCESSES, interleaved, median
from drivetrain_jax._machine import usable_cores
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.executor import Executor, Threads, run_threads
from drivetrain_jax.runs.executors import make_executor
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.run import run_to_file
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.shard_writer import FOUND, ShardWriter, Share, Shares
from drivetrain_jax.runs.sharded_run import ShardedRun
from drivetrain_jax.store.chunks import PartsFolder
from tests.oracles.cardan_reference import BASE_CASE

# Code of a process that runs a sweep of one output. It prints the largest resident memory in MB with and without the pages
# of mapped files, and the seconds.
_ONE_OUTPUT = """
import sys, time
from pathlib import Path
from drivetrain_jax.runs.run import run_to_file

def resident(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1]) / 1024

own, calls = [0.0], [0]
def report(_):
    calls[0] += 1
    if calls[0] % 16 == 1:
        own[0] = max(own[0], resident("RssAnon"))

begin = time.perf_counter()
run_to_file(Path(sys.argv[1]), Path(sys.argv[2]), report=report)
print(resident("VmHWM"), own[0], time.perf_counter() - begin)
"""


def scene(points: int) -> dict[str, Any]:
    """The chart of the README with about this many points, every one solved directly."""
    rows = max(round((points * 3 / 4) ** 0.5), 2)
    axes = {
        "beta": {"start": 0.0, "stop": 1.5, "num": rows},
        "Omega": {"start": 0.1, "stop": 2.0, "num": max(round(points / rows), 2)},
    }
    return {
        "system": "cardan",
        "analysis": "floquet",
        "outputs": ["spectral_radius", "spectral_radius_error", "verdict"],
        "axes": axes,
        "fixed": dict(BASE_CASE),
        "options": {"method": "direct", "rtol": 1e-9},
    }


def cheap_scene(points: int) -> dict[str, Any]:
    """The cheapest analysis with one output, whose cost is that of the engine."""
    side = max(round(points**0.5), 2)
    axes = {name: {"start": 0.0, "stop": 1.0, "num": side} for name in ("beta", "velocity0")}
    fixed = {"element": "input", "zeta": 0.01}
    return {"system": "tripod", "analysis": "parameters", "outputs": ["c_inertia"], "axes": axes, "fixed": fixed}


def seconds(job: Callable[[], Any]) -> float:
    """Duration of ``job``."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def cpu_seconds(job: Callable[[], Any]) -> float:
    """CPU time of all threads of this process for ``job``."""
    begin = time.process_time()
    job()
    return time.process_time() - begin


def bare(job: Job) -> None:
    """The kernels alone: all chunks in threads, results dropped."""
    chunks = job.ordered(range(len(job.plan.costs)))
    for _ in run_threads(chunks, job.compute, usable_cores()):
        pass


@dataclass(frozen=True)
class Overhead:
    """Seconds and CPU seconds of the engine (scene to file) and of its kernels alone, measured in turns.

    ``resume_s`` are the seconds of a process that finds the run finished.
    """

    points: int
    engine_s: float
    kernels_s: float
    engine_cpu_s: float
    kernels_cpu_s: float
    bytes_per_point: float
    resume_s: float

    @property
    def ratio(self) -> float:
        """Time of the engine over that of the kernels, minus 1."""
        return self.engine_s / self.kernels_s - 1

    @property
    def cpu_ratio(self) -> float:
        """The same ratio of CPU seconds, which depends less on the load of the machine."""
        return self.engine_cpu_s / self.kernels_cpu_s - 1


def overhead(points: int, repeats: int, folder: Path) -> Overhead:
    """Measure the engine and its kernels, both compiled before the clock starts.

    A separate process resumes the finished run.
    """
    out, content = folder / "overhead.nc", scene(points)
    engine = resolve(load_scene(content))
    warm = scene(min(points, 50_000))
    bare(resolve(load_scene(warm)))
    run_to_file(warm, folder / "warm.nc")
    wall: dict[str, list[float]] = {"engine": [], "kernels": []}
    cpu: dict[str, list[float]] = {"engine": [], "kernels": []}
    jobs = {"kernels": lambda: bare(engine), "engine": lambda: run_to_file(content, out, fresh=True)}
    # Plan before the clock starts: planning belongs to the engine, not to the kernels.
    _ = engine.plan
    for _ in range(repeats):
        for name, job in jobs.items():
            begin = time.process_time()
            wall[name].append(seconds(job))
            cpu[name].append(time.process_time() - begin)
    (folder / "scene.toml").write_text(toml.write(content))
    command = [sys.executable, "-m", "drivetrain_jax.cli", "run", str(folder / "scene.toml"), "--out", str(out)]
    resumes = [seconds(lambda: subprocess.run(command, check=True, capture_output=True)) for _ in range(3)]
    medians = [median(times[name]) for times in (wall, cpu) for name in ("engine", "kernels")]
    return Overhead(engine.total, *medians, out.stat().st_size / engine.total, median(resumes))


@dataclass(frozen=True)
class Place:
    """Seconds of a run into a file on one executor, and their excess over those of threads, as a fraction."""

    where: str
    points: int
    seconds: float
    over_threads: float


@contextmanager
def dask_cluster(folder: Path) -> Iterator[str]:
    """Yield the address of a scheduler with single-threaded workers, each started by a command of its own."""
    file = folder / "scheduler.json"
    common = ["--no-dashboard", "--scheduler-file", str(file)]
    worker = ["dask_worker", "--nthreads", "1", "--local-directory", str(folder), *common]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{name}", *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for name, *options in (["dask_scheduler", "--port", "0", *common], *[worker] * PROCESSES)
    ]
    try:
        while not file.exists():
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(PROCESSES)
        yield address
    finally:
        for process in started:
            process.kill()
            process.wait()
        file.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Counts:
    """A computation whose tasks return what a worker of a Zarr run returns."""

    digest: str = "counts"

    def compute(self, task: Any, /) -> Mapping[str, np.ndarray]:
        return {
            "seconds": np.zeros(()),
            "part": np.array(["x" * 40]),
            **dict.fromkeys(FOUND[:2] + FOUND[3:], np.ones(1)),
        }


def request_cost(count: int = 2000) -> float:
    """CPU seconds of a request: the larger one of this process and Dask's scheduler.

    Generators, because tasks of known number are requested together.
    """
    tasks = (Shares(number, (Share(number, 0, 1, 1),), 1.0) for number in itertools.count())
    with tempfile.TemporaryDirectory() as folder, dask_cluster(Path(folder)) as address:
        executor = make_executor(dask=address)
        with closing(executor):
            deque(executor.run(_Counts(), (task for task in itertools.islice(tasks, 100))), maxlen=0)
            scheduler = _scheduler_seconds()
            own = cpu_seconds(
                lambda: deque(executor.run(_Counts(), (task for task in itertools.islice(tasks, count))), maxlen=0)
            )
            return max(own, _scheduler_seconds() - scheduler) / count


def _scheduler_seconds() -> float:
    """CPU seconds so far of the children of this process that are Dask schedulers."""
    ticks = 0
    for folder in Path("/proc").glob("[0-9]*"):
        fields = (folder / "stat").read_text().rpartition(")")[2].split() if folder.exists() else []
        if fields and int(fields[1]) == os.getpid() and b"dask_scheduler" in (folder / "cmdline").read_bytes():
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def block_cost(blocks: int = 5) -> tuple[int, float, float]:
    """Points of a block, CPU seconds of a worker that plans, computes and writes it, and the share of the kernels.

    Medians of ``blocks`` blocks around the middle of a sweep; each block is computed as a whole and by its kernels alone.
    """
    job, whole, kernels = resolve(load_scene(scene(10_000_000))), [], []
    first = job.grid.shards.count // 2
    with tempfile.TemporaryDirectory() as folder:
        parts = PartsFolder(Path(folder) / "r.zarr")
        parts.open()
        ShardedRun(job, parts, job.route.progress(job), None).create()
        writer = ShardWriter(job, str(parts.out))
        # The first block compiles the kernels.
        for block in (first - 1, *range(first, first + blocks)):
            task = Shares(0, (Share(block, 0, 1, 1),), math.inf)
            whole.append(cpu_seconds(lambda task=task: writer.compute(task)))
            plan = job.block_plan(block)
            chunks = [plan.chunk(number) for number in range(len(plan.costs))]
            kernels.append(cpu_seconds(lambda chunks=chunks: deque(map(job.compute, chunks), maxlen=0)))
        parts.close()
    begin, stop = job.grid.block(first)
    share = median([part / all_ for part, all_ in zip(kernels[1:], whole[1:], strict=True)])
    return stop - begin, median(whole[1:]), share


def places(points: int, repeats: int, folder: Path) -> list[Place]:
    """Measure threads, processes that the run starts, and a Dask cluster, on the same cores.

    The first run on the cluster is separate, because its workers then import and compile.
    """
    content, out = scene(points), folder / "places.nc"

    def job(executor: Executor) -> Callable[[], Any]:
        return lambda: run_to_file(content, out, fresh=True, executor=executor)

    with dask_cluster(folder) as address:
        on_dask, workers = job(make_executor(dask=address)), f"{PROCESSES} workers of a Dask cluster"
        first = seconds(on_dask)
        jobs = {
            f"{PROCESSES} threads": job(Threads(PROCESSES)),
            f"{PROCESSES} processes, their start included": job(make_executor(workers=PROCESSES)),
            f"{workers}, again": on_dask,
        }
        for run in jobs.values():
            run()
        found = {name: median(times) for name, times in interleaved(jobs, repeats).items()}
    threads = next(iter(found.values()))
    found[f"{workers}, first run"] = first
    return [Place(name, points, value, value / threads - 1) for name, value in found.items()]


@dataclass(frozen=True)
class Memory:
    """Largest resident memory (MB) of a sweep of one output, with and without pages of mapped files, and the seconds."""

    points: int
    resident_mb: float
    own_mb: float
    seconds: float


def memory(counts: Sequence[int], folder: Path) -> list[Memory]:
    """The memory of sweeps of these numbers of points, each in a process of its own."""
    found = []
    for count in counts:
        content, out = cheap_scene(count), folder / "memory.nc"
        (folder / "memory.toml").write_text(toml.write(content))
        command = [sys.executable, "-c", _ONE_OUTPUT, str(folder / "memory.toml"), str(out)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        out.unlink()
        points = content["axes"]["beta"]["num"] ** 2
        found.append(Memory(points, *(float(word) for word in done.stdout.split())))
    return found


def slope(found: Sequence[Memory]) -> float:
    """Growth of the largest resident memory in bytes per point, between the two largest sweeps."""
    small, large = found[-2:]
    return (large.resident_mb - small.resident_mb) * 2**20 / (large.points - small.points)


def rows_of(found: Overhead) -> list[Mapping[str, Any]]:
    """The row of a table of overhead."""
    return [
        {
            "points": found.points,
            "engine": f"{found.engine_s:.1f} s",
            "kernels alone": f"{found.kernels_s:.1f} s",
            "engine over kernels": f"{100 * found.ratio:+.1f} %",
            "the same in CPU seconds": f"{100 * found.cpu_ratio:+.1f} %",
            "file": f"{found.bytes_per_point:.1f} bytes a point",
            "finished run resumed": f"{found.resume_s:.2f} s",
        }
    ]


def rows_of_places(found: Sequence[Place]) -> list[Mapping[str, Any]]:
    """The rows of a table of executors."""
    return [
        {
            "where": p.where,
            "points": p.points,
            "time": f"{p.seconds:.1f} s",
            "over threads": f"{100 * p.over_threads:+.0f} %",
        }
        for p in found
    ]
