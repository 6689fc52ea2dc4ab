"""Zarr stores that workers write: results equal to the HDF5 file, resumption, and detection of damage."""

from __future__ import annotations

import json
import re
import warnings

import pytest
import xarray as xr
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax._machine import threads
from drivetrain_jax.cli import main
from drivetrain_jax.invariants import verify
from drivetrain_jax.runs import assemble, toml
from drivetrain_jax.runs.assemble import PENDING, export
from drivetrain_jax.runs.output import status
from drivetrain_jax.runs.run import Incomplete, Interrupted, run, run_to_file
from drivetrain_jax.runs.work import Threads
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.consolidate import attributes
from tests.sizes import full_after

pytest.importorskip("zarr")
pytestmark = pytest.mark.usefixtures("small_blocks")


def to_store(scene, path, **options):
    return run_to_file(scene, path, store="zarr", **options)


def opened(path):
    with xr.open_dataset(path, engine="h5netcdf") as ds:
        return ds.load()


def identical(one, two):
    for name in one.variables:
        a, b = one[name], two[name]
        assert (a.dims, a.dtype, str(a.attrs)) == (b.dims, b.dtype, str(b.attrs)), name
        assert a.values.tobytes() == b.values.tobytes(), name
    assert list(one.variables) == list(two.variables) and one.attrs["digest"] == two.attrs["digest"]


def large(scene):
    """A scene with enough chunks for several shards."""
    return scene | {"axes": {"b": {"start": 1.0, "stop": 9.0, "num": 10}, "a": {"start": 0.0, "stop": 10.0, "num": 41}}}


LINE = {
    "system": "toy",
    "analysis": "line",
    "axes": {"b": {"values": [1.0, 4.0]}, "a": {"start": 0, "stop": 9, "num": 9}},
}
ONE = {"system": "toy", "analysis": "toy", "outputs": ["value", "wave"], "fixed": {"a": 1.0}}
FIXED_PATH = LINE | {"axes": {"a": {"values": [1.0, 2.0]}}, "fixed": {"b": 5.0}}
POINTS = {"system": "toy", "analysis": "toy", "points": {"a": [1.0, 8.0, 9.5], "b": [1.0, 2.0, 3.0]}}


@pytest.mark.parametrize("which", full_after(2, ["grid", "line", "one", "fixed path", "points"]))
def test_export_is_bit_identical_to_the_file(grid_scene, tmp_path, which):
    scenes = {"grid": large(grid_scene), "line": LINE, "one": ONE, "fixed path": FIXED_PATH, "points": POINTS}
    scene = scenes[which]
    direct = run_to_file(scene, tmp_path / "direct.nc")
    assert str(to_store(scene, tmp_path / "r.zarr")) == str(direct)
    export(tmp_path / "r.zarr", tmp_path / "exported.nc")
    ours, exported = opened(tmp_path / "direct.nc"), opened(tmp_path / "exported.nc")
    identical(ours, exported)
    # A later version can then report differences, and can extend either file.
    details = [attributes(tmp_path / name)["numerics_detail"] for name in ("direct.nc", "exported.nc")]
    assert details[0] == details[1] is not None
    assert verify(tmp_path / "exported.nc").problem == "" == verify(tmp_path / "r.zarr").problem
    assert sorted(p.name for p in tmp_path.iterdir()) == ["direct.nc", "exported.nc", "r.zarr"]
    found = status(scene, tmp_path / "r.zarr")
    assert (found.state, found.done, found.failed) == ("complete", direct.total, direct.failed)
    assert to_store(scene, tmp_path / "r.zarr").reused == direct.total


