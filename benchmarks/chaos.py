"""Lyapunov time units and strobes per second against SciPy, heyoka.py and pynamicalsys; error against run time.

    python -m benchmarks.chaos [--pynamicalsys PYTHON] [--quick]   # writes results/chaos.csv, chaos_precision.csv and .png

The motions are Lorenz (10, 28, 8/3) with three tangent vectors, orthonormalised every half time unit, and the double tripod
(29) at 3066.5 Hz with two, orthonormalised at every strobe. The package takes equal steps, the others are adaptive. The
package is timed with the divergence and the records of every segment (``record_growth``), 64 members at a time in each of
two threads. The others run in two spawned processes: SciPy member by member, heyoka.py eight members in a batch, with the
vectors of 256 members orthonormalised together. Methods take turns, so that a change in the machine's load affects all
alike (pynamicalsys comes after them); rates are medians. Errors are those of state and tangent vectors after one time unit
of Lorenz' system (from points of the attractor) and after 16 strobes of the tripod, relative to their size, root mean
square, against SciPy at 1e-13. Methods are compared at the error of SciPy's DOP853 at tolerance 1e-10.
``PYTHON`` is an interpreter that has pynamicalsys (it needs other versions than this package).
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from benchmarks.timing import PROCESSES, median, parser, results_folder, spawned_workers, table, write_csv
from tests.oracles.chaos_reference import (
    INTERVAL,
    HeyokaFlow,
    attractor,
    heyoka_lorenz,
    heyoka_tripod,
    lorenz,
    scipy_flow,
    scipy_spectrum,
    tripod_field,
)

matplotlib.use("Agg")

LANES = 64
# Members of a run of heyoka.py, which has eight lanes; more members share the cost of NumPy's calls.
MEMBERS = 256
STEPS = {"Lorenz": (32, 40, 48, 56, 64, 72), "tripod": (6, 8, 12, 16, 24)}
TOLERANCES = (1e-6, 1e-8, 1e-9, 1e-10, 1e-12)
QUICK_STEPS, QUICK_TOLERANCES = {"Lorenz": (56, 72), "tripod": (8, 12)}, (1e-8, 1e-10)
# The tolerance at whose error the methods are compared.
COMPARED = 1e-10
TRIPOD = {"zeta": 0.0016, "chi": 0.0026, "frequency": 3066.5}
CONSTANTS = {
    "Omega": 9633.726700903984, "c1": 0.005213670937369757, "c2": 0.0016565396527480861,
    "A_TJ": 3.652758897391374e-05, "F_over_I": 8365.245060248115, "chi_T": 0.05,
}  # fmt: skip
STROBES = 16
_PYNAMICALSYS = """
import json, sys, time
from pynamicalsys import ContinuousDynamicalSystem
units = float(sys.argv[1])
system = ContinuousDynamicalSystem(model="lorenz system")
system.integrator("rk45", atol=1e-10, rtol=1e-10)
run = lambda t: system.lyapunov([1.0, 1.0, 20.0], t, parameters=[10.0, 28.0, 8 / 3], transient_time=5.0)
run(10.0)
seconds = []
for _ in range(int(sys.argv[2])):
    start = time.perf_counter()
    spectrum = run(units)
    seconds.append(time.perf_counter() - start)
