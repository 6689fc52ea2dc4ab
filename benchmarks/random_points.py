"""Errors, bounds and times of the package at random points over wide ranges of all parameters.

    python -m benchmarks.random_points [--quick] [--out FOLDER]     # random_points.csv

The other studies use chosen points and their neighbours. Here each parameter is drawn on its own, from a range of several
decades (``POINTS``). All points are computed by the default method, at the default tolerance, on one core; the time per
point is that of its chunk over the points of the chunk. The first points are compared with a reference: Taylor series in
200 bits (cardan floquet), eigenvalues and determinants in many digits (planetary, bicardan), extended precision (rattle),
and SciPy at 1e-13 (cardan forced, tripod). Bounds are compared after the error of SciPy itself is added to them: 1e-12, and
for forced motions a tenth of the distance between 1e-13 and 1e-11.

``over_bound`` is the largest error over its bound or estimate: above 1 a bound is broken. Errors are relative to the largest
component of a point; points whose outcome is not success are counted and keep their error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision_forced import Region, scipy_shooting
from benchmarks.precision_rattle import marching
from benchmarks.timing import parser, results_folder, table, write_csv
from tests.oracles import tripod_reference
from tests.oracles.bicardan_precise_reference import precise_frequencies
from tests.oracles.cardan_precise_reference import spectral_radius
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies
from tests.oracles.rattle_reference import extended, random_case

_ANGLES = (0.0, 1.3, 3.0, 4.9)
_MODES = 6
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Study:
    """An analysis at random points: its ``scene``, names of the result and of its bound, exact values and their error."""

    scene: Mapping[str, Any]
    result: str
    bound: str
    exact: Callable[[int], tuple[np.ndarray, Any]]


def decades(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Random numbers, uniform in their logarithm."""
    return np.exp(rng.uniform(math.log(low), math.log(high), count))


def cardan_points(count: int) -> Columns:
    """Angles to 86 deg, speeds over two decades, damping over six, the other parameters over four."""
    rng = np.random.default_rng(11)
    return {
        "beta": rng.uniform(0.0, 1.5, count),
        "Omega": decades(rng, count, 0.05, 5.0),
        "zeta": decades(rng, count, 1e-6, 1.0),
        "alpha": decades(rng, count, 0.01, 100.0),
        "mu": decades(rng, count, 0.01, 100.0),
        "gamma": decades(rng, count, 0.01, 100.0),
    }


def _row(columns: Columns, i: int) -> dict[str, Any]:
    return {name: column[i].tolist() for name, column in columns.items()}


def cardan_floquet(count: int) -> Study:
    """Stability of the cardan shaft."""
    columns = cardan_points(count)
    scene = columns_scene("cardan", "floquet", ["spectral_radius", "spectral_radius_error"], columns)
    return Study(scene, "spectral_radius", "spectral_radius_error",
                 lambda i: (np.array([float(spectral_radius(_row(columns, i)))]), 0.0))  # fmt: skip


def cardan_forced(count: int) -> Study:
    """Forced motion of the cardan shaft."""
    columns = cardan_points(count)
    scene = columns_scene("cardan", "forced", ["periodic_state", "periodic_state_error"], columns)

    def exact(i: int) -> tuple[np.ndarray, Any]:
        fine, rough = (scipy_shooting(Region(True, _row(columns, i)), rtol) for rtol in (1e-13, 1e-11))
        return fine, 0.1 * np.max(np.abs(fine - rough)) + 1e-12 * np.max(np.abs(fine))

    return Study(scene, "periodic_state", "periodic_state_error", exact)


def tripod_floquet(count: int) -> Study:
    """Stability of the input element of the double tripod."""
    rng = np.random.default_rng(12)
    columns = {
        # Radii above 0.3, of which SciPy has twelve digits.
        "zeta": decades(rng, count, 1e-4, 0.03),
        "excitation_frequency": decades(rng, count, 300.0, 20_000.0),
        "chi_n": decades(rng, count, 1e-4, 0.5),
    }
    fixed = {"element": "input", "beta": tripod_reference.NINE_DEGREES}
    scene = columns_scene("tripod", "floquet", ["spectral_radius", "spectral_radius_error"], columns, fixed=fixed)

    def exact(i: int) -> tuple[np.ndarray, Any]:
        p = _row(columns, i)
        radius = tripod_reference.spectral_radius("input", p["zeta"], p["excitation_frequency"], p["chi_n"])
        return np.array([radius]), 1e-12

    return Study(scene, "spectral_radius", "spectral_radius_error", exact)


def bicardan_speeds(count: int) -> Study:
    """Critical speeds of shafts of three segments, each parameter of each segment on its own."""
    rng = np.random.default_rng(13)
    ranges = {"length": (0.05, 2.0), "EI": (1e2, 1e6), "rhoA": (0.1, 100.0)}
    columns = {f"{name}[{i}]": decades(rng, count, *ends) for name, ends in ranges.items() for i in range(3)}
    columns |= {name: decades(rng, count, 1e2, 1e10) for name in ("k_A", "k_D")}
    outputs = ["angular_frequency", "relative_error", "count_certified"]
    # The columns replace the entries of the lists.
    lists = {name: [1.0] * 3 for name in ranges}
    scene = columns_scene("bicardan", "critical_speeds", outputs, columns, fixed=lists)
    modes = tuple(range(1, _MODES + 1))

    def exact(i: int) -> tuple[np.ndarray, Any]:
        row = _row(columns, i)
        lists = {name: [row.pop(f"{name}[{k}]") for k in range(3)] for name in ranges}
        return np.array(precise_frequencies(lists | row, modes)[0], float), 0.0

    return Study(scene, "angular_frequency", "relative_error", exact)


