"""Lyapunov time units and strobes per second against SciPy, heyoka.py and pynamicalsys; error against run time.

    python -m benchmarks.chaos [--pynamicalsys PYTHON] [--quick]      # writes results/chaos.csv, chaos_precision.csv

Lorenz (10, 28, 8/3) with three tangent vectors, made orthonormal every half time unit: ours with equal steps, the
others adaptive. The error is that of state and tangent vectors after one time unit, relative to their size, from 64
(--quick: 16) points of the attractor, root mean square, against SciPy at 1e-13. Methods are compared at the error that
SciPy's DOP853 has at tolerance 1e-10. All use both cores: ours by two threads over one compiled function, the others by
two spawned processes. ``PYTHON`` is an interpreter that has pynamicalsys (it needs other versions than this package).
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from benchmarks.chaos_reference import (
    INTERVAL,
    HeyokaLorenz,
    attractor,
    lorenz,
    scipy_flow,
    scipy_spectrum,
    tripod_field,
)
from benchmarks.timing import PROCESSES, RESULTS, spawned_workers, table, write_csv

LANES = 512
STEPS = (24, 32, 40, 48, 56, 64)
QUICK_STEPS = (32, 64)
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
QUICK_TOLERANCES = (1e-8, 1e-10)
TRIPOD = {"zeta": 0.0016, "chi": 0.0026, "frequency": 3066.5}
_PYNAMICALSYS = """
import json, sys, time
from pynamicalsys import ContinuousDynamicalSystem
units = float(sys.argv[1])
system = ContinuousDynamicalSystem(model="lorenz system")
system.integrator("rk45", atol=1e-10, rtol=1e-10)
run = lambda t: system.lyapunov([1.0, 1.0, 20.0], t, parameters=[10.0, 28.0, 8 / 3], transient_time=5.0)
run(10.0)
start = time.perf_counter()
spectrum = run(units)
print(json.dumps({"seconds": time.perf_counter() - start, "spectrum": list(map(float, spectrum))}))
"""


def _compiled(function: Callable, *arguments: Any) -> Any:
    import jax

    from drivetrain_jax.store.provenance import instruction_set

    # As the package's engine compiles.
    options = {"xla_cpu_prefer_vector_width": 512} if "avx512f" in instruction_set() else None
    return jax.jit(function).lower(*arguments).compile(options)


def lorenz_flow(starts: Any, period: float) -> Any:
    """Lorenz' system of the package's flows from ``starts`` (3, N)."""
    from drivetrain_jax.systems import Flow

    def field(_: Any, y: Any) -> tuple:
        return 10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]

    return Flow(field, tuple(starts), period)


def package_flow(starts: np.ndarray, steps: int) -> np.ndarray:
    """States and tangent vectors after one time unit, shape ``(N, 12)``."""
    from drivetrain_jax.analysis.variational import initial_frame, strobe_map

    flow = lorenz_flow(starts.T, 1.0)
    frame = strobe_map(flow, steps)(0, initial_frame(flow)._replace(contraction=None))
    return np.concatenate([np.stack(frame.state), *(np.stack(v) for v in frame.tangents)]).T


def package_spectrum(steps: int, lanes: int) -> Callable[[float], float]:
    """``rate(intervals)``: Lorenz time units per second by two threads, ``steps`` per time unit."""
    import jax
    import jax.numpy as jnp

    from drivetrain_jax.analysis.variational import Frame, initial_frame, orthonormal, strobe_map

    def spectrum(starts: Any, count: Any) -> Any:
        flow = lorenz_flow(starts, INTERVAL)
        advance = strobe_map(flow, max(round(steps * INTERVAL), 1))

        def body(k: Any, carry: tuple) -> tuple:
            frame, total = carry
            frame = advance(k, frame)
            tangents, logs = orthonormal(frame.tangents)
            return Frame(frame.state, tangents), total + logs

        start = initial_frame(flow)._replace(contraction=None)
        return jax.lax.fori_loop(0, count, body, (start, jnp.zeros((3, lanes))))[1] / (count * INTERVAL)

    starts = np.resize(attractor(64), (PROCESSES, lanes, 3)).transpose(0, 2, 1) + 1e-3 * np.arange(lanes)
    run = _compiled(spectrum, starts[0], 1)

    def rate(count: int) -> float:
        start = time.perf_counter()
        with ThreadPoolExecutor(PROCESSES) as pool:
            for result in pool.map(lambda part: run(part, count), starts):
                result.block_until_ready()
        return PROCESSES * lanes * count * INTERVAL / (time.perf_counter() - start)

    rate(1)
    return rate


def error_of(flow: Callable[[np.ndarray], np.ndarray], starts: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square over the points of the relative error of state and tangent vectors."""
    found = flow(starts)
    return float(np.sqrt(np.mean(np.sum((found - exact) ** 2, 1) / np.sum(exact**2, 1))))


