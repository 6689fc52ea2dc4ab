"""Cells per second and error of every method on one chart, measured in one run, in turns.

    python -m benchmarks.throughput [--cells 30000] [--repeats 5] [--quick]     # writes results/throughput.csv

Chart: beta in [0, 1.5], Omega in [0.1, 2], zeta 0.001, alpha = mu = 1, gamma = 100. The result is the spectral radius, with
its bound for the package, so every time includes the eigenvalues. All methods may use both cores: the package by the
threads of its engine, the peers by two spawned processes that are started, and compiled, beforehand. diffrax gets a coarser
grid of the same chart, SciPy random cells of it. Errors are relative to heyoka at tolerance 1e-15, which is itself compared
with SciPy and with ``direct``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks import peers
from benchmarks.engine_job import engine_job
from benchmarks.timing import (
    PROCESSES,
    at_once,
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
from tests.oracles.cardan_reference import (
    BASE_CASE,
    monodromy,
    spectral_radius,
    stacked_half_period_monodromy,
    stacked_monodromy,
)

Columns = Mapping[str, np.ndarray]
_exact = cache(peers.HeyokaBatch)

# Every family has a setting below and one above an error of 1e-9 on this chart.
DIRECT_TOLERANCES = (1e-6, 1e-7, 1e-10)
DIFFRAX_TOLERANCES = (1e-5, 1e-6)
HEYOKA_TOLERANCES = (1e-8, 2e-9, 1e-10)
RK45_TOLERANCES, DOP853_TOLERANCES, STACKED_TOLERANCES = (1e-9, 3e-11), (1e-9, 1e-10), (1e-9, 2e-12)
HALF_PERIOD_TOLERANCES = (1e-9, 1e-10)
# Code of a process of its own that measures memory and time from the first import to the result.
_FRESH = """
import json, resource, sys, time
start = time.perf_counter()
import drivetrain_jax as dt
ds = dt.run(json.loads(sys.argv[1]))
seconds = time.perf_counter() - start
megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"seconds": seconds, "megabytes": megabytes, "cells": ds.outcome.size}))
"""


@dataclass(frozen=True)
class Contender:
    """A method: ``job()`` returns the spectral radii of ``columns``, or NaN if it computes no eigenvalues."""

    label: str
    job: Callable[[], np.ndarray]
    columns: Columns
    compile_s: float = 0.0


def scene(columns: Columns, method: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The chart as a scene of the package."""
    axes = {name: {"values": np.unique(columns[name]).tolist()} for name in ("beta", "Omega")}
    return {
        "title": "throughput",
        "system": "cardan",
        "analysis": "floquet",
        "outputs": ["spectral_radius", "spectral_radius_error"],
        "axes": axes,
        "fixed": BASE_CASE,
        "options": {"method": method, **options},
    }


def package_contender(columns: Columns, method: str, options: Mapping[str, Any]) -> Contender:
    """The package's engine on the whole chart: its plan, kernels and threads as in ``dt.run``, compiled once.

    ``dt.run`` compiles again in a fresh process, whose time is measured separately.
    """
    start = time.perf_counter()
    computed = engine_job(scene(columns, method, options), PROCESSES)
    compile_s = time.perf_counter() - start
    settings = ", ".join(f"{key} {value:g}" for key, value in options.items())
    return Contender(f"drivetrain_jax {method}, {settings}", lambda: computed()["spectral_radius"], columns, compile_s)


def heyoka_contender(stack: ExitStack, columns: Columns, tolerance: float, eigenvalues: bool = True) -> Contender:
    """heyoka's batch integrator in its best form (benchmarks.peers) on two processes."""
    start = time.perf_counter()
    peers.HeyokaBatch("half", tolerance, 8)
    compile_s = time.perf_counter() - start
    pool = stack.enter_context(spawned_workers(peers.prepare_worker, ("half", tolerance, 8)))
    task = peers.radius_in_worker if eigenvalues else peers.monodromy_in_worker
    label = f"heyoka batch, tolerance {tolerance:g}" + ("" if eigenvalues else ", without eigenvalues")
    job = shared_out(pool.map, task, columns, 4 * PROCESSES)
    return Contender(label, job, columns, compile_s)


