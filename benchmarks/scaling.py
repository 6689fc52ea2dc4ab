"""What the engine costs beside its kernels, and what large sweeps would cost: measured figures and a small simulation.

``python -m benchmarks.scaling`` measures and writes the tables of docs/scaling.md; ``--points`` makes it smaller.
"""

from __future__ import annotations

import argparse
import heapq
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks.cardan_reference import BASE_CASE
from benchmarks.timing import median, provenance, significant, write_csv
from drivetrain_jax.store import checksums
from drivetrain_jax.store.chunks import Part
from drivetrain_jax.sweep import toml
from drivetrain_jax.sweep.assemble import Table
from drivetrain_jax.sweep.engine import Engine
from drivetrain_jax.sweep.executor import IN_FLIGHT, run_threads
from drivetrain_jax.sweep.run import run_to_file
from drivetrain_jax.sweep.scene import load_scene

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
BEGIN, END = "<!-- scaling: written by python -m benchmarks.scaling -->", "<!-- end of scaling -->"
RESULTS = Path(__file__).parent / "results"


def scene(points: int) -> dict[str, Any]:
    """The chart of the README with about this many points, every one solved directly."""
    rows = max(round((points * 3 / 4) ** 0.5), 2)
    axes = {
        "beta": {"start": 0.0, "stop": 1.5, "num": rows},
        "Omega": {"start": 0.1, "stop": 2.0, "num": max(round(points / rows), 2)},
    }
    outputs = ["spectral_radius", "spectral_radius_error", "verdict"]
    options = {"method": "direct", "rtol": 1e-9}
    return {
        "system": "cardan",
        "analysis": "floquet",
        "outputs": outputs,
        "axes": axes,
        "fixed": dict(BASE_CASE),
        "options": options,
    }


def seconds(job: Callable[[], Any]) -> float:
    """How long ``job`` takes."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def bare(engine: Engine) -> None:
    """The kernels alone: all chunks in threads, results dropped."""
    chunks = engine.ordered(range(len(engine.plan.costs)))
    for _ in run_threads(chunks, engine.compute_chunk, os.cpu_count() or 1):
        pass


@dataclass(frozen=True)
class Overhead:
    """Seconds of the engine (scene to file) and of its kernels, in turns, and what the file takes."""

    points: int
    engine_s: float
    kernels_s: float
    bytes_per_point: float
    resume_s: float

    @property
    def ratio(self) -> float:
        """Time of the engine over that of the kernels, minus 1."""
        return self.engine_s / self.kernels_s - 1


def overhead(points: int, repeats: int, folder: Path) -> Overhead:
    """Kernels are compiled before the clock starts in both; a finished run is resumed in a process of its own."""
    out, content = folder / "overhead.nc", scene(points)
    engine = Engine(load_scene(content))
    bare(Engine(load_scene(scene(4096))))
    run_to_file(content, out)
    times: dict[str, list[float]] = {"engine": [], "kernels": []}
    for _ in range(repeats):
        times["kernels"].append(seconds(lambda: bare(engine)))
        times["engine"].append(seconds(lambda: run_to_file(content, out, fresh=True)))
    (folder / "scene.toml").write_text(toml.write(content))
    command = [
        sys.executable,
        "-m",
        "drivetrain_jax.cli",
        "run",
        str(folder / "scene.toml"),
        "--out",
        str(out),
        "--quiet",
    ]
    resumes = [seconds(lambda: subprocess.run(command, check=True, capture_output=True)) for _ in range(3)]
    size = out.stat().st_size / engine.total
    return Overhead(engine.total, median(times["engine"]), median(times["kernels"]), size, median(resumes))


@dataclass(frozen=True)
class Costs:
    """Measured figures of one chunk and one point."""

    chunk: int
    compute_s: float
    spread: float
    plan_s_per_point: float
    transfer_bytes: int
    handle_s: float
    checksum_s_per_byte: float
    result_bytes_per_point: float


def costs(points: int) -> Costs:
    """One core per chunk, as processes have it."""
    engine = Engine(load_scene(scene(points)))
    planning = seconds(lambda: engine.plan)
    chunks = [engine.plan.chunk(n) for n in range(len(engine.plan.costs))]
    sample = [chunks[i] for i in np.linspace(0, len(chunks) - 1, min(len(chunks), 24)).astype(int)]
    results = [engine.compute_chunk(chunk) for chunk in sample]
    affinity = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(affinity)})
    computing = [seconds(lambda c=chunk: engine.compute_chunk(c)) for chunk in sample]
    os.sched_setaffinity(0, affinity)
    sizes = [len(pickle.dumps(dict(result))) for result in results]
    table = Table(engine.scene, engine.grid)
    table.lay_out()

    def handle() -> None:
        for chunk, result in zip(sample, results, strict=True):
            table.fill(chunk.points, pickle.loads(pickle.dumps(dict(result))))
        joined = {name: np.concatenate([r[name] for r in results]) for name in results[0]}
        Part([c.number for c in sample], [c.points.size for c in sample], joined, 0.0).to_bytes()

    handling = median([seconds(handle) for _ in range(5)]) / len(sample)
    per_point = sum(array.itemsize * array[0].size for array in results[0].values())
    return Costs(
        max(c.size for c in sample),
        median(computing),
        float(np.std(computing) / np.mean(computing)),
        planning / engine.grid.size,
        int(median(sizes)),
        handling,
        hashing(),
        per_point,
    )


def hashing() -> float:
    """Seconds for one byte of a result when it is sealed."""
    with h5py.File("hash", "w", driver="core", backing_store=False) as file:
        values = file.create_dataset("x", data=np.random.default_rng(1).random(1 << 22))
        return median([seconds(lambda: checksums.checksums(file)) for _ in range(3)]) / values.nbytes


@dataclass(frozen=True)
class Load:
    """What the simulation finds for one sweep on ``workers`` cores."""

    points: float
    workers: int
    hours: float
    driver_busy: float
    workers_busy: float


def simulate(cost: Costs, workers: int, chunks: int = 20_000, seed: int = 1) -> tuple[float, float, float]:
    """Seconds per chunk, and how busy driver and workers are: ``workers`` with two chunks each, one driver that handles
    what comes back in the order of its coming and then hands out the next chunk."""
    rng = np.random.default_rng(seed)
    chunks = max(chunks, 20 * workers)
    shape = 1 / max(cost.spread, 1e-3) ** 2
    times = rng.gamma(shape, cost.compute_s / shape, chunks)
    free = np.zeros(workers)
    queue: list[tuple[float, int]] = []
    started = 0
    for _ in range(IN_FLIGHT):
        for worker in range(min(workers, chunks - started)):
            free[worker] += times[started]
            heapq.heappush(queue, (free[worker], worker))
            started += 1
    driver = busy = 0.0
    while queue:
        finished, worker = heapq.heappop(queue)
        driver = max(driver, finished) + cost.handle_s
        busy += cost.handle_s
        if started < chunks:
            free[worker] = max(free[worker], driver) + times[started]
            heapq.heappush(queue, (free[worker], worker))
            started += 1
    return driver / chunks, busy / driver, float(times.sum() / (workers * driver))


def loads(cost: Costs, counts: Sequence[int] = (2, 16, 128, 1024, 4096)) -> list[Load]:
    """Sweeps of 1e9 and 1e12 points."""
    found = []
    for workers in counts:
        per_chunk, driver, busy = simulate(cost, workers)
        for points in (1e9, 1e12):
            found.append(Load(points, workers, points / cost.chunk * per_chunk / 3600, driver, busy))
    return found


def rows_of(cost: Costs) -> list[dict[str, str]]:
    """What does not depend on the number of workers."""
    rows = []
    for points in (1e9, 1e12):
        size = points * cost.result_bytes_per_point
        rows.append(
            {
                "points": f"{points:.0e}",
                "chunks": f"{points / cost.chunk:.2g}",
                "result": f"{size / 1e9:,.0f} GB",
                "over the network": f"{points / cost.chunk * cost.transfer_bytes / 1e9:,.0f} GB",
                "plan in the driver's memory (8 B a point)": f"{8 * points / 1e9:,.0f} GB",
                "planning": f"{points * cost.plan_s_per_point / 3600:.2g} h",
                "checksums": f"{size * cost.checksum_s_per_byte / 3600:.2g} h",
            }
        )
    return rows


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as a table."""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + " --- |" * len(rows[0])]
    lines += ["| " + " | ".join(str(significant(value)) for value in row.values()) + " |" for row in rows]
    return "\n".join(lines)


