"""Scenes of the package, made small: their files obey the CF conventions and survive every way out and back.

`make test` takes the first scene of every kind, `make validate` the others.
"""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.report.statements import axes_table, statements
from drivetrain_jax.runs import job
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.scene import Problem, result_variables
from drivetrain_jax.store.consolidate import attributes

SCENES = sorted((Path(__file__).parents[2] / "sweeps").glob("*.toml"))


def kind(path: Path) -> tuple[Any, ...]:
    """System, analysis, and whether there are axes or points given one by one."""
    scene = tomllib.loads(path.read_text())
    return scene["system"], scene["analysis"], "axes" in scene, "points" in scene


FIRST = set({kind(path): path for path in reversed(SCENES)}.values())
# The least that these options allow.
OPTIONS = {"strobes": 128, "discard": 0, "num": 12, "samples": 5}
# Lengths that depend on the system: both the tripod's and those of a chart without its multipliers.
SIZES = {"multiplier": 2, "exponent": 2, "component": 3, "state": 2, "shaft": 2, "joint": 2}
PROVENANCE = {"created", "history", "wall_time_s", "checksums"}


def small(path: Path) -> dict[str, Any]:
    """The scene with two values an axis, short motions, and a hundredth of the ranges of an atlas."""
    scene = tomllib.loads(path.read_text())
    for axis in scene.get("axes", {}).values():
        if "values" in axis:
            axis["values"] = axis["values"][:2]
        elif "num" in axis:
            axis["num"] = 2
        else:
            axis["stop"] = axis["start"] + 0.01 * (axis["stop"] - axis["start"])
    scene["options"] = {name: OPTIONS.get(name, value) for name, value in scene.get("options", {}).items()}
    return scene


def invented(problem: Problem, grid: Grid, *_: Any) -> Any:
    """A kernel that solves nothing, and gives numbers of the types and shapes of the results: compiling takes minutes."""
    sizes = SIZES | {d.name: len(d.values) for d in problem.dimensions if d.values}
    line = () if grid.path is None else (grid.path_length,)

    def kernel(columns: dict[str, np.ndarray], *_: Any) -> dict[str, np.ndarray]:
        count = len(next(iter(columns.values()))) if columns else 1
        rng, found = np.random.default_rng(1), {}
        for variable in result_variables(problem):
            shape = (count, *line, *(sizes[dim] for dim in variable.dims))
            # Below the smallest valid value netCDF4 masks.
            least = max(variable.lower or 0, 0)
            if np.dtype(variable.dtype).kind in "iu":
                found[variable.name] = rng.integers(least, len(variable.flags) or 100, shape).astype(variable.dtype)
            else:
                values = np.where(rng.random(shape) < 0.2, np.nan, least + rng.random(shape)).astype(variable.dtype)
                found[variable.name] = values * (1 + 2j) if variable.dtype == "complex128" else values
        return found

    return kernel


@pytest.fixture(
    scope="module",
    params=[pytest.param(path, id=path.stem, marks=[pytest.mark.full] * (path not in FIRST)) for path in SCENES],
)
def result(request, tmp_path_factory) -> Iterator[Path]:
    """The file of a scene."""
    folder = tmp_path_factory.mktemp("scene")
    computed(request.param, folder / "r.nc")
    yield folder / "r.nc"
    shutil.rmtree(folder)


def computed(path: Path, out: Path | None = None) -> xr.Dataset:
    """The result of a scene, made small. An atlas is solved: its panels follow from the numbers."""
    scene = small(path)
    with pytest.MonkeyPatch.context() as patch:
        if scene["analysis"] != "atlas":
            patch.setattr(job, "kernel_of", invented)
        return dt.run(scene, out=out)


def opened(path: Path, **options: Any) -> xr.Dataset:
    with xr.open_dataset(path, engine="h5netcdf", **options) as dataset:
        return dataset.load()


def test_a_report_says_something_of_every_result(result):
    dataset = opened(result)
    if dataset.attrs["analysis"] != "atlas":
        said = statements(dataset)
        assert any(f"{dataset.outcome.size:,} point" in sentence for sentence in said)
        assert all(sentence.endswith(".") and "nan" not in sentence.split() for sentence in said), said
        assert axes_table(dataset) or dataset.outcome.ndim == 0


@pytest.fixture(scope="module")
def checker():
    """The CF checker, which brings its tables along."""
    from compliance_checker.runner import CheckSuite

    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()

    def messages(path: Path) -> list[str]:
        """Requirements of the checker that the file does not meet."""
        dataset = suite.load_dataset(str(path))
        try:
            (groups, failed), *_ = suite.run_all(dataset, ["cf:1.11"]).values()
        finally:
            dataset.close()
        wrong = [f"{group.name}: {text}" for group in groups if group.weight == 3 for text in unmet(group)]
        return [*wrong, *(f"{name}: {error[0]}" for name, error in failed.items())]

    return messages