print(json.dumps({"seconds": seconds, "spectrum": list(map(float, spectrum))}))
"""


@dataclass
class Contender:
    """A method with a setting: ``rate()`` in time units or strobes per second; ``rates`` collects its results."""

    case: str
    method: str
    setting: str
    error: float
    rate: Callable[[], float]
    rates: list[float] = field(default_factory=list)

    @property
    def per_s(self) -> float:
        """Median rate."""
        return median(self.rates)


def _compiled(function: Callable, *arguments: Any) -> Any:
    import jax

    from drivetrain_jax._machine import instruction_set

    # The compiler options of the package's engine.
    options = {"xla_cpu_prefer_vector_width": 512} if "avx512f" in instruction_set() else None
    return jax.jit(function).lower(*arguments).compile(options)


def lorenz_flow(starts: Any, period: float) -> Any:
    """Lorenz' system of the package's flows from ``starts`` (3, N)."""
    from drivetrain_jax.systems import Flow

    def rates(_: Any, y: Any) -> tuple:
        return 10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]

    return Flow(rates, tuple(starts), period)


def tripod_flow(starts: Any) -> Any:
    """(29) of the package from ``starts`` (2, N): twist, and its rate over Omega."""
    from drivetrain_jax.systems import get_system

    system = get_system("tripod")
    values = {p.name: p.default for p in system.parameters if p.default is not None}
    values |= {"element": "input", "beta": math.radians(9), "zeta": TRIPOD["zeta"], "chi_n": TRIPOD["chi"]}
    values |= {"phi0": starts[0], "velocity0": starts[1] * CONSTANTS["Omega"]}
    return system.models["lyapunov"].build(values | {"excitation_frequency": TRIPOD["frequency"]})


def package_ends(flow: Callable[[Any], Any], strobes: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """``ends(starts, steps)``: states and tangent vectors ``strobes`` later, one row per start, ``steps`` per strobe."""
    import jax
    import jax.numpy as jnp

    from drivetrain_jax.analysis.lyapunov.variational import initial_frame, one_kernel, strobe_map

    @jax.jit
    def ends(starts: Any, steps: Any) -> Any:
        built = flow(starts)
        advance = strobe_map(built, steps)
        march = one_kernel(built)(lambda frame: jax.lax.fori_loop(0, strobes, advance, frame))
        frame = march(initial_frame(built)._replace(contraction=None))
        return jnp.concatenate([jnp.stack(frame.state), *jnp.stack(frame.tangents, axis=1)])

    return lambda starts, steps: np.asarray(ends(starts.T, steps)).T


def package_rate(flow: Callable[[Any], Any], starts: np.ndarray, period: float) -> Callable[[int, int], float]:
    """``rate(steps, strobes)``: strobes per second of all members, ``steps`` per strobe, by two threads."""
    import jax
    import jax.numpy as jnp

    from drivetrain_jax.analysis.lyapunov.growth_record import record_growth

    def march(starts: Any, steps: Any, time: Any) -> Any:
        record = record_growth(flow(starts), steps, time, 0.0, jnp.ones(LANES, bool))
        return record.growth, record.contraction, record.strobe

    parts = np.resize(starts, (PROCESSES, LANES, starts.shape[1])).transpose(0, 2, 1) + 1e-6 * np.arange(LANES)
    run = _compiled(march, parts[0], 4, 1.0)

    def rate(steps: int, strobes: int) -> float:
        begin = time.perf_counter()
        with ThreadPoolExecutor(PROCESSES) as pool:
            done = list(pool.map(lambda part: jax.block_until_ready(run(part, steps, (strobes - 0.5) * period)), parts))
        return sum(int(np.sum(result[2])) for result in done) / (time.perf_counter() - begin)

    return rate


def relative_error(found: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square over the rows of the relative error."""
    return float(np.sqrt(np.mean(np.sum((found - exact) ** 2, 1) / np.sum(exact**2, 1))))


def scipy_rate(case: str, count: int, tolerance: float) -> float:
    """Strobes per second of one process, by Benettin's method."""
    start, interval = (np.array([1.0, 1.0, 20.0]), INTERVAL) if case == "Lorenz" else (np.zeros(2), _PERIOD)
    rates = lorenz if case == "Lorenz" else tripod_field(CONSTANTS | TRIPOD)
    begin = time.perf_counter()
    scipy_spectrum(rates, start, interval, count, tolerance)
    return count / (time.perf_counter() - begin)


_PERIOD = 1 / TRIPOD["frequency"]
attractor_points = cache(attractor)


@cache
def _heyoka(case: str, tolerance: float) -> HeyokaFlow:
    return heyoka_lorenz(tolerance) if case == "Lorenz" else heyoka_tripod(CONSTANTS | TRIPOD, tolerance)


