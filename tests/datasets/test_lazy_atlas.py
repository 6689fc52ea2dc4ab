"""An atlas opened by xarray: on any grid, evaluated where it is touched."""

from __future__ import annotations

import os
import pickle
import shutil

import dask
import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.datasets.engine import gap
from drivetrain_jax.runs import through_atlas
from drivetrain_jax.runs.atlas_file import StoredAtlas
from tests.atlases import SHAFT, atlas_file
from tests.sizes import but_full

ATLAS = {
    "system": "cardan",
    "analysis": "atlas",
    "axes": {"beta": {"start": 0.0, "stop": 0.6}, "Omega": {"start": 1.0, "stop": 2.0}},
    "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0},
}
GRID = {"beta": 300, "Omega": (1.2, 1.8, 400)}


@pytest.fixture(scope="module")
def file():
    return atlas_file(ATLAS)


@pytest.fixture(scope="module")
def atlas(file):
    return dt.open_atlas(file)


@pytest.fixture(scope="module")
def expected(atlas):
    return atlas.grid(beta=np.linspace(0, 0.6, 300), Omega=np.linspace(1.2, 1.8, 400))


@pytest.fixture
def evaluated(monkeypatch):
    """Numbers of cells of all evaluations."""
    sizes, arrays = [], StoredAtlas.arrays

    def counting(self, columns, **options):
        found = arrays(self, columns, **options)
        sizes.append(found["outcome"].size)
        return found

    monkeypatch.setattr(StoredAtlas, "arrays", counting)
    return sizes


def opened(file, grid=GRID, **options):
    return xr.open_dataset(file, engine="drivetrain", grid=grid, **options)


def test_it_is_the_result_on_the_grid(file, expected):
    found = opened(file)
    plain = found.drop_vars("proved").drop_attrs(deep=False)
    xr.testing.assert_identical(plain, expected.drop_attrs(deep=False))
    assert found.attrs.keys() == expected.attrs.keys() and found.attrs["analysis"] == "floquet"
    assert opened(file, None)["verdict"].shape == (512, 512)


def test_what_is_never_touched_is_never_computed(file, evaluated):
    found = opened(file, dict.fromkeys(("beta", "Omega"), 1_000_000))
    assert found["verdict"].shape == (1_000_000, 1_000_000) and "verdict" in repr(found)
    part = found.isel(beta=slice(0, 3000, 1000), Omega=500_000)
    assert evaluated == []
    part.load()
    # All results of a selection come from one evaluation.
    assert evaluated == [3]


def test_selections_are_the_grid_of_their_values(file, atlas, evaluated):
    found = opened(file, 2000).drop_vars("proved")
    part = found.sel(beta=slice(0.2, 0.4)).isel(Omega=[30, 10, 1000])
    xr.testing.assert_equal(part.load(), atlas.grid(beta=part["beta"].values, Omega=part["Omega"].values))
    line = found.sel(beta=0.3, method="nearest")
    xr.testing.assert_equal(line.load(), atlas.grid(beta=float(line["beta"]), Omega=line["Omega"].values))
    point = found.isel(beta=700, Omega=900)
    assert float(point["spectral_radius"]) == float(
        atlas(beta=float(point["beta"]), Omega=float(point["Omega"]))["spectral_radius"]
    )
    assert found.isel(beta=slice(0, 0))["verdict"].values.shape == (0, 2000)
    turned = found["spectral_radius"].isel(beta=slice(40), Omega=slice(60)).T
    evaluated.clear()
    assert turned.values.shape == (60, 40) and evaluated == [2400]


def test_a_block_is_not_the_points_of_its_rows(file):
    rows, places = [1, 5], xr.DataArray([1, 5], dims="p")
    selections = {"beta": rows, "Omega": rows}, dict.fromkeys(("beta", "Omega"), places)
    for order in (selections, selections[::-1]):
        found = opened(file, 16)
        block, points = (found.isel(s)["spectral_radius"].values for s in order)
        block, points = (block, points) if order is selections else (points, block)
        assert block.shape == (2, 2)
        np.testing.assert_allclose(np.diag(block), points, rtol=1e-14)


def test_scattered_points_are_evaluated_one_by_one(file, atlas, evaluated):
    random = np.random.default_rng(0)
    places = {name: xr.DataArray(random.integers(0, 10_000, (4, 25)), dims=("a", "b")) for name in ("beta", "Omega")}
    found = opened(file, 10_000).isel(places)["spectral_radius"]
    assert found.dims == ("a", "b") and evaluated == []
    values = found.values
    assert evaluated == [100]
    exact = atlas(beta=found["beta"], Omega=found["Omega"])["spectral_radius"]
    np.testing.assert_array_equal(values, exact.values)
    along = opened(file, 1000).isel(beta=xr.DataArray(np.arange(0, 1000, 100), dims="a"))["verdict"]
    assert along.dims == ("a", "Omega") and along.values.shape == (10, 1000)


