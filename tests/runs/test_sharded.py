"""Zarr stores that workers write: results equal to the HDF5 file, resumption, and detection of damage."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import toy
import xarray as xr
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax._threads import threads
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.cli import main
from drivetrain_jax.invariants.verify import verify
from drivetrain_jax.runs import shard_writer, sharded_run, toml
from drivetrain_jax.runs.executor import Executor, Threads
from drivetrain_jax.runs.export import export
from drivetrain_jax.runs.pending import PENDING
from drivetrain_jax.runs.run import Incomplete, Interrupted, run, run_to_file
from drivetrain_jax.runs.status import status
from drivetrain_jax.store import shards, zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import read_attribute
from tests.sizes import full_after

pytest.importorskip("zarr")


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
    return scene | {"axes": {"b": {"start": 1.0, "stop": 9.0, "num": 40}, "a": {"start": 0.0, "stop": 10.0, "num": 41}}}


LINE = {
    "system": "toy",
    "analysis": "line",
    "axes": {"b": {"values": [1.0, 4.0]}, "a": {"start": 0, "stop": 9, "num": 9}},
}
LINE_A = {"a": {"start": 0, "stop": 9, "num": 9}}
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
    details = [read_attribute(tmp_path / name, "numerics_detail") for name in ("direct.nc", "exported.nc")]
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
        with pytest.raises(InputError, match=r"names a Zarr store; allowed is a name such as s\.nc"):
            refused(tmp_path / "s.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["r.zarr"]


def test_an_export_that_was_killed_at_its_end_is_finished_by_the_same_command(tmp_path, capsys):
    words = ["export", str(tmp_path / "r.zarr"), str(tmp_path / "e.nc")]
    to_store(POINTS, tmp_path / "r.zarr")
    assert main(words) == 0
    data, folder = (tmp_path / "e.nc").read_bytes(), tmp_path / "e.nc.parts"
    folder.mkdir()
    (folder / "lock").touch()
    assert status(POINTS, tmp_path / "e.nc").state == "complete"
    assert main(words) == 0 and "points: 3 exported" in capsys.readouterr().err
    assert (tmp_path / "e.nc").read_bytes() == data and not folder.exists()
    # Anything else at that path is refused and stays: a damaged result, and the result of another store.
    changed = bytearray(data)
    changed[data.index(opened(tmp_path / "e.nc").value.values.tobytes())] ^= 1
    to_store(ONE, tmp_path / "s.zarr")
    for content, store in ((bytes(changed), "r.zarr"), (data, "s.zarr"), (b"x", "r.zarr")):
        (tmp_path / "e.nc").write_bytes(content)
        folder.mkdir(exist_ok=True)
        assert main(["export", str(tmp_path / store), str(tmp_path / "e.nc")]) == 2
        assert capsys.readouterr().err.endswith("allowed is a new file in an existing folder\n")
        assert (tmp_path / "e.nc").read_bytes() == content and folder.exists()


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
def test_xarray_opens_a_store_as_the_file(grid_scene, tmp_path, which, monkeypatch):
    monkeypatch.setattr(shards, "MOST_POINTS", 50)
    scenes = {"grid": large(grid_scene), "line": LINE, "one": ONE, "fixed path": FIXED_PATH, "points": POINTS}
    run_to_file(scenes[which], tmp_path / "r.nc")
    to_store(scenes[which], tmp_path / "r.zarr")
    file, store = as_file(tmp_path / "r.nc"), as_file(tmp_path / "r.zarr")
    xr.testing.assert_identical(file, store)
    for name in file.data_vars:
        assert file[name].dtype == store[name].dtype and file[name].values.tobytes() == store[name].values.tobytes()


class InTurn(Executor):
    """Computes one task after the other, so that nothing is written while the test reads."""

    in_process = True

    def run(self, computation, tasks):
        return ((task, computation.compute(task)) for task in tasks)

    def close(self):
        pass


def test_a_growing_store_opens_with_the_computed_points(grid_scene, tmp_path, monkeypatch):
    """Incomplete shards are written as well; missing points have no value."""
    monkeypatch.setattr(sharded_run, "_INTERVAL", 0.0)
    monkeypatch.setattr(sharded_run, "_RATIO", 0.0)
    scene, path, seen = large(grid_scene), tmp_path / "r.zarr", []

    def look(progress):
        seen.append((progress.computed, as_file(tmp_path / "r.zarr.parts" / "store")))

    to_store(scene, path, executor=InTurn(), report=look)
    whole, counts = dt.run(scene), []
    for computed, found in seen:
        there = (found.outcome != PENDING).values
        counts.append(int(there.sum()))
        assert counts[-1] <= computed and found.sizes == whole.sizes
        assert found.value.values[there].tobytes() == whole.value.values[there].tobytes()
        assert np.isnan(found.value.values[~there]).all() and found.outcome.attrs["flag_meanings"].endswith("pending")
    assert counts[0] == 0 and any(0 < count < 1640 for count in counts)
    assert "pending" not in as_file(path).outcome.attrs["flag_meanings"]


SLOW = {
    "system": "toy",
    "analysis": "slow",
    "outputs": ["value", "wave"],
    "axes": {"a": {"start": 0.0, "stop": 8.0, "num": 400}},
}


@pytest.mark.full
def test_a_store_whose_run_is_killed_opens_and_is_resumed(tmp_path):
    """After two kills by SIGKILL no stored batch is lost, and the result has the bits of the file."""
    (tmp_path / "scene.toml").write_text(toml.write(SLOW))
    path, parts = tmp_path / "r.zarr", tmp_path / "r.zarr.parts"
    command = [sys.executable, toy.__file__, "run", str(tmp_path / "scene.toml"), "--out", str(path), "--store", "zarr"]
    for count in (2, 4):
        process = subprocess.Popen([*command, "--threads", "1", "--quiet"], cwd=Path(toy.__file__).parents[2])
        while len(list(parts.glob("*.h5"))) < count:
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
        process.wait()
    growing, whole, found = as_file(parts / "store"), dt.run(SLOW), status(SLOW, path)
    there = (growing.outcome != PENDING).values
    assert there.sum() <= found.done < 400 and not path.exists()
    assert growing.value.values[there].tobytes() == whole.value.values[there].tobytes()
    progress = to_store(SLOW, path)
    assert (progress.reused, progress.computed) == (found.done, 400 - found.done) and found.done > 0
    run_to_file(SLOW, tmp_path / "r.nc")
    xr.testing.assert_identical(as_file(tmp_path / "r.nc"), as_file(path))


def test_points_of_several_blocks_and_shards(grid_scene, tmp_path, monkeypatch):
    """Each shard is written once, when its block is complete."""
    monkeypatch.setattr(shards, "MOST_POINTS", 100)
    written, write = [], zarr_store.write
    monkeypatch.setattr(zarr_store, "write", lambda *a: written.append(a[3]) or write(*a))
    scene = large(grid_scene)
    to_store(scene, tmp_path / "r.zarr", executor=Threads(1))
    assert sorted(written) == list(range(20)) and zarr_store.shards_of(tmp_path / "r.zarr").count == 20
    run_to_file(scene, tmp_path / "r.nc")
    xr.testing.assert_identical(as_file(tmp_path / "r.nc"), as_file(tmp_path / "r.zarr"))


@pytest.mark.parametrize("executor", [InTurn(), Threads(3)])
def test_the_remaining_chunks_of_a_share_are_divided(grid_scene, tmp_path, monkeypatch, executor):
    """Shares that end after one chunk compute every chunk once, on any number of workers."""
    computed, compute = [], shard_writer.Job.compute
    monkeypatch.setattr(sharded_run, "SECONDS", 1e-6)
    monkeypatch.setattr(shard_writer.Job, "compute", lambda job, c: computed.append(c.number) or compute(job, c))
    monkeypatch.setattr(shards, "MOST_POINTS", 900)
    scene = large(grid_scene)
    found = to_store(scene, tmp_path / "r.zarr", executor=executor)
    assert sorted(set(computed)) == sorted(computed) and found.computed == 1640
    run_to_file(scene, tmp_path / "r.nc")
    xr.testing.assert_identical(as_file(tmp_path / "r.nc"), as_file(tmp_path / "r.zarr"))


class Crashing(InTurn):
    """Every task with the first chunk of block 70 crashes its worker."""

    def __init__(self):
        self.crashed = []

    def run(self, computation, tasks):
        for task in tasks:
            blocks = [share.block for share in getattr(task, "shares", ())]
            number = getattr(task, "size", None) and task.number
            if crash := 70 in blocks or number == 70 * shard_writer.NUMBERS:
                self.crashed.append(len(blocks))
            yield task, None if crash else computation.compute(task)


@pytest.mark.full
def test_only_the_chunk_that_crashes_its_worker_is_lost(grid_scene, tmp_path, monkeypatch):
    """The shares of a task that crashes are tried alone, then the chunks of the crashing share."""
    monkeypatch.setattr("drivetrain_jax.store.shards.Shards.of", lambda *_: shards.Shards((40, 41), (1, 20)))
    scene, executor = large(grid_scene), Crashing()
    found = to_store(scene, tmp_path / "r.zarr", executor=executor)
    assert (found.computed, found.failed) == (1640, int((as_file(tmp_path / "r.zarr").outcome != 0).sum()))
    ours, whole = as_file(tmp_path / "r.zarr"), dt.run(scene)
    lost = ours.outcome.values == Outcome.LOST
    assert executor.crashed[0] > 1 and executor.crashed[1:] == [1, 0]
    assert 0 < lost.sum() <= 20 and ours.value.values[~lost].tobytes() == whole.value.values[~lost].tobytes()


@pytest.mark.full
@pytest.mark.parametrize("which", ["grid", "line"])
def test_written_shards_of_unfinished_work_are_counted_opened_and_resumed(grid_scene, tmp_path, monkeypatch, which):
    """A worker writes a whole block without a part."""
    monkeypatch.setattr(shards, "MOST_POINTS", 60)
    scene = {"grid": large(grid_scene), "line": LINE | {"axes": {"b": {"start": 1, "stop": 9, "num": 40}, **LINE_A}}}[
        which
    ]
    path, whole = tmp_path / "r.zarr", dt.run(scene)
    name = next(iter(whole.data_vars))
    with pytest.raises(Interrupted):
        to_store(scene, path, executor=InTurn(), report=stop_after(6))
    parts = PartsFolder(path)
    assert zarr_store.done(parts.path / zarr_store.UNFINISHED).sum() > 3
    found, partial = status(scene, path), dt.open_result(path)
    there = (partial["outcome"] != PENDING).values
    assert 0 < found.done == there.sum() == partial.attrs["points_done"] < whole.outcome.size
    assert partial[name].values[there].tobytes() == whole[name].values[there].tobytes()
    # A worker that is killed during a write leaves a temporary file of Zarr.
    (parts.path / zarr_store.UNFINISHED / "outcome" / "c" / "0.x.partial").write_bytes(b"half")
    progress = to_store(scene, path)
    assert (progress.reused, progress.computed) == (found.done, whole.outcome.size - found.done)
    assert not list(path.rglob("*.partial"))
    assert as_file(path)[name].values.tobytes() == whole[name].values.tobytes()


def test_interrupted_damaged_and_resumed(grid_scene, tmp_path):
    scene, path, pool = large(grid_scene), tmp_path / "r.store", threads(1, "chunk")
    with pytest.raises(Interrupted) as stopped:
        to_store(scene, path, executor=Threads(1), report=stop_after(3))
    # The thread of the interrupted run must end, as it would with its process.
    pool.shutdown()
    done, found = stopped.value.progress.computed, status(scene, path)
    assert 0 < done <= found.done < 1640 and found.state == "partial" and not path.exists()
    with pytest.raises(InputError, match="unfinished work of --store zarr"):
        run_to_file(scene, path)
    file = next((tmp_path / "r.store.parts").glob("*.h5"))
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    progress = to_store(scene, path)
    assert 0 < progress.reused < found.done and progress.reused + progress.computed == 1640
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
    with pytest.raises(InputError, match=r"out = .*e.nc': unfinished work is in .*e.nc.parts'; allowed is a new file"):
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


def test_a_store_of_an_earlier_version_is_one_line(grid_scene, tmp_path, capsys):
    """The points of such a store are in the order of computation."""
    import zarr

    path = tmp_path / "r.zarr"
    zarr.create_group(path, attributes={"digest": "d", "groups": "[]", "scene": "", "checksum": "c"})
    for command in (["verify", str(path)], ["export", str(path), str(tmp_path / "e.nc")]):
        assert main(command) == 2
        err = capsys.readouterr().err.splitlines()
        assert len(err) == 1 and "a store of an earlier version" in err[0]
    with pytest.raises(InputError, match="of another scene or version"):
        to_store(grid_scene, path)


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
        to_store(scene, path, executor=Threads(1), report=stop_after(3))
    pool.shutdown()
    partial, whole, done = dt.open_result(path), dt.run(scene), status(scene, path).done
    there = (partial["outcome"] != PENDING).values
    assert 0 < partial.attrs["points_done"] == there.sum() == done < 1640
    assert partial["wave"].values[there].tobytes() == whole["wave"].values[there].tobytes()
    report = verify(path)
    assert not report.complete and re.fullmatch(r"unfinished: ([1-9]\d*) of \1 parts are intact", str(report))
    next((tmp_path / "r.zarr.parts").glob("*.h5")).write_bytes(b"rubbish")
    assert "the run that resumes computes the chunks of the others again" in str(verify(path))


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
def test_an_unfinished_store_with_damaged_metadata_is_replaced(grid_scene, tmp_path, name, damage):
    path, scene = tmp_path / "r.zarr", large(grid_scene)
    with pytest.raises(Interrupted):
        to_store(scene, path, executor=Threads(1), report=stop_after(3))
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


def test_fresh_replaces_a_store_and_a_kill_keeps_the_former_one(grid_scene, tmp_path, monkeypatch):
    path, other = tmp_path / "r.zarr", grid_scene | {"fixed": {"n": 4}}
    to_store(grid_scene, path)
    with pytest.raises(InputError, match=r"fixed.n is 4, was 3; --fresh replaces it"):
        to_store(other, path)
    (tmp_path / "r.zarr.parts").mkdir()
    path.rename(tmp_path / "r.zarr.parts" / "former")
    assert status(grid_scene, path).state == "complete"
    to_store(other, path, fresh=True)
    assert status(other, path).state == "complete" and [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


def test_reading_while_a_store_is_replaced_moves_nothing(grid_scene, tmp_path, monkeypatch):
    path, other, seen = tmp_path / "r.zarr", grid_scene | {"fixed": {"n": 4}}, []
    to_store(grid_scene, path)
    rename = Path.rename

    def look(self, target):
        moved = rename(self, target)
        if Path(target).name == zarr_store.FORMER:
            seen.append((status(other, path), status(grid_scene, path), dt.open_result(path), verify(path)))
        return moved

    with monkeypatch.context() as replacing:
        replacing.setattr(Path, "rename", look)
        assert to_store(other, path, fresh=True).computed == 123
    ((ours, former, partial, report),) = seen
    assert (ours.state, ours.done, former.state) == ("partial", 123, "complete")
    assert partial.attrs["points_done"] == 123 and str(report).startswith("unfinished: ")
    assert status(other, path).state == "complete" and [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


def test_a_run_restores_a_former_store_unless_another_run_is_working(grid_scene, tmp_path):
    path = tmp_path / "r.zarr"
    to_store(grid_scene, path)
    parts = PartsFolder(path)
    parts.open()
    path.rename(parts.path / zarr_store.FORMER)
    with pytest.raises(InputError, match="another run is working on it"):
        to_store(grid_scene, path)
    parts.close()
    assert to_store(grid_scene, path).reused == 123 and [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


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
        (["export", "r.zarr", "e.nc"], "allowed is a new file"),
        (["export", "r.zarr", "nowhere/e.nc"], "allowed is a new file"),
        (["run", "scene.toml", "--out", "e.nc", "--store", "zarr"], "is a file"),
        (["run", "scene.toml", "--out", "d"], "is a folder"),
        (["run", "scene.toml", "--out", "r.zarr", "--store", "hdf5"], "names a Zarr store"),
        (["run", "scene.toml", "--out", "f.zarr", "--store", "zarr", "--reuse", "e.nc"], "reuse: given together"),
    ]:
        assert main(arguments) == 2
        assert part in capsys.readouterr().err, arguments


@pytest.mark.parametrize(
    ("shape", "path", "lengths"),
    [
        ((), None, ()),
        ((7,), None, (7,)),
        ((1000, 1000), None, (250, 1000)),
        ((3, 2, 1_000_000), None, (1, 1, 250_000)),
        ((10, 262_145), None, (1, 131_073)),
        pytest.param((500, 400, 300), 1, (2, 400, 300), marks=pytest.mark.full),
        ((2, 1_000_000), 1, (1, 1_000_000)),
    ],
)
def test_shards_cover_the_sweep_once(shape, path, lengths):
    found = shards.Shards.of(shape, path, 8)
    assert found.lengths == lengths
    seen, starts, inside = np.zeros(shape, np.int8), found.starts(path), 1 if path is None else shape[path]
    before = 0
    for shard in range(found.count):
        assert starts[shard] * inside == before
        seen[found.place(shard)] += 1
        before += seen[found.place(shard)].size
    assert (seen == 1).all() and starts[-1] * inside == seen.size