def heyoka_rate(case: str, count: int, tolerance: float) -> float:
    """Strobes per second of one process, by Benettin's method."""
    integrator, interval = _heyoka(case, tolerance), INTERVAL if case == "Lorenz" else _PERIOD
    starts = np.resize(attractor_points(8) if case == "Lorenz" else np.zeros((8, 2)), (MEMBERS, integrator.n))
    integrator.spectrum(starts, interval, 2)
    begin = time.perf_counter()
    integrator.spectrum(starts, interval, count)
    return MEMBERS * count / (time.perf_counter() - begin)


def pynamicalsys_rate(python: str, units: float, rounds: int) -> float:
    """Time units per second of two processes of the interpreter ``python``, each the median of its rounds.

    The processes start once and run after the other methods, because their compilation takes longer than their work.
    """
    command = [python, "-c", _PYNAMICALSYS, str(units), str(rounds)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(PROCESSES)]
    return sum(units / median(json.loads(process.communicate()[0])["seconds"]) for process in processes)


def lorenz_contenders(pool: Executor, quick: bool) -> list[Contender]:
    """The package, SciPy and heyoka.py over their settings; rates in time units."""
    starts = attractor_points(8 if quick else 64)
    exact = scipy_flow(starts, 1.0, 1e-13)
    ends, rate = (
        package_ends(lambda s: lorenz_flow(s, 1.0), 1),
        package_rate(lambda s: lorenz_flow(s, INTERVAL), starts, INTERVAL),
    )
    strobes, share = (128, 10) if quick else (1024, 1)
    found = [
        Contender("Lorenz", "drivetrain_jax", f"{steps} steps per time unit", relative_error(ends(starts, steps), exact),
                  lambda n=steps: INTERVAL * rate(round(n * INTERVAL), strobes))
        for steps in (QUICK_STEPS if quick else STEPS)["Lorenz"]
    ]  # fmt: skip
    flows = {
        "SciPy DOP853": lambda tolerance: scipy_flow(starts, 1.0, tolerance),
        "heyoka.py": lambda tolerance: _heyoka("Lorenz", tolerance).flow(starts, 1.0),
    }
    return found + peers(pool, "Lorenz", flows, exact, {"SciPy DOP853": 50 // share, "heyoka.py": 150 // share}, quick)


def peers(
    pool: Executor,
    case: str,
    flows: Mapping[str, Callable[[float], np.ndarray]],
    exact: np.ndarray,
    counts: Mapping[str, int],
    quick: bool,
) -> list[Contender]:
    """SciPy and heyoka.py at their tolerances: ``flows`` for the error, ``counts`` intervals of each for the rate."""
    jobs, unit = {"SciPy DOP853": scipy_rate, "heyoka.py": heyoka_rate}, INTERVAL if case == "Lorenz" else 1.0
    found = []
    for tolerance in QUICK_TOLERANCES if quick else TOLERANCES:
        for name, flow in flows.items():

            def rate(job: Callable = jobs[name], count: int = counts[name], tolerance: float = tolerance) -> float:
                both = zip(*[(case, count, tolerance)] * PROCESSES, strict=True)
                return unit * sum(pool.map(job, *both))

            error = relative_error(flow(tolerance), exact)
            found.append(Contender(case, name, f"tolerance {tolerance:g}", error, rate))
    return found


def tripod_contenders(pool: Executor, quick: bool) -> list[Contender]:
    """The package, SciPy and heyoka.py over their settings; rates in strobes.

    Starts have the size of the tangent vectors, so that the error weighs both alike.
    """
    starts = np.random.default_rng(0).uniform(-0.3, 0.3, (8, 2))
    rates = tripod_field(CONSTANTS | TRIPOD)
    exact = scipy_flow(starts, STROBES * _PERIOD, 1e-13, rates)
    ends, rate = package_ends(tripod_flow, STROBES), package_rate(tripod_flow, starts, _PERIOD)
    strobes = 512 if quick else 4096
    found = [
        Contender("tripod", "drivetrain_jax", f"{steps} steps per strobe", relative_error(ends(starts, steps), exact),
                  lambda n=steps: rate(n, strobes))
        for steps in (QUICK_STEPS if quick else STEPS)["tripod"]
    ]  # fmt: skip
    flows = {
        "SciPy DOP853": lambda tolerance: scipy_flow(starts, STROBES * _PERIOD, tolerance, rates),
        "heyoka.py": lambda tolerance: _heyoka("tripod", tolerance).flow(starts, STROBES * _PERIOD),
    }
    counts = {"SciPy DOP853": 40 if quick else 200, "heyoka.py": 20 if quick else 200}
    return found + peers(pool, "tripod", flows, exact, counts, quick)


def compared(contenders: Sequence[Contender]) -> list[dict[str, Any]]:
    """The best rate of every method at the error of SciPy at the tolerance ``COMPARED``, also relative to SciPy."""
    rows = []
    for case in dict.fromkeys(c.case for c in contenders):
        own = [c for c in contenders if c.case == case]
        peer = next(c for c in own if (c.method, c.setting) == ("SciPy DOP853", f"tolerance {COMPARED:g}"))
        for method in dict.fromkeys(c.method for c in own):
            reached = [c for c in own if c.method == method and c.error <= 1.001 * peer.error]
            best = max(reached, key=lambda c: c.per_s, default=None)
            rate = best.per_s if best else math.nan
            rows.append({"case": f"{case} at error <= {peer.error:.1e}", "method": method,
                         "setting": best.setting if best else "none", "error": best.error if best else math.nan,
                         "per_s": rate, "times_scipy": rate / peer.per_s})  # fmt: skip
    return rows


def draw(contenders: Sequence[Contender], path: Path) -> None:
    """Error against rate, one panel for each case."""
    from matplotlib.figure import Figure

    from benchmarks.precision_figure import style_of

    cases = list(dict.fromkeys(c.case for c in contenders))
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    for axes, case in zip(figure.subplots(1, len(cases), squeeze=False)[0], cases, strict=True):
        for number, method in enumerate(dict.fromkeys(c.method for c in contenders if c.case == case)):
            points = [(c.per_s, c.error) for c in contenders if (c.case, c.method) == (case, method)]
            axes.loglog(*zip(*sorted(points), strict=True), label=method, **style_of(number))
        unit = "time units" if case == "Lorenz" else "strobes"
        axes.set(xlabel=f"{unit} per second, two cores", ylabel="relative error (root mean square)", title=case)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write the tables and the figure."""
    known = parser(__doc__)
    known.add_argument("--pynamicalsys", metavar="PYTHON", help="interpreter that has pynamicalsys")
    given = known.parse_args(arguments)
    import drivetrain_jax.systems  # noqa: F401  double precision, before anything is computed

    rounds, units = (1, 20.0) if given.quick else (5, 200.0)
    with spawned_workers() as pool:
        contenders = [*lorenz_contenders(pool, given.quick), *tripod_contenders(pool, given.quick)]
        for contender in contenders:  # starts the workers, and compiles
            contender.rate()
        for number in range(rounds):
            print(f"{time.strftime('%H:%M:%S')} round {number + 1} of {rounds}", file=sys.stderr, flush=True)
            for contender in contenders:
                contender.rates.append(contender.rate())
    rows = [
        {"case": c.case, "method": c.method, "setting": c.setting, "error": c.error, "per_s": c.per_s}
        for c in contenders
    ]
    summary = compared(contenders)
    if given.pynamicalsys:
        peer = pynamicalsys_rate(given.pynamicalsys, units, rounds)
        scipy = next(row for row in summary if row["method"] == "SciPy DOP853")["per_s"]
        # pynamicalsys returns exponents and no states, so the error of its states is unknown.
        summary.append({"case": "Lorenz at its own tolerance", "method": "pynamicalsys", "setting": "tolerance 1e-10",
                        "error": math.nan, "per_s": peer, "times_scipy": peer / scipy})  # fmt: skip
    print(table(rows), table(summary), sep="\n\n")
    note = f"Time units (Lorenz) and strobes (tripod) per second, {PROCESSES} cores, medians of {rounds} rounds."
    folder = results_folder(given)
    write_csv(folder / "chaos_precision.csv", rows, ("error: see benchmarks/chaos.py", note))
    write_csv(folder / "chaos.csv", summary, (note,))
    draw(contenders, folder / "chaos_precision.png")


if __name__ == "__main__":
    main()