def page(found: Overhead, cost: Costs, simulated: Sequence[Load]) -> str:
    """The tables, with where they come from."""
    where = "; ".join(f"{key}: {value}" for key, value in provenance().items())
    limit = cost.compute_s / cost.handle_s
    chunk_rows = [{"figure": name, "value": value} for name, value in asdict(cost).items()]
    overhead_rows = [asdict(found) | {"engine over kernels": f"{100 * found.ratio:+.1f} %"}]
    load_rows = [
        {
            "points": f"{load.points:.0e}",
            "workers (cores)": load.workers,
            "time": f"{load.hours:,.2g} h",
            "driver busy": f"{100 * load.driver_busy:.0f} %",
            "workers busy": f"{100 * load.workers_busy:.0f} %",
        }
        for load in simulated
    ]
    return "\n\n".join(
        [
            f"{where}.",
            "### Overhead",
            markdown(overhead_rows),
            "### One chunk",
            markdown(chunk_rows),
            "### Sweeps: size",
            markdown(rows_of(cost)),
            "### Sweeps: time and load",
            markdown(load_rows),
            f"The single writer keeps up with about {limit:,.0f} cores (computing over handling of one chunk).",
        ]
    )


def main() -> None:
    """Measure, simulate, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000, help="points of the overhead measurement")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--dry", action="store_true", help="print, write nothing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = overhead(options.points, options.repeats, Path(folder))
    cost = costs(min(options.points, 200_000))
    simulated = loads(cost)
    text = page(found, cost, simulated)
    print(text)
    if not options.dry:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.partition(END)[2]}")
        write_csv(
            RESULTS / "scaling.csv", [asdict(load) for load in simulated], [f"{asdict(cost)}", f"{asdict(found)}"]
        )


if __name__ == "__main__":
    main()
