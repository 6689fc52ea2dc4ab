"""A power cut leaves whole results: files are flushed before they count, and no result is believed unread."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax._threads import threads
from drivetrain_jax.runs.executor import Threads
from drivetrain_jax.runs.run import Interrupted, run_to_file
from drivetrain_jax.runs.status import status
from drivetrain_jax.store import shards, zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from tests.sizes import full_after

pytest.importorskip("zarr")
pytestmark = pytest.mark.usefixtures("toys")

SCENE = {
    "system": "toy",
    "analysis": "toy",
    "outputs": ["value", "wave"],
    "axes": {"b": {"values": [1.0, 3.0, 2.0]}, "a": {"start": 0.0, "stop": 10.0, "num": 41}},
}
LARGE = SCENE | {"axes": {"b": {"start": 1.0, "stop": 9.0, "num": 40}, "a": {"start": 0.0, "stop": 10.0, "num": 41}}}


@pytest.fixture
def flushed(monkeypatch):
    """Times (ns) of the last flush by inode."""
    times, fsync = {}, os.fsync

    def record(handle):
        fsync(handle)
        times[os.fstat(handle).st_ino] = time.time_ns()

    monkeypatch.setattr(os, "fsync", record)
    return times


def unflushed(folder, times):
    """Files and folders that have changed since their last flush."""
    paths = [folder, *folder.rglob("*")]
    return [str(path) for path in paths if path.stat().st_mtime_ns > times.get(path.stat().st_ino, 0)]


def test_a_store_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch, flushed):
    path, seen, rename = tmp_path / "r.zarr", [], Path.rename

    def look(self, target):
        if self.name in (zarr_store.UNFINISHED, "half"):
            seen.append((self.name, unflushed(self, flushed)))
        moved = rename(self, target)
        seen.append((Path(target).name, time.time_ns()))
        return moved

    monkeypatch.setattr(Path, "rename", look)
    for number in (3, 4):
        run_to_file(SCENE | {"fixed": {"n": number}}, path, store="zarr", fresh=True)
    names = [name for name, _ in seen]
    once = ["half", "store", "store", "r.zarr"]
    assert names == [*once, "half", "store", "former", "store", "r.zarr"] or names == [
        *once,
        *once[:3],
        "former",
        "r.zarr",
    ]
    assert all(left == [] for name, left in seen if isinstance(left, list)), seen
    assert flushed[tmp_path.stat().st_ino] > max(moment for _, moment in seen if isinstance(moment, int))


def test_a_shard_is_on_the_disk_before_it_counts(tmp_path, monkeypatch, flushed):
    monkeypatch.setattr(shards, "MOST_POINTS", 82)
    counted, replace = [], Path.replace

    def look(self, target):
        target = Path(target)
        if target.parent.name == "c" and target.parent.parent.name == "shards":
            store = target.parents[3]
            results = [store / name for name in ("value", "wave", "outcome")]
            left = [p for folder in results for p in unflushed(folder, flushed) if "zarr.json" not in p]
            counted.append((target.name, left))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", look)
    run_to_file(LARGE, tmp_path / "r.zarr", store="zarr", executor=Threads(1))
    assert sorted(int(name) for name, _ in counted) == list(range(20))
    assert [left for _, left in counted] == [[]] * 20


def empty(folder, pattern):
    files = [path for path in folder.rglob(pattern) if path.is_file()]
    assert files
    for path in files:
        path.write_bytes(b"")


@pytest.mark.parametrize("lost", full_after(2, ["*", "shards/c/*", "a/c/*", "zarr.json", "value/**/*"]))
def test_a_run_survives_a_power_cut_that_empties_its_store(tmp_path, lost):
    path, pool = tmp_path / "r.zarr", threads(1, "chunk")
    with pytest.raises(Interrupted):
        run_to_file(LARGE, path, store="zarr", executor=Threads(1), report=stop_after(3))
    pool.shutdown()
    found = status(LARGE, path).done
    store = PartsFolder(path).path / "store"
    (store / "checksums" / "shards" / "c").mkdir(exist_ok=True)
    (store / "checksums" / "shards" / "c" / "0").touch()
    empty(store, lost)
    progress = run_to_file(LARGE, path, store="zarr")
    assert 0 < progress.reused == found and progress.reused + progress.computed == 1640
    assert status(LARGE, path).state == "complete" and zarr_store.damage(path) == ""


@pytest.mark.parametrize("lost", full_after(2, ["*", "zarr.json", "value/c/**/*", "outcome/c/**/*", "a/c/*"]))
@pytest.mark.parametrize("gone", [True, False])
def test_a_finished_store_that_lost_files_is_not_believed_and_replaced(tmp_path, lost, gone):
    path = tmp_path / "r.zarr"
    run_to_file(SCENE, path, store="zarr")
    empty(path, lost)
    for file in path.rglob("*") if gone else ():
        if file.is_file() and file.stat().st_size == 0:
            file.unlink()
    found = status(SCENE, path)
    assert (found.state, found.done) == ("stale", 0) and "a damaged result" in found.reason
    with pytest.raises(InputError, match=r"holds a damaged result \((its metadata|1 shard)\); --fresh replaces it"):
        run_to_file(SCENE, path, store="zarr")
    assert run_to_file(SCENE, path, store="zarr", fresh=True).computed == 123
    assert status(SCENE, path).state == "complete" and [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


def test_a_folder_of_another_program_is_not_replaced(tmp_path):
    path = tmp_path / "r.zarr"
    (path / "outcome").mkdir(parents=True)
    (path / "zarr.json").write_bytes(b"")
    with pytest.raises(InputError, match="not a readable Zarr store"):
        run_to_file(SCENE, path, store="zarr", fresh=True)
    assert (path / "outcome").is_dir()


def test_a_finished_file_is_compared_with_its_checksums(tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(SCENE, path)
    data = bytearray(path.read_bytes())
    data[data.index(dt.open_result(path)["value"].values.tobytes()) + 5] ^= 1
    path.write_bytes(data)
    found = status(SCENE, path)
    assert (found.state, found.done) == ("stale", 0) and "a damaged result (value)" in found.reason
    with pytest.raises(InputError, match=r"holds a damaged result \(value\); --fresh replaces it"):
        run_to_file(SCENE, path)
    run_to_file(SCENE, path, fresh=True)
    assert np.isfinite(dt.open_result(path)["value"]).any() and status(SCENE, path).state == "complete"
