"""Cells per second of the atlas and of rivals on samples of the same cells, in one run.

    python -m benchmarks.atlas [--cells 30000 1000000 4000000 20000000] [--repeats 3]    # writes results/atlas.csv

Chart: that of benchmarks.throughput, beta in [0, 1.5] x Omega in [0.1, 2], base case, spectral radius with its bound and
verdict. Times of the package for each number of cells:

    evaluation    the grid from an existing atlas (its kernels compiled)
    points        as many cells at random places, one million at most
    construction  the atlas alone: nodes, direct solves and fits; independent of the number of cells
    warm          atlas, grid and result in memory: nodes and direct solves included, compilation excluded
    file          as `warm`, into a file, flushed to the disk (not read back)
    cold          the whole command `drivetrain run`: import, compilation, solves, evaluation, file

`warm` also includes the checking of the scene, the digest of the code and the labelled result, which neither `construction`
nor `evaluation` includes.

Last row: an atlas over four parameters (sweeps/cardan_atlas_4d.toml) opened and sliced to a chart of 1000 x 1000 cells.

Rivals compute a sample of the cells (heyoka 20,000, SciPy 200) on both cores, in turns with the package. Their time for
all cells is extrapolated, which favours none of them: their time per cell does not depend on the number of cells. Errors
are those of the spectral radius relative to heyoka at 1e-15 on the sample; bounds are those of the package there. The rtol
of the package is chosen so that its largest error is about that of heyoka's fastest setting.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.throughput import Columns, heyoka_contender, reference_radius, scipy_contender
from benchmarks.timing import (
    chart,
    interleaved,
    median,
    parser,
    results_folder,
    spawned_workers,
    table,
    take,
    write_csv,
)
from tests.oracles.cardan_reference import BASE_CASE

CELLS = (30_000, 1_000_000, 4_000_000, 20_000_000)
RTOL = 3e-8
OUTPUTS = ("spectral_radius", "spectral_radius_error", "verdict")
SCENE_4D = Path(__file__).parents[1] / "sweeps" / "cardan_atlas_4d.toml"
_HEYOKA_SAMPLE, _SCIPY_SAMPLE = 20_000, 200
_MOST_POINTS = 1_000_000
# Peak memory of the whole command, children included.
_COLD = """
import json, resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, capture_output=True)
seconds = time.perf_counter() - start
print(json.dumps([seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024]))
"""


def axes(cells: int) -> dict[str, np.ndarray]:
    """The axes of a chart of about ``cells`` cells."""
    columns = chart(cells)
    return {name: np.unique(columns[name]) for name in ("beta", "Omega")}


def scene(cells: int) -> dict[str, Any]:
    """The chart as a scene of the package."""
    grid = {n: {"start": float(x[0]), "stop": float(x[-1]), "num": len(x)} for n, x in axes(cells).items()}
    return {
        "title": "atlas",
        "system": "cardan",
        "analysis": "floquet",
        "outputs": list(OUTPUTS),
        "axes": grid,
        "fixed": BASE_CASE,
        "options": {"method": "atlas", "rtol": RTOL},
    }


def package_jobs(cells: int, folder: Path) -> dict[str, Callable[[], Any]]:
    """The warm times of the package."""
    import drivetrain_jax as dt
    from drivetrain_jax.runs.run import run_to_file
    from drivetrain_jax.runs.scene import load_scene
    from drivetrain_jax.runs.through_atlas import build_atlas
    from drivetrain_jax.runs.work import Progress, Threads, Work

    grid, given = axes(cells), scene(cells)
    ranges = {name: (float(x[0]), float(x[-1])) for name, x in grid.items()}
    checked = load_scene(given)

    def construct() -> Any:
        return build_atlas(checked, ranges, Work(Threads()), Progress(0))[0]

    atlas = construct()
    low, high = np.array(list(ranges.values())).T
    size = min(int(np.prod([len(x) for x in grid.values()])), _MOST_POINTS)
    points = low + (high - low) * np.random.default_rng(2).random((size, 2))

    values = list(grid.values())
    return {
        "evaluation": lambda: atlas.on_grid(values, OUTPUTS),
        "points": lambda: atlas.at(points, OUTPUTS),
        "construction": construct,
        "warm": lambda: dt.run(given),
        "file": lambda: run_to_file(given, folder / "chart.nc", fresh=True),
    }


def four_parameters(folder: Path) -> dict[str, Any]:
    """The row about the atlas over four parameters."""
    import drivetrain_jax as dt

    path, axes_of_chart = (
        folder / "four.nc",
        {"beta": np.linspace(0.0, 1.3, 1000), "Omega": np.linspace(0.2, 2.5, 1000)},
    )
    dt.run(SCENE_4D, out=path, fresh=True).close()

    def opened() -> float:
        start = time.perf_counter()
        dt.open_atlas(path).grid(**axes_of_chart, mu=3.0, alpha=2.0)
        return time.perf_counter() - start

    opened()  # compiles
    cells = 1_000_000
    return _row(
        "atlas over four parameters, opened and sliced", cells, cells / median([opened() for _ in range(3)])
    ) | {
        "chart": cells,
        "times_heyoka": "",
        "max_error": "",
        "median_bound": "",
        "peak_MB": "",
    }


def cold(cells: int, folder: Path) -> tuple[float, float]:
    """Seconds and peak memory (MB) of the command in fresh processes."""
    path = folder / "scene.toml"
    path.write_text(_toml(scene(cells)))
    command = ["-m", "drivetrain_jax.cli", "run", str(path), "--out", str(folder / "cold.nc"), "--fresh"]
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"}
    done = subprocess.run(
        [sys.executable, "-c", _COLD, sys.executable, *command],
        check=True,
        capture_output=True,
        text=True,
        env=environment,
    )
    return tuple(json.loads(done.stdout))


def _toml(mapping: dict[str, Any]) -> str:
    head = [f"{key} = {json.dumps(value)}" for key, value in mapping.items() if not isinstance(value, dict)]
    for key, part in mapping.items():
        if isinstance(part, dict):
            head.append(f"[{key}]")
            head += [f"{k} = {_value(v)}" for k, v in part.items()]
    return "\n".join(head) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)


def rivals(stack: ExitStack, columns: Columns, rng: np.random.Generator) -> dict[str, tuple[Callable, Columns]]:
    """Jobs on samples of the cells."""
    size = columns["beta"].size
    many, few = (take(columns, rng.choice(size, min(n, size), replace=False)) for n in (_HEYOKA_SAMPLE, _SCIPY_SAMPLE))
    pool = stack.enter_context(spawned_workers())
    entries = [
        *(heyoka_contender(stack, many, tolerance) for tolerance in (1e-8, 1e-10)),
        *(scipy_contender(pool, few, method, 1e-9) for method in ("RK45", "DOP853")),
    ]
    return {entry.label: (entry.job, entry.columns) for entry in entries}


def measure(cells: int, repeats: int, folder: Path) -> list[dict[str, Any]]:
    """Rows of the table for one number of cells."""
    grid = axes(cells)
    count, columns = int(np.prod([len(x) for x in grid.values()])), chart(min(cells, 1_000_000))
    with ExitStack() as stack:
        others = rivals(stack, columns, np.random.default_rng(0))
        ours = package_jobs(cells, folder)
        answers = {label: job() for label, (job, _) in others.items()}
        for job in ours.values():
            job()
        colds: list[tuple[float, float]] = []
        jobs = {**ours, "cold": lambda: colds.append(cold(cells, folder))}
        seconds = interleaved({**jobs, **{label: job for label, (job, _) in others.items()}}, repeats)
    done = {label: min(count, _MOST_POINTS) if label == "points" else count for label in ours}
    rows = [_row(f"atlas, {label}", n, n / median(seconds[label])) for label, n in done.items()]
    in_all, memory = zip(*colds, strict=True)
    rows.append(_row("atlas, cold command", count, count / median(in_all)) | {"peak_MB": round(max(memory))})
    error, bound = _atlas_errors(folder / "cold.nc")
    rows = [row | {"max_error": error, "median_bound": bound} for row in rows]
    for label, (_, sample) in others.items():
        size = sample["beta"].size
        worst = float(np.nanmax(np.abs(answers[label] / reference_radius(sample) - 1)))
        rows.append(_row(label, size, size / median(seconds[label])) | {"max_error": worst})
    best = max(row["cells_per_s"] for row in rows if row["method"].startswith("heyoka"))
    blank = {"peak_MB": "", "median_bound": ""}
    return [{**blank, **row, "chart": count, "times_heyoka": row["cells_per_s"] / best} for row in rows]


def _row(method: str, cells: int, rate: float) -> dict[str, Any]:
    return {"method": method, "cells_computed": cells, "cells_per_s": round(rate)}


def _atlas_errors(path: Path) -> tuple[float, float]:
    """Largest relative error on a sample of the cells in a file, and the median relative bound."""
    import xarray as xr

    with xr.open_dataset(path, engine="h5netcdf") as ds:
        rng = np.random.default_rng(1)
        i, j = (rng.integers(0, ds.sizes[name], 3000) for name in ("beta", "Omega"))
        radius = ds.spectral_radius.values[i, j]
        bound = ds.spectral_radius_error.values[i, j]
        given = {"beta": ds.beta.values[i], "Omega": ds.Omega.values[j]}
    fixed = {name: np.full(len(i), value) for name, value in BASE_CASE.items()}
    return float(np.abs(radius / reference_radius({**given, **fixed}) - 1).max()), float(np.median(bound / radius))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the CSV, print the table."""
    known = parser(__doc__)
    known.add_argument("--cells", type=int, nargs="+", default=list(CELLS), help="sizes of the chart (%(default)s)")
    known.add_argument("--repeats", type=int, default=3, help="runs of which the median counts (%(default)s)")
    options = known.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        for cells in [30_000] if options.quick else options.cells:
            rows += measure(cells, options.repeats, Path(folder))
        if not options.quick:
            rows.append(four_parameters(Path(folder)))
    order = ("chart", "method", "cells_computed", "cells_per_s", "times_heyoka", "max_error", "median_bound", "peak_MB")
    rows = [{name: row[name] for name in order} for row in rows]
    about = f"rtol {RTOL:g}; {time.perf_counter() - start:.0f} s in all"
    write_csv(results_folder(options) / "atlas.csv", rows, [about])
    print(table(rows))


if __name__ == "__main__":
    main()