def test_usual_ways_of_xarray(file, expected, tmp_path):
    found = opened(file)
    assert float(found["spectral_radius"].mean()) == float(expected["spectral_radius"].mean())
    unstable = found["spectral_radius"].where(found["verdict"] == 1)
    assert int(unstable.count()) == int((expected["verdict"] == 1).sum()) > 100
    found.to_zarr(tmp_path / "grid.zarr")
    with xr.open_zarr(tmp_path / "grid.zarr") as again:
        xr.testing.assert_identical(again["spectral_radius"].load(), expected["spectral_radius"])
    found["spectral_radius"].sel(beta=slice(0.1, 0.2)).plot()


@pytest.mark.filterwarnings("ignore:The specified chunks")
@pytest.mark.parametrize("scheduler", but_full(["threads", "processes"], "processes"))
def test_chunks_of_dask(file, expected, scheduler):
    found = opened(file, chunks={"beta": 100, "Omega": 400})
    assert found["spectral_radius"].chunks == ((100, 100, 100), (400,))
    with dask.config.set(scheduler=scheduler, num_workers=2):
        mean = float(found["spectral_radius"].mean())
        counts = int((found["verdict"] == 1).sum())
    assert mean == pytest.approx(float(expected["spectral_radius"].mean()), rel=1e-12)
    assert counts == int((expected["verdict"] == 1).sum())


def test_chunks_that_dask_chooses_are_of_one_size(file):
    sizes = opened(file, 3000, chunks={})["verdict"].chunks
    assert all(len(set(along[:-1])) == 1 and along[-1] >= 0.9 * along[0] for along in sizes)
    assert opened(file, 300, chunks={})["verdict"].chunks == ((300,), (300,))


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    """An atlas of three parameters."""
    path = tmp_path_factory.mktemp("deep") / "atlas.nc"
    axes = ATLAS["axes"] | {"mu": {"start": 0.9, "stop": 1.1}}
    dt.run(ATLAS | {"axes": axes, "fixed": {"zeta": 0.001, "alpha": 1.0, "gamma": 100.0}}, out=path)
    return path


@pytest.mark.full
def test_chunks_agree_along_an_axis_that_predictions_depend_on(deep):
    found = opened(deep, {"beta": 200, "Omega": 200, "mu": 150}, chunks={})
    assert found.drivetrain.resonances().dims == ("mu", "resonance")
    assert found.chunks["mu"] == found["verdict"].chunksizes["mu"] and len(found.chunks["mu"]) > 10


@pytest.mark.full
def test_chunks_of_even_axes_reach_along_those_of_low_degree(deep):
    (panel, *_), names = dt.open_atlas(deep).stability.atlas.panels, ("beta", "Omega", "mu")
    chunks = opened(deep, 400, chunks={})["verdict"].chunksizes
    shortest = min(names, key=lambda name: chunks[name][0])
    assert panel.degrees[names.index(shortest)] == max(panel.degrees)


