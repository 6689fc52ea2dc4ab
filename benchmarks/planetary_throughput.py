"""Planetary gears per second: the package against NumPy's batched LAPACK on the same matrices, and a SciPy loop.

    python -m benchmarks.planetary_throughput [--gears 20000] [--repeats 5] [--quick]

Writes results/planetary_throughput.csv. Every gear has its own mesh and bearing stiffness and its own position of the
second planet; the result is all 9 + 3N frequencies. The engine of the package is compiled beforehand. LAPACK gets the
finished matrices, whose assembly is not timed, divided into as many parts as there are threads. Both use both cores. Errors
are relative, the largest over all modes of nonzero frequency, against 50 digits on a few gears.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from benchmarks.engine_job import columns_scene, engine_job
from benchmarks.timing import PROCESSES, at_once, interleaved, median, parser, results_folder, table, write_csv
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies, extension_matrix, natural_frequencies

COUNTS = (3, 4, 5, 7, 12)
_CHECKED = 5
Job = Callable[[], np.ndarray]


def gears(planets: int, count: int) -> dict[str, np.ndarray]:
    """Columns of the swept parameters of ``count`` gears."""
    rng = np.random.default_rng(planets)
    second = 2 * math.pi / planets * rng.uniform(0.8, 1.2, count)
    return {"planet_angle[1]": second, "k_sp": 10 ** rng.uniform(8, 9, count), "k_p": 10 ** rng.uniform(7, 9, count)}


def parameters(planets: int, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """All parameters of these gears for the references, in lanes."""
    angles = [np.full_like(columns["k_p"], angle) for angle in 2 * math.pi * np.arange(planets) / planets]
    angles[1] = columns["planet_angle[1]"]
    return TABLE_2 | {"planet_angle": angles, "k_sp": columns["k_sp"], "k_p": columns["k_p"]}


def package_job(planets: int, columns: Mapping[str, np.ndarray], method: str) -> Job:
    """The engine on these gears: its plan, kernels and threads as in ``dt.run``, compiled once."""
    fixed = {"planet_angle": (2 * math.pi * np.arange(planets) / planets).tolist()}
    scene = columns_scene("planetary", "modes", ["natural_frequency"], columns, fixed=fixed, options={"method": method})
    computed = engine_job(scene, PROCESSES)
    return lambda: computed()["natural_frequency"]


def lapack_job(matrices: np.ndarray, solve: Callable[[np.ndarray], np.ndarray]) -> Job:
    """A job that applies ``solve`` to parts of ``matrices`` in one thread per core.

    LAPACK releases the interpreter lock.
    """
    parts = np.array_split(matrices, 4 * PROCESSES)

    def job() -> np.ndarray:
        with ThreadPoolExecutor(PROCESSES) as pool:
            return np.concatenate(list(pool.map(solve, parts)))

    return job


def _svd(matrices: np.ndarray) -> np.ndarray:
    return np.linalg.svd(matrices, compute_uv=False)[:, ::-1] / (2 * math.pi)


def _eigvalsh(matrices: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.linalg.eigvalsh(matrices), 0)) / (2 * math.pi)


def one_gear(p: Mapping[str, Any], index: int) -> dict[str, Any]:
    """The parameters of gear number ``index``."""
    angles = tuple(float(angle[index]) for angle in p["planet_angle"])
    single = {name: float(np.ravel(v)[index if np.ndim(v) else 0]) for name, v in p.items() if name != "planet_angle"}
    return {"planet_angle": angles, **single}


def contenders(planets: int, count: int) -> tuple[dict[str, Job], dict[str, int], dict[str, Any]]:
    """Jobs by name, the number of gears of each, and the parameters of the gears."""
    columns = gears(planets, count)
    p = parameters(planets, columns)
    factors = extension_matrix(p)
    squares = np.swapaxes(factors, 1, 2) @ factors
    few = max(count // 100, 10)
    reduced, whole = at_once([partial(package_job, planets, columns, method) for method in ("auto", "full")])
    jobs = {
        "package": reduced,
        "package, without the reduction": whole,
        "numpy svd of the same matrices": lapack_job(factors, _svd),
        "numpy eigvalsh of their squares": lapack_job(squares, _eigvalsh),
        "scipy eigh, one by one": lambda: np.stack([natural_frequencies(one_gear(p, i)) for i in range(few)]),
    }
    return jobs, {name: few if name.startswith("scipy") else count for name in jobs}, p


def measure(planets: int, count: int, repeats: int) -> list[dict[str, Any]]:
    """One row per contender."""
    jobs, sizes, p = contenders(planets, count)
    exact = np.array([exact_frequencies(one_gear(p, i)) for i in range(_CHECKED)])
    found = {name: job()[:_CHECKED] for name, job in jobs.items()}
    seconds = {name: median(values) for name, values in interleaved(jobs, repeats).items()}
    rates = {name: sizes[name] / seconds[name] for name in jobs}
    baseline = rates["numpy svd of the same matrices"]
    return [
        {
            "planets": planets,
            "method": name,
            "gears": sizes[name],
            "gears_per_s": rates[name],
            "frequencies_per_s": rates[name] * (9 + 3 * planets),
            "over_numpy_svd": rates[name] / baseline,
            "error": float(np.abs(found[name][:, 1:] / exact[:, 1:] - 1).max()),
            "rigid_Hz": float(found[name][:, 0].max()),
        }
        for name in jobs
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the table."""
    known = parser(__doc__)
    known.add_argument("--gears", type=int, default=20000, help="for every number of planets (%(default)s)")
    known.add_argument("--repeats", type=int, default=5, help="runs of which the median counts (%(default)s)")
    given = known.parse_args(arguments)
    count, repeats = (2048, 1) if given.quick else (given.gears, given.repeats)
    counts = COUNTS[1:2] if given.quick else COUNTS
    rows = [row for planets in counts for row in measure(planets, count, repeats)]
    print(table(rows))
    note = f"{PROCESSES} threads for the package and for LAPACK; the SciPy loop runs on one core"
    write_csv(results_folder(given) / "planetary_throughput.csv", rows, [note])


if __name__ == "__main__":
    main()
