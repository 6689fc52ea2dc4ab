"""Cost of the engine in addition to its kernels, and cost of large sweeps: measurements and a small simulation.

``python -m benchmarks.scaling`` measures, and writes the tables of docs/scaling.md and scaling.csv, overhead.csv, places.csv
and memory.csv in results/. ``--points`` makes the sweep smaller; with ``--quick`` or ``--out`` the page stays unchanged.
"""

from __future__ import annotations

import heapq
import pickle
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks import engine_cost
from benchmarks.engine_cost import Memory, cpu_seconds, scene
from benchmarks.results_files import between_marks
from benchmarks.timing import RESULTS, median, parser, provenance, results_folder, significant, write_csv
from drivetrain_jax.runs import sharded_run
from drivetrain_jax.runs.assemble import ResultBuffer
from drivetrain_jax.runs.executor import IN_FLIGHT
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.store import checksums
from drivetrain_jax.store.chunks import Part

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
BEGIN, END = "<!-- scaling: written by python -m benchmarks.scaling -->", "<!-- end of scaling -->"
# Numbers of points of the sweeps whose memory is measured; a plan keeps up to 4 million sorted points.
_MEMORY, _QUICK_MEMORY = (1_000_000, 10_000_000, 100_000_000), (1_000_000, 5_000_000)


@dataclass(frozen=True)
class Costs:
    """Measured costs of one chunk, point, block and request; all seconds are CPU seconds.

    With ``--store zarr`` a worker plans, computes and writes a ``block`` in ``block_s``, of which the kernels take the share
    ``block_kernels``. A request takes ``request_s`` of the driver or of Dask's scheduler, whichever has more work.
    """

    chunk: int
    compute_s: float
    spread: float
    plan_s_per_point: float
    transfer_bytes: int
    handle_s: float
    checksum_s_per_byte: float
    result_bytes_per_point: float
    block: int
    block_s: float
    block_kernels: float
    request_s: float


def costs(points: int) -> Costs:
    """Measure costs in CPU seconds, because in processes each chunk has one core."""
    engine = resolve(load_scene(scene(points)))
    planning = cpu_seconds(lambda: engine.plan)
    chunks = [engine.plan.chunk(n) for n in range(len(engine.plan.costs))]
    sample = [chunks[i] for i in np.linspace(0, len(chunks) - 1, min(len(chunks), 24)).astype(int)]
    results = [engine.compute(chunk) for chunk in sample]
    computing = [cpu_seconds(lambda c=chunk: engine.compute(c)) for chunk in sample]
    sizes = [len(pickle.dumps(dict(result))) for result in results]
    table = ResultBuffer(engine.scene, engine.grid)
    table.lay_out()

    def handle() -> None:
        for chunk, result in zip(sample, results, strict=True):
            table.fill(chunk.points, pickle.loads(pickle.dumps(dict(result))))
        joined = {name: np.concatenate([r[name] for r in results]) for name in results[0]}
        Part([c.number for c in sample], [c.points.size for c in sample], joined, 0.0).to_bytes()

    handling = median([cpu_seconds(handle) for _ in range(5)]) / len(sample)
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
        *engine_cost.block_cost(),
        engine_cost.request_cost(),
    )


def hashing() -> float:
    """Seconds for the checksum of one byte of a result."""
    with h5py.File("hash", "w", driver="core", backing_store=False) as file:
        values = file.create_dataset("x", data=np.random.default_rng(1).random(1 << 22))
        return median([cpu_seconds(lambda: checksums.checksums(file)) for _ in range(3)]) / values.nbytes


@dataclass(frozen=True)
class Task:
    """Work that a worker gets at once: points, seconds and their spread, seconds of the driver, share of the kernels."""

    points: float
    seconds: float
    spread: float
    driver_s: float
    kernels: float


@dataclass(frozen=True)
class Load:
    """Result of the simulation for one sweep on ``workers`` cores."""

    store: str
    points: float
    workers: int
    hours: float
    driver_busy: float
    workers_busy: float


def task_of(cost: Costs, store: str, workers: int) -> Task:
    """A chunk for a result file that the driver writes; whole blocks for a store that workers write."""
    if store == "hdf5":
        return Task(cost.chunk, cost.compute_s, cost.spread, cost.handle_s, 1.0)
    blocks = max(round(max(sharded_run.SECONDS, IN_FLIGHT * workers / sharded_run.PER_SECOND) / cost.block_s), 1)
    spread = cost.spread / (blocks * cost.block / cost.chunk) ** 0.5
    return Task(blocks * cost.block, blocks * cost.block_s, spread, cost.request_s, cost.block_kernels)


