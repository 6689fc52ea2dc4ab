"""Lane-periods per second of the gear-rattle solvers, and their error against run time.

``python -m benchmarks.rattle_throughput`` writes benchmarks/results/rattle_throughput.csv and .png (``--quick``: a smaller
table). Contenders are the closed form, and diffrax and SciPy each with and without events, on the same motions (Table 1 of
the paper, omega 0.3 .. 1.5, ten drive periods from rest). Every contender uses one core: XLA runs these loops in one thread,
and so does SciPy. The error is the largest over a few motions against extended precision; runs with failed motions are kept
and marked.

At omega = 0.3 the error of solvers with events does not fall with the tolerance: a short contact at t = 146.9 begins and
ends within one step. SciPy finds this contact with steps of at most 0.05. Nothing shows it to a user.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from benchmarks.precision_figure import style_of
from benchmarks.rattle_diffrax import integrate
from benchmarks.timing import interleaved, median, parser, provenance, results_folder, table, write_csv
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.oracles.rattle_reference import extended, scipy_events, scipy_plain

PERIODS = 10
TABLE1 = PRESETS["table1"]
# Number of motions on which SciPy is timed, and from which errors are computed.
FEW = 8
EXACT, EVENTS = "exact", "scipy with events"


class Size(NamedTuple):
    """Numbers of lanes of the closed form and of diffrax, tolerances, and number of runs for the median."""

    lanes: int
    diffrax_lanes: int
    tolerances: tuple[float, ...]
    repeats: int


FULL, QUICK = Size(1024, 256, (1e-6, 1e-9, 1e-12), 3), Size(256, 16, (1e-9,), 1)


class Contender(NamedTuple):
    """A solver at a tolerance, its frequencies, and its run, which returns states of shape (2, frequencies)."""

    name: str
    rtol: float
    omega: np.ndarray
    run: Callable[[], np.ndarray]


def exact(omega: np.ndarray) -> Callable[[], np.ndarray]:
    """The closed form, compiled for these frequencies."""

    def run(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        lanes = prepare(Rattle.models["basins"].build(TABLE1 | {"omega": w}))
        motion = march(lanes, start(lanes, 0.0 * w, 0.0 * w, jnp.full(w.shape, PERIODS, jnp.int32)), 100_000)
        return motion.u, motion.v

    compiled = jax.jit(run).lower(omega).compile()
    return lambda: np.stack(jax.block_until_ready(compiled(omega)))


def by_diffrax(omega: np.ndarray, rtol: float, events: bool) -> Callable[[], np.ndarray]:
    """diffrax over a vmapped batch, compiled for these frequencies."""

    def one(w: jax.Array) -> jax.Array:
        end = PERIODS * 2 * jnp.pi / w
        state, done = integrate(
            Rattle.models["basins"].build(TABLE1 | {"omega": w}), jnp.zeros(2), end, rtol=rtol, events=events
        )
        return jnp.where(done, state, jnp.nan)

    compiled = jax.jit(jax.vmap(one)).lower(omega).compile()
    return lambda: np.asarray(compiled(omega)).T


def by_scipy(omega: np.ndarray, rtol: float, solver: Callable) -> Callable[[], np.ndarray]:
    """SciPy, lane by lane."""
    return lambda: np.array([solver(TABLE1 | {"omega": float(w)}, 0.0, 0.0, PERIODS, rtol) for w in omega]).T


def contenders(size: Size) -> list[Contender]:
    """All contenders, compiled."""
    omega, some = (np.linspace(0.3, 1.5, lanes) for lanes in (size.lanes, size.diffrax_lanes))
    few = np.linspace(0.3, 1.5, FEW)
    found = [Contender(EXACT, 0.0, omega, exact(omega))]
    for rtol in size.tolerances:
        found += [
            Contender("diffrax with events", rtol, some, by_diffrax(some, rtol, True)),
            Contender("diffrax across the kinks", rtol, some, by_diffrax(some, rtol, False)),
            Contender(EVENTS, rtol, few, by_scipy(few, rtol, scipy_events)),
            Contender("scipy across the kinks", rtol, few, by_scipy(few, rtol, scipy_plain)),
        ]
    return found


def error_of(omega: np.ndarray, states: np.ndarray) -> tuple[float, int]:
    """Largest error of a few motions that have not failed, and number of all failed motions."""
    chosen = np.unique(np.linspace(0, omega.size - 1, FEW).round().astype(int))
    truth = np.array([extended(TABLE1 | {"omega": float(w)}, 0.0, 0.0, PERIODS)[:2] for w in omega[chosen]]).T
    errors = np.abs(states[:, chosen] - truth).max(axis=0)
    known = errors[np.isfinite(errors)]
    return float(known.max()) if known.size else float("nan"), int((~np.isfinite(states).all(axis=0)).sum())


def measure(size: Size) -> list[dict[str, Any]]:
    """A row for every contender; runs are taken in turns."""
    runs = contenders(size)
    results = [contender.run() for contender in runs]
    seconds = interleaved({str(i): contender.run for i, contender in enumerate(runs)}, size.repeats)
    rows = []
    for i, (contender, states) in enumerate(zip(runs, results, strict=True)):
        error, failed = error_of(contender.omega, states)
        pace = 1e6 * median(seconds[str(i)]) / contender.omega.size / PERIODS
        row = {"solver": contender.name, "rtol": contender.rtol, "lanes": contender.omega.size}
        rows.append(row | {"us_per_lane_period": pace, "per_second": 1e6 / pace, "error": error, "failed": failed})
    return rows


def ratio(rows: list[dict[str, Any]]) -> str:
    """Ratio of the speed of the closed form to that of SciPy with events, at each tolerance of SciPy, as text."""
    own = next(row for row in rows if row["solver"] == EXACT)["us_per_lane_period"]
    times = (f"{row['us_per_lane_period'] / own:.0f} at {row['rtol']:g}" for row in rows if row["solver"] == EVENTS)
    return f"{EVENTS} over {EXACT}, time per lane-period: {', '.join(times)}"


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """The figure: error against time, crosses where motions failed."""
    figure = Figure(figsize=(6.5, 4.2), dpi=150)
    axes = figure.add_axes((0.12, 0.17, 0.84, 0.8))
    for number, name in enumerate(dict.fromkeys(row["solver"] for row in rows)):
        own = [row for row in rows if row["solver"] == name]
        # Without an error, because all motions failed, the point is at the top.
        points = [(row["us_per_lane_period"], row["error"] if row["error"] > 0 else 1.0, row["failed"]) for row in own]
        (line,) = axes.loglog(*zip(*((x, y) for x, y, _ in points), strict=True), label=name, **style_of(number))
        for x, y, failed in points:
            if failed:
                axes.plot(x, y, marker="x", markersize=12, markeredgewidth=2, color=line.get_color())
                axes.annotate(f"{failed} failed", (x, y), textcoords="offset points", xytext=(8, 4), fontsize=7)
    axes.set(xlabel="time [us per lane-period]", ylabel="largest error after ten periods [m]")
    axes.legend(frameon=False, fontsize=8)
    known = provenance()
    figure.text(0.01, 0.01, f"{known['machine']}; {known['versions']}", fontsize=4.5)
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all contenders, write table and figure."""
    options = parser(__doc__).parse_args(arguments)
    rows = measure(QUICK if options.quick else FULL)
    sys.stdout.write(f"{table(rows)}\n{ratio(rows)}\n")
    folder = results_folder(options)
    write_csv(folder / "rattle_throughput.csv", rows, [ratio(rows)])
    draw(rows, folder / "rattle_throughput.png")


if __name__ == "__main__":
    main()
