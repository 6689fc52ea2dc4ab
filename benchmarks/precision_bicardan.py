"""Error against run time for the stepped shaft: the package, the plain determinant, dynamic stiffness, finite elements.

    python -m benchmarks.precision_bicardan [--quick] [--out FOLDER]     # precision_bicardan.csv and .png

Each method computes six frequencies of a shaft of three segments (in "high mode" all 60, of which the last six count).
Every region is one shaft and its neighbours, each parameter within 1 %. All points are timed; the error is that of the first
shaft. The reference is the paper's determinant in enough digits for its cancellation
(tests/oracles/bicardan_precise_reference.py); finite elements of high degree give the number and place of its roots. The
error of a mode of frequency 0 is its frequency over the first elastic one. The package solves its points in batches, as its
engine does, one chunk at a time; "dynamic stiffness" bisects the points of a batch together with NumPy; the other methods
solve one shaft after another.

Regions: uniform shaft (easy); the paper's shaft (typical); modes 55 to 60 of the paper's shaft; supports of 1e17 and 10 N/m;
supports of 1e-6 N/m; no supports; two slender ends on a heavy stiff middle, whose frequencies come in pairs 2e-5 apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from tests.oracles.bicardan_precise_reference import precise_frequencies
from tests.oracles.bicardan_reference import determinant_roots, finite_elements
from tests.oracles.bicardan_rivals import dynamic_stiffness_frequencies, hermite_frequencies

_PAPER = {"length": (0.07, 0.59, 0.25), "EI": (64427.2, 22156.5, 8349.76), "rhoA": (15.288, 2.808, 5.5068)}
_UNIFORM = {"length": (0.3,) * 3, "EI": (64050.0,) * 3, "rhoA": (15.288,) * 3}
_PAIRS = {"length": (0.3, 0.3, 0.3), "EI": (1e4, 1e12, 1e4), "rhoA": (3.0, 1e6, 3.0)}
REGIONS: dict[str, dict[str, Any]] = {
    "easy": _UNIFORM | {"k_A": 1e7, "k_D": 1e7},
    "typical": _PAPER | {"k_A": 85e6, "k_D": 20e6},
    "high mode": _PAPER | {"k_A": 85e6, "k_D": 20e6},
    "stiff supports": _PAPER | {"k_A": 1e17, "k_D": 10.0},
    "soft supports": _PAPER | {"k_A": 1e-6, "k_D": 2e-6},
    "rigid modes": _PAPER | {"k_A": 0.0, "k_D": 0.0},
    "near double root": _PAIRS | {"k_A": 1e5, "k_D": 1e5},
}
_LISTS = ("length", "EI", "rhoA")
_QUICK = ("typical", "soft supports", "near double root")
_LANES, _BATCH, _FEW = 512, 32, 3


def modes_of(region: str) -> tuple[int, ...]:
    """Numbers of the modes that are compared."""
    return tuple(range(55, 61)) if region == "high mode" else tuple(range(1, 7))


@cache
def reference(region: str) -> tuple[np.ndarray, float]:
    """The frequencies, 0 for rigid modes, and the difference of finite elements and determinant."""
    shaft, modes = REGIONS[region], modes_of(region)
    zeros = 2 if shaft["k_A"] == shaft["k_D"] == 0 else 0
    elastic = tuple(mode for mode in modes if mode > zeros)
    found, distance = precise_frequencies(shaft, elastic, bubbles=70 if region == "high mode" else 24)
    return np.array([0.0] * (len(modes) - len(elastic)) + [float(value) for value in found]), distance


def neighbours(region: str, count: int) -> dict[str, np.ndarray]:
    """Columns ``length[0]`` ... ``k_D``: the shaft of the region first, then shafts next to it."""
    shaft, rng = REGIONS[region], np.random.default_rng(1)
    factors = [np.r_[1.0, rng.uniform(0.99, 1.01, count - 1)] for _ in range(11)]
    columns = {f"{name}[{i}]": shaft[name][i] * factors.pop() for name in _LISTS for i in range(3)}
    return columns | {name: shaft[name] * factors.pop() for name in ("k_A", "k_D")}


def gathered(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The same columns by parameter, lists whole."""
    lists = {name: [columns[f"{name}[{i}]"] for i in range(3)] for name in _LISTS}
    return lists | {name: columns[name] for name in ("k_A", "k_D")}