def scipy_contender(pool: Any, columns: Columns, method: str, rtol: float) -> Contender:
    """``solve_ivp`` point by point on two processes."""
    job = shared_out(pool.map, SciPyPoints(method, rtol), columns, 8 * PROCESSES)
    return Contender(f"scipy {method}, rtol {rtol:g}", job, columns)


def stacked_contender(pool: Any, columns: Columns, rtol: float, half_period: bool = False) -> Contender:
    """``solve_ivp`` with hundreds of points in one state, on two processes."""
    job = shared_out(pool.map, SciPyStacked(rtol, half_period), columns, PROCESSES)
    form = "stacked, half period" if half_period else "stacked"
    return Contender(f"scipy DOP853 {form}, rtol {rtol:g}", job, columns)


@dataclass(frozen=True)
class SciPyPoints:
    """Spectral radii point by point (a class, so that spawned processes can receive it)."""

    method: str
    rtol: float

    def __call__(self, columns: Columns) -> np.ndarray:
        """Spectral radii of ``columns``."""
        points = ({name: column[i] for name, column in columns.items()} for i in range(columns["beta"].size))
        return np.array([spectral_radius(monodromy(p, self.method, self.rtol, self.rtol)) for p in points])


@dataclass(frozen=True)
class SciPyStacked:
    """Spectral radii of all points, 512 to a state."""

    rtol: float
    half_period: bool = False

    def __call__(self, columns: Columns) -> np.ndarray:
        """Spectral radii of ``columns``."""
        solve = stacked_half_period_monodromy if self.half_period else stacked_monodromy
        return spectral_radius(solve(columns, self.rtol, self.rtol))


def shared_out(
    mapper: Callable[..., Any], function: Callable[[Columns], np.ndarray], columns: Columns, tasks: int
) -> Callable[[], np.ndarray]:
    """A job that distributes the cells over the workers in turn, and returns the results in order."""
    deals = [np.arange(start, columns["beta"].size, tasks) for start in range(tasks)]
    hands = [take(columns, deal) for deal in deals]

    def job() -> np.ndarray:
        out = np.empty(columns["beta"].size)
        for deal, answer in zip(deals, mapper(function, hands), strict=True):
            out[deal] = answer
        return out

    return job


def fresh_process(columns: Columns) -> dict[str, float]:
    """Seconds from the first import to the result, compilation included, and peak memory of the chart in a fresh process."""
    given = json.dumps(scene(columns, "direct", {"rtol": 1e-10}))
    alone = os.environ | {"DRIVETRAIN_JAX_CACHE": "0"}
    done = subprocess.run([sys.executable, "-c", _FRESH, given], check=True, capture_output=True, text=True, env=alone)
    return json.loads(done.stdout.splitlines()[-1])


def contenders(stack: ExitStack, columns: Columns, sample: int, quick: bool) -> list[Contender]:
    """All methods, compiled; with ``quick`` only the setting of each method that reaches an error of 1e-9."""
    rng = np.random.default_rng(0)
    size = columns["beta"].size
    few, some = (take(columns, rng.choice(size, min(n, size), replace=False)) for n in (sample, 16 * sample))
    coarse = chart(min(size, 15 * sample))
    pool = stack.enter_context(spawned_workers())
    chosen = slice(-1, None) if quick else slice(None)
    direct = DIRECT_TOLERANCES[1:2] if quick else DIRECT_TOLERANCES
    own = [(columns, "direct", {"rtol": rtol}) for rtol in direct]
    own += [] if quick else [(coarse, "diffrax", {"rtol": rtol}) for rtol in DIFFRAX_TOLERANCES]
    bare = () if quick else (heyoka_contender(stack, columns, HEYOKA_TOLERANCES[0], eigenvalues=False),)
    return [
        *at_once([partial(package_contender, *given) for given in own]),
        *(heyoka_contender(stack, columns, tolerance) for tolerance in HEYOKA_TOLERANCES[chosen]),
        *bare,
        *(scipy_contender(pool, few, "RK45", rtol) for rtol in RK45_TOLERANCES[chosen]),
        *(scipy_contender(pool, few, "DOP853", rtol) for rtol in DOP853_TOLERANCES[chosen]),
        *(stacked_contender(pool, some, rtol) for rtol in STACKED_TOLERANCES[chosen]),
        *(stacked_contender(pool, some, rtol, half_period=True) for rtol in HALF_PERIOD_TOLERANCES[chosen]),
    ]