def scipy_rate(count: int, tolerance: float) -> float:
    """Time units per second of one process."""
    start = time.perf_counter()
    scipy_spectrum(lorenz, np.array([1.0, 1.0, 20.0]), INTERVAL, count, tolerance)
    return count * INTERVAL / (time.perf_counter() - start)


def heyoka_rate(count: int, tolerance: float) -> float:
    """Time units per second of one process."""
    integrator = HeyokaLorenz(tolerance)
    starts = np.resize(attractor(8), (integrator.batch, 3))
    integrator.spectrum(starts, 2)
    start = time.perf_counter()
    integrator.spectrum(starts, count)
    return integrator.batch * count * INTERVAL / (time.perf_counter() - start)


def pynamicalsys_rate(python: str, units: float) -> float:
    """Time units per second of two processes of the interpreter ``python``."""
    command = [python, "-c", _PYNAMICALSYS, str(units)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(PROCESSES)]
    return sum(units / json.loads(process.communicate()[0])["seconds"] for process in processes)


def _progress(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def package_rows(quick: bool, starts: np.ndarray, exact: np.ndarray) -> list[dict[str, Any]]:
    """Error and rate of the package over the steps per time unit."""
    rows = []
    for steps in QUICK_STEPS if quick else STEPS:
        _progress(f"Lorenz, {steps} steps")
        error = error_of(lambda s, n=steps: package_flow(s, n), starts, exact)
        rate = package_spectrum(steps, LANES)(20 if quick else 400)
        rows.append({"method": "drivetrain_jax", "setting": f"{steps} steps", "error": error, "units_per_s": rate})
    return rows


def rival_rows(quick: bool, starts: np.ndarray, exact: np.ndarray) -> list[dict[str, Any]]:
    """Error and rate of SciPy and heyoka.py over their tolerance."""
    rows = []
    with spawned_workers() as pool:
        # Both processes import what they need before anything is timed.
        list(pool.map(scipy_rate, [1] * PROCESSES, [1e-6] * PROCESSES))
        for tolerance in QUICK_TOLERANCES if quick else TOLERANCES:
            _progress(f"Lorenz, SciPy and heyoka.py at {tolerance:g}")
            jobs = {
                "scipy DOP853": (scipy_rate, 20 if quick else 100, lambda s, t=tolerance: scipy_flow(s, 1.0, t)),
                "heyoka": (heyoka_rate, 200 if quick else 2000, lambda s, t=tolerance: HeyokaLorenz(t).flow(s, 1.0)),
            }
            for name, (job, size, flow) in jobs.items():
                rate = sum(pool.map(job, [size] * PROCESSES, [tolerance] * PROCESSES))
                rows.append({"method": name, "setting": f"tolerance {tolerance:g}",
                             "error": error_of(flow, starts, exact), "units_per_s": rate})  # fmt: skip
    return rows


def precision(quick: bool) -> list[dict[str, Any]]:
    """Error and rate of every method and setting."""
    starts = attractor(16 if quick else 64)
    exact = scipy_flow(starts, 1.0, 1e-13)
    return package_rows(quick, starts, exact) + rival_rows(quick, starts, exact)


def _tripod_scipy(strobes: int) -> float:
    constants = {
        "Omega": 9633.726700903984, "c1": 0.005213670937369757, "c2": 0.0016565396527480861,
        "A_TJ": 3.652758897391374e-05, "F_over_I": 8365.245060248115, "chi_T": 0.05,
    }  # fmt: skip
    start = time.perf_counter()
    scipy_spectrum(tripod_field(constants | TRIPOD), np.zeros(2), 1 / TRIPOD["frequency"], strobes, 1e-10)
    return strobes / (time.perf_counter() - start)


def tripod_rates(quick: bool) -> dict[str, float]:
    """Strobes per second with two tangent vectors: the package's engine over a batch of damping ratios, and SciPy."""
    import drivetrain_jax as dt

    _progress("tripod")
    strobes, points = (2048 if quick else 8192), 2 * LANES
    scene = {
        "system": "tripod", "analysis": "lyapunov", "outputs": ["lyapunov_spectrum"],
        "axes": {"zeta": {"start": 0.0016, "stop": 0.0186, "num": points}},
        "fixed": {"element": "input", "beta": math.radians(9), "excitation_frequency": TRIPOD["frequency"], "chi_n": 0.0026},
    }  # fmt: skip
    seconds, counts = [], (64, 64 + strobes)
    for count in counts:
        run = scene | {"options": {"max_time": (count - 0.5) / TRIPOD["frequency"], "steps": 12}}
        start = time.perf_counter()
        dt.run(run)
        seconds.append(time.perf_counter() - start)
    # The difference of two lengths leaves out what does not grow with the strobes, compilation above all.
    longer = seconds[1] - seconds[0]
    ours = points * strobes / longer if longer > 0 else math.nan
    with spawned_workers() as pool:
        list(pool.map(_tripod_scipy, [1] * PROCESSES))
        rival = sum(pool.map(_tripod_scipy, [100] * PROCESSES))
    return {"drivetrain_jax": ours, "scipy DOP853": rival}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pynamicalsys", metavar="PYTHON", help="interpreter that has pynamicalsys")
    parser.add_argument("--quick", action="store_true", help="small sizes")
    given = parser.parse_args(arguments)
    import drivetrain_jax.systems  # noqa: F401  double precision, before anything is computed

    rows = precision(given.quick)
    summary = [{"case": "tripod, strobes with two tangent vectors", "method": name, "per_s": rate}
               for name, rate in tripod_rates(given.quick).items()]  # fmt: skip
    target = next(r["error"] for r in rows if (r["method"], r["setting"]) == ("scipy DOP853", "tolerance 1e-10"))
    for method in ("drivetrain_jax", "scipy DOP853", "heyoka"):
        reached = [r["units_per_s"] for r in rows if r["method"] == method and r["error"] <= 1.001 * target]
        summary.append({"case": f"Lorenz, time units at error <= {target:.1e}", "method": method,
                        "per_s": max(reached, default=math.nan)})  # fmt: skip
    if given.pynamicalsys:
        _progress("Lorenz, pynamicalsys")
        summary.append({"case": "Lorenz, time units at its tolerance 1e-10", "method": "pynamicalsys",
                        "per_s": pynamicalsys_rate(given.pynamicalsys, 20.0 if given.quick else 500.0)})  # fmt: skip
    print(table(rows), table(summary), sep="\n\n")
    write_csv(RESULTS / "chaos_precision.csv", rows, ("error: see benchmarks/chaos.py",))
    write_csv(RESULTS / "chaos.csv", summary, ("Per second of wall time, two cores.",))


if __name__ == "__main__":
    main()