def error_of(region: str, found: np.ndarray) -> Judged:
    """The error of the modes ``found`` of the first shaft."""
    exact, _ = reference(region)
    mine = found[np.array(modes_of(region)) - 1]
    scale = np.where(exact > 0, exact, exact[exact > 0][0])
    errors = np.abs(mine - exact) / scale
    if not np.all(np.isfinite(errors)):
        return Judged(np.nan, 1, "nan")
    return Judged(float(errors.max()))


def package(region: str, method: str, lanes: int) -> Contender:
    """A method of the package."""
    columns, modes = neighbours(region, lanes), max(modes_of(region))
    # Placeholders for the number of segments: all entries vary, so that one kernel serves all regions.
    fixed = {name: [1.0] * 3 for name in _LISTS}
    scene = columns_scene(
        "bicardan", "critical_speeds", ["angular_frequency"], columns, fixed=fixed,
        options={"method": method, "modes": modes},
    )  # fmt: skip

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        of_error = error_of(region, results["angular_frequency"][0])
        return Judged(of_error.error, of_error.failed, told(results["outcome"][:1]))

    return Contender("bicardan", region, f"package, {method}", "default", lanes, partial(engine_job, scene), judged)


def one_by_one(region: str, method: str, setting: str, solve: Callable[[Mapping[str, Any]], np.ndarray]) -> Contender:
    """A rival that solves one shaft after another."""
    columns = neighbours(region, _FEW)
    shafts = [gathered({name: column[i] for name, column in columns.items()}) for i in range(_FEW)]

    def job() -> np.ndarray:
        return np.stack([solve(shaft) for shaft in shafts])

    return Contender("bicardan", region, method, setting, _FEW, lambda: job, lambda found: error_of(region, found[0]))


def contenders_of(region: str, quick: bool) -> list[Contender]:
    """All methods in one region."""
    modes = max(modes_of(region))
    lanes = 64 if quick else _LANES
    batch = 4 if modes > 6 else _BATCH
    found = [package(region, "certified", lanes), package(region, "krylov_determinant", lanes)]
    for points in (12,) if quick else (4, 12, 48):
        solve = partial(determinant_roots, modes=modes, points_per_mode=points)
        found.append(one_by_one(region, "scipy, plain determinant", f"{points} points a mode", solve))
    together = gathered(neighbours(region, batch))
    for rtol in (1e-9,) if quick else (1e-5, 1e-9, 1e-13):
        bisected = partial(dynamic_stiffness_frequencies, together, modes, rtol)
        found.append(
            Contender("bicardan", region, "numpy, dynamic stiffness", f"rtol={rtol:g}", batch, lambda job=bisected: job,
                      lambda values: error_of(region, values[:, 0]))
        )  # fmt: skip
    for elements in (8, 32) if quick else (4, 16, 64, 256) if modes <= 6 else (24, 64, 256):
        solve = partial(hermite_frequencies, modes=modes, elements=elements)
        found.append(one_by_one(region, "scipy, Hermite elements", f"{elements} elements a segment", solve))
    for bubbles in (10,) if quick else (4, 8, 16) if modes <= 6 else (30, 45, 60):
        solve = partial(finite_elements, modes=modes, bubbles=bubbles)
        found.append(one_by_one(region, "scipy, one element of high degree", f"degree {bubbles + 3}", solve))
    return found


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions, and the difference of the two references."""
    regions = _QUICK if quick else tuple(REGIONS)
    notes = ["; ".join(f"{region}: finite elements differ from the determinant by {reference(region)[1]:.0e}"
                       for region in regions)]  # fmt: skip
    return [contender for region in regions for contender in contenders_of(region, quick)], notes


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_bicardan", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
