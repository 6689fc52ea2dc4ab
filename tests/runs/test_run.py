"""Running scenes: values and labels in memory, files, resuming."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import toy
import xarray as xr
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax.analyses import analyse
from drivetrain_jax.analysis import Dimension, Solver
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.output import status
from drivetrain_jax.runs.run import Incomplete, run_to_file
from drivetrain_jax.runs.work import Cluster, Threads
from drivetrain_jax.store.parts import PartsFolder
from tests.sizes import full_after

pytestmark = pytest.mark.usefixtures("small_blocks")


def expected_value(a, b, n=3, length=(1.0, 2.0, 3.0)):
    total = a + b * n + length[0] + 10 * length[1] + 100 * length[2]
    return np.where(a > 9, np.nan, total)


def assert_same(one, two):
    """Arrays, coordinates and attributes of variables are equal; the provenance is not compared."""
    for name in one.variables:
        a, b = one[name], two[name]
        assert a.dims == b.dims and a.dtype == b.dtype and a.values.tobytes() == b.values.tobytes(), name
        assert str(a.attrs) == str(b.attrs)
    assert list(one.variables) == list(two.variables)


def test_grid_values_dims_and_labels(grid_scene):
    ds = dt.run(grid_scene)
    a, b = ds["a"], ds["b"]
    assert ds["value"].dims == ("b", "a") and ds["wave"].dims == ("b", "a", "part")
    np.testing.assert_allclose(ds["value"], expected_value(a.values[None, :], b.values[:, None]), rtol=1e-15)
    np.testing.assert_allclose(ds["wave"].isel(b=0), np.exp(1j * a.values[:, None] * np.arange(3)), rtol=1e-14)
    assert ds["wave"].dtype == complex and ds["sign"].dtype == np.int8 and ds["outcome"].dtype == np.int8
    assert np.array_equal(ds["sign"].isel(b=1), a > toy.LARGE)
    assert np.array_equal(ds["outcome"] >= 2, np.isnan(ds["value"])) and int((ds["outcome"] == 4).sum()) == 12
    assert set(ds.data_vars) == {"value", "wave", "sign", "effort_seen", "outcome"}
    for variable in ds.variables.values():
        assert variable.attrs["units"] and variable.attrs["long_name"]
    assert ds["outcome"].attrs["flag_meanings"].split()[:2] == ["success", "tolerance_not_met"]
    assert ds["sign"].attrs["flag_values"].tolist() == [0, 1]
    assert ds["part"].values.tolist() == [1, 2, 3]


def test_only_the_requested_results_are_there():
    ds = dt.run({"system": "toy", "analysis": "toy", "outputs": ["sign"], "axes": {"a": {"values": [1, 8]}}})
    assert set(ds.data_vars) == {"sign", "outcome"} and "part" not in ds.coords


def test_effort_is_the_largest_of_the_chunk(grid_scene):
    ds = dt.run(grid_scene)
    seen = ds["effort_seen"].where(ds["a"] <= toy.LARGE)
    assert bool((seen >= 10 * ds["a"]).where(seen.notnull(), True).all())
    assert bool((ds["effort_seen"] == 100 * ds["b"]).where(ds["a"] > toy.LARGE, True).isel(b=1).all())


def test_batch_equals_loop(grid_scene):
    ds = dt.run(grid_scene)
    for i, j in [(0, 0), (1, 13), (2, 20), (0, 21), (2, 40)]:
        one = dt.run(grid_scene | {"axes": {}, "fixed": {"a": ds["a"].values[j], "b": ds["b"].values[i]}})
        for name in ("value", "wave", "sign", "outcome"):
            np.testing.assert_allclose(ds[name].values[i, j], one[name].values, rtol=1e-14)


def test_no_axes_is_one_point():
    ds = dt.run({"system": "toy", "analysis": "toy", "outputs": ["value", "wave"], "fixed": {"a": 1.0}})
    assert ds["value"].dims == () and float(ds["value"]) == expected_value(1.0, 2.0) and ds["wave"].dims == ("part",)


def test_points_are_one_dimension():
    scene = {"system": "toy", "analysis": "toy", "outputs": ["value", "wave"]}
    ds = dt.run(scene | {"points": {"a": [1, 8, 1], "b": [1.0, 2.0, 1.0]}})
    assert ds["value"].dims == ("point",) and ds["wave"].dims == ("point", "part")
    assert ds["a"].dims == ds["b"].dims == ("point",) and ds["a"].attrs["units"] == "m"
    np.testing.assert_allclose(ds["value"], expected_value(np.array([1, 8, 1]), np.array([1, 2, 1])))


def test_one_entry_of_a_list_is_swept():
    axes = {"length[1]": {"values": [0.0, 5.0]}, "a": {"values": [1.0, 6.0]}}
    ds = dt.run({"system": "toy", "analysis": "toy", "axes": axes, "fixed": {"length": [4.0, 1.0, 2.0]}})
    assert ds["value"].dims == ("length_1", "a")
    for i, entry in enumerate((0.0, 5.0)):
        np.testing.assert_allclose(ds["value"][i], expected_value(ds["a"].values, 2.0, length=(4.0, entry, 2.0)))
    named = {"units": "1", "long_name": "lengths, entry 1", "parameter": "length[1]"}
    assert ds["length_1"].attrs == named | {"units": ds["length_1"].attrs["units"]}
    assert "parameter" not in ds["a"].attrs


def test_axis_that_the_analysis_does_not_use_and_integer_axis():
    axes = {"unused": {"values": [1.0, 2.0]}, "n": {"start": 1, "stop": 4, "num": 4}}
    ds = dt.run({"system": "toy", "analysis": "toy", "axes": axes, "fixed": {"a": 1.0}})
    assert ds["n"].dtype == np.int64 and np.array_equal(ds["value"][0], ds["value"][1])
    np.testing.assert_allclose(ds["value"][0], expected_value(1.0, 2.0, n=ds["n"].values))


def test_a_result_that_does_not_vary_fills_the_axis():
    ds = dt.run({"system": "toy", "analysis": "toy", "axes": {"unused": {"values": [1.0, 2.0]}}, "fixed": {"a": 1.0}})
    assert ds["value"].values.tolist() == [expected_value(1.0, 2.0)] * 2


@pytest.mark.parametrize("order", [("a", "b", "n"), ("b", "a", "n"), ("a", "n", "b")])
def test_path_axis_is_never_cut(order):
    values = {"a": [1.0, 2.0, 3.0], "b": [1.0, 4.0, 9.0, 16.0], "n": [1, 2]}
    ds = dt.run({"system": "toy", "analysis": "line", "axes": {name: {"values": values[name]} for name in order}})
    assert ds["response"].dims == (*order, "direction") and ds["outcome"].dims == order
    assert ds["direction"].values.tolist() == ["up", "down"]
    up = ds["response"].sel(direction="up").transpose("n", "a", "b").values
    np.testing.assert_allclose(up[1], np.outer(values["a"], np.cumsum(values["b"])))
    np.testing.assert_allclose(ds["response"].sel(direction="down").isel(a=2, n=0), [30, 29, 25, 16])


def test_fixed_path_parameter_is_a_line_of_one():
    ds = dt.run({"system": "toy", "analysis": "line", "axes": {"a": {"values": [1.0, 2.0]}}, "fixed": {"b": 5.0}})
    assert ds["response"].dims == ("a", "direction")
    assert ds["response"].sel(direction="up").values.tolist() == [5.0, 10.0]


def test_an_option_names_the_path_and_it_may_be_one_entry_of_a_list():
    axes = {"b": {"values": [1.0, 2.0, 3.0]}, "length[1]": {"values": [5.0, 7.0]}}
    scene = {"system": "toy", "analysis": "follow", "axes": axes, "fixed": {"weight": [1.0, 2.0, 3.0]}}
    ds = dt.run(scene | {"options": {"track": "length[1]"}})
    assert ds["load"].dims == ("b", "length_1", "piece") and ds["piece"].values.tolist() == [1, 2, 3]
    assert ds["load"].values[2].tolist() == [[1.0, 10.0, 9.0], [2.0, 24.0, 18.0]]


def test_a_number_may_stand_for_a_list():
    scene = {"system": "toy", "analysis": "follow", "fixed": {"b": 1.0}, "options": {"track": "weight"}}
    along = dt.run(scene | {"axes": {"weight": {"values": [2.0, 5.0]}}})
    assert along["load"].values.tolist() == [[2.0, 4.0, 6.0], [7.0, 14.0, 21.0]]
    ds = dt.run(scene | {"axes": {"weight": {"values": [2.0]}}, "fixed": {"b": 1.0, "stiffness": float("inf")}})
    assert ds["load"].values.tolist() == [[2.0, 4.0, 6.0]]
    assert json.loads(ds.attrs["fixed_parameters"])["stiffness"]["value"] == "inf"


def test_a_derived_parameter_may_be_left_out_given_or_swept():
    scene = {"system": "toy", "analysis": "toy", "axes": {"a": {"values": [1.0]}}}
    assert dt.run(scene)["value"].values.tolist() == [expected_value(1.0, 2.0)]
    ds = dt.run(scene | {"axes": scene["axes"] | {"derived": {"values": [2.0, 5.0]}}})
    assert (ds["value"].values[0] - expected_value(1.0, 2.0)).tolist() == [0.0, 3.0]


def test_points_that_no_solver_can_compute_have_the_outcome_step_limit(tmp_path):
    scene = {
        "system": "toy",
        "analysis": "toy",
        "options": {"method": "hopeless"},
        "axes": {"a": {"values": [1.0, 6.0]}},
    }
    ds = dt.run(scene)
    assert ds["outcome"].values.tolist() == [0, 3] and np.isnan(ds["value"][1])
    assert str(run_to_file(scene, tmp_path / "r.nc")) == "points: total=2 computed=2 reused=0 failed=1"


def test_a_result_without_a_single_value_has_its_dimensions_and_grows(tmp_path):
    scene = {"system": "toy", "analysis": "toy", "outputs": ["wave"], "options": {"method": "hopeless"}}
    run_to_file(scene | {"axes": {"a": {"values": [6.0]}}}, tmp_path / "r.nc")
    assert dt.run(scene, overrides={"fixed.a": 6.0})["wave"].shape == (3,)
    large = scene | {"axes": {"a": {"values": [6.0, 1.0, 7.0]}}}
    assert str(run_to_file(large, tmp_path / "r.nc")) == "points: total=3 computed=2 reused=1 failed=2"
    assert_same(dt.run(large, out=tmp_path / "r.nc"), dt.run(large))


def test_resonances_depend_on_the_axes_among_their_parameters():
    ds = dt.run({"system": "toy", "analysis": "toy", "axes": {"a": {"values": [1, 2]}, "b": {"values": [1.0, 3.0]}}})
    assert "resonance" not in ds.dims
    predicted = ds.drivetrain.resonances()
    assert predicted.name == "resonance_a" and predicted.attrs["units"] == "m"
    assert predicted.dims == ("b", "resonance") and predicted["resonance"].values.tolist() == ["R1", "R2"]
    assert predicted.values.tolist() == [[1, 0.5], [3, 1.5]]
    assert ds.isel(b=1).drivetrain.resonances().values.tolist() == [3, 1.5]
    fixed = dt.run({"system": "toy", "analysis": "toy", "axes": {"a": {"values": [1, 2]}}})
    assert fixed.drivetrain.resonances().values.tolist() == [2.0, 1.0]
    # The parameters along a dimension of the user are unknown.
    for other in (
        dt.run({"system": "toy", "analysis": "toy", "points": {"a": [1, 2]}}),
        xr.concat([fixed, fixed], "run"),
        fixed.isel(a=0),
        fixed.assign_attrs(system="of another package"),
    ):
        with pytest.raises(dt.InputError, match="resonances: none are predicted along these axes"):
            other.drivetrain.resonances()


def test_file_opens_with_xarray_h5py_and_netcdf4(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    written, memory = dt.run(grid_scene, out=path), dt.run(grid_scene)
    assert_same(written, memory)
    with xr.open_dataset(path, engine="h5netcdf") as ds:
        assert_same(ds, memory)
        assert ds.attrs["Conventions"] == "CF-1.11" and ds.attrs["system"] == "toy"
        assert json.loads(ds.attrs["fixed_parameters"])["n"]["value"] == 3
        assert {"title", "digest", "machine", "versions", "wall_time_s", "created", "method", "source"} <= set(ds.attrs)
        assert ds.attrs["references"] == "nowhere"
    with h5py.File(path) as file:
        assert np.array_equal(file["wave"][()], memory["wave"]) and file["wave"].dtype == complex
    with netCDF4.Dataset(path, auto_complex=True) as file:
        assert np.array_equal(file["outcome"][:], memory["outcome"]) and file["value"].units == "m"
        assert np.array_equal(file["wave"][:], memory["wave"])
    assert os.listdir(tmp_path) == ["r.nc"]


def test_scene_in_the_file_gives_the_same_result(grid_scene, tmp_path):
    first = dt.run(grid_scene, out=tmp_path / "r.nc", overrides={"axes.b.values": [2.5]})
    scene = tmp_path / "again.toml"
    scene.write_text(first.attrs["scene"])
    again = dt.run(scene)
    assert_same(first, again)
    assert again.attrs["digest"] == first.attrs["digest"]


def test_threads_and_repetition_do_not_change_a_bit(grid_scene):
    first = dt.run(grid_scene, threads=1)
    for workers in (1, 2, 5):
        assert_same(first, dt.run(grid_scene, threads=workers))


def test_complete_result_is_only_read(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    assert str(run_to_file(grid_scene, path)) == "points: total=123 computed=123 reused=0 failed=12"
    before = path.read_bytes()
    assert str(run_to_file(grid_scene, path)) == "points: total=123 computed=0 reused=123 failed=12"
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["r.nc"]
    assert str(run_to_file(grid_scene, path, fresh=True)) == "points: total=123 computed=123 reused=0 failed=12"
    assert status(grid_scene, path).state == "complete"


def test_interrupted_and_resumed_equals_uninterrupted(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    done = stopped.value.progress
    assert 0 < done.computed < 123 and not path.exists()
    found = status(grid_scene, path)
    assert (found.total, found.done, found.failed, found.state) == (123, done.computed, done.failed, "partial")
    resumed = run_to_file(grid_scene, path)
    assert resumed.reused == done.computed and resumed.computed == 123 - done.computed and resumed.failed == 12
    assert_same(xr.open_dataset(path, engine="h5netcdf"), dt.run(grid_scene))
    assert os.listdir(tmp_path) == ["r.nc"]


def test_parts_are_not_resumed_by_another_scene(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(KeyboardInterrupt):
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    other = grid_scene | {"fixed": {"n": 4}}
    assert status(other, path).state == "stale"
    with pytest.raises(dt.InputError, match="unfinished work of another scene"):
        run_to_file(other, path)
    assert status(grid_scene, path).state == "partial"
    assert run_to_file(other, path, fresh=True).computed == 123
    assert status(grid_scene, path).state == "stale"


def test_interrupted_replacement_keeps_the_old_result_and_resumes(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(grid_scene, path)
    before = path.read_bytes()
    other = grid_scene | {"fixed": {"n": 4}}
    with pytest.raises(dt.InputError, match="--fresh"):
        run_to_file(other, path)
    with pytest.raises(KeyboardInterrupt):
        run_to_file(other, path, fresh=True, executor=Threads(1), report=stop_after(2))
    assert path.read_bytes() == before and status(other, path).state == "partial"
    assert run_to_file(other, path).reused > 0
    assert status(other, path).state == "complete" and os.listdir(tmp_path) == ["r.nc"]


def test_work_is_not_resumed_over_a_newer_result(grid_scene, tmp_path):
    path, meanwhile = tmp_path / "r.nc", tmp_path / "s.nc"
    run_to_file(grid_scene | {"fixed": {"n": 4}}, path)
    with pytest.raises(KeyboardInterrupt):
        run_to_file(grid_scene, path, fresh=True, executor=Threads(1), report=stop_after(2))
    run_to_file(grid_scene | {"fixed": {"n": 5}}, meanwhile)
    os.replace(meanwhile, path)
    before = path.read_bytes()
    assert status(grid_scene, path).state == "stale"
    with pytest.raises(dt.InputError, match="that was started for another result"):
        run_to_file(grid_scene, path)
    assert path.read_bytes() == before


def test_a_finished_result_is_read_despite_unfinished_work_of_another_scene(grid_scene, tmp_path):
    path, other = tmp_path / "r.nc", grid_scene | {"fixed": {"n": 4}}
    run_to_file(grid_scene, path)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_to_file(other, path, fresh=True, executor=Threads(1), report=stop_after(2))
    assert run_to_file(grid_scene, path).reused == 123
    assert run_to_file(other, path).reused == stopped.value.progress.computed > 0


def test_remains_of_a_finished_run_are_deleted(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(grid_scene, path)
    digest = dt.open_result(path).attrs["digest"]
    for plan in ({"digest": digest, "replaces": None}, None):
        parts = PartsFolder(path)
        parts.open()
        if plan:
            parts.start(plan)
        parts.close()
        run_to_file(grid_scene, path)
        assert os.listdir(tmp_path) == ["r.nc"]


def test_an_address_without_a_scheduler_loses_no_work(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    with pytest.raises(dt.InputError, match="no scheduler answers"):
        run_to_file(grid_scene, path, fresh=True, executor=Cluster("tcp://127.0.0.1:1"))
    assert run_to_file(grid_scene, path).reused == stopped.value.progress.computed > 0


def test_a_run_that_ends_between_check_and_lock_is_noticed(grid_scene, tmp_path, monkeypatch):
    path, other, open_folder = tmp_path / "r.nc", grid_scene | {"fixed": {"n": 4}}, PartsFolder.open

    def late(folder):
        monkeypatch.setattr(PartsFolder, "open", open_folder)
        run_to_file(other, path)
        open_folder(folder)

    monkeypatch.setattr(PartsFolder, "open", late)
    with pytest.raises(dt.InputError, match="another run has changed it"):
        run_to_file(grid_scene, path)
    assert status(other, path).state == "complete" and os.listdir(tmp_path) == ["r.nc"]


def test_a_finished_result_in_a_folder_without_write_permission_is_read(grid_scene, tmp_path, monkeypatch):
    path = tmp_path / "r.nc"
    run_to_file(grid_scene, path)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("drivetrain_jax.store.parts.Path.mkdir", refuse)
    assert run_to_file(grid_scene, path).reused == 123 and status(grid_scene, path).state == "complete"
    assert_same(dt.run(grid_scene, path), dt.run(grid_scene))
    for fresh, name in ((True, "r.nc"), (False, "new.nc")):
        with pytest.raises(dt.InputError, match="expected a path in a writable folder"):
            run_to_file(grid_scene, tmp_path / name, fresh=fresh)
    assert os.listdir(tmp_path) == ["r.nc"]


def test_a_name_that_is_not_utf8_names_a_result(grid_scene, tmp_path, monkeypatch):
    path = tmp_path / os.fsdecode(b"\xff.nc")
    monkeypatch.setattr(sys, "argv", ["drivetrain", "run", "scene.toml", "--out", str(path)])
    run_to_file(grid_scene, path)
    assert r"\udcff.nc" in dt.open_result(path).attrs["history"]


def test_a_link_stays_a_link_and_has_the_lock_of_its_file(grid_scene, tmp_path):
    (tmp_path / "data").mkdir()
    path, link = tmp_path / "data" / "r.nc", tmp_path / "link.nc"
    link.symlink_to(path)
    run_to_file(grid_scene, link)
    assert link.is_symlink() and path.is_file()
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_to_file(grid_scene, link, fresh=True, executor=Threads(1), report=stop_after(2))
    assert PartsFolder(link).path == PartsFolder(path).path and len(os.listdir(tmp_path)) == 2
    assert run_to_file(grid_scene, path, fresh=True).reused == stopped.value.progress.computed > 0
    assert link.is_symlink() and os.listdir(tmp_path / "data") == ["r.nc"]


def test_a_damaged_block_is_computed_again(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    for part in Path(f"{path}.parts").glob("*.npz"):
        data = bytearray(part.read_bytes())
        data[len(data) // 2] ^= 1
        part.write_bytes(data)
    assert stopped.value.progress.computed > 0 and status(grid_scene, path).done == 0
    assert run_to_file(grid_scene, path).reused == 0
    assert_same(xr.open_dataset(path, engine="h5netcdf"), dt.run(grid_scene))


def test_a_failing_solver_leaves_a_resumable_run(tmp_path):
    scene = {"system": "toy", "analysis": "broken", "axes": {"a": {"values": [1.0, 2.0]}}}
    with pytest.raises(Incomplete, match=r"broken: RuntimeError: no luck"):
        run_to_file(scene, tmp_path / "r.nc")
    assert status(scene, tmp_path / "r.nc").state == "partial" and not (tmp_path / "r.nc").exists()
    with pytest.raises(Incomplete, match="broken: RuntimeError"):
        dt.run(scene)


GOOD = {"wave": np.ones(3), "outcome": 0}


@pytest.mark.parametrize(
    ("found", "dim", "message"),
    [
        ({"outcome": 0}, "part", "solve returned outcome, not wave; expected wave, outcome"),
        ({"wave": np.ones(3)}, "part", "solve returned wave, not outcome; expected wave, outcome"),
        (GOOD | {"wave": np.ones(4)}, "part", "wave has the shape (4,); expected (part = 3, lanes)"),
        (GOOD | {"wave": 1.0}, "part", "wave has the shape (); expected (part = 3, lanes)"),
        (GOOD, "parts", "wave has the dimension 'part' (did you mean parts?); expected parts"),
    ],
)
@pytest.mark.parametrize("into", ["scene", "function"])
def test_wrong_results_of_an_analysis_are_one_line(monkeypatch, found, dim, message, into):
    solvers, labels = (Solver("fixed", lambda *_: found),), (Dimension(dim, "part of the wave", (1, 2, 3)),)
    wrong = replace(toy.ANALYSES["toy"], solvers=lambda *_: solvers, dimensions=lambda *_: labels)
    monkeypatch.setitem(toy.ANALYSES, "toy", wrong)
    monkeypatch.setattr("drivetrain_jax.analysis.get_analysis", lambda _: wrong)
    with pytest.raises((Incomplete, dt.InputError)) as raised:
        if into == "scene":
            dt.run({"system": "toy", "analysis": "toy", "outputs": ["wave"], "fixed": {"a": 1.0}})
        else:
            analyse("toy", toy.Toy(a=1.0, unused=0.0), ["wave"], {})
    assert str(raised.value).startswith(f"analysis toy: {message}") and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("error", "passes"),
    [
        (OSError(5, "Input/output error"), True),
        (MemoryError(), True),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes"), True),
        (ValueError("no such shape"), False),
    ],
)
def test_only_errors_that_may_vanish_offer_the_same_command(grid_scene, tmp_path, monkeypatch, error, passes):
    def kernel(*_):
        raise error

    monkeypatch.setattr("drivetrain_jax.runs.job.kernel_of", lambda *_: kernel)
    with pytest.raises(Incomplete, match=rf"^\w+: {type(error).__name__}: ") as stopped:
        run_to_file(grid_scene, tmp_path / "r.nc", executor=Threads(1))
    assert str(stopped.value).endswith("; the same command resumes") is passes


def test_full_disk_leaves_a_resumable_run(grid_scene, tmp_path, monkeypatch):
    path = tmp_path / "r.nc"
    run_to_file(grid_scene, path)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("drivetrain_jax.store.files.os.fsync", full)
    with pytest.raises(Incomplete, match="No space left on device"):
        run_to_file(grid_scene, path, fresh=True)
    assert path.read_bytes() == before
    assert not list(Path(f"{path}.parts").glob("*.tmp"))


def test_fresh_does_not_resume_parts_of_the_present_result(grid_scene, tmp_path, monkeypatch):
    """The run is killed after it has moved the new result into place and before it has deleted its parts."""
    path = tmp_path / "r.nc"
    run_to_file(grid_scene, path)
    close = PartsFolder.close

    def killed(parts, remove=False):
        if remove:
            raise KeyboardInterrupt
        close(parts)

    def fresh_but_for_the_end():
        with monkeypatch.context() as short:
            short.setattr(PartsFolder, "close", killed)
            with pytest.raises(KeyboardInterrupt):
                run_to_file(grid_scene, path, fresh=True)
        assert PartsFolder(path).numbers()

    fresh_but_for_the_end()
    assert run_to_file(grid_scene, path, fresh=True).computed == 123
    fresh_but_for_the_end()
    assert run_to_file(grid_scene, path).reused == 123 and os.listdir(tmp_path) == ["r.nc"]


def test_result_too_large_for_the_memory_is_refused_at_once(grid_scene, monkeypatch):
    monkeypatch.setattr("drivetrain_jax.runs.run.physical_memory", lambda: 1000.0)
    with pytest.raises(dt.InputError, match="GB of memory"):
        dt.run(grid_scene)


def test_a_full_disk_is_reported_at_the_first_results(grid_scene, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("drivetrain_jax.store.consolidate.os.posix_fallocate", full)
    with pytest.raises(Incomplete, match="No space left on device") as stopped:
        run_to_file(grid_scene, tmp_path / "r.nc", executor=Threads(1))
    assert stopped.value.progress.computed < 123 and not (tmp_path / "r.nc").exists()
    assert not list((tmp_path / "r.nc.parts").glob("*.tmp"))


def test_one_point_without_axes_goes_into_a_file(tmp_path):
    scene = {"system": "toy", "analysis": "toy", "fixed": {"a": 1.0}, "outputs": ["value", "wave"]}
    ds = dt.run(scene, out=tmp_path / "r.nc")
    assert ds["value"].dims == () and ds["wave"].dims == ("part",)
    assert_same(ds, dt.run(scene))


MANY = """
import resource, sys, threading, toy
from pathlib import Path
toy.names()
from drivetrain_jax.runs import assemble, job
from drivetrain_jax.runs.run import run_to_file

