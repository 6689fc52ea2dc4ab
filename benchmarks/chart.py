"""Contenders on charts of the cardan shaft, on two cores: cell by cell, and by an atlas.

Chart: beta in [0, 1.5], Omega in [0.1, 2], zeta 0.001, alpha = mu = 1, gamma = 100. The result is the spectral radius,
with its bound for the package, so every time includes the eigenvalues. The package uses the threads of its engine,
rivals one process a core, which are started and compiled beforehand. diffrax gets a coarser grid of the chart, SciPy
random cells of it. Errors are relative to heyoka at tolerance 1e-15, which is itself compared with SciPy (head of the
CSV).

Atlas, for each number of cells of the chart:

    evaluation    the grid from an existing atlas (its kernels compiled)
    points        as many cells at random places, one million at most
    warm          atlas, grid and result in memory: nodes and direct solves included, compilation excluded
    cold command  `drivetrain run` of the same scene: import, compilation, solves, evaluation, file

heyoka computes 20,000 of the cells; its time per cell does not depend on their number.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cardan import HEYOKA, heyoka_batch, reference_radius
from benchmarks.measure import CORES, Columns, Job, Judged, Method, Study, engine_job, judged, shared_out, take
from tests.oracles.cardan_reference import (
    BASE_CASE,
    monodromy,
    spectral_radius,
    stacked_half_period_monodromy,
    stacked_monodromy,
)

RANGES = {"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}
CELLS = "chart of 30,000 cells"
SAMPLE, COARSE = {"few": 200, "some": 3200, "many": 20_000}, 3000
ATLASES = {f"{cells:,} cells": cells for cells in (30_000, 1_000_000, 4_000_000, 20_000_000)}
_TOLERANCE, _MOST_POINTS = 3e-8, 1_000_000
_OUTPUTS = ("spectral_radius", "spectral_radius_error", "verdict")


def axes(cells: int) -> dict[str, np.ndarray]:
    """The axes of a chart of about ``cells`` cells, of shape 3:4."""
    rows = max(2, round((cells * 3 / 4) ** 0.5))
    sizes = (rows, max(2, round(cells / rows)))
    return {name: np.linspace(*ends, size) for (name, ends), size in zip(RANGES.items(), sizes, strict=True)}


@cache
def chart(cells: int) -> Columns:
    """The cells as columns."""
    grid = np.meshgrid(*axes(cells).values(), indexing="ij")
    fixed = {name: np.full(grid[0].size, value) for name, value in BASE_CASE.items()}
    return dict(zip(RANGES, (part.ravel() for part in grid), strict=True)) | fixed


@cache
def sample(cells: int, size: int) -> Columns:
    """Random cells of a chart."""
    columns = chart(cells)
    return take(columns, np.random.default_rng(size).choice(len(columns["beta"]), min(size, cells), replace=False))


def scene(cells: int, method: str, rtol: float) -> dict[str, Any]:
    """The chart as a scene."""
    grid = {name: {"start": ends[0], "stop": ends[1], "num": axes(cells)[name].size} for name, ends in RANGES.items()}
    return {"system": "cardan", "analysis": "floquet", "outputs": list(_OUTPUTS), "axes": grid, "fixed": dict(BASE_CASE),
            "options": {"method": method, "rtol": rtol}}  # fmt: skip


@cache
def _exact(cells: int, size: int) -> np.ndarray:
    return reference_radius(sample(cells, size) if size else chart(cells))


def radius_error(cells: int, size: int, region: str, setting: Any, result: Any) -> Judged:
    """The error of all cells."""
    radii = result["spectral_radius"] if isinstance(result, Mapping) else result
    if np.all(np.isnan(radii)):
        return Judged(float("nan"), 0, "no eigenvalues")
    return judged(np.max(np.abs(radii / _exact(cells, size) - 1)))


@dataclass(frozen=True)
class Rival:
    """Spectral radii in a process of its own (a class, so that spawned processes can receive it)."""

    method: str
    rtol: float

    def __call__(self, columns: Columns) -> np.ndarray:
        """Spectral radii of ``columns``, or NaN without eigenvalues."""
        if self.method.startswith("heyoka"):
            z = heyoka_batch(self.rtol).monodromy(columns)
            return np.full(len(z), np.nan) if "without" in self.method else spectral_radius(z)
        if self.method == "stacked":
            return spectral_radius(stacked_monodromy(columns, self.rtol, self.rtol))
        if self.method == "half period":
            return spectral_radius(stacked_half_period_monodromy(columns, self.rtol, self.rtol))
        points = ({name: column[i] for name, column in columns.items()} for i in range(len(columns["beta"])))
        return np.array([spectral_radius(monodromy(p, self.method, self.rtol, self.rtol)) for p in points])


def _package(cells: int, method: str, region: str, rtol: float) -> Job:
    return engine_job(scene(cells, method, rtol), CORES)


def _rival(method: str, cells: int, size: int, region: str, rtol: float) -> Job:
    columns = sample(cells, size) if size else chart(cells)
    return shared_out(Rival(method, rtol), columns, CORES if "p" in method and size == SAMPLE["some"] else 4 * CORES)


def _cells(name: str, prepare: Callable, settings: Sequence[float], quick: Sequence[float], size: int = 0,
           cells: int = 30_000, label: str = "rtol={:g}") -> Method:  # fmt: skip
    points = size or len(chart(cells)["beta"])
    return Method(name, prepare, points, settings, quick, label, partial(radius_error, cells, size))


def _scipy(name: str, method: str, size: str, settings: Sequence[float]) -> Method:
    return _cells(name, partial(_rival, method, 30_000, SAMPLE[size]), settings, settings[-1:], SAMPLE[size])


# Every method has a setting below and one above an error of 1e-9 on this chart.
STUDY = Study(
    "chart", (CELLS,) if HEYOKA else (), (CELLS,) if HEYOKA else (),
    (
        _cells("package, direct", partial(_package, 30_000, "direct"), (1e-6, 1e-7, 3e-8, 1e-10), (1e-7,)),
        _cells("package, diffrax", partial(_package, COARSE, "diffrax"), (1e-5, 1e-6), (), cells=COARSE),
        _cells("heyoka batch", partial(_rival, "heyoka", 30_000, 0), (1e-8, 2e-9, 1e-10), (1e-10,), label="tolerance={:g}"),
        _cells("heyoka batch, without eigenvalues", partial(_rival, "heyoka, without", 30_000, 0), (1e-8,), (),
               label="tolerance={:g}"),
        _scipy("scipy RK45", "RK45", "few", (1e-9, 3e-11)),
        _scipy("scipy DOP853", "DOP853", "few", (1e-9, 1e-10)),
        _scipy("scipy DOP853 stacked", "stacked", "some", (1e-9, 2e-12)),
        _scipy("scipy DOP853 stacked, half period", "half period", "some", (1e-9, 1e-10)),
    ),
    lambda *_: Judged(0.0),
    lambda regions: ["reference heyoka 1e-15: differs from scipy DOP853 1e-13 by {:.1e} ({} cells)".format(
        np.abs(Rival("DOP853", 1e-13)(sample(30_000, 60)) / _exact(30_000, 60) - 1).max(), 60)] if regions else (),
)  # fmt: skip


@cache
def _atlas(cells: int) -> Any:
    import drivetrain_jax as dt

    folder = Path(tempfile.mkdtemp(prefix="benchmarks-"))
    whole = scene(cells, "atlas", _TOLERANCE) | {"analysis": "atlas"}
    whole["axes"] = {name: {"start": low, "stop": high} for name, (low, high) in RANGES.items()}
    whole["options"] = {"rtol": _TOLERANCE}
    whole.pop("outputs")
    dt.run(whole, out=folder / "atlas.nc").close()
    return dt.open_atlas(folder / "atlas.nc")


def evaluation(region: str, setting: Any) -> Job:
    """The grid from an existing atlas."""
    atlas, grid = _atlas(ATLASES[region]), axes(ATLASES[region])
    return _compiled(lambda: atlas.grid(**grid))


def scattered(region: str, setting: Any) -> Job:
    """Random points from an existing atlas."""
    rng, atlas = np.random.default_rng(2), _atlas(ATLASES[region])
    points = {name: rng.uniform(*ends, _scattered(region)) for name, ends in RANGES.items()}
    return _compiled(lambda: atlas(**points, proved=False))


def _scattered(region: str) -> int:
    return min(_size(region), _MOST_POINTS)


def warm(region: str, rtol: float) -> Job:
    """Atlas, grid and result in memory."""
    import drivetrain_jax as dt

    whole = scene(ATLASES[region], "atlas", rtol)
    return _compiled(lambda: dt.run(whole))


def _compiled(job: Job) -> Job:
    job()
    return job


def cold(region: str, rtol: float) -> Job:
    """The whole command, without compiled code."""
    from drivetrain_jax.runs import toml

    folder = Path(tempfile.mkdtemp(prefix="benchmarks-"))
    (folder / "scene.toml").write_text(toml.write({"title": "atlas"} | scene(ATLASES[region], "atlas", rtol)))
    command = "run", str(folder / "scene.toml"), "--out", str(folder / "cold.nc"), "--fresh"

    def job() -> Any:
        environment = os.environ | {"DRIVETRAIN_JAX_CACHE": "0"}
        words = [sys.executable, "-m", "drivetrain_jax.cli", *command]
        subprocess.run(words, check=True, capture_output=True, env=environment)
        return folder / "cold.nc"

    return job


def atlas_error(region: str, setting: Any, result: Any) -> Judged:
    """The largest relative error of 3000 cells of a grid."""
    import xarray as xr

    if isinstance(result, Path):
        with xr.open_dataset(result, engine="h5netcdf") as stored:
            return atlas_error(region, setting, stored.load())
    rng = np.random.default_rng(1)
    index = [rng.integers(0, values.size, 3000) for values in axes(ATLASES[region]).values()]
    columns = {name: values[i] for (name, values), i in zip(axes(ATLASES[region]).items(), index, strict=True)}
    columns |= {name: np.full(3000, value) for name, value in BASE_CASE.items()}
    return judged(np.abs(np.asarray(result["spectral_radius"])[tuple(index)] / reference_radius(columns) - 1).max())


def _size(region: str) -> int:
    return int(np.prod([values.size for values in axes(ATLASES[region]).values()]))


def _heyoka_sample(region: str, tolerance: float) -> Job:
    return shared_out(Rival("heyoka", tolerance), sample(_MOST_POINTS, SAMPLE["many"]))


_HOW = (_TOLERANCE,)
ATLAS = Study(
    "atlas", tuple(ATLASES) if HEYOKA else (), (),
    (
        Method("package, evaluation", evaluation, _size, _HOW, error=atlas_error),
        Method("package, points", scattered, _scattered, _HOW, error=lambda *_: Judged(0.0)),
        Method("package, warm", warm, _size, _HOW, error=atlas_error),
        Method("package, cold command", cold, _size, _HOW, error=atlas_error),
        Method("heyoka batch", _heyoka_sample, SAMPLE["many"], (1e-8, 1e-10), label="tolerance={:g}",
               error=lambda region, setting, radii: radius_error(_MOST_POINTS, SAMPLE["many"], region, setting, radii)),
    ),
    atlas_error,
)  # fmt: skip
