"""What changes the digest of a scene, and what does not."""

from __future__ import annotations

import inspect
import pickle
from pathlib import Path

import pytest
import toy

import drivetrain_jax as dt
from drivetrain_jax.runs import identity
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene

CARDAN = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
BASE = {"system": "toy", "analysis": "toy", "axes": {"a": {"start": 0, "stop": 1, "num": 3}}}


def digest(scene):
    return resolve(load_scene(scene)).digest


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
def test_a_job_is_equal_to_its_pickled_copy(method):
    axes = {"beta": {"start": 0.0, "stop": 1.0, "num": 3}, "Omega": {"start": 1.0, "stop": 2.0, "num": 3}}
    scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": CARDAN}
    job, other = (resolve(load_scene(scene | {"options": {"method": m}})) for m in (method, "diffrax"))
    copy = pickle.loads(pickle.dumps(job))
    assert copy == job and hash(copy) == hash(job) and len({job, copy, other}) == 2
    assert copy.scene.text == job.scene.text and copy.route.sources == job.route.sources


def test_order_of_axes_matters():
    axes = {"a": {"values": [1, 2]}, "b": {"values": [1, 2]}}
    assert digest(BASE | {"axes": axes}) != digest(BASE | {"axes": dict(reversed(axes.items()))})


def test_numerics_decide(monkeypatch):
    before = digest(BASE)
    for name, value in (("instruction_set", lambda: {"z80"}), ("versions", lambda packages: {"jax": "9"})):
        with monkeypatch.context() as patch:
            patch.setattr(identity, name, value)
            assert digest(BASE) != before
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert digest(BASE) != before


def test_source_of_systems_analyses_and_engine_decides(monkeypatch):
    files = {}
    monkeypatch.setattr(identity, "_source_digest", lambda name, path: str(files.setdefault(name, path)))
    digest(BASE)
    assert {"analysis/_base.py", "systems/_base.py", "runs/kernel.py", "runs/plan.py", "toy.py"} <= set(files)
    assert files["toy.py"].samefile(toy.__file__)


def test_what_a_system_of_another_package_imports_from_its_own_decides(tmp_path):
    """Absolute and relative imports, however deep; its neighbours and libraries do not."""
    package = tmp_path / "gears"
    (package / "laws").mkdir(parents=True)
    texts = {
        "gears/__init__.py": "",
        "gears/shaft.py": "import numpy\nimport unrelated\nfrom . import mesh\nfrom gears.laws.stiffness import law\n",
        "gears/mesh.py": "from drivetrain_jax.systems import System\n",
        "gears/laws/__init__.py": "",
        "gears/laws/stiffness.py": "from ..constants import PITCH\nfrom .contact import force\n",
        "gears/laws/contact.py": "",
        "gears/constants.py": "",
        "gears/unused.py": "",
        "unrelated.py": "",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    found = {identity._label(path) for path in identity._imported([package / "shaft.py"])}
    assert {name for name in found if name.startswith("gears")} == set(texts) - {"gears/unused.py", "unrelated.py"}
    assert "systems/_base.py" in found and not any("numpy" in name or "unrelated" in name for name in found)


def test_imports_are_found_within_every_kind_of_statement(tmp_path):
    text = """
def law(x):
    for _ in x:
        with x:
            import a
    else:
        import b
    try:
        import c
    except ImportError:
        from d import e
    finally:
        if x: import f
    match x:
        case 1:
            import g
    class Inner:
        async def lazy(self):
            while self:
                from . import h
"""
    (tmp_path / "law.py").write_text(text)
    assert {name.strip(".") for name in identity._imports(tmp_path / "law.py")} == {*"abcfgh", "d.e"}


def test_the_choice_of_an_atlas_decides():
    axes = {"beta": {"start": 0.0, "stop": 1.0, "num": 3}, "Omega": {"start": 1.0, "stop": 2.0, "num": 3}}
    scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": CARDAN}
    found, direct = (
        set(resolve(load_scene(scene | {"options": {"method": method}})).numerics_detail["sources"])
        for method in ("atlas", "direct")
    )
    assert found - direct >= {"runs/atlas_choice.py", "runs/rounds.py", "atlas/construction.py"}


def test_chunk_size_decides(monkeypatch):
    from dataclasses import replace

    scene = load_scene(BASE)
    engine = resolve(scene)
    solvers = [replace(solver, chunk=solver.chunk * 2) for solver in engine.solvers]
    assert identity.scene_digest(scene, solvers, engine.numerics) != engine.digest


def sources(system, analysis):
    scene = load_scene(
        {"system": system, "analysis": analysis, "points": {"beta": [0.1], "Omega": [1.0]}, "fixed": CARDAN}
    )
    build, solvers = scene.system.models[analysis].build, scene.analysis.solvers
    starts = [Path(inspect.getsourcefile(inspect.unwrap(function))) for function in (build, solvers)]
    return {path.relative_to(Path(dt.__file__).parent).as_posix() for path in identity._imported(starts)}


def test_only_code_that_the_scene_runs_decides():
    of_floquet, of_forced = sources("cardan", "floquet"), sources("cardan", "forced")
    common = {
        "systems/cardan.py",
        "systems/_base.py",
        "_quantities.py",
        "analysis/_base.py",
        "analysis/numerics/linear_algebra.py",
    }
    assert common <= of_floquet & of_forced
    assert {"analysis/floquet/propagator.py", "analysis/floquet/diffrax_solvers.py"} <= of_floquet - of_forced
    assert {"analysis/forced/orbit.py", "analysis/forced/amplitude.py"} <= of_forced - of_floquet
    assert "systems/rattle.py" not in of_floquet | of_forced
