"""Error against run time for planetary gears: singular values and eigenvalues, of the package, of NumPy and of SciPy.

    python -m benchmarks.precision_planetary [--quick] [--out FOLDER]     # precision_planetary.csv and .png

Each method computes all frequencies of a gear. Every region is one gear and its neighbours, masses and stiffnesses within
1 %. All points are timed; the error is that of the first gear, the largest over its modes. The reference is eigenvalues in
50 digits (mpmath) of matrices that were assembled in another way (tests/oracles/planetary_reference.py). The error of a mode
of frequency 0 is its frequency over the lowest other one. No method has a setting, so each is one point.

"reduced" is the package's default, which splits the equations of identical planets. "whole" is its singular values of the
whole matrix, and "vectors" its Jacobi rotations, which also give shapes and types. "svd" is NumPy's decomposition of the
same matrix, "eigh" NumPy's eigenvalues of its square. "stiffness and mass" is SciPy's generalised eigenvalues gear by gear;
"refined" uses ``|G v|`` of its eigenvectors v instead of the root of the eigenvalue, which recovers the digits that the
square loses. Matrices of NumPy's methods are finished before the clock starts.

The package gives a bound of the error of every frequency (``natural_frequency_error``). A bound of more than 1e-9 of the
frequency counts as a notice, unless the true error is larger than the bound, which counts as silent.

In the region of mode shapes every method also returns the shapes, of modal mass 1. The error is the largest distance of a
shape from that of 50 digits, up to its sign, weighted by the roots of the masses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import eigh

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import GOAL, Contender, Judged
from benchmarks.precision_study import study
from tests.oracles.planetary_reference import (
    TABLE_2,
    exact_frequencies,
    exact_shapes,
    extension_matrix,
    matrices,
    natural_frequencies,
)

_LANES, _FEW = 1024, 8
# All parameters except the angles vary, so that gears with equal numbers of planets share a kernel.
_VARIED = tuple(TABLE_2)
_FOUR = ("equal planets", "zero stiffness", "ill-conditioned 1e16")


def _gear(planets: int, **changed: Any) -> dict[str, Any]:
    return TABLE_2 | {"planet_angle": tuple(2 * math.pi * i / planets for i in range(planets)), **changed}


_FREE = dict.fromkeys(("k_s", "k_r", "k_c", "k_su", "k_ru", "k_cu"), 0.0)
_GRADED = {
    "k_sp": 1e16,
    "k_rp": 1e12,
    "k_p": 1e6,
    "k_s": 1.0,
    "k_r": 1.0,
    "k_c": 1.0,
    "k_ru": 1.0,
    "m_s": 1e-3,
    "I_s": 1e-3,
}
REGIONS: dict[str, dict[str, Any]] = {
    "equal planets": _gear(4),
    "unequal spacing": _gear(5) | {"planet_angle": (0.0, 1.1, 2.4, 3.9, 5.2)},
    "coincident roots": _gear(6),
    "zero pressure angle": _gear(8, pressure_angle=0.0),
    "twelve planets": _gear(12),
    "zero stiffness": _gear(4, **_FREE),
    "ill-conditioned 1e16": _gear(4, **_GRADED),
}


@cache
def reference(region: str) -> np.ndarray:
    """The frequencies in Hz; those below 1e-20 of the largest are 0."""
    found = np.array(exact_frequencies(REGIONS[region]))
    return np.where(found > 1e-20 * found[-1], found, 0.0)


def neighbours(region: str, count: int) -> dict[str, np.ndarray]:
    """Columns of the masses and stiffnesses: the gear of the region first, then gears within 1 % of it."""
    rng = np.random.default_rng(2)
    return {name: REGIONS[region][name] * np.r_[1.0, rng.uniform(0.99, 1.01, count - 1)] for name in _VARIED}


def error_of(region: str, found: np.ndarray) -> Judged:
    """The largest relative error of the modes ``found`` of the first gear."""
    exact = reference(region)
    largest = float(np.max(np.abs(found - exact) / np.where(exact > 0, exact, exact[exact > 0][0])))
    return Judged(largest) if math.isfinite(largest) else Judged(math.nan, 1, "nan")


_SPECTRUM = ["natural_frequency", "natural_frequency_error"]


def package(region: str, name: str, method: str, outputs: list[str], lanes: int) -> Contender:
    """A method of the package."""
    fixed, columns = {"planet_angle": list(REGIONS[region]["planet_angle"])}, neighbours(region, lanes)
    scene = columns_scene("planetary", "modes", outputs, columns, fixed=fixed, options={"method": method})

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        found, bound, exact = results["natural_frequency"][0], results["natural_frequency_error"][0], reference(region)
        largest, failed, _ = error_of(region, found)
        known = bool(np.all(np.abs(found - exact) <= bound))
        doubtful = known and bool(np.any(bound > GOAL * np.where(exact > 0, exact, exact[exact > 0][0])))
        return Judged(largest, failed, told(results["outcome"][:1]) or ("natural_frequency_error" if doubtful else ""))

    return Contender("planetary", region, f"package, {name}", "double", lanes, lambda: engine_job(scene), judged)


def _svd(factors: np.ndarray) -> np.ndarray:
    return np.linalg.svd(factors, compute_uv=False)[:, ::-1] / (2 * math.pi)


def _eigh(squares: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.linalg.eigvalsh(squares), 0)) / (2 * math.pi)


def refined_frequencies(gear: Mapping[str, Any]) -> np.ndarray:
    """Frequencies in Hz from the eigenvectors of SciPy by Rayleigh's quotient in its factored form, rising."""
    mass, stiffness = matrices(gear)
    _, vectors = eigh(np.array(stiffness, float), np.diag(mass))
    # The modal mass is 1, so the quotient is |G M^(1/2) v|^2, a sum of squares without cancellation.
    strain = extension_matrix(gear) @ (np.sqrt(mass)[:, None] * vectors)
    return np.sort(np.linalg.norm(strain, axis=0)) / (2 * math.pi)