def unmet(group: Any) -> list[str]:
    passed, asked = group.value if isinstance(group.value, tuple) else (group.value, True)
    return [] if passed == asked else list(group.msgs)


# What CF lacks, and the contract of the file demands.
EXCEPTIONS = (
    # Complex numbers.
    ("§2.2 Data Types: The variable ", "_PFNC_DOUBLE_COMPLEX_TYPE"),
    # The checker subtracts labels from each other; numbers are compared below.
    ("check_coordinate_variables_strict_monotonicity: ", "'str' and 'str'"),
    # The standard name stands for dates, not for seconds since a start.
    ("§5.1 Independent", "Coordinate variable 'time' should have standard_name='time'"),
)


def test_cf(result, checker):
    wrong = [m for m in checker(result) if not any(m.startswith(a) and b in m for a, b in EXCEPTIONS)]
    assert not wrong
    dataset = opened(result)
    for name in dataset.indexes:
        if dataset[name].dtype.kind in "if":
            steps = np.diff(dataset[name].values)
            assert (steps > 0).all() or (steps < 0).all(), name
            # Positions in lists of the scene count from 0, all other labels that count from 1.
            counts = dataset[name].dtype.kind == "i" and name != "point" and "parameter" not in dataset[name].attrs
            assert not counts or dataset[name].values[0] == 1, name
    for variable in dataset.variables.values():
        assert variable.attrs["units"] and variable.attrs["long_name"]
    assert all(str(name).isidentifier() and str(name).isascii() for name in (*dataset.variables, *dataset.dims))
    assert dataset.attrs["source"] == f"drivetrain_jax {dt.__version__}"
    assert dataset.attrs["history"].startswith(f"{dataset.attrs['created']}: ")
    assert dataset.attrs["title"] and dataset.attrs["references"] and dataset.attrs["Conventions"] == "CF-1.11"
    assert "numerics_detail" not in dataset.attrs and attributes(result).get("numerics_detail")
    assert len(repr(dataset)) < 8000


def test_memory_and_copies_equal_the_file(result, request, tmp_path):
    dataset = opened(result)
    memory = computed(request.node.callspec.params["result"])
    same = {name: value for name, value in dataset.attrs.items() if name not in PROVENANCE}
    assert same == {name: value for name, value in memory.attrs.items() if name not in PROVENANCE}
    xr.testing.assert_identical(dataset.drop_attrs(deep=False), memory.drop_attrs(deep=False))
    for name, variable in memory.variables.items():
        np.testing.assert_equal(dataset[name].encoding.get("_FillValue"), variable.encoding["_FillValue"])
    dataset.to_netcdf(tmp_path / "copy.nc", engine="h5netcdf")
    xr.testing.assert_identical(opened(tmp_path / "copy.nc"), dataset)


@pytest.mark.filterwarnings("ignore:.*[Zz]arr")
def test_zarr(result, tmp_path):
    dataset = opened(result)
    dataset.to_zarr(tmp_path / "r.zarr")
    with xr.open_zarr(tmp_path / "r.zarr") as again:
        xr.testing.assert_identical(again.load(), dataset)


def test_pandas(result):
    """A row is a point, or an element of what each point has; back from pandas all values are there."""
    dataset = opened(result).drop_encoding()
    if dataset.attrs["analysis"] == "atlas":
        # Panels and gaps have no common rows.
        frames = [part.to_dataset().to_dataframe() for part in dataset.data_vars.values()]
    else:
        frames = [dataset.expand_dims("run").to_dataframe()]
        assert len(frames[0]) == np.prod([*dataset.sizes.values()])
        own = {dim for part in dataset.data_vars.values() for dim in part.dims} - set(dataset["outcome"].dims)
        assert own or len(frames[0]) == dataset["outcome"].size
    seen = set()
    for frame in frames:
        back = xr.Dataset.from_dataframe(frame)
        for name in back.data_vars:
            original = dataset.get(name)
            if original is None:
                continue
            again = back[name].isel({dim: 0 for dim in back[name].dims if dim not in original.dims}, drop=True)
            again = again.transpose(*original.dims).reindex_like(original)
            np.testing.assert_array_equal(again.values, original.values)
            seen.add(name)
    assert seen >= set(dataset.data_vars)


def test_netcdf4_and_h5py(result):
    dataset = opened(result)
    with netCDF4.Dataset(result, auto_complex=True) as file, h5py.File(result) as plain:
        assert {name: dim.size for name, dim in file.dimensions.items()} == dict(dataset.sizes)
        assert file.title == plain.attrs["title"] == dataset.attrs["title"]
        for name, variable in dataset.variables.items():
            words = variable.dtype.kind not in "iufc"
            raw = plain[name].asstr()[()] if words else plain[name][()]
            assert file[name].dimensions == variable.dims and file[name].units == variable.attrs["units"]
            assert plain[name].attrs["long_name"] == variable.attrs["long_name"]
            np.testing.assert_array_equal(raw, variable.values)
            np.testing.assert_array_equal(np.ma.filled(file[name][...], np.nan) if not words else raw, variable.values)
