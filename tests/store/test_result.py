"""Datasets and their files: labels, CF attributes, and files that are complete or absent."""

from __future__ import annotations

import json
import os
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

from drivetrain_jax import InputError
from drivetrain_jax._machine import machine, physical_memory, usable_cores
from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.store import files
from drivetrain_jax.store.consolidate import Entry, Labelled, ResultFile, attributes, open_result, release, write_result


@pytest.fixture
def result():
    x = Entry(("x",), np.array([1.0, 2.0]), {"units": "m", "long_name": "place"})
    time = Entry(("x",), np.array([0.0, 5.0]), {"units": "s", "long_name": "instant"})
    results = [
        (Variable("z", "1", "complex", ("k",), "complex128"), np.array([[1 + 2j, np.nan], [0, -1j]])),
        (Variable("f", "s", "duration"), np.array([np.nan, 3.0])),
        (Variable("v", "1", "flag", dtype="int8", flags=("no", "not at all")), np.array([0, 1], np.int8)),
    ]
    dims = (Dimension("k", "number", ("up", "down")), Dimension("unused", "never", (1, 2)))
    return Labelled.build(
        ("x",), {"x": x, "t0": time}, dims, results, {"digest": "abc", "scene": "é = 1\n" * 30_000, "wall_time_s": 1.5}
    )


def test_labels(result):
    dataset = result.to_dataset()
    assert dataset["z"].dims == ("x", "k") and "unused" not in dataset.coords
    assert dataset["v"].attrs["flag_meanings"] == "no not_at_all" and dataset["v"].attrs["flag_values"].dtype == np.int8
    assert all(v.attrs["units"] and v.attrs["long_name"] for v in dataset.variables.values())


def test_round_trip_by_plain_xarray(result, tmp_path):
    path, dataset = tmp_path / "r.nc", result.to_dataset()
    write_result(result, path, tmp_path / "tmp")
    with xr.open_dataset(path, engine="h5netcdf") as again:
        assert sorted(json.loads(again.attrs.pop("checksums"))) == ["/", "f", "k", "t0", "v", "x", "z"]
        xr.testing.assert_identical(again, dataset)
        assert again["z"].dtype == complex and again["f"].dtype == float and again["t0"].dtype == float
        assert "_FillValue" not in again["x"].encoding and again["k"].values.tolist() == ["up", "down"]
    assert attributes(path).get("digest") == "abc" and attributes(path).get("nothing") is None
    assert os.listdir(tmp_path) == ["r.nc"]


def test_long_details_are_in_a_group(result, tmp_path):
    """Datasets lack them; they are also read from older files, which have them among the global attributes."""
    path, long = tmp_path / "r.nc", "x" * 5000
    detailed = result.with_attrs(numerics_detail=long)
    write_result(detailed, path, tmp_path / "tmp")
    with xr.open_dataset(path, engine="h5netcdf") as again:
        assert "numerics_detail" not in again.attrs and len(repr(again)) < 1500
        xr.testing.assert_identical(again.drop_attrs(deep=False), detailed.to_dataset().drop_attrs(deep=False))
    assert "numerics_detail" not in detailed.to_dataset().attrs
    assert attributes(path).get("numerics_detail") == long and attributes(path).get("digest") == "abc"
    with netCDF4.Dataset(path) as file:
        assert file["provenance"].numerics_detail == long
    with h5py.File(path, "r+") as file:
        del file["provenance"]
        file.attrs["numerics_detail"] = "old"
    assert attributes(path).get("numerics_detail") == "old"


