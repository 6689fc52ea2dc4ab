"""Changes that alter the digest of a scene, and changes that do not."""

from __future__ import annotations

import importlib
import pickle
import shutil
from pathlib import Path

import pytest
import toy

import drivetrain_jax as dt
from drivetrain_jax import _programs
from drivetrain_jax.runs.job import scene_digest
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.store.files import source_digest

CARDAN = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
BASE = {"system": "toy", "analysis": "toy", "axes": {"a": {"start": 0, "stop": 1, "num": 3}}}


def digest(scene):
    return resolve(load_scene(scene)).digest


def test_physical_data_and_names_of_parts_belong_to_the_result():
    """Orders follow from the teeth, and labels are the names: nothing is computed from them, and a reader sees them."""
    gear = {"system": "planetary", "analysis": "modes"}
    assert len({digest(gear | {"fixed": {"teeth": t}}) for t in ([20, 26, 72], [30, 39, 108])}) == 2
    chain = {"system": "driveline", "analysis": "phasing", "fixed": {"beta": [0.1, 0.1]}}
    assert len({digest(chain | {"parts": parts}) for parts in (["front", "rear"], ["rear", "front"])}) == 2


@pytest.mark.parametrize(
    "same",
    [
        {"title": "another"},
        {"axes": {"a": {"values": [0, 0.5, 1]}}},
        {"fixed": {"b": 2.0}},
        {"fixed": {"b": 2}},
        {"options": {"rtol": 1e-10}},
        {"outputs": ["value"]},
    ],
)
def test_the_same_computation_has_the_same_digest(same):
    assert digest(BASE | same) == digest(BASE)


@pytest.mark.parametrize(
    "other",
    [
        {"axes": {"a": {"values": [0, 0.5, 1.1]}}},
        {"axes": {}, "points": {"a": [0, 0.5, 1]}},
        {"fixed": {"b": 2.1}},
        {"fixed": {"unused": 1.0}},
        {"options": {"rtol": 1e-9}},
        {"options": {"method": "other"}},
        {"outputs": ["value", "sign"]},
    ],
)
def test_another_computation_has_another_digest(other):
    assert digest(BASE | other) != digest(BASE)


@pytest.mark.parametrize("method", ["direct", "atlas"])
def test_a_pickled_job_keeps_its_digest(method):
    axes = {"beta": {"start": 0.0, "stop": 1.0, "num": 3}, "Omega": {"start": 1.0, "stop": 2.0, "num": 3}}
    scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": CARDAN}
    job, other = (resolve(load_scene(scene | {"options": {"method": m}})) for m in (method, "diffrax"))
    copy = pickle.loads(pickle.dumps(job))
    assert copy.digest == job.digest != other.digest
    assert copy.scene.text == job.scene.text and copy.route.name == job.route.name


def test_order_of_axes_matters():
    axes = {"a": {"values": [1, 2]}, "b": {"values": [1, 2]}}
    assert digest(BASE | {"axes": axes}) != digest(BASE | {"axes": dict(reversed(axes.items()))})


def test_numerics_change_the_digest(monkeypatch):
    before = digest(BASE)
    for name, value in (("instruction_set", lambda: {"z80"}), ("versions", lambda packages: {"jax": "9"})):
        with monkeypatch.context() as patch:
            patch.setattr(_programs, name, value)
            assert digest(BASE) != before
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert digest(BASE) != before


def code(scene):
    return resolve(load_scene(scene)).numerics_detail["sources"]


def test_the_code_of_systems_analyses_and_engine_changes_the_digest():
    parts = code(BASE)
    own = {"resonances.py", "systems", "analysis", "analysis/numerics", "analysis/floquet", "atlas", "runs/kernel.py"}
    assert own < set(parts) and len(set(parts.values())) == len(parts)
    # The code of a system of a test is this file alone.
    assert parts["toy.py"] == source_digest({"toy.py": Path(toy.__file__)})


def test_a_changed_file_changes_the_digest_and_a_figure_does_not(monkeypatch, tmp_path):
    def digests():
        _programs._own_sources.cache_clear()
        return _programs._own_sources()

    copy = tmp_path / "drivetrain_jax"
    shutil.copytree(Path(dt.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__", "sweeps"))
    monkeypatch.setattr(_programs, "_ROOT", copy)
    before = digests()
    try:
        (copy / "view" / "charts.py").write_text("")
        assert digests() == before
        (copy / "analysis" / "floquet" / "direct.py").write_text("")
        changed = digests()
    finally:
        _programs._own_sources.cache_clear()
    assert {name for name in before if changed[name] != before[name]} == {"analysis/floquet"}


def test_the_whole_package_of_an_external_system_changes_the_digest(tmp_path, monkeypatch):
    package = tmp_path / "gears_of_a_test"
    (package / "laws").mkdir(parents=True)
    for name in ("__init__.py", "shaft.py", "laws/__init__.py", "laws/stiffness.py"):
        (package / name).write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("gears_of_a_test.shaft")
    before = _programs._sources_of(package.name)
    assert list(before) == [package.name]
    (package / "laws" / "stiffness.py").write_text("K = 1")
    _programs._sources_of.cache_clear()
    assert _programs._sources_of(package.name) != before


def test_the_route_changes_the_digest():
    axes = {"beta": {"start": 0.0, "stop": 1.0, "num": 3}, "Omega": {"start": 1.0, "stop": 2.0, "num": 3}}
    scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": CARDAN}
    atlas, direct = (
        resolve(load_scene(scene | {"options": {"method": method}})).numerics_detail for method in ("atlas", "direct")
    )
    assert {name for name in atlas if atlas[name] != direct[name]} == {"route"}


def test_chunk_size_changes_the_digest(monkeypatch):
    from dataclasses import replace

    scene = load_scene(BASE)
    engine = resolve(scene)
    solvers = [replace(solver, chunk=solver.chunk * 2) for solver in engine.solvers]
    assert scene_digest(scene, solvers, engine.numerics) != engine.digest