def test_the_name_chooses_the_store(tmp_path):
    run_to_file(ONE, tmp_path / "r.zarr")
    assert zarr_store.is_store(tmp_path / "r.zarr") and status(ONE, tmp_path / "r.zarr").state == "complete"
    for refused in (lambda out: run_to_file(ONE, out, store="hdf5"), lambda out: run(ONE, out)):
        with pytest.raises(InputError, match=r"names a Zarr store; expected a name such as s\.nc"):
            refused(tmp_path / "s.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["r.zarr"]


def as_file(path):
    """The Dataset of a store or a file, without the attributes that differ from run to run."""
    if path.is_dir():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ds = xr.open_zarr(path).load()
    else:
        ds = opened(path)
    return ds.drop_attrs(deep=False).assign_attrs(
        {n: v for n, v in ds.attrs.items() if n not in ("created", "history", "wall_time_s", "checksums", "checksum")}
    )


@pytest.mark.parametrize("which", full_after(1, ["grid", "line", "one", "fixed path", "points"]))
def test_xarray_opens_a_store_as_the_file(grid_scene, tmp_path, which):
    scenes = {"grid": large(grid_scene), "line": LINE, "one": ONE, "fixed path": FIXED_PATH, "points": POINTS}
    run_to_file(scenes[which], tmp_path / "r.nc")
    to_store(scenes[which], tmp_path / "r.zarr")
    file, store = as_file(tmp_path / "r.nc"), as_file(tmp_path / "r.zarr")
    xr.testing.assert_identical(file, store)
    for name in file.data_vars:
        assert file[name].dtype == store[name].dtype and file[name].values.tobytes() == store[name].values.tobytes()


def test_interrupted_damaged_and_resumed(grid_scene, tmp_path):
    scene, path, pool = large(grid_scene), tmp_path / "r.store", threads(1, "chunk")
    with pytest.raises(Interrupted) as stopped:
        to_store(scene, path, executor=Threads(1), report=stop_after(6))
    # The thread of the interrupted run must end, as it would with its process.
    pool.shutdown()
    done, found = stopped.value.progress.computed, status(scene, path)
    assert 0 < done <= found.done < 410 and found.state == "partial" and not path.exists()
    with pytest.raises(InputError, match="unfinished work of --store zarr"):
        run_to_file(scene, path)
    file = next(p for p in (tmp_path / "r.store.parts" / "store" / "value" / "c").rglob("*") if p.is_file())
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    progress = to_store(scene, path)
    assert 0 < progress.reused < found.done and progress.reused + progress.computed == 410
    export(path, tmp_path / "e.nc")
    run_to_file(scene, tmp_path / "d.nc")
    identical(opened(tmp_path / "d.nc"), opened(tmp_path / "e.nc"))


@pytest.mark.parametrize("name", full_after(2, ["value", "wave", "outcome", "shards"]))
def test_damage_of_a_finished_store_is_found(grid_scene, tmp_path, name):
    path = tmp_path / "r.zarr"
    to_store(grid_scene, path)
    file = sorted(path.rglob(f"{name}/c/*"))[0]
    file = file if file.is_file() else next(p for p in file.rglob("*") if p.is_file())
    data = bytearray(file.read_bytes())
    data[len(data) // 3] ^= 1
    file.write_bytes(data)
    assert "shards are damaged" in verify(path).problem
    with pytest.raises(InputError, match="is damaged"):
        export(path, tmp_path / "e.nc")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.zarr"]


@pytest.mark.parametrize("name", full_after(2, ["scene", "digest", "title", "checksum"]))
@pytest.mark.parametrize("how", ["changed", "renamed", "gone"])
def test_damage_of_the_attributes_is_found(tmp_path, capsys, name, how):
    path = tmp_path / "r.zarr"
    to_store(POINTS, path)
    content = json.loads((path / "zarr.json").read_text())
    value = content["attributes"].pop(name)
    if how != "gone":
        changed = str(value).replace("1", "3")
        content["attributes"] |= {name + "x": value} if how == "renamed" else {name: changed + " "}
    (path / "zarr.json").write_text(json.dumps(content))
    for command in (["verify", str(path)], ["export", str(path), str(tmp_path / "e.nc")]):
        assert main(command) == 2
        err = capsys.readouterr().err
        assert len(err.splitlines()) == 1 and ("attributes" in err or "not a result" in err), err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.zarr"]


def test_damaged_attributes_of_a_growing_store_are_replaced(grid_scene, tmp_path):
    scene, path, pool = large(grid_scene), tmp_path / "r.zarr", threads(1, "chunk")
    with pytest.raises(Interrupted):
        to_store(scene, path, executor=Threads(1), report=stop_after(2))
    pool.shutdown()
    file = tmp_path / "r.zarr.parts" / "store" / "zarr.json"
    file.write_text(file.read_text().replace("stop = 10.0", "stop = 10.5"))
    to_store(scene, path)
    export(path, tmp_path / "e.nc")
    assert opened(tmp_path / "e.nc").equals(dt.run(scene))


def test_export_leaves_unfinished_work_alone(grid_scene, tmp_path):
    to_store(ONE, tmp_path / "r.zarr")
    with pytest.raises(Interrupted):
        run_to_file(grid_scene, tmp_path / "e.nc", executor=Threads(1), report=stop_after(2))
    done = status(grid_scene, tmp_path / "e.nc").done
    with pytest.raises(
        InputError, match=r"out = .*e.nc': expected a new file in an existing folder, without unfinished work"
    ):
        export(tmp_path / "r.zarr", tmp_path / "e.nc")
    assert status(grid_scene, tmp_path / "e.nc").done == done > 0


@pytest.mark.parametrize("kind", full_after(2, ["group", "array", "text", "attributes"]))
def test_a_path_without_a_store_is_one_line(tmp_path, capsys, kind):
    import zarr

    path = tmp_path / "r.zarr"
    if kind == "array":
        zarr.create_array(path, shape=(3,), dtype="f8")
    else:
        zarr.create_group(path, attributes={"title": "of another program"})
    if kind in ("text", "attributes"):
        (path / "zarr.json").write_text({"text": "{rubbish", "attributes": '{"attributes": 3}'}[kind])
    for command in (["verify", str(path)], ["export", str(path), str(tmp_path / "e.nc")]):
        assert main(command) == 2
        err = capsys.readouterr().err.splitlines()
        assert len(err) == 1 and ("not a readable Zarr store" in err[0] or "not a result of" in err[0])


@pytest.mark.parametrize("place", full_after(2, ["outcome", "checksums", "checksums/shards", "a"]))
def test_broken_metadata_of_a_finished_store_are_found(grid_scene, tmp_path, place):
    path = tmp_path / "r.zarr"
    to_store(grid_scene, path)
    (path / place / "zarr.json").write_text("{rubbish")
    assert "damaged" in verify(path).problem
    with pytest.raises(InputError, match="attributes are damaged"):
        export(path, tmp_path / "e.nc")


def test_a_changed_coordinate_is_found(grid_scene, tmp_path):
    path = tmp_path / "r.zarr"
    to_store(grid_scene, path)
    import zarr

    zarr.open_group(path, mode="r+")["a"][3] = 0.7
    assert "attributes of the store: damaged" in verify(path).problem
    # Other readers see a damaged byte by the checksum of Zarr.
    chunk = path / "a" / "c" / "0"
    chunk.write_bytes(bytes([chunk.read_bytes()[0] ^ 1]) + chunk.read_bytes()[1:])
    with pytest.raises(ValueError, match="checksum"):
        zarr.open_group(path)["a"][:]


def test_points_that_no_solver_can_compute_are_counted(tmp_path):
    scene = {"system": "toy", "analysis": "toy", "options": {"method": "hopeless"}}
    scene["axes"] = {"a": {"start": 0.0, "stop": 10.0, "num": 11}}
    first = to_store(scene, tmp_path / "r.zarr")
    found, again = status(scene, tmp_path / "r.zarr"), to_store(scene, tmp_path / "r.zarr")
    assert (first.failed, again.failed, again.reused) == (5, 5, 11)
    assert (found.done, found.failed, found.failed_by_outcome) == (11, 5, {"step_limit": 5})
    assert export(tmp_path / "r.zarr", tmp_path / "e.nc") == 11 and opened(tmp_path / "e.nc").equals(dt.run(scene))


def test_unfinished_work_is_opened_and_counted(grid_scene, tmp_path):
    scene, path, pool = large(grid_scene), tmp_path / "r.zarr", threads(1, "chunk")
    with pytest.raises(Interrupted):
        to_store(scene, path, executor=Threads(1), report=stop_after(6))
    pool.shutdown()
    partial, whole, done = dt.open_result(path), dt.run(scene), status(scene, path).done
    there = (partial["outcome"] != PENDING).values
    assert 0 < partial.attrs["points_done"] == there.sum() == done < 410
    assert partial["wave"].values[there].tobytes() == whole["wave"].values[there].tobytes()
    report = verify(path)
    assert not report.complete and re.fullmatch(r"unfinished: ([1-9]\d*) of \1 finished blocks are intact", str(report))
    chunks = (tmp_path / "r.zarr.parts" / "store" / "value" / "c").rglob("*")
    next(p for p in chunks if p.is_file()).write_bytes(b"rubbish")
    assert "the run that resumes computes the others again" in str(verify(path))


@pytest.mark.parametrize(
    ("name", "damage"),
    full_after(
        1,
        [
            (".", lambda file: file.write_text("rubbish")),
            ("checksums", lambda file: file.write_text("{}")),
            ("checksums/shards", lambda file: file.unlink()),
            ("value", lambda file: file.write_text(json.dumps(json.loads(file.read_text()) | {"shape": [1]}))),
        ],
        several=True,
    ),
)
def test_damaged_metadata_of_an_unfinished_store_are_renewed(grid_scene, tmp_path, name, damage):
    path, scene = tmp_path / "r.zarr", large(grid_scene)
    with pytest.raises(Interrupted):
        to_store(scene, path, executor=Threads(1), report=stop_after(6))
    damage(tmp_path / "r.zarr.parts" / "store" / name / "zarr.json")
    assert to_store(scene, path).reused > 0 and verify(path).problem == ""
    run_to_file(scene, tmp_path / "r.nc")
    xr.testing.assert_identical(as_file(tmp_path / "r.nc"), as_file(path))


@pytest.mark.parametrize("name", ["value", "shards"])
def test_a_missing_shard_is_found(grid_scene, tmp_path, name):
    to_store(grid_scene, tmp_path / "r.zarr")
    next(p for p in (tmp_path / "r.zarr").rglob("*") if p.is_file() and f"/{name}/c/" in p.as_posix()).unlink()
    assert "damaged" in verify(tmp_path / "r.zarr").problem


def test_a_store_that_workers_wrote_elsewhere_is_not_finished(grid_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_store, "write", lambda *_: None)
    with pytest.raises(Incomplete, match=r"1 shards are missing; every worker must see the store at"):
        to_store(ONE, tmp_path / "r.zarr")
    assert not (tmp_path / "r.zarr").exists()


def test_a_kill_while_a_store_is_replaced_loses_no_block(grid_scene, tmp_path, monkeypatch):
    path, other, move = tmp_path / "r.zarr", grid_scene | {"fixed": {"n": 4}}, assemble.move_folder
    to_store(grid_scene, path)
    with pytest.raises(InputError, match=r"fixed.n is 4, was 3; --fresh replaces it"):
        to_store(other, path)

    def killed(folder, target):
        if target == path:
            raise KeyboardInterrupt
        move(folder, target)

    with monkeypatch.context() as replacing:
        replacing.setattr(assemble, "move_folder", killed)
        with pytest.raises(KeyboardInterrupt):
            to_store(other, path, fresh=True)
    assert not path.exists() and (status(other, path).done, status(grid_scene, path).state) == (123, "stale")
    progress = to_store(other, path)
    assert (progress.computed, progress.reused) == (0, 123) and [p.name for p in tmp_path.iterdir()] == ["r.zarr"]
    assert status(other, path).state == "complete" and zarr_store.damage(path) == ""


def test_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(toml.write(POINTS))
    assert main(["run", "scene.toml", "--out", "r.zarr", "--store", "zarr", "--quiet"]) == 0
    assert main(["export", "r.zarr", "e.nc"]) == 0 and main(["verify", "r.zarr"]) == 0
    assert opened("e.nc").equals(dt.run(POINTS)) and main(["run", "scene.toml", "--out", "r.zarr", "--quiet"]) == 0
    (tmp_path / "d").mkdir()
    capsys.readouterr()
    for arguments, part in [
        (["export", "nothing", "f.nc"], "not a Zarr store"),
        (["export", "r.zarr", "e.nc"], "expected a new file"),
        (["export", "r.zarr", "nowhere/e.nc"], "expected a new file"),
        (["run", "scene.toml", "--out", "e.nc", "--store", "zarr"], "is a file"),
        (["run", "scene.toml", "--out", "d"], "is a folder"),
        (["run", "scene.toml", "--out", "r.zarr", "--store", "hdf5"], "names a Zarr store"),
        (["run", "scene.toml", "--out", "f.zarr", "--store", "zarr", "--reuse", "e.nc"], "reuse: given together"),
    ]:
        assert main(arguments) == 2
        assert part in capsys.readouterr().err, arguments
