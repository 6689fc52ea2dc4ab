"""Contenders on planetary gears: singular values and eigenvalues, of the package, of NumPy and of SciPy.

Each method computes all frequencies of a gear. Points of a region are a gear and its neighbours, masses and stiffnesses
within 1 %; the error is that of the first gear, the largest over its modes, against eigenvalues in 50 digits (mpmath)
of matrices that were assembled in another way (tests/oracles/planetary_reference.py). The error of a mode of frequency
0 is its frequency over the lowest other one. No method has a setting.

"reduced" is the package's default, which splits the equations of identical planets. "whole" is its singular values of
the whole matrix, and "vectors" its Jacobi rotations, which also give shapes and types. "svd" is NumPy's decomposition
of the same matrix, "eigh" NumPy's eigenvalues of its square. "stiffness and mass" is SciPy's generalised eigenvalues
gear by gear. Matrices of NumPy's methods are finished before the clock starts. The package's bound of the error counts
as a notice if it is more than 1e-9 of the frequency and holds. Mode shapes have modal mass 1; their error is the
largest distance from that of 50 digits, up to its sign, weighted by the roots of the masses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import eigh

from benchmarks.measure import GOAL, Job, Judged, Method, Study, judged, near, outcomes, points_job, take
from tests.oracles.planetary_reference import (
    TABLE_2,
    exact_frequencies,
    exact_shapes,
    extension_matrix,
    matrices,
    natural_frequencies,
)

_LANES, _FEW = 1024, 8
_SHAPES = "mode shapes"


def gear(planets: int, **changed: Any) -> dict[str, Any]:
    """Table 2 with equally spaced planets."""
    return TABLE_2 | {"planet_angle": tuple(2 * math.pi * i / planets for i in range(planets)), **changed}


_FREE = dict.fromkeys(("k_s", "k_r", "k_c", "k_su", "k_ru", "k_cu"), 0.0)
_GRADED = {
    "k_sp": 1e16, "k_rp": 1e12, "k_p": 1e6, "k_s": 1.0, "k_r": 1.0, "k_c": 1.0, "k_ru": 1.0, "m_s": 1e-3, "I_s": 1e-3,
}  # fmt: skip
REGIONS: dict[str, dict[str, Any]] = {
    "equal planets": gear(4),
    "unequal spacing": gear(5) | {"planet_angle": (0.0, 1.1, 2.4, 3.9, 5.2)},
    "coincident roots": gear(6),
    "zero pressure angle": gear(8, pressure_angle=0.0),
    "twelve planets": gear(12),
    "zero stiffness": gear(4, **_FREE),
    "ill-conditioned 1e16": gear(4, **_GRADED),
    # Three planets at unequal angles: no frequency is double, so every shape is determined.
    _SHAPES: TABLE_2 | {"planet_angle": (0.0, 1.9, 4.4)},
}
_FREQUENCIES = tuple(name for name in REGIONS if name != _SHAPES)
# Mode shapes take long to compile, so they are measured for one number of planets.
_FOUR = ("equal planets", "zero stiffness", "ill-conditioned 1e16")


@cache
def reference(region: str) -> np.ndarray:
    """The frequencies in Hz; those below 1e-20 of the largest are 0."""
    exact = np.array(exact_frequencies(REGIONS[region]))
    return np.where(exact > 1e-20 * exact[-1], exact, 0.0)


def neighbours(region: str, count: int) -> dict[str, np.ndarray]:
    """Columns of masses and stiffnesses, those of the region first; the angles are fixed, so that gears share a kernel."""
    return near({name: REGIONS[region][name] for name in TABLE_2}, tuple(TABLE_2), count, 0.01, seed=2)


def _scale(exact: np.ndarray) -> np.ndarray:
    return np.where(exact > 0, exact, exact[exact > 0][0])


def error_of(region: str, setting: Any, result: Any) -> Judged:
    """The largest relative error of the modes of the first gear."""
    exact, package = reference(region), isinstance(result, Mapping)
    modes = (result["natural_frequency"] if package else result)[0]
    notice = ""
    if package:
        bound = result["natural_frequency_error"][0]
        honest = np.all(np.abs(modes - exact) <= bound) and np.any(bound > GOAL * _scale(exact))
        notice = outcomes(result["outcome"][:1]) or ("natural_frequency_error" if honest else "")
    return judged(np.max(np.abs(modes - exact) / _scale(exact)), notice)


_SPECTRUM = ("natural_frequency", "natural_frequency_error")


def package(method: str, region: str, setting: Any, outputs: Sequence[str] = _SPECTRUM) -> Job:
    """A method of the package."""
    fixed = {"planet_angle": list(REGIONS[region]["planet_angle"])}
    columns = neighbours(region, _LANES)
    return points_job("planetary", "modes", outputs, columns, fixed=fixed, options={"method": method})


def _factors(region: str) -> np.ndarray:
    columns = neighbours(region, _LANES)
    return extension_matrix(
        columns | {"planet_angle": [np.full(_LANES, angle) for angle in REGIONS[region]["planet_angle"]]}
    )


def squares(factors: np.ndarray) -> np.ndarray:
    """``G^T G`` of every gear."""
    return np.swapaxes(factors, 1, 2) @ factors


def svd(factors: np.ndarray) -> np.ndarray:
    """Frequencies by NumPy's singular values."""
    return np.linalg.svd(factors, compute_uv=False)[:, ::-1] / (2 * math.pi)