# As if the sweep were as many times larger.
job._SECONDS, job._MOST_POINTS, job._PIECE, assemble._RESIDENT = 2, 1 << 13, 1 << 12, 1 << 20

def peak():
    return int(next(l for l in Path("/proc/self/status").read_text().splitlines() if l.startswith("VmRSS")).split()[1])

scene = {"system": "toy", "analysis": "toy", "outputs": ["wave"], "fixed": {"n": 1},
         "axes": {"a": {"start": 0, "stop": 9, "num": int(sys.argv[2])}, "b": {"start": 1, "stop": 2, "num": 1000}}}
most = [0]
run_to_file(scene, Path(sys.argv[1]), report=lambda _: most.__setitem__(0, max(most[0], peak())))
print(most[0] / 1024)
"""


@pytest.mark.full
def test_memory_does_not_grow_with_the_results(tmp_path):
    def megabytes(rows):
        command = [sys.executable, "-c", MANY, str(tmp_path / f"{rows}.nc"), str(rows)]
        return float(
            subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(toy.__file__).parent).stdout
        )

    small, large = megabytes(100), megabytes(600)
    # Pages of mapped files are included. 500,000 more points of 49 bytes are 24 MB. The allowed growth is the slack of the
    # allocator, and some tens of bytes for each chunk of 16 or 32 points (512 in large sweeps).
    assert large - small < 500_000 * 24 / 2**20
    assert (tmp_path / "600.nc").stat().st_size > 600_000 * 49


SLOW = {"system": "toy", "analysis": "slow", "axes": {"a": {"start": 0, "stop": 8, "num": 400}}}


@pytest.fixture
def slow_process(tmp_path):
    """A function that starts ``drivetrain run`` on a scene of about 2.5 s in a process of its own, and the result path."""
    scene = tmp_path / "slow.toml"
    scene.write_text(toml.write(SLOW))
    out = tmp_path / "r.nc"
    command = [sys.executable, toy.__file__, "run", str(scene), "--out", str(out), "--quiet", "--threads", "1"]

    def start():
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=Path(toy.__file__).parents[2])

    return start, out


def wait_for_parts(out, count, process):
    deadline = time.monotonic() + 30
    while len(list(Path(f"{out}.parts").glob("*.npz"))) < count:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline, "no parts appeared"
        time.sleep(0.01)


def test_killed_and_resumed_equals_uninterrupted(slow_process, tmp_path):
    start, out = slow_process
    for parts in (1, 2):
        process = start()
        wait_for_parts(out, parts, process)
        process.kill()
        process.communicate()
        assert not out.exists()
    done = status(SLOW, out).done
    assert 0 < done < 400
    resumed = run_to_file(SLOW, out)
    assert (resumed.reused, resumed.computed) == (done, 400 - done)
    reference = tmp_path / "reference.nc"
    run_to_file(SLOW, reference)
    assert_same(xr.open_dataset(out, engine="h5netcdf"), xr.open_dataset(reference, engine="h5netcdf"))


@pytest.mark.parametrize("sent", full_after(1, [signal.SIGINT, signal.SIGTERM]))
def test_signal_stops_promptly_and_loses_nothing(slow_process, sent):
    start, out = slow_process
    process = start()
    wait_for_parts(out, 1, process)
    process.send_signal(sent)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    lines = stderr.splitlines()
    found = status(SLOW, out)
    assert lines[-1] == f"points: total=400 computed={found.done} reused=0 failed=0" and len(lines) == 2
    assert 0 < found.done < 400 and "Traceback" not in stderr


def test_a_signal_that_ends_as_an_exception_of_a_library_is_an_interrupt(tmp_path):
    signalled = []

    class Breaking(Threads):
        def run(self, *args):
            yield next(iter(super().run(*args)))
            signalled.append(True)
            raise ValueError("Can't close the file")

    def report(progress):
        if signalled:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stop:
        run_to_file(SLOW, tmp_path / "r.nc", executor=Breaking(1), report=report)
    assert 0 < stop.value.progress.computed == status(SLOW, tmp_path / "r.nc").done < 400


def test_second_run_on_the_same_file_is_refused(slow_process):
    start, out = slow_process
    process = start()
    wait_for_parts(out, 1, process)
    with pytest.raises(dt.InputError, match="another run"):
        run_to_file(SLOW, out)
    assert process.wait(timeout=60) == 0 and status(SLOW, out).state == "complete"
