"""Any scene and any command line is either run or refused: exit 2, one line that names the field, nothing written."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import drivetrain_jax
from drivetrain_jax.cli import main
from drivetrain_jax.runs import toml

# Seconds within which a small scene has to be run, or a bad one refused, on a busy machine.
FUZZ = {
    "deadline": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    "derandomize": True,
}

WORDS = st.one_of(
    st.sampled_from(["toy", "cardan", "line", "follow", "a", "b", "n", "length[1]", "length[9]", "kind", "weight"]),
    st.sampled_from(
        ["../../etc/passwd", "/tmp/evil", "a/b", "..", "__class__", "{0.__class__}", "$(touch evil)", "`id`"]
    ),
    st.text(max_size=8),
)
NUMBERS = st.one_of(
    st.integers(-3, 12),
    st.floats(-3, 12),
    st.sampled_from([float("nan"), float("inf"), -float("inf"), 1e308, 5e-324, 10**30, -(2**63), 1e12]),
)
VALUES = st.one_of(
    NUMBERS, WORDS, st.booleans(), st.lists(NUMBERS, max_size=4), st.dictionaries(WORDS, NUMBERS, max_size=2)
)
# Either small enough to be run or too large to be.
COUNTS = st.one_of(st.integers(-1, 5), st.sampled_from([10**10, 10**12, 10**18, 10**30]), VALUES)
AXES = st.one_of(
    st.fixed_dictionaries({"start": NUMBERS, "stop": NUMBERS, "num": COUNTS}),
    st.fixed_dictionaries({"values": st.lists(NUMBERS, max_size=5)}),
    st.dictionaries(st.sampled_from(["start", "stop", "num", "scale", "values", "step"]), VALUES, max_size=4),
    VALUES,
)
NAMES = st.one_of(st.sampled_from(["a", "b", "n", "length[1]", "length", "kind", "unused", "derived", "weight"]), WORDS)
GOOD = {"system": "toy", "analysis": "toy", "axes": {"a": {"start": 0.0, "stop": 10.0, "num": 4}}, "fixed": {"b": 2.0}}


@st.composite
def scenes(draw):
    """A good scene with some of its entries replaced, added or removed."""
    scene = {key: dict(value) if isinstance(value, dict) else value for key, value in GOOD.items()}
    for _ in range(draw(st.integers(0, 3))):
        table = draw(st.sampled_from(["axes", "fixed", "options", "points", "top", "remove"]))
        if table == "top":
            key = draw(st.one_of(st.sampled_from(["title", "system", "analysis", "outputs", "axes", "fixed"]), WORDS))
            scene[key] = draw(st.one_of(VALUES, st.lists(WORDS, max_size=3)))
        elif table == "remove":
            scene.pop(draw(st.sampled_from(sorted(scene, key=str)))) if scene else None
        else:
            entries = scene.setdefault(table, {})
            if isinstance(entries, dict):
                name = draw(st.one_of(NAMES, st.sampled_from(["method", "rtol", "knob", "track"])))
                entries[name] = draw(AXES if table == "axes" else VALUES)
    return scene


@pytest.fixture
def folder(tmp_path, monkeypatch):
    inner = tmp_path / "outer" / "inner"
    inner.mkdir(parents=True)
    monkeypatch.chdir(inner)
    return inner


def seen(root):
    return {p.relative_to(root): p.stat().st_size if p.is_file() else None for p in root.rglob("*")}


def call(capsys, *arguments):
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err.splitlines()


def judge(folder, capsys, *arguments):
    """Run one command; it is done, or refused with one line and nothing written outside the output."""
    root, before = folder.parents[1], seen(folder.parents[1])
    code, out, err = call(capsys, *arguments)
    new = {path for path, size in seen(root).items() if before.get(path, "absent") != size}
    if code == 2:
        assert (out, len(err), new) == ("", 1, set()), (err, new)
        assert re.fullmatch(r"drivetrain: .{5,}", err[0])
    else:
        own = (Path("outer/inner/r.nc"), Path("outer/inner/r.nc.parts"))
        assert all(path in own or own[1] in path.parents for path in new), new
    for path in folder.iterdir():
        if path.name.startswith("r.nc"):
            __import__("shutil").rmtree(path) if path.is_dir() else path.unlink()
    return code, err


def many(count):
    return settings(max_examples=count, **FUZZ)


@many(40)
@given(scenes())
@example(
    GOOD | {"axes": {"a": {"start": 0.0, "stop": 10.0, "num": 10**6}, "b": {"start": 1.0, "stop": 2.0, "num": 10**6}}}
)
def test_any_scene_is_run_or_refused(folder, capsys, scene):
    Path("scene.toml").write_text(toml.write(scene), errors="surrogatepass")
    code, _ = judge(folder, capsys, "run", "scene.toml", "--out", "r.nc", "--quiet")
    assert code in (0, 2)


@pytest.mark.full
@many(3000)
@given(scenes())
def test_many_scenes_are_run_or_refused(folder, capsys, scene):
    Path("scene.toml").write_text(toml.write(scene), errors="surrogatepass")
    code, _ = judge(folder, capsys, "run", "scene.toml", "--out", "r.nc", "--quiet")
    assert code in (0, 2)


@many(100)
@given(st.text(max_size=80))
@example("[axes\n")
@example("system = 1979-05-27\nanalysis = 'toy'")
@example("a = 'b'\na = 'c'")
@example("\ufeff")
@example("system = { system = 'toy' }")
@example("system = " + "[" * 2000)
def test_any_text_is_refused(folder, capsys, text):
    Path("scene.toml").write_bytes(text.encode("utf-8", "surrogatepass"))
    assert judge(folder, capsys, "run", "scene.toml", "--out", "r.nc")[0] == 2


@many(150)
@given(
    st.lists(
        st.one_of(
            st.sampled_from(
                ["run", "status", "plot", "point", "verify", "export", "query", "list", "scene.toml", "--out", "r.nc"]
            ),
            st.sampled_from(
                ["--set", "fixed.b=3", "axes.a.num=0", "--json", "--quiet", "--fresh", "--workers", "0", "-1"]
            ),
            st.sampled_from(
                ["--reuse", "--store", "zarr", "--dask", "nowhere", "toy", "a=1", "a=99", "=", "a=", "x.y=1"]
            ),
            st.text(max_size=6).filter(lambda text: "\0" not in text),
        ),
        max_size=7,
    )
)
@example(["run", "scene.toml", "--out", "r.nc", "--set", "axes.a.num=1000000000000"])
@example(["run", "scene.toml", "--out", "", "--quiet"])
@example(["run", "", "--out", "r.nc"])
@example(["plot", "", "--out", ""])
@example(["verify", "."])
@example(["point", "toy", "toy", "a=1", "outputs=../x"])
def test_any_command_is_done_or_refused(folder, capsys, arguments):
    Path("scene.toml").write_text(toml.write(GOOD))
    code, err = judge(folder, capsys, *arguments)
    assert code in (0, 2, 3), err


def test_a_grid_of_many_points_is_refused_with_count_and_limit(folder, capsys):
    axes = {"a": {"start": 0.0, "stop": 10.0, "num": 10**6}, "b": {"start": 1.0, "stop": 2.0, "num": 10**6}}
    Path("scene.toml").write_text(toml.write(GOOD | {"axes": axes, "fixed": {}}))
    code, err = judge(folder, capsys, "run", "scene.toml", "--out", "r.nc")
    assert code == 2 and "1000000000000 points; expected up to 2000000000" in err[0]


def test_axis_larger_than_memory_is_refused_before_it_is_made(folder, capsys, monkeypatch):
    monkeypatch.setattr("drivetrain_jax.runs.axes.physical_memory", lambda: 1e9)
    Path("scene.toml").write_text(toml.write(GOOD | {"axes": {"a": {"start": 0.0, "stop": 10.0, "num": 10**9}}}))
    code, err = judge(folder, capsys, "run", "scene.toml", "--out", "r.nc")
    assert code == 2
    assert "axes.a.num = 1000000000: expected up to 31250000 with this memory" in err[0]


def test_an_output_that_points_elsewhere_is_only_that(folder, capsys):
    """The place of the result is the command line's; nothing in a scene moves it."""
    Path("scene.toml").write_text(toml.write(GOOD | {"title": "../../title"}))
    assert call(capsys, "run", "scene.toml", "--out", "../r.nc", "--quiet")[0] == 0
    assert sorted(os.listdir("..")) == ["inner", "r.nc"]


@pytest.mark.full
def test_nothing_is_executed_or_unpickled():
    """No module calls what would run text or bytes that it has read; compiled code comes from a cache of the user's own."""
    for path in Path(drivetrain_jax.__file__).parent.rglob("*.py"):
        if path.name == "_programs.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            name = (
                getattr(node, "id", getattr(node, "attr", None))
                if isinstance(node, (ast.Name, ast.Attribute))
                else None
            )
            imported = [alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
            assert not {"pickle", "dill", "cloudpickle", "marshal", "shelve"} & {name, *imported}, path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec", "compile", "__import__"), path
