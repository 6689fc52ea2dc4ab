"""Critical speeds per second: this package, root finding with NumPy and SciPy, finite elements (ROSS).

    python -m benchmarks.critical_speeds [--shafts 16384] [--repeats 5] [--ross PYTHON]   # results/critical_speeds.csv

Each method computes six critical speeds of random shafts of three segments (those of the paper, every parameter within a
factor of 1.5, supports from 1e5 to 1e9 N/m). The engine of the package, compiled beforehand, runs the chunks of its plan in
two threads. SciPy scans the determinant of the transfer matrices and applies Brent's method
(tests/oracles/bicardan_reference.py), point by point in two processes. The critical-speed map over 20 support
stiffnesses is computed by the package and by ``Rotor.run_ucs`` of ROSS (``ross-rotordynamics``, extra ``peers``; it
needs plotly before 6) in the Python of ``--ross``, 4 elements per segment; ROSS computes both planes of bending with
the gyroscopic effect.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.engine_job import columns_scene, engine_job
from benchmarks.timing import (
    PROCESSES,
    at_once,
    interleaved,
    median,
    parser,
    results_folder,
    spawned_workers,
    table,
    take,
    write_csv,
)
from drivetrain_jax.systems.bicardan import PRESETS
from tests.oracles.bicardan_reference import determinant_roots

MODES = 6
SUPPORTS = np.geomspace(1e5, 1e9, 20)
_LISTS = ("length", "EI", "rhoA")
_ROSS = """
import json, sys, time
import numpy as np
import ross
steel = ross.Material(name="steel", rho=7800, E=2.1e11, G_s=8.1e10)
sections = ((0.07, 0.0, 0.05), (0.59, 0.045, 0.05), (0.25, 0.0, 0.03))
elements = [
    ross.ShaftElement(L=length / 4, idl=inner, odl=outer, material=steel, shear_effects=False, rotary_inertia=False)
    for length, inner, outer in sections for _ in range(4)
]
bearings = [ross.BearingElement(n=node, kxx=1e7, cxx=0.0) for node in (0, 12)]
rotor = ross.Rotor(elements, bearing_elements=bearings)
seconds = []
for _ in range(int(sys.argv[1])):
    start = time.perf_counter()
    result = rotor.run_ucs(stiffness_range=(5, 9), num=20, num_modes=16)
    seconds.append(time.perf_counter() - start)
rotor = ross.Rotor(elements, bearing_elements=[ross.BearingElement(n=node, kxx=1e9, cxx=0.0) for node in (0, 12)])
print(json.dumps({"seconds": seconds, "version": ross.__version__, "wn": rotor.run_modal(speed=0.0).wn.tolist()}))
"""


def random_shafts(count: int) -> dict[str, np.ndarray]:
    """Columns ``length[0]`` ... ``k_D`` of ``count`` shafts."""
    rng = np.random.default_rng(0)
    columns = {
        f"{name}[{i}]": value * rng.uniform(2 / 3, 1.5, count)
        for name in _LISTS
        for i, value in enumerate(PRESETS["paper"][name])
    }
    return columns | {name: 10 ** rng.uniform(5, 9, count) for name in ("k_A", "k_D")}


def package_job(columns: Mapping[str, np.ndarray], method: str = "certified") -> tuple[Callable[[], np.ndarray], float]:
    """The package's engine on all shafts, and the seconds of its compilation."""
    scene = columns_scene(
        "bicardan",
        "critical_speeds",
        ["angular_frequency", "count_certified"],
        columns,
        fixed={name: list(PRESETS["paper"][name]) for name in _LISTS},
        options={"method": method, "modes": MODES},
    )
    start = time.perf_counter()
    computed = engine_job(scene, PROCESSES)
    return lambda: computed()["angular_frequency"], time.perf_counter() - start