def eigvalsh(of_squares: np.ndarray) -> np.ndarray:
    """Frequencies by NumPy's eigenvalues."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(of_squares), 0)) / (2 * math.pi)


def _numpy(decompose: Callable, squared: bool) -> Callable[[str, Any], Job]:
    def prepare(region: str, setting: Any) -> Job:
        factors = _factors(region)
        return partial(decompose, squares(factors) if squared else factors)

    return prepare


def _one_by_one(solve: Callable) -> Callable[[str, Any], Job]:
    def prepare(region: str, setting: Any) -> Job:
        columns = neighbours(region, _FEW)
        gears = [REGIONS[region] | take(columns, i) for i in range(_FEW)]
        return lambda: [solve(one) for one in gears]

    return prepare


@cache
def _weighted_shapes(angles: tuple[float, ...]) -> np.ndarray:
    return exact_shapes(TABLE_2 | {"planet_angle": angles})


def shape_error(one: Mapping[str, Any], shapes: np.ndarray, notice: str = "") -> Judged:
    """The error of ``shapes``, one mode a row, in the degrees of freedom times the roots of their masses."""
    exact = _weighted_shapes(tuple(one["planet_angle"]))
    signs = np.sign(np.sum(exact * shapes, axis=1, keepdims=True))
    return judged(np.max(np.linalg.norm(signs * shapes - exact, axis=1)), notice)


def _roots() -> np.ndarray:
    return np.sqrt(matrices(REGIONS[_SHAPES])[0])


def _package_shapes(region: str, setting: Any, result: Any) -> Judged:
    return shape_error(REGIONS[region], _roots() * result["mode_shape"][0], outcomes(result["outcome"][:1]))


def _scipy_shapes(region: str, setting: Any) -> Job:
    mass, stiffness = matrices(REGIONS[region])
    return lambda: eigh(np.array(stiffness, float), np.diag(mass))[1]


_method = partial(Method, settings=("double",), quick=("double",), label="{}")
STUDY = Study(
    "planetary", tuple(REGIONS), _FOUR,
    (
        _method("package, reduced", partial(package, "auto"), _LANES, regions=_FREQUENCIES),
        _method("package, whole", partial(package, "full"), _LANES, regions=_FREQUENCIES),
        _method("package, vectors", partial(package, "full", outputs=(*_SPECTRUM, "mode_type")), _LANES,
                quick=(), regions=_FOUR),
        _method("numpy, svd", _numpy(svd, False), _LANES, regions=_FREQUENCIES),
        _method("numpy, eigh", _numpy(eigvalsh, True), _LANES, regions=_FREQUENCIES),
        _method("scipy, eigh of stiffness and mass", _one_by_one(natural_frequencies), _FEW, regions=_FREQUENCIES),
        _method("package, vectors", partial(package, "auto", outputs=("natural_frequency", "mode_shape")), _LANES,
                error=_package_shapes, regions=(_SHAPES,)),
        _method("numpy, svd", _numpy(np.linalg.svd, False), _LANES, regions=(_SHAPES,),
                error=lambda region, setting, r: shape_error(REGIONS[region], r[2][0][::-1])),
        _method("numpy, eigh", _numpy(np.linalg.eigh, True), _LANES, regions=(_SHAPES,),
                error=lambda region, setting, r: shape_error(REGIONS[region], r[1][0].T)),
        _method("scipy, eigh of stiffness and mass", _scipy_shapes, 1, regions=(_SHAPES,),
                error=lambda region, setting, r: shape_error(REGIONS[region], (_roots()[:, None] * r).T)),
    ),
    error_of,
    lambda regions: ["singular values (NumPy) differ from the reference, over the largest frequency, by " + "; ".join(
        f"{name}: {np.abs(svd(extension_matrix(REGIONS[name])[None])[0] - reference(name)).max() / reference(name)[-1]:.0e}"
        for name in regions if name != _SHAPES)],
)  # fmt: skip