@pytest.mark.full
def test_small_rectangles_have_the_numbers_of_single_points(deep):
    """Also where eigenvalues decide."""
    stability = dt.open_atlas(deep).stability
    axes = [
        np.linspace(*ends, n) for ends, n in zip(((0.0, 0.6), (1.38, 1.46), (0.95, 1.05)), (20, 40, 33), strict=True)
    ]
    found = stability.on_grid(axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    alone = stability.at(points)
    error = found["spectral_radius_error"].ravel() + alone["spectral_radius_error"]
    assert (abs(found["spectral_radius"].ravel() - alone["spectral_radius"]) <= error).all()
    assert (found["outcome"].ravel() == alone["outcome"]).all() and (found["verdict"] == 1).any()
    both = (found["verdict"].ravel() < 2) & (alone["verdict"] < 2)
    assert both.mean() > 0.99 and (found["verdict"].ravel() == alone["verdict"])[both].all()
    slow = stability.by_eigenvalues(points[-200:], ["spectral_radius", "spectral_radius_error"])
    error = slow["spectral_radius_error"] + alone["spectral_radius_error"][-200:]
    assert (abs(slow["spectral_radius"] - alone["spectral_radius"][-200:]) <= error).all()


@pytest.mark.full
def test_arrays_travel_without_what_they_hold(file, expected):
    array = opened(file)["spectral_radius"].variable
    array[:10, :10].values  # noqa: B018
    packed = pickle.dumps(array)
    assert len(packed) < 20_000
    np.testing.assert_array_equal(pickle.loads(packed).values, expected["spectral_radius"].values)


def test_values_of_all_kinds_make_a_grid(file):
    row = np.array([0.1, 0.4, 0.2])
    found = opened(file, {"beta": row, "Omega": 1.5})
    assert found["verdict"].dims == ("beta",) and found["beta"].values.tolist() == row.tolist()
    assert float(found["Omega"]) == 1.5 and found["Omega"].attrs["units"] == "1"
    assert opened(file, {"beta": xr.DataArray(row), "Omega": [1.5]})["verdict"].shape == (3, 1)
    dropped = opened(file, drop_variables=["verdict", "outcome"])
    assert set(dropped.data_vars) == {"spectral_radius", "spectral_radius_error", "proved"}


def test_physical_data_make_a_grid(file, atlas):
    # 1 rad/s of this shaft is Omega = 0.01.
    shaft = {"J1": 2.0, "k1": 2e4}
    speeds = ("1100 rpm", "1700 rpm", 4)
    found = opened(file, {"speed": speeds, **shaft, "angle": [5.0, 20.0]})
    assert found["verdict"].dims == ("angle", "speed") and found["speed"].attrs["units"] == "rpm"
    np.testing.assert_allclose(found["speed"], [1100, 1300, 1500, 1700], rtol=1e-14)
    np.testing.assert_allclose(found["Omega"], found["speed"] * np.pi / 30 / 100, rtol=1e-14)
    plain = atlas.grid(beta=found["beta"].values, Omega=found["Omega"].values)
    np.testing.assert_array_equal(found["spectral_radius"], plain["spectral_radius"].values)
    angle = opened(file, {"beta": ("3 deg", "0.5 rad", 3), "Omega": 5})["beta"].values
    np.testing.assert_allclose(angle, np.linspace(np.pi / 60, 0.5, 3), rtol=1e-14)
    with pytest.raises(dt.InputError, match=r"^J1: missing; Omega = speed sqrt\(J1/k1\) needs J1 and k1$"):
        opened(file, {"speed": (1100.0, 1700.0, 4)})


@pytest.mark.full
def test_axes_of_a_scene_in_physical_data_name_the_results():
    """Axes of the scene name dimensions and values in its units; numbers in a question have the quantity's own unit."""
    file = atlas_file(SHAFT)
    atlas, hertz = dt.open_atlas(file), opened(file, {"speed": 4, "c1": 2})
    assert hertz["verdict"].dims == ("speed", "c1") and opened(file, None)["verdict"].dims == ("speed", "c1")
    assert hertz["speed"].attrs["units"] == "Hz" and list(hertz.coords) == ["speed", "Omega", "c1", "zeta"]
    np.testing.assert_allclose(hertz["speed"], [22, 23, 24, 25], rtol=1e-14)
    np.testing.assert_allclose(hertz["Omega"], hertz["speed"] * 2 * np.pi * np.sqrt(2 / 6e4), rtol=1e-14)
    rpm = atlas.grid(c1=[0.1, 0.5], speed=[1320.0, 1500.0])
    assert rpm["verdict"].dims == ("c1", "speed") and rpm["speed"].attrs["units"] == "rpm"
    np.testing.assert_allclose(rpm["speed"], [1320, 1500], rtol=1e-15)
    np.testing.assert_allclose(rpm["spectral_radius"].T, hertz["spectral_radius"][[0, 3]], rtol=1e-10)
    point = atlas(speed=1425.0, c1=0.1)
    assert float(point["speed"]) == pytest.approx(1425, rel=1e-15) and point["verdict"] == 1
    assert opened(file, {"Omega": 3, "c1": 0.2})["verdict"].dims == ("Omega",)
    for wrong, message in (
        (lambda: atlas(speed=1600.0, c1=0.2), "speed = 1600: expected 1320 <= speed <= 1500, in rpm"),
        (lambda: atlas(speed="23 Hz"), "c1: missing; expected 0.1 <= c1 <= 0.5, in N m s/rad"),
        (lambda: opened(file, {"speed": 5, "c1": 0.7}), "c1 = 0.7: expected 0.1 <= c1 <= 0.5, in N m s/rad"),
        (lambda: opened(file, {"speed": 1}), "grid.speed = 1: is a number of values"),
    ):
        with pytest.raises(dt.InputError) as refused:
            wrong()
        assert str(refused.value).startswith(message)
    with xr.open_dataset(file, engine="h5netcdf") as chart:
        assert chart["verdict"].dims == ("speed", "c1")


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ({"speed": 10}, "speed = 10: not a parameter of the atlas; expected 0 <= beta <= 0.6, in rad; 1 <= Omega <= 2"),
        ({"mu": 10}, "mu = 10: the atlas is made for mu = 1; leave it out"),
        ({"beta": 1}, "grid.beta = 1: is a number of values; expected 2 or more; 1.0 would fix beta"),
        ({"Omega": (1.0, 3.0, 5)}, "Omega = 2.5: expected 1 <= Omega <= 2"),
        ({"beta": "wide"}, "grid.beta = 'wide': expected a number of values (1000), (START, STOP, NUM), "),
        ({"beta": True}, "grid.beta = True: expected "),
        ({"beta": np.zeros((2, 2))}, "grid.beta = array([[0., 0.],        [0., 0.]]): expected "),
        ({"beta": 0.1, "Omega": 1.5}, "grid: fixes all parameters; expected one that varies, "),
        ("all", "grid = 'all': expected a number of values, or a table by the names of parameters"),
    ],
)
def test_grids_that_are_none(file, grid, message):
    with pytest.raises(dt.InputError) as refused:
        opened(file, grid)
    assert str(refused.value).startswith(message)