def rivals(region: str, lanes: int) -> list[Contender]:
    """NumPy's batched methods and SciPy gear by gear."""
    gear = REGIONS[region]
    together = {k: v for k, v in gear.items() if k != "planet_angle"} | neighbours(region, lanes)
    factors = extension_matrix(together | {"planet_angle": [np.full(lanes, angle) for angle in gear["planet_angle"]]})
    squares = np.swapaxes(factors, 1, 2) @ factors
    alone = [gear | {name: float(column[i]) for name, column in neighbours(region, _FEW).items()} for i in range(_FEW)]

    def contender(method: str, points: int, job: Callable[[], Any]) -> Contender:
        return Contender("planetary", region, method, "double", points, lambda: job, lambda f: error_of(region, f[0]))

    return [
        contender("numpy, svd", lanes, lambda: _svd(factors)),
        contender("numpy, eigh", lanes, lambda: _eigh(squares)),
        contender("scipy, eigh of stiffness and mass", _FEW, lambda: [natural_frequencies(one) for one in alone]),
        contender("scipy, eigh refined", _FEW, lambda: [refined_frequencies(one) for one in alone]),
    ]


_SHAPES = "mode shapes"
# Three planets at unequal angles: no frequency is double, so every shape is determined.
_DISTINCT = TABLE_2 | {"planet_angle": (0.0, 1.9, 4.4)}


def shape_error(gear: Mapping[str, Any], shapes: np.ndarray, notice: str = "") -> Judged:
    """The error of ``shapes``, one mode a row, in the degrees of freedom times the roots of their masses."""
    exact = _weighted_shapes(tuple(gear["planet_angle"]))
    signs = np.sign(np.sum(exact * shapes, axis=1, keepdims=True))
    error = float(np.max(np.linalg.norm(signs * shapes - exact, axis=1)))
    return Judged(error, 0, notice) if math.isfinite(error) else Judged(math.nan, 1, notice or "nan")


@cache
def _weighted_shapes(angles: tuple[float, ...]) -> np.ndarray:
    return exact_shapes(TABLE_2 | {"planet_angle": angles})


def shapes(lanes: int) -> list[Contender]:
    """The package, NumPy and SciPy with mode shapes."""
    gear, columns = _DISTINCT, neighbours("equal planets", lanes)
    scene = columns_scene("planetary", "modes", ["natural_frequency", "mode_shape"], columns,
                          fixed={"planet_angle": list(gear["planet_angle"])})  # fmt: skip
    together = {k: v for k, v in gear.items() if k != "planet_angle"} | columns
    factors = extension_matrix(together | {"planet_angle": [np.full(lanes, angle) for angle in gear["planet_angle"]]})
    squares = np.swapaxes(factors, 1, 2) @ factors
    roots = np.sqrt(matrices(gear)[0])

    def scipy_job() -> np.ndarray:
        mass, stiffness = matrices(gear)
        return eigh(np.array(stiffness, float), np.diag(mass))[1]

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        return shape_error(gear, roots * results["mode_shape"][0], told(results["outcome"][:1]))

    def contender(method: str, points: int, prepare: Callable[[], Any], error: Callable[[Any], Judged]) -> Contender:
        return Contender("planetary", _SHAPES, method, "double", points, prepare, error)

    def numpy_job(decompose: Callable, given: np.ndarray) -> Callable[[], Callable[[], Any]]:
        return lambda: lambda: decompose(given)

    return [
        contender("package, vectors", lanes, lambda: engine_job(scene), judged),
        contender("numpy, svd", lanes, numpy_job(np.linalg.svd, factors),
                  lambda f: shape_error(gear, f[2][0][::-1])),
        contender("numpy, eigh", lanes, numpy_job(np.linalg.eigh, squares),
                  lambda f: shape_error(gear, f[1][0].T)),
        contender("scipy, eigh of stiffness and mass", 1, lambda: scipy_job,
                  lambda f: shape_error(gear, (roots[:, None] * f).T)),
    ]  # fmt: skip


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions, and the difference of NumPy's singular values from the reference."""
    lanes = 256 if quick else _LANES
    regions = _FOUR if quick else tuple(REGIONS)
    found, distances = [], []
    for region in regions:
        found += [
            package(region, "reduced", "auto", _SPECTRUM, lanes),
            package(region, "whole", "full", _SPECTRUM, lanes),
        ]
        # Mode shapes take long to compile, so they are measured for one number of planets.
        if not quick and region in _FOUR:
            found.append(package(region, "vectors", "full", [*_SPECTRUM, "mode_type"], lanes))
        found += rivals(region, lanes)
        exact = reference(region)
        singular = _svd(extension_matrix(REGIONS[region])[None])[0]
        distances.append(f"{region}: {np.abs(singular - exact).max() / exact[-1]:.0e}")
    found += [] if quick else shapes(lanes)
    note = f"singular values (NumPy) differ from the reference, over the largest frequency, by {'; '.join(distances)}"
    return found, [note]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_planetary", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
