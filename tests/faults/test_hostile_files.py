"""Damaged and hostile files: refused in one line and in seconds, whatever HDF5 would do with them."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax.cli import main
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.run import run_to_file
from drivetrain_jax.runs.status import status
from drivetrain_jax.store import checksums, gate
from drivetrain_jax.store.consolidate import map_variable, read_variable
from tests.sizes import full_after

pytestmark = pytest.mark.usefixtures("toys")

SCENE = {"system": "toy", "analysis": "toy", "outputs": ["value"], "axes": {"a": {"values": [1.0, 2.0, 3.0]}}}


@pytest.fixture
def path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(toml.write(SCENE))
    run_to_file(SCENE, tmp_path / "r.nc")
    return tmp_path / "r.nc"


def replaced(path, change):
    """The file without its former variable ``value``, changed."""
    with h5py.File(path, "r+") as file:
        del file["value"]
        change(file)


def plugin(file):
    kept = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    kept.set_chunk((3,))
    kept.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, ())
    h5py.h5d.create(file.id, b"value", h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((3,)), kept)


def virtual(file):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("other.nc", "value", shape=(3,))
    file.create_virtual_dataset("value", layout)


def linked(name, content):
    """The variable ``value`` with its dimensions named by an attribute of another type: HDF5 may crash on it."""
    return lambda file: file.create_dataset("value", data=np.zeros(3)).attrs.__setitem__(name, content)


HOSTILE = {
    "a number as scales": linked("DIMENSION_LIST", 1.5),
    "words as scales": linked("DIMENSION_LIST", ["a", "b", "c"]),
    "a number as labels": linked("DIMENSION_LABELS", np.zeros(1)),
    "labels of another shape": linked("DIMENSION_LABELS", "a"),
    "8 TB": lambda f: f.create_dataset("value", (1000, 10**9), "f8", chunks=(1000, 1000)),
    "8 TB in one block": lambda f: f.create_dataset("value", (1000, 10**9), "f8"),
    "link": lambda f: f.__setitem__("value", h5py.SoftLink("/a")),
    "link to a file": lambda f: f.__setitem__("value", h5py.ExternalLink("/etc/passwd", "/")),
    "values in a file": lambda f: f.create_dataset("value", (3,), "f8", external=[("/etc/passwd", 0, 24)]),
    "virtual": virtual,
    "plugin": plugin,
    "objects": lambda f: [f.create_group(f"value{k}") for k in range(gate._OBJECTS + 1)],
}


@pytest.mark.parametrize("kind", full_after(4, HOSTILE))
def test_a_hostile_file_is_refused(path, kind):
    replaced(path, HOSTILE[kind])
    with pytest.raises(InputError, match="not a readable"):
        dt.open_result(path)


@pytest.mark.parametrize("words", ["verify r.nc", "plot r.nc --out f.png", "run scene.toml --out r.nc"])
def test_every_reader_refuses_a_hostile_file(path, capsys, words):
    replaced(path, HOSTILE["virtual"])
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert "not a readable netCDF4/HDF5 file" in said and len(said.splitlines()) == 1, said


def with_rank(values):
    """The variable ``value`` with other values, and no dimensions."""
    return lambda file: file.create_dataset("value", data=values)


UNFIT = {
    "group": lambda f: f.create_group("value"),
    "no rank": with_rank(1.0),
    "two dimensions of no name": with_rank(np.zeros((3, 3))),
    "words": with_rank(["x", "y", "z"]),
    "outcome without rank": lambda f: [f.__delitem__("outcome"), f.create_dataset("outcome", data=np.int8(0))],
    "outcome of words": lambda f: [f.__delitem__("outcome"), f.create_dataset("outcome", data=["x", "y", "z"])],
    "axis without rank": lambda f: [f.__delitem__("a"), f.create_dataset("a", data=1.0)],
    "scene is a number": lambda f: f.attrs.__setitem__("scene", 1.5),
    "analysis is a list": lambda f: f.attrs.__setitem__("analysis", np.arange(3)),
}


@pytest.mark.parametrize("kind", full_after(4, UNFIT))
def test_sealed_content_of_no_result_is_one_line(path, capsys, kind):
    replaced(path, UNFIT[kind])
    with h5py.File(path, "r+") as file:
        checksums.reserve(file)
        checksums.seal(file)
    for words in ("verify r.nc", "plot r.nc --out f.png", "status scene.toml --out r.nc", "run scene.toml --out r.nc"):
        code = main(words.split())
        said = capsys.readouterr().err
        assert code in (0, 2) and len(said.splitlines()) == int(code == 2 or words.startswith("run")), (words, said)
    assert code == 2


@pytest.mark.parametrize("read", [read_variable, map_variable])
def test_a_group_in_place_of_a_variable_is_one_line(path, read):
    replaced(path, UNFIT["group"])
    with pytest.raises(InputError, match=r"^[^\n]*r\.nc[^\n]*$"):
        read(path, "value")


@pytest.mark.parametrize("solves", ["x", "", np.arange(2)])
def test_a_sealed_number_of_solves_that_is_none_is_one_line(path, capsys, solves):
    with h5py.File(path, "r+") as file:
        file.attrs["solves"] = solves
        checksums.seal(file)
    for command, code in (("status", 0), ("run", 2)):
        assert main([command, "scene.toml", "--out", "r.nc"]) == code
        assert "does not fit a result" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("code", "reason"), [("import time; time.sleep(60)", "takes longer"), ("import os; os.abort()", "crashes")]
)
def test_a_file_in_which_hdf5_hangs_or_crashes_is_refused(path, monkeypatch, code, reason):
    os.utime(path, (1, 1))
    monkeypatch.setattr(gate, "_SCAN", code)
    monkeypatch.setattr(gate, "_PATIENCE", 0.5)
    with pytest.raises(InputError, match=rf"not a readable .*damaged in its structure \(reading it {reason}"):
        dt.open_result(path)


def test_a_sound_file_is_scanned_once_and_an_own_one_never(path, monkeypatch):
    calls, scanned = [], gate._scanned
    monkeypatch.setattr(gate, "_scanned", lambda *words: calls.append(words) or scanned(*words))
    dt.open_result(path)
    assert len(calls) == 0
    copy = shutil.copy(path, "copy.nc")
    for _ in range(2):
        assert np.isfinite(dt.open_result(copy)["value"]).all()
    assert len(calls) == 1


def test_an_unknown_outcome_is_counted(path):
    with h5py.File(path, "r+") as file:
        file["outcome"][0] = -1
        checksums.seal(file)
    found = status(SCENE, path)
    assert (found.state, found.done, found.failed) == ("complete", 3, 0)


def test_changed_values_are_not_opened_and_not_drawn(path):
    with h5py.File(path, "r+") as file:
        file["value"][0] += 1.0
    for reader in (dt.open_result, dt.plot):
        with pytest.raises(InputError, match=r"damaged \(value\); allowed is to restore it or to compute it again"):
            reader(path)


def test_a_selection_that_xarray_has_written_is_opened(path):
    part = dt.open_result(path).isel(a=slice(2))
    part.to_netcdf("part.nc", engine="h5netcdf")
    assert checksums.ATTRIBUTE in part.attrs and dt.open_result("part.nc").identical(part)


@pytest.mark.parametrize("kind", full_after(1, ["pipe", "device"]))
@pytest.mark.parametrize(
    "words",
    [
        "run X --out n.nc",
        "status X --out n.nc",
        "run scene.toml --out X",
        "status scene.toml --out X",
        "verify X",
        "plot X --out f.png",
        "plot r.nc --out X",
        "point cardan floquet --data X",
    ],
)
def test_what_is_no_regular_file_is_refused(path, capsys, kind, words):
    special = Path("x.png" if words.endswith("--out X") and words.startswith("plot") else "x.nc")
    if kind == "pipe":
        os.mkfifo(special)
    else:
        special.symlink_to("/dev/zero")
    assert main(words.replace("X", str(special)).split()) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and ("regular file" in said or ".csv" in said), said
    assert special.exists() and not special.is_file()


def test_a_scene_of_more_than_64_mb_is_refused(path, capsys):
    with open("large.toml", "wb") as file:
        file.truncate((1 << 26) + 1)
    assert main(["run", "large.toml", "--out", "n.nc"]) == 2
    assert "scene = 'large.toml': larger than 64 MB" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["plan.json", "00000000-x.h5", "result.tmp", "plan.tmp"])
def test_a_pipe_among_the_parts_stops_nothing(path, name):
    parts = Path("n.nc.parts")
    parts.mkdir()
    os.mkfifo(parts / name)
    status(SCENE, "n.nc")
    assert run_to_file(SCENE, Path("n.nc"), fresh=True).computed == 3 and not parts.exists()


def bind(path):
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda lock: lock.symlink_to("n.nc"), bind])
def test_a_lock_that_is_no_file_is_refused(path, capsys, make):
    lock = Path("n.nc.parts", "lock")
    lock.parent.mkdir()
    make(lock)
    status(SCENE, "n.nc")
    for more in ([], ["--fresh"]):
        assert main(["run", "scene.toml", "--out", "n.nc", *more]) == 2
        said = capsys.readouterr().err
        assert said == f"drivetrain: out = {str(lock)!r}: allowed is a regular file; remove it\n"
    assert os.path.lexists(lock)


@pytest.mark.parametrize("scene", ['"x"', '"title = 1"', "3", "[]", "null"])
def test_a_damaged_plan_is_one_line(path, capsys, scene):
    parts = Path("n.nc.parts")
    parts.mkdir()
    (parts / "plan.json").write_text(f'{{"scene": {scene}, "digest": 3, "reused_files": 4}}')
    for words in (["plot", "n.nc", "--out", "f.png"], ["run", "scene.toml", "--out", "n.nc"]):
        assert main(words) == 2 and len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("known", [False, True], ids=["first reading", "known structure"])
def test_a_file_that_another_program_writes_is_locked(path, capsys, known):
    """Also if this process has read the structure of the file before."""
    if not known:
        gate._passed.clear()
    code = f"import h5py; file = h5py.File({str(path)!r}, 'r+'); print('open', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline().strip() == b"open"
        if known:
            gate._remember(gate._state(os.stat(path)))
        assert main(["verify", str(path)]) == 2
        with pytest.raises(InputError, match="locked by another program"):
            dt.open_result(path)
        other.communicate(b"\n")
    said = capsys.readouterr().err
    assert said == f"drivetrain: file = {str(path)!r}: locked by another program; wait until that program closes it\n"