def simulate(task: Task, workers: int, tasks: int = 20_000, seed: int = 1) -> tuple[float, float, float]:
    """Seconds per task, and the shares of time in which the driver is busy and the workers run kernels.

    Each of the ``workers`` has two tasks. One driver handles results in the order of arrival, and sends the next task.
    """
    rng = np.random.default_rng(seed)
    tasks = max(tasks, 20 * workers)
    shape = 1 / max(task.spread, 1e-3) ** 2
    times = rng.gamma(shape, task.seconds / shape, tasks)
    free = np.zeros(workers)
    queue: list[tuple[float, int]] = []
    started = 0
    for _ in range(IN_FLIGHT):
        for worker in range(min(workers, tasks - started)):
            free[worker] += times[started]
            heapq.heappush(queue, (free[worker], worker))
            started += 1
    driver = busy = 0.0
    while queue:
        finished, worker = heapq.heappop(queue)
        driver = max(driver, finished) + task.driver_s
        busy += task.driver_s
        if started < tasks:
            free[worker] = max(free[worker], driver) + times[started]
            heapq.heappush(queue, (free[worker], worker))
            started += 1
    return driver / tasks, busy / driver, float(task.kernels * times.sum() / (workers * driver))


def loads(cost: Costs, counts: Sequence[int] = (2, 16, 128, 1024, 4096)) -> list[Load]:
    """Sweeps of 1e12 points, in 500 scenes or more."""
    found = []
    for store in ("hdf5", "zarr"):
        for workers in counts:
            task = task_of(cost, store, workers)
            per_task, driver, busy = simulate(task, workers)
            found.append(Load(store, 1e12, workers, 1e12 / task.points * per_task / 3600, driver, busy))
    return found


def rows_of(cost: Costs) -> list[dict[str, str]]:
    """Costs that do not depend on the number of workers."""
    rows = []
    for points in (1e9, 1e12):
        size = points * cost.result_bytes_per_point
        rows.append(
            {
                "points": f"{points:.0e}",
                "chunks": f"{points / cost.chunk:.2g}",
                "result": f"{size / 1e9:,.0f} GB",
                "over the network": f"{points / cost.chunk * cost.transfer_bytes / 1e9:,.0f} GB",
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


def page(tables: Mapping[str, str], cost: Costs, simulated: Sequence[Load]) -> str:
    """The text of the page: the measured ``tables``, the simulated ones, and their sources."""
    where = "; ".join(f"{key}: {value}" for key, value in provenance().items())
    limit = cost.compute_s / cost.handle_s
    chunk_rows = [{"figure": name, "value": value} for name, value in asdict(cost).items()]
    load_rows = [
        {
            "--store": load.store,
            "workers (cores)": load.workers,
            "time": f"{load.hours:,.2g} h",
            "driver busy": f"{100 * load.driver_busy:.0f} %",
            "kernels on the workers": f"{100 * load.workers_busy:.0f} %",
        }
        for load in simulated
    ]
    return "\n\n".join(
        [
            f"{where}.",
            *(f"### {title}\n\n{table}" for title, table in tables.items()),
            "### One chunk",
            markdown(chunk_rows),
            "### Sweeps: size",
            markdown(rows_of(cost)),
            "### A sweep of 1e12 points: time and load",
            markdown(load_rows),
            f"The writer of an HDF5 file keeps up with about {limit:,.0f} cores (computing over handling of one chunk).",
        ]
    )


def memory_table(found: Sequence[Memory]) -> str:
    """Memory against points."""
    rows = [
        {
            "points": f"{m.points:,}",
            "largest resident memory": f"{m.resident_mb:,.0f} MB",
            "without mapped files": f"{m.own_mb:,.0f} MB",
            "time": f"{m.seconds:.1f} s",
        }
        for m in found
    ]
    return (
        f"{markdown(rows)}\n\nOne output of the cheapest analysis, each sweep in a process of its own. Between the two "
        f"largest, memory grows by {engine_cost.slope(found):.2g} bytes a point."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, simulate, write."""
    known = parser(__doc__)
    known.add_argument("--points", type=int, default=1_000_000, help="points of the overhead measurement (%(default)s)")
    known.add_argument("--repeats", type=int, default=5, help="runs of which the median counts (%(default)s)")
    options = known.parse_args(arguments)
    points, repeats = (50_000, 1) if options.quick else (options.points, options.repeats)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = engine_cost.overhead(points, repeats, folder)
        elsewhere = engine_cost.places(points, repeats, folder)
        memory = engine_cost.memory(_QUICK_MEMORY if options.quick else _MEMORY, folder)
    cost = costs(min(points, 200_000))
    simulated = loads(cost)
    tables = {
        "Overhead": markdown(engine_cost.rows_of(found)),
        "Where chunks are computed": markdown(engine_cost.rows_of_places(elsewhere)),
        "Memory": memory_table(memory),
    }
    text = page(tables, cost, simulated)
    print(text)
    results = results_folder(options)
    write_csv(results / "scaling.csv", [asdict(load) for load in simulated], [f"{asdict(cost)}"])
    write_csv(results / "overhead.csv", [asdict(found) | {"engine_over_kernels": found.ratio}])
    write_csv(results / "places.csv", [asdict(place) for place in elsewhere])
    write_csv(results / "memory.csv", [asdict(m) for m in memory])
    if results == RESULTS:
        PAGE.write_text(between_marks(PAGE.read_text(), text, BEGIN, END))


if __name__ == "__main__":
    main()
