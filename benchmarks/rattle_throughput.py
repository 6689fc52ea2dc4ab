"""Lane-periods per second of the gear-rattle solvers, and their error against run time.

``python -m benchmarks.rattle_throughput [lanes]`` writes benchmarks/results/rattle_throughput.csv and .png: the closed
form, diffrax with and without declared events, and SciPy with and without, on the same motions (Table 1 of the paper,
omega 0.3 .. 1.5, ten drive periods from rest). The error is the largest over the motions against extended precision
(NaN where a motion failed). At omega = 0.3 the solvers with events differ from both the closed form and extended precision
by 2.4e-7 however small the tolerance, which is what a contact that begins and ends within one step would cause.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from benchmarks.rattle_reference import extended, scipy_events, scipy_plain
from drivetrain_jax.analysis.piecewise_diffrax import integrate
from drivetrain_jax.analysis.piecewise_march import march, prepare, start
from drivetrain_jax.systems.rattle import PRESETS, oscillator

RESULTS = Path(__file__).parent / "results"
PERIODS = 10
TABLE1 = PRESETS["table1"]
TOLERANCES = (1e-6, 1e-9, 1e-12)
# SciPy is timed on so many of the motions.
SCIPY_LANES = 8


def exact(omega: np.ndarray) -> Callable[[], np.ndarray]:
    """The closed form, compiled for these frequencies."""

    def run(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        lanes = prepare(oscillator(TABLE1 | {"omega": w}))
        motion = march(lanes, start(lanes, 0.0 * w, 0.0 * w, jnp.full(w.shape, PERIODS, jnp.int32)), 100_000)
        return motion.u, motion.v

    compiled = jax.jit(run).lower(omega).compile()
    return lambda: np.stack(jax.block_until_ready(compiled(omega)))


def by_diffrax(omega: np.ndarray, rtol: float, events: bool) -> Callable[[], np.ndarray]:
    """diffrax over a vmapped batch, compiled for these frequencies."""

    def one(w: jax.Array) -> jax.Array:
        end = PERIODS * 2 * jnp.pi / w
        state, done = integrate(oscillator(TABLE1 | {"omega": w}), jnp.zeros(2), end, rtol=rtol, events=events)
        return jnp.where(done, state, jnp.nan)

    compiled = jax.jit(jax.vmap(one)).lower(omega).compile()
    return lambda: np.asarray(compiled(omega)).T


def by_scipy(omega: np.ndarray, rtol: float, solver: Callable) -> Callable[[], np.ndarray]:
    """SciPy, lane by lane."""
    return lambda: np.array([solver(TABLE1 | {"omega": float(w)}, 0.0, 0.0, PERIODS, rtol) for w in omega]).T


def contenders(lanes: int) -> Iterator[tuple[str, float, np.ndarray, Callable[[], np.ndarray]]]:
    """Name, tolerance, frequencies and run of every contender."""
    omega = np.linspace(0.3, 1.5, lanes)
    few = omega[:: max(lanes // SCIPY_LANES, 1)]
    yield "exact", 0.0, omega, exact(omega)
    for rtol in TOLERANCES:
        yield "diffrax with events", rtol, omega[: lanes // 4], by_diffrax(omega[: lanes // 4], rtol, True)
        yield "diffrax across the kinks", rtol, omega[: lanes // 4], by_diffrax(omega[: lanes // 4], rtol, False)
        yield "scipy with events", rtol, few, by_scipy(few, rtol, scipy_events)
        yield "scipy across the kinks", rtol, few, by_scipy(few, rtol, scipy_plain)


def measure(run: Callable[[], np.ndarray], repeats: int = 3) -> tuple[np.ndarray, float]:
    """The result and the shortest of a few run times in seconds."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - begin)
    return result, min(times)


def main(lanes: int = 1024) -> None:
    """Measure all contenders and write table and figure."""
    rows = []
    truth: dict[float, np.ndarray] = {}
    for name, rtol, omega, run in contenders(lanes):
        result, seconds = measure(run, 1 if name.startswith("scipy") else 3)
        chosen = range(0, omega.size, max(omega.size // SCIPY_LANES, 1))
        error = 0.0
        for k in chosen:
            w = float(omega[k])
            if w not in truth:
                truth[w] = np.array(extended(TABLE1 | {"omega": w}, 0.0, 0.0, PERIODS)[:2])
            error = max(error, float(np.abs(result[:, k] - truth[w]).max()))
        rows.append((name, rtol, omega.size, 1e6 * seconds / omega.size / PERIODS, error))
        sys.stdout.write(f"{name:26s} rtol {rtol:7.0e}  {rows[-1][3]:10.2f} us per lane-period  error {error:.1e}\n")
    write(rows)


def write(rows: list[tuple[str, float, int, float, float]]) -> None:
    """Table and figure of the measurements."""
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "rattle_throughput.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("solver", "rtol", "lanes", "microseconds_per_lane_period", "largest_error"))
        writer.writerows(rows)
    figure = Figure(figsize=(6.5, 4.0), dpi=150)
    axes = figure.add_axes((0.12, 0.14, 0.84, 0.8))
    for name in dict.fromkeys(row[0] for row in rows):
        own = [row for row in rows if row[0] == name]
        axes.loglog([r[3] for r in own], [max(r[4], 1e-17) for r in own], marker="o", label=name)
    axes.set(xlabel="time [us per lane-period]", ylabel="largest error after ten periods [m]")
    axes.legend(frameon=False)
    figure.savefig(RESULTS / "rattle_throughput.png")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
