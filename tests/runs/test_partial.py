"""Opening and drawing unfinished work, whose missing points are pending."""

from __future__ import annotations

import numpy as np
import pytest
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.runs.assemble import PENDING
from drivetrain_jax.runs.run import Interrupted, run_to_file
from drivetrain_jax.runs.work import Threads
from drivetrain_jax.store.parts import PartsFolder

pytestmark = pytest.mark.usefixtures("small_blocks")


def compare(partial, whole):
    done = (partial["outcome"] != PENDING).values
    assert 0 < done.sum() < done.size and partial.attrs["points_done"] == done.sum()
    for name in whole.data_vars:
        assert partial[name].values[done].tobytes() == whole[name].values[done].tobytes(), name
        if partial[name].dtype.kind in "fc":
            assert np.isnan(partial[name].values[~done]).all()
    assert "unfinished" in partial.attrs["title"] and partial["outcome"].attrs["flag_meanings"].endswith(" pending")


def test_finished_points_have_values_and_others_are_pending(grid_scene, tmp_path):
    path, whole = tmp_path / "r.nc", dt.run(grid_scene)
    seen = []

    def look(progress):
        if progress.computed and not seen and PartsFolder(path).numbers():
            seen.append(dt.open_result(path))

    run_to_file(grid_scene, path, executor=Threads(1), report=look)
    assert seen
    compare(seen[0], whole)
    assert dt.open_result(path).equals(whole)


def test_after_an_interrupt(grid_scene, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(Interrupted):
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    before = sorted(p.name for p in tmp_path.rglob("*"))
    compare(dt.open_result(path), dt.run(grid_scene))
    assert sorted(p.name for p in tmp_path.rglob("*")) == before


def test_points_reused_from_another_result_have_values(grid_scene, tmp_path):
    small, path = tmp_path / "small.nc", tmp_path / "r.nc"
    run_to_file(grid_scene | {"axes": grid_scene["axes"] | {"b": {"values": [3.0]}}}, small)
    with pytest.raises(Interrupted) as stopped:
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2), reuse=[small])
    partial = dt.open_result(path)
    assert partial.attrs["points_done"] == 41 + stopped.value.progress.computed
    assert (partial["outcome"].sel(b=3.0) != PENDING).all()


@pytest.mark.parametrize("order", [("a", "b"), ("b", "a")])
def test_lines_are_pending_as_a_whole(tmp_path, order):
    values = {"a": [float(x) for x in range(1, 10)], "b": [1.0, 4.0, 9.0]}
    scene = {"system": "toy", "analysis": "line", "axes": {name: {"values": values[name]} for name in order}}
    with pytest.raises(Interrupted):
        run_to_file(scene, tmp_path / "r.nc", executor=Threads(1), report=stop_after(1))
    partial = dt.open_result(tmp_path / "r.nc")
    pending = (partial["outcome"] == PENDING).transpose("a", "b").values
    assert pending.any() and not pending.all() and (pending.all(axis=1) == pending.any(axis=1)).all()


@pytest.mark.full
def test_an_unfinished_chart_is_drawn(tmp_path, capsys):
    base = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    axes = {"beta": {"start": 0.1, "stop": 1.2, "num": 20}, "Omega": {"start": 0.5, "stop": 1.5, "num": 20}}
    scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": base, "options": {"rtol": 1e-6}}
    path = tmp_path / "r.nc"
    with pytest.raises(Interrupted):
        run_to_file(scene, path, executor=Threads(1), report=stop_after(1))
    figure = tmp_path / "f.png"
    assert main(["plot", str(path), "--out", str(figure)]) == 0 and figure.stat().st_size > 5000
    assert main(["plot", str(tmp_path / "other.nc"), "--out", str(figure)]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_work_of_another_version_is_not_opened(grid_scene, tmp_path, monkeypatch):
    path = tmp_path / "r.nc"
    with pytest.raises(Interrupted):
        run_to_file(grid_scene, path, executor=Threads(1), report=stop_after(2))
    from drivetrain_jax import _programs

    monkeypatch.setattr(_programs, "versions", lambda names: dict.fromkeys(names, "0"))
    with pytest.raises(dt.InputError, match="unfinished work of another scene or version: diffrax is 0"):
        dt.open_result(path)