def planetary_modes(count: int) -> Study:
    """Natural frequencies of gears with four unequally spaced planets, masses and stiffnesses over four decades."""
    rng = np.random.default_rng(14)
    columns = {
        name: value * decades(rng, count, 0.01, 100.0) for name, value in TABLE_2.items() if name != "pressure_angle"
    }
    columns["pressure_angle"] = rng.uniform(0.2, 0.6, count)
    outputs = ["natural_frequency", "natural_frequency_error"]
    scene = columns_scene("planetary", "modes", outputs, columns, fixed={"planet_angle": list(_ANGLES)})

    def exact(i: int) -> tuple[np.ndarray, Any]:
        return np.array(exact_frequencies(_row(columns, i) | {"planet_angle": _ANGLES})), 0.0

    return Study(scene, outputs[0], outputs[1], exact)


STUDIES = {
    "cardan, floquet": cardan_floquet,
    "cardan, forced": cardan_forced,
    "tripod, floquet": tripod_floquet,
    "bicardan, critical speeds": bicardan_speeds,
    "planetary, modes": planetary_modes,
}


def computed(scene: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Results of all points, by one core, and the seconds of each point in a second run."""
    spent = np.full(len(next(iter(scene["points"].values()))), math.nan)
    job = engine_job(scene, spent=spent)
    job()
    return job(), spent


def row_of(name: str, study: Study, compared: int) -> dict[str, Any]:
    """The row of one analysis."""
    found, spent = computed(study.scene)
    errors, ratios = [], []
    for i in range(compared):
        exact, own = study.exact(i)
        value, bound = np.atleast_1d(found[study.result][i]), found[study.bound][i]
        if study.bound == "relative_error":
            bound = bound * np.abs(value)
        away = np.abs(value - exact)
        errors.append(np.max(away) / np.max(np.abs(exact)))
        ratios.append(np.max(away / (bound + own)))
    return _summary(name, np.array(errors), np.array(ratios), spent, told(found["outcome"]), found["outcome"])


def rattle_motion(count: int, compared: int) -> dict[str, Any]:
    """The row of the exact motion of gear rattle, which has no bound."""
    rng = np.random.default_rng(15)
    cases = [random_case(rng) for _ in range(count)]
    values = {name: np.array([case[0][name] for case in cases]) for name in cases[0][0]}
    u, v, periods = (np.array([case[k] for case in cases]) for k in (1, 2, 3))
    run = marching(count)
    arguments = values, u, v, periods.astype(np.int32)
    jax.block_until_ready(run(*arguments))
    begin = time.perf_counter()
    states, _, arrived = map(np.asarray, jax.block_until_ready(run(*arguments)))
    spent = np.full(count, (time.perf_counter() - begin) / count)
    errors = []
    for i, (point, *start, number) in enumerate(cases[:compared]):
        exact = np.array(extended(point, *start, number)[:2])
        size = max(abs(exact[0]), abs(start[0]), abs(exact[1]) / point["omega"], 1e-3)
        errors.append(np.max(np.abs(states[:, i] - exact) / (size, size * point["omega"])))
    outcome = np.where(arrived, 0, 1)
    return _summary("rattle, motion", np.array(errors), np.array([math.nan]), spent, "", outcome)


def _summary(
    name: str, errors: np.ndarray, ratios: np.ndarray, spent: np.ndarray, notice: str, outcome: np.ndarray
) -> dict[str, Any]:
    us, known = 1e6 * spent[np.isfinite(spent)], errors[np.isfinite(errors)]
    return {
        "analysis": name,
        "points": outcome.size,
        "us_median": float(np.median(us)),
        "us_99": float(np.quantile(us, 0.99)),
        "compared": errors.size,
        "error_median": float(np.median(known)),
        "error_99": float(np.quantile(known, 0.99)),
        "error_max": float(known.max()),
        "over_bound": float(np.nanmax(ratios)) if np.isfinite(ratios).any() else math.nan,
        "not_success": int(np.sum(outcome != 0)),
        "outcomes": notice,
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print and write."""
    options = parser(__doc__).parse_args(argv)
    count, compared = (512, 8) if options.quick else (4096, 100)
    # A forced motion costs a thousand times as much as a frequency.
    counts = {"cardan, forced": count // 8}
    rows = [row_of(name, make(counts.get(name, count)), compared) for name, make in STUDIES.items()]
    rows.append(rattle_motion(count, compared))
    write_csv(results_folder(options) / "random_points.csv", rows, ["default methods and tolerances, one core"])
    print(table(rows))


if __name__ == "__main__":
    main()