def test_files_that_are_none(tmp_path, file):
    with pytest.raises(dt.InputError, match=r"gaps = 'fill': expected one of solve, nan"):
        opened(file, gaps="fill")
    with pytest.raises(dt.InputError, match=r"none.nc': No such file"):
        opened(tmp_path / "none.nc")
    with pytest.raises(dt.InputError, match="expected the path of the file of an atlas"):
        opened(memoryview(b""))
    damaged = tmp_path / "damaged.nc"
    shutil.copy(file, damaged)
    with h5py.File(damaged, "r+") as store:
        store["coefficients"][0, 0] *= 2
    with pytest.raises(dt.InputError, match=r"damaged \(coefficients"):
        opened(damaged)


def test_a_file_that_changes_is_not_mixed_with_another(tmp_path, file):
    copy = tmp_path / "atlas.nc"
    shutil.copy(file, copy)
    found = opened(copy)
    os.utime(copy, ns=(0, 0))
    with pytest.raises(dt.InputError, match="has changed since it was opened; open it again"):
        found["verdict"].values  # noqa: B018
    assert opened(copy)["verdict"].isel(beta=0).values.shape == (400,)


@pytest.mark.full
def test_xarray_knows_the_file_without_an_engine(file, tmp_path):
    assert xr.open_dataset(file)["verdict"].shape == (512, 512)
    knows = xr.backends.list_engines()["drivetrain"].guess_can_open
    assert knows(file) and knows(str(file))
    chart = tmp_path / "chart.nc"
    axes = {"beta": {"values": [0.1, 0.2]}, "Omega": {"values": [1.2, 1.3]}}
    dt.run(ATLAS | {"analysis": "floquet", "axes": axes}, out=chart)
    for other in (chart, tmp_path, tmp_path / "absent.nc", "https://example.org/atlas.nc", b"bytes", None):
        assert not knows(other)
    assert "spectral_radius" in xr.open_dataset(chart)


def test_other_readers_see_the_panels(file):
    with netCDF4.Dataset(file) as found:
        coefficients = found["coefficients"][:]
    with h5py.File(file) as found:
        np.testing.assert_array_equal(found["coefficients"][:], coefficients)
    with xr.open_dataset(file, engine="h5netcdf") as found:
        assert found.attrs["analysis"] == "atlas"
        np.testing.assert_array_equal(found["coefficients"].values, coefficients)


@pytest.mark.full
def test_gaps_are_solved_or_have_no_value(monkeypatch, tmp_path):
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 50)
    path, grid = tmp_path / "gaps.nc", {"beta": [0.1, 0.3], "Omega": [1.2, 1.3, 1.9]}
    dt.run(ATLAS, out=path)
    solved = opened(path, grid)
    axes = {name: {"values": values} for name, values in grid.items()}
    exact = dt.run(ATLAS | {"analysis": "floquet", "axes": axes, "options": {"method": "direct"}})
    np.testing.assert_array_equal(solved["spectral_radius"].values, exact["spectral_radius"].values)
    blank = opened(path, grid, gaps="nan")
    assert np.isnan(blank["spectral_radius"].values).all() and (blank["verdict"] == 2).all()
    assert (blank["outcome"] == gap()).all()
    assert blank["outcome"].attrs["flag_meanings"].split()[gap()] == "gap"
    assert blank["outcome"].attrs["flag_values"].tolist() == list(range(gap() + 1))