def scipy_roots(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Six roots of every shaft by SciPy."""
    rows = []
    for i in range(columns["k_A"].size):
        shaft = {name: [columns[f"{name}[{j}]"][i] for j in range(3)] for name in _LISTS}
        rows.append(determinant_roots(shaft | {"k_A": columns["k_A"][i], "k_D": columns["k_D"][i]}, MODES))
    return np.array(rows)


def scipy_job(pool: Any, columns: Mapping[str, np.ndarray]) -> Callable[[], np.ndarray]:
    """A job of SciPy on all shafts, distributed over the workers of ``pool``."""
    deals = [np.arange(start, columns["k_A"].size, PROCESSES) for start in range(PROCESSES)]
    hands = [take(columns, deal) for deal in deals]

    def job() -> np.ndarray:
        out = np.empty((columns["k_A"].size, MODES))
        for deal, answer in zip(deals, pool.map(scipy_roots, hands), strict=True):
            out[deal] = answer
        return out

    return job


def map_columns() -> dict[str, np.ndarray]:
    """The paper's shaft on 20 pairs of equal supports, with the true area of the tube, as in ROSS."""
    area = math.pi / 4 * np.array([50e-3**2, 50e-3**2 - 45e-3**2, 30e-3**2])
    values = PRESETS["paper"] | {"rhoA": tuple(7800 * area)}
    columns = {f"{name}[{i}]": np.full(20, values[name][i]) for name in _LISTS for i in range(3)}
    return columns | {"k_A": SUPPORTS, "k_D": SUPPORTS}


def ross_map(python: str, repeats: int) -> dict[str, Any]:
    """Seconds per map, version and natural frequencies at the stiffest supports, from ROSS in the given Python."""
    done = subprocess.run([python, "-c", _ROSS, str(repeats)], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def row(method: str, shafts: int, seconds: float, compile_s: float, error: float, baseline: float) -> dict[str, Any]:
    """One line of the result."""
    rate = shafts / seconds
    return {
        "method": method,
        "shafts": shafts,
        "shafts_per_s": round(rate, 1),
        "ratio": rate / baseline if baseline else 1.0,
        "compile_s": compile_s,
        "max_difference": error,
    }


def measure(shafts: int, repeats: int, sample: int, ross: str | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows of the result table and the notes above it."""
    columns = random_shafts(shafts)
    few = take(columns, np.arange(min(sample, shafts)))
    (ours, compile_s), (grid, grid_compile_s) = at_once([partial(package_job, c) for c in (columns, map_columns())])
    with spawned_workers() as pool:
        theirs = scipy_job(pool, few)
        answers, reference = ours(), theirs()
        seconds = interleaved({"ours": ours, "scipy": theirs, "map": grid}, repeats)
    error = float(np.max(np.abs(answers[: len(reference)] / reference - 1)))
    rate = len(reference) / median(seconds["scipy"])
    rows = [
        row("scipy, scan and Brent", len(reference), median(seconds["scipy"]), 0.0, 0.0, rate),
        row("drivetrain_jax certified", shafts, median(seconds["ours"]), compile_s, error, rate),
    ]
    notes = [f"six critical speeds per shaft; {repeats} repeats in turns, medians; ratio: to SciPy, in the map to ROSS"]
    if ross is not None:
        peer = ross_map(ross, repeats)
        frequencies = np.sort(np.unique(np.round(np.array(peer["wn"]), 6)))[0]
        baseline = 20 / median(peer["seconds"])
        difference = float(abs(frequencies / grid()[-1, 0] - 1))
        rows.append(row("ROSS run_ucs, map of 20 supports", 20, median(peer["seconds"]), 0.0, difference, baseline))
        rows.append(row("drivetrain_jax, the same map", 20, median(seconds["map"]), grid_compile_s, 0.0, baseline))
        about = "both planes of bending with the gyroscopic effect"
        difference_of = "max_difference of its first natural frequency at the stiffest supports"
        notes.append(f"ROSS {peer['version']}, {about}; {difference_of}")
    return rows, notes


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and write the table."""
    known = parser(__doc__)
    known.add_argument("--shafts", type=int, default=16384, help="that the package solves (%(default)s)")
    known.add_argument("--repeats", type=int, default=5, help="runs of which the median counts (%(default)s)")
    known.add_argument("--sample", type=int, default=200, help="shafts that SciPy solves (%(default)s)")
    known.add_argument("--ross", metavar="PYTHON", help="interpreter that has ross-rotordynamics; without it: no ROSS")
    given = known.parse_args(arguments)
    shafts, repeats, sample = (2048, 1, 8) if given.quick else (given.shafts, given.repeats, given.sample)
    rows, notes = measure(shafts, repeats, sample, given.ross)
    print(table(rows))
    write_csv(results_folder(given) / "critical_speeds.csv", rows, notes)


if __name__ == "__main__":
    main()
