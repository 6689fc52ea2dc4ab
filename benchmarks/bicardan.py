"""Contenders on the stepped shaft: the package, the plain determinant, dynamic stiffness, finite elements.

Each method computes six frequencies of a shaft of three segments (in "high mode" all 60, of which the last six count).
Points of a region are a shaft and neighbours, each parameter within 1 %; the error is that of the first shaft. The
reference is the paper's determinant in enough digits for its cancellation
(tests/oracles/bicardan_precise_reference.py); finite elements of high degree give the number and place of its roots.
The error of a mode of frequency 0 is its frequency over the first elastic one. "Dynamic stiffness" bisects the points
of a batch together; other rivals solve one shaft after another.

Regions: uniform shaft (easy); the paper's shaft (typical); modes 55 to 60 of the paper's shaft; supports of 1e17 and 10
N/m; supports of 1e-6 N/m; no supports; two slender ends on a heavy stiff middle, whose frequencies come in pairs 2e-5
apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.measure import Columns, Job, Judged, Method, Study, judged, near, outcomes, points_job, take
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
_LOW = tuple(name for name in REGIONS if name != "high mode")
_LISTS = ("length", "EI", "rhoA")
_LANES, _FEW = 512, 3


def modes_of(region: str) -> tuple[int, ...]:
    """Numbers of the modes that are compared."""
    return tuple(range(55, 61)) if region == "high mode" else tuple(range(1, 7))


@cache
def reference(region: str) -> tuple[np.ndarray, float]:
    """The frequencies, 0 for rigid modes, and the difference of finite elements and determinant."""
    shaft, modes = REGIONS[region], modes_of(region)
    zeros = 2 if shaft["k_A"] == shaft["k_D"] == 0 else 0
    elastic = tuple(mode for mode in modes if mode > zeros)
    roots, distance = precise_frequencies(shaft, elastic, bubbles=70 if region == "high mode" else 24)
    return np.array([0.0] * (len(modes) - len(elastic)) + [float(value) for value in roots]), distance


def flat(shaft: Mapping[str, Any]) -> dict[str, float]:
    """Parameters ``length[0]`` ... ``k_D``."""
    lists = {f"{name}[{i}]": shaft[name][i] for name in _LISTS for i in range(3)}
    return lists | {name: shaft[name] for name in ("k_A", "k_D")}


def gathered(columns: Columns) -> dict[str, Any]:
    """The same columns by parameter, lists whole."""
    lists = {name: [columns[f"{name}[{i}]"] for i in range(3)] for name in _LISTS}
    return lists | {name: columns[name] for name in ("k_A", "k_D")}


def neighbours(region: str, count: int) -> dict[str, np.ndarray]:
    """Columns of ``count`` shafts, that of the region first."""
    shaft = flat(REGIONS[region])
    return near(shaft, tuple(shaft), count, 0.01, seed=1)


def error_of(region: str, setting: Any, result: Any) -> Judged:
    """The error of the first shaft."""
    package = isinstance(result, Mapping)
    exact = reference(region)[0]
    modes = (result["angular_frequency"] if package else result)[0][np.array(modes_of(region)) - 1]
    scale = np.where(exact > 0, exact, exact[exact > 0][0])
    return judged(np.max(np.abs(modes - exact) / scale), outcomes(result["outcome"][:1]) if package else "")


def package(columns: Columns, modes: int, method: str = "certified", threads: int = 1) -> Job:
    """A method of the package; all entries of the lists vary, so that one kernel serves all regions."""
    fixed, options = {name: [1.0] * 3 for name in _LISTS}, {"method": method, "modes": modes}
    return points_job(
        "bicardan", "critical_speeds", ["angular_frequency"], columns, threads, fixed=fixed, options=options
    )


def _package(method: str) -> Method:
    def prepare(region: str, setting: Any) -> Job:
        return package(neighbours(region, _LANES), max(modes_of(region)), method)

    return Method(f"package, {method}", prepare, _LANES, ("default",), ("default",), "{}")


def _one_by_one(
    name: str, solve: Callable, argument: str, label: str, settings: Any, quick: Any = (), regions: Any = ()
) -> Method:
    def prepare(region: str, setting: Any) -> Job:
        columns = neighbours(region, _FEW)
        shafts = [gathered(take(columns, i)) for i in range(_FEW)]
        return lambda: np.stack([solve(shaft, modes=max(modes_of(region)), **{argument: setting}) for shaft in shafts])

    return Method(name, prepare, _FEW, settings, quick, label, regions=regions)


def _batch(region: str) -> int:
    return 4 if region == "high mode" else 32


def dynamic_stiffness(region: str, rtol: float) -> Job:
    """Bisection of a batch."""
    shafts, modes = gathered(neighbours(region, _batch(region))), max(modes_of(region))
    return lambda: dynamic_stiffness_frequencies(shafts, modes, rtol).T


def _two_references(regions: Sequence[str]) -> list[str]:
    apart = (f"{name}: finite elements differ from the determinant by {reference(name)[1]:.0e}" for name in regions)
    return ["; ".join(apart)]


_ELEMENTS = partial(_one_by_one, "scipy, Hermite elements", hermite_frequencies, "elements", "{} elements a segment")
_DEGREES = partial(_one_by_one, "scipy, one element of high degree", finite_elements, "bubbles", "{} bubbles")
STUDY = Study(
    "bicardan", tuple(REGIONS), ("typical", "soft supports", "near double root"),
    (
        _package("certified"),
        _package("krylov_determinant"),
        _one_by_one("scipy, plain determinant", determinant_roots, "points_per_mode", "{} points a mode",
                    (4, 12, 48), (12,)),
        Method("numpy, dynamic stiffness", dynamic_stiffness, _batch, (1e-5, 1e-9, 1e-13), (1e-9,)),
        _ELEMENTS((4, 16, 64, 256), (8, 32), _LOW),
        _ELEMENTS((24, 64, 256), (), ("high mode",)),
        _DEGREES((4, 8, 16), (10,), _LOW),
        _DEGREES((30, 45, 60), (), ("high mode",)),
    ),
    error_of, _two_references,
)  # fmt: skip