def measure(cells: int, repeats: int, sample: int, quick: bool = False) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows of the result table, and the notes above it."""
    columns = chart(cells)
    with ExitStack() as stack:
        entries = contenders(stack, columns, sample, quick)
        answers = {entry.label: entry.job() for entry in entries}  # starts the workers
        seconds = interleaved({entry.label: entry.job for entry in entries}, repeats)
    rows = []
    for entry in entries:
        error = np.abs(answers[entry.label] / reference_radius(entry.columns) - 1)
        size = entry.columns["beta"].size
        rate = size / median(seconds[entry.label])
        spread = max(seconds[entry.label]) / min(seconds[entry.label])
        rows.append(
            {"method": entry.label, "cells": size, "cells_per_s": rate, "slowest_over_fastest": spread}
            | {
                "compile_s": entry.compile_s,
                "max_error": float(np.max(error)),
                "median_error": float(np.median(error)),
            }
        )
    baseline = next(row["cells_per_s"] for row in rows if row["method"].startswith("scipy RK45"))
    for row in rows:
        row["times_scipy_RK45"] = row["cells_per_s"] / baseline
        row["cells_per_s"] = round(row["cells_per_s"])
    return rows, notes(columns, repeats, sample, None if quick else 1e-13)


def reference_radius(columns: Columns) -> np.ndarray:
    """Spectral radii to about 1e-13; the notes of the result file give the check of this accuracy."""
    return spectral_radius(_exact("half", 1e-15).monodromy(columns))


def notes(columns: Columns, repeats: int, sample: int, rtol: float | None) -> list[str]:
    """Accuracy of the reference (also against ``direct`` if ``rtol`` is given), and memory of the package."""
    import drivetrain_jax as dt

    reference = reference_radius(columns)
    index = np.random.default_rng(1).choice(columns["beta"].size, min(sample, 60), replace=False)
    independent = SciPyPoints("DOP853", 1e-13)(take(columns, index))
    fresh = fresh_process(columns)
    trusted = f"scipy DOP853 1e-13 by {np.abs(independent / reference[index] - 1).max():.1e} ({index.size} cells)"
    if rtol:
        tight = dt.run(scene(columns, "direct", {"rtol": rtol})).spectral_radius.values.ravel()
        trusted += f", from direct {rtol:g} by {np.nanmax(np.abs(tight / reference - 1)):.1e} (all cells)"
    return [
        f"chart of {columns['beta'].size:,} cells, medians of {repeats} interleaved repeats, {PROCESSES} cores",
        f"reference heyoka 1e-15: differs from {trusted}",
        f"fresh process, no compiled code, direct rtol 1e-10: import to result {fresh['seconds']:.1f} s, "
        f"peak memory {fresh['megabytes']:.0f} MB",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the CSV, print the table."""
    known = parser(__doc__)
    known.add_argument("--cells", type=int, default=30_000, help="of the chart (%(default)s)")
    known.add_argument("--repeats", type=int, default=5, help="runs of which the median counts (%(default)s)")
    options = known.parse_args(arguments)
    cells, repeats, sample = (3000, 3, 20) if options.quick else (options.cells, options.repeats, 200)
    rows, remarks = measure(cells, repeats, sample, options.quick)
    write_csv(results_folder(options) / "throughput.csv", rows, remarks)
    print("\n".join(remarks), table(rows), sep="\n")


if __name__ == "__main__":
    main()
