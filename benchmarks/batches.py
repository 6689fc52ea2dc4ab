"""Cost of a point by batch width, number of points, cores, size of the system and outputs; and a cold start.

    python -m benchmarks.batches [--quick] [--out FOLDER]     # batches.csv, outputs.csv, cold_start.csv and batches.png

"width": points a second of one kernel compiled for chunks of that many points, on one core. "points" and "cores": a
process of its own runs the scene from start to file twice; the second run counts, and peak memory is that of the process.
The largest number of points is extrapolated from the last two measured ones, and marked as such. "planets": gears a second
by number of planets, 3N + 9 frequencies each. "outputs": time per point relative to the first set of outputs; kernels take
turns. "parameters varied": the same points, with all parameters but two as columns of the kernel instead of constants. "cold
start": a small scene in a new process, divided into import, compilation, computation and file, with an empty, a filled and
no folder of compiled code (``DRIVETRAIN_JAX_CACHE``, docs/sharp_edges.md).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.batches_figure import draw
from benchmarks.batches_scenes import COLD, FOUR, OUTPUTS, WIDTHS, cells, gears, shafts
from benchmarks.timing import at_once, interleaved, median, parser, results_folder, table, write_csv

_POINTS, _QUICK_POINTS = (100, 1_000, 10_000, 100_000, 1_000_000), (100, 10_000)
_EXTRAPOLATED = 10_000_000
# Code of the process: arguments are the scene, the output, the number of cores, and the number of runs to a file. A single
# run to a file follows two runs in memory. Prints seconds and MB.
_CHILD = """
import json, os, sys, time
scene, out, cores, runs = json.loads(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
start = time.perf_counter()
from pathlib import Path
from drivetrain_jax import _compile_cache
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.kernel import kernel_of
from drivetrain_jax.runs.run import run, run_to_file
from drivetrain_jax.runs.scene import load_scene
imported = time.perf_counter()
_compile_cache.enable(short=True)
engine = resolve(load_scene(scene))
chunks = [chunk for block in engine.blocks() for chunk in engine.plan(block)]
for index, size in {(chunk.solver, chunk.size) for chunk in chunks}:
    kernel_of(engine.scene, engine.grid, engine.solvers[index], size)
compiled = time.perf_counter()
ran = warm = compiled
if runs == 1:
    run(scene)
    ran = time.perf_counter()
    run(scene)
    warm = time.perf_counter()
seconds = []
for number in range(runs):
    begin = time.perf_counter()
    run_to_file(scene, Path(f"{out}.{number}.nc"))
    seconds.append(time.perf_counter() - begin)
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(json.dumps({"import_s": imported - start, "compile_s": compiled - imported, "run_s": ran - compiled,
                  "warm_s": warm - ran, "file_s": seconds[-1], "peak_MB": int(status["VmHWM"].split()[0]) / 1024}))
"""


def child(scene: Mapping[str, Any], cores: int, cache: str, runs: int = 2) -> dict[str, float]:
    """Seconds and peak memory of a process that runs ``scene`` to a file; ``cache`` is the folder of compiled code."""
    own = dict(os.environ) | {"DRIVETRAIN_JAX_CACHE": cache}
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-c", _CHILD, json.dumps(scene), f"{folder}/out", str(cores), str(runs)]
        done = subprocess.run(words, check=True, capture_output=True, text=True, env=own)
    return json.loads(done.stdout.strip().splitlines()[-1])


def kernel_job(scene: Mapping[str, Any], width: int | None = None) -> tuple[Any, int]:
    """A function that runs a chunk of ``scene``, and the number of its points, ``width`` or that of the plan.

    The chunk is the one whose predicted cost is next to the mean: a plan begins with the hardest points.
    """
    from drivetrain_jax.runs.kernel import kernel_of
    from drivetrain_jax.runs.resolve import resolve
    from drivetrain_jax.runs.scene import load_scene

    engine = resolve(load_scene(dict(scene)))
    chunks = [chunk for block in engine.blocks() for chunk in engine.plan(block)]
    costs = np.array([chunk.cost for chunk in chunks])
    chunk = chunks[int(np.argmin(np.abs(costs - costs.mean())))]
    size = width or chunk.size
    kernel = kernel_of(engine.scene, engine.grid, engine.solvers[chunk.solver], size)
    columns = engine.grid.columns(np.resize(chunk.points, size))
    return lambda: kernel(columns, engine.grid.numbers, chunk.effort), size


def rate_row(what: str, system: str, number: int, per_s: float, how: str, peak: float = float("nan")) -> dict[str, Any]:
    """A line of batches.csv."""
    return {"by": what, "system": system, "number": number, "points_per_s": per_s, "how": how, "peak_MB": peak}


def timed(scenes: Mapping[tuple, tuple[Mapping[str, Any], int | None]], repeats: int) -> dict[tuple, tuple[float, int]]:
    """Median seconds and points of one chunk of every scene, taken in turns; the first run only warms up."""
    made = at_once([partial(kernel_job, scene, width) for scene, width in scenes.values()])
    jobs = dict(zip(scenes, made, strict=True))
    names = {str(i): key for i, key in enumerate(jobs)}
    for job, _ in made:
        job()
    seconds = interleaved({name: jobs[key][0] for name, key in names.items()}, repeats)
    return {key: (median(seconds[name]), jobs[key][1]) for name, key in names.items()}


def by_width(quick: bool, repeats: int) -> list[dict[str, Any]]:
    """Points a second against the width of the batch, and gears a second against the number of planets."""
    widths, counts = {"cardan": (1, 32, 512, 8192), "planetary": (1, 512, 8192), "bicardan": (1, 512, 8192)}, (3, 12)
    if quick:
        widths, counts = {"bicardan": (64, 512)}, ()
    scenes = {(system, width): (WIDTHS[system], width) for system, all_of in widths.items() for width in all_of}
    planets = {("planets", n): (gears(n), 512) for n in counts}
    found = timed(scenes | planets, repeats)
    rows = [rate_row("width", *key, size / s, "kernel") for key, (s, size) in found.items() if key[0] != "planets"]
    if counts:
        found["planets", FOUR] = found["planetary", 512]
    return rows + [rate_row("planets", "planetary", key[1], size / s, "kernel")
                   for key, (s, size) in sorted(found.items()) if key[0] == "planets"]  # fmt: skip


def by_points(quick: bool, cache: str) -> list[dict[str, Any]]:
    """Points a second of whole runs against their number, and against the number of cores."""
    rows, spent = [], []
    system, scene = ("bicardan", shafts) if quick else ("cardan", cells)
    for count in _QUICK_POINTS if quick else _POINTS:
        found = child(scene(count), 2, cache)
        spent.append((count, found["file_s"]))
        rows.append(rate_row("points", system, count, count / found["file_s"], "measured", found["peak_MB"]))
    (n1, t1), (n2, t2) = spent[-2:]
    seconds = t2 + (t2 - t1) / (n2 - n1) * (_EXTRAPOLATED - n2)
    rows.append(rate_row("points", system, _EXTRAPOLATED, _EXTRAPOLATED / seconds, "extrapolated"))
    if not quick:
        for system, scene, count in (
            ("cardan", cells(100_000), 100_000),
            ("planetary", gears(FOUR, 50_000), 50_000),
        ):
            for cores in (1, 2):
                found = child(scene, cores, cache)
                rows.append(rate_row("cores", system, cores, count / found["file_s"], "measured", found["peak_MB"]))
    return rows


def by_outputs(quick: bool, repeats: int) -> list[dict[str, Any]]:
    """Time per point for each set of outputs."""
    rows = []
    for (system, first), sets in OUTPUTS.items():
        if quick and system != "bicardan":
            continue
        chosen = list(sets.items())[: 2 if quick else None]
        found = timed({(name,): (scene, None) for name, scene in chosen}, repeats)
        least = found[first,][0] / found[first,][1]
        for (name,), (seconds, size) in found.items():
            rows.append({"system": system, "outputs": name, "us_per_point": 1e6 * seconds / size,
                         "times_the_first": seconds / size / least})  # fmt: skip
    return rows


def cold_start(quick: bool) -> list[dict[str, Any]]:
    """Parts of a cold start with an empty, a filled and no folder of compiled code."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, cache in (("empty", folder), ("filled", folder), ("off", "0"))[: 2 if quick else 3]:
            found = child(shafts(1000) if quick else COLD, 2, cache, runs=1)
            write, peak = max(found.pop("file_s") - found.pop("warm_s"), 0.0), found.pop("peak_MB")
            rows.append({"compiled_code": name, **found, "write_s": write, "peak_MB": peak})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print and write."""
    options = parser(__doc__).parse_args(argv)
    folder, repeats = results_folder(options), 1 if options.quick else 3
    with tempfile.TemporaryDirectory() as cache:
        batches = by_width(options.quick, repeats) + by_points(options.quick, cache)
    outputs, cold = by_outputs(options.quick, repeats), cold_start(options.quick)
    write_csv(
        folder / "batches.csv", batches, ["width, planets: one kernel; points, cores: start to file, compiled before"]
    )
    about = "one kernel on one core, everything that is not asked for left out of it"
    write_csv(folder / "outputs.csv", outputs, [f"{about}; taken in turns, medians of {repeats}"])
    write_csv(folder / "cold_start.csv", cold, ["seconds in a new process; write: what a run to a file takes more"])
    draw(batches, outputs, cold, Path(folder))
    print(table(batches), table(outputs), table(cold), sep="\n\n")


if __name__ == "__main__":
    main()