def test_two_files_of_one_result_are_identical(result, tmp_path):
    """The type of complex numbers holds the second of its creation, so one of several pairs must agree."""

    def pair():
        for name in ("one", "two"):
            write_result(result, tmp_path / name, tmp_path / "tmp")
        return (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()

    assert any(pair() for _ in range(4))


def test_a_variable_without_entries(tmp_path):
    axis = Entry(("x",), np.array([1.0, 2.0]), {"units": "m", "long_name": "place"})
    results = [(Variable("z", "1", "nothing", ("k",)), np.empty((2, 0))), (Variable("f", "s", "time"), np.ones(2))]
    result = Labelled.build(("x",), {"x": axis}, (), results, {"digest": "abc"})
    write_result(result, tmp_path / "r.nc", tmp_path / "tmp")
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as again:
        assert again["z"].shape == (2, 0) and again["f"].values.tolist() == [1.0, 1.0]


def resident():
    """Resident memory of this process in pages of files, in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return sum(int(line.split()[1]) / 1024 for line in lines if line.startswith(("RssFile", "RssShmem")))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is looked up in /proc")
def test_released_pages_take_no_memory_and_are_not_lost(tmp_path):
    blank = np.broadcast_to(np.zeros(()), (1 << 22,))
    template = Labelled.build(("x",), {}, [], [(Variable("f", "s", "duration"), blank)], {"digest": "abc"})
    with ResultFile(tmp_path / "tmp") as file:
        arrays = file.lay_out(template)
        arrays["f"][:] = 3.0
        full = resident()
        release(arrays.values())
        assert resident() < full - 30
        assert (arrays["f"] == 3.0).all()
        release([np.zeros(3)])


@pytest.mark.parametrize("step", ["os.fsync", "os.replace"])
def test_a_failure_keeps_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "r"
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"drivetrain_jax.store.files.{step}", fail)
    with pytest.raises(OSError, match="No space"):
        files.write_atomic(path, b"new", tmp_path / "tmp")
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["r"]


@pytest.mark.parametrize(
    ("name", "file", "told"),
    [
        ("r.nc.parts", "plan.json", "a folder of unfinished work; give .*r.nc'$"),
        ("r.zarr", "zarr.json", "a Zarr store; use xarray.open_zarr, or `drivetrain export`$"),
        ("r", "anything", "is a folder; give a result written by `drivetrain run`$"),
    ],
)
def test_the_message_about_a_folder_names_its_kind(tmp_path, name, file, told):
    (tmp_path / name).mkdir()
    (tmp_path / name / file).write_text("{}")
    with pytest.raises(InputError, match=told):
        open_result(tmp_path / name)


def test_a_device_is_no_result():
    with pytest.raises(InputError, match="not a readable"):
        open_result(Path("/dev/null"))


@pytest.mark.parametrize("content", [None, b"", b"no HDF5 at all", "cut"])
def test_unreadable_result_is_one_clear_line(tmp_path, result, content):
    path = tmp_path / "r.nc"
    if content == "cut":
        write_result(result, path, tmp_path / "tmp")
        content = path.read_bytes()[:2000]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="does not exist" if content is None else "not a readable"):
        open_result(path)


def test_digest_of_content():
    base = {"b": 1.0, "a": [1, "x", None], "v": np.array([1.0, 2.0])}
    assert files.digest(base) == files.digest(dict(reversed(base.items())))
    others = [
        base | {"b": 1},
        base | {"v": np.array([1.0, 3.0])},
        base | {"v": np.array([1, 2])},
        base | {"a": ["x", 1]},
    ]
    assert len({files.digest(other) for other in [base, *others]}) == 5
    with pytest.raises(TypeError, match="no digest of set"):
        files.digest({1, 2})


def test_digest_of_sources(tmp_path):
    (tmp_path / "a.py").write_text("1")
    (tmp_path / "b.py").write_text("1")
    one = files.source_digest({"x": tmp_path / "a.py"})
    assert one == files.source_digest({"x": tmp_path / "b.py"})
    assert one != files.source_digest({"y": tmp_path / "a.py"})
    (tmp_path / "b.py").write_text("2")
    assert one != files.source_digest({"x": tmp_path / "b.py"})


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (["/usr/bin/drivetrain", "run", "a b.toml", "--out", "r.nc"], "drivetrain run 'a b.toml' --out r.nc"),
        (["study.py"], "study.py"),
        (["-c", "x"], "python"),
        ([""], "python"),
        (["/lib/ipykernel_launcher.py", "-f", "/run/kernel.json"], "notebook"),
    ],
)
def test_the_command_that_runs(monkeypatch, argv, told):
    monkeypatch.setattr("sys.argv", argv)
    assert files.command() == told


def test_provenance_has_machine_and_versions():
    assert "cores" in machine() and "/" not in machine().split("Python")[1]
    assert files.versions(["numpy"]) == {"numpy": np.__version__}
    assert usable_cores() >= 1 and physical_memory() > 1e8
