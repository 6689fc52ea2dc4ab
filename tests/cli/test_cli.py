"""The command line: exit codes, exactly one line for wrong input, nothing written by it."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest
import xarray as xr

from drivetrain_jax import ChunkError, InputError, __version__
from drivetrain_jax.cli import _number_or_range, _reading, main, quiet_hdf5
from drivetrain_jax.runs.run import Progress, ProgressLine
from drivetrain_jax.systems import get_system
from tests.sizes import full_after

SCENE = """
system = "toy"
analysis = "toy"
[axes]
a = { start = 0.0, stop = 10.0, num = 21 }
[fixed]
b = 2.0
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def cli(folder, capsys):
    """Runs a command; gives exit code, standard output and lines of standard error."""

    def call(*arguments):
        try:
            code = main(arguments)
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out, err.splitlines()

    return call


def test_run_status_run_again(cli):
    assert json.loads(cli("status", "scene.toml", "--out", "r.nc", "--json")[1]) == {
        "total": 21,
        "done": 0,
        "failed": 0,
        "state": "absent",
    }
    code, out, err = cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    assert (code, out, err) == (0, "", ["points: total=21 computed=21 reused=0 failed=2"])
    code, _, err = cli("run", "scene.toml", "--out", "r.nc")
    assert (code, err) == (0, ["points: total=21 computed=0 reused=21 failed=2"])
    found = json.loads(cli("status", "scene.toml", "--out", "r.nc", "--json")[1])
    counts = {"total": 21, "done": 21, "failed": 2, "state": "complete"}
    assert found == counts | {"failed_by_outcome": {"not_finite": 2}}
    text = "complete: 21 of 21 points done, 2 without a value\n  not_finite: 2\n"
    assert cli("status", "scene.toml", "--out", "r.nc")[1] == text
    assert sorted(os.listdir()) == ["r.nc", "scene.toml"]


@pytest.mark.parametrize(("store", "out"), [("hdf5", "r.nc"), ("zarr", "r.zarr")])
def test_values_that_miss_their_target_are_counted(cli, store, out):
    Path("scene.toml").write_text(SCENE.replace('analysis = "toy"', 'analysis = "loose"'))
    tolerance = "" if store == "zarr" else " 1e-10"
    remark = f"drivetrain: 2 of 21 values miss the tolerance{tolerance}; outcome = 1 marks them"
    code, _, err = cli("run", "scene.toml", "--out", out, "--store", store)
    assert (code, err[-2:]) == (0, [remark, "points: total=21 computed=21 reused=0 failed=2"])
    assert any("21/21 points" in line and "2 failed, 2 inaccurate" in line for line in err[:-2])
    again = cli("run", "scene.toml", "--out", out, "--store", store)
    assert again[2] == [remark, "points: total=21 computed=0 reused=21 failed=2"]
    assert cli("run", "scene.toml", "--out", out, "--store", store, "--quiet")[2] == again[2][1:]
    found = json.loads(cli("status", "scene.toml", "--out", out, "--json")[1])
    assert (found["failed"], found["inaccurate"]) == (2, 2)
    text = cli("status", "scene.toml", "--out", out)[1]
    assert text.endswith("2 without a value\n  not_finite: 2\n  tolerance_not_met: 2, with a value\n")


@pytest.mark.full
def test_the_worst_value_that_misses_its_tolerance_is_shown(cli):
    """Two multipliers nearly coincide at this point, which limits the accuracy of both."""
    fixed = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    axes = "[axes]\nbeta = { values = [0.0, 0.59] }\nOmega = { values = [0.674, 1.25] }\n[fixed]\n"
    head = 'system = "cardan"\nanalysis = "floquet"\n'
    Path("shaft.toml").write_text(
        head + axes + "".join(f"{name} = {value}\n" for name, value in fixed.items()) + "[options]\nrtol = 2e-13\n"
    )
    remark = cli("run", "shaft.toml", "--out", "r.nc")[2][-2]
    worst = xr.load_dataset("r.nc", engine="h5netcdf").spectral_radius_error.sel(beta=0.59, Omega=0.674)
    assert remark == (
        f"drivetrain: 1 of 4 values misses the tolerance 2e-13 (largest error bound {worst.item():.1e}, at beta = 0.59, "
        "Omega = 0.674); the verdicts are decided; outcome = 1 marks it"
    )


def test_progress_then_the_last_line(cli):
    code, out, err = cli("run", "scene.toml", "--out", "r.nc")
    assert code == 0 and out == "" and err[-1] == "points: total=21 computed=21 reused=0 failed=2"
    assert any("21/21 points" in line and "/s" in line for line in err[:-1])


def test_what_counts_do_not_tell_is_a_line_before_them(cli, monkeypatch):
    noted = Progress(3, computed=3, note="the atlas has gaps")
    monkeypatch.setattr("drivetrain_jax.runs.run.run_to_file", lambda *_, **__: noted)
    counts = "points: total=3 computed=3 reused=0 failed=0"
    assert cli("run", "scene.toml", "--out", "r.nc")[2][-2:] == ["drivetrain: the atlas has gaps", counts]
    assert cli("run", "scene.toml", "--out", "r.nc", "--quiet")[2] == [counts]


def test_points_that_cost_nothing_are_counted(capsys):
    """The points of an atlas have no cost in the plan."""
    with ProgressLine() as report:
        report(Progress(total=21, computed=21))
    assert "21/21 points" in capsys.readouterr().err


def test_no_bar_beside_the_line_of_wrong_input(capsys):
    """A scheduler that does not answer is found out after the first report."""
    with pytest.raises(InputError), ProgressLine() as report:
        report(Progress(total=21))
        raise InputError("dask = 'tcp://nowhere:1': no scheduler answers there")
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_what_is_worked_on(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with _reading(Path("atlas.nc")):
        print("the answer")
    found = capsys.readouterr()
    assert found.out == "the answer\n" and "atlas.nc" in found.err
    assert "\x1b[?25l" not in found.err, "a hidden cursor would stay so after Ctrl-C"
    with _reading(Path("atlas.nc"), Path("b.nc"), Path("c.nc")):
        pass
    assert "atlas.nc and 2 more" in capsys.readouterr().err
    monkeypatch.setenv("TERM", "dumb")
    with _reading(Path("atlas.nc")):
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    with _reading(Path("atlas.nc")):
        assert capsys.readouterr().err == ""


def test_set_replaces_entries(cli):
    settings = [
        "--set",
        "fixed.b=4",
        "--set",
        "axes.a.num=3",
        "--set",
        "options.method=other",
        "--set",
        "fixed.kind=fancy",
    ]
    assert cli("run", "scene.toml", "--out", "r.nc", *settings)[0] == 0
    with xr.open_dataset("r.nc", engine="h5netcdf") as ds:
        assert ds.sizes["a"] == 3 and ds.attrs["method"] == "other" and float(ds["value"][0]) == 333.5
    assert json.loads(cli("status", "scene.toml", "--out", "r.nc", *settings, "--json")[1])["state"] == "complete"
    assert cli("status", "scene.toml", "--out", "r.nc")[1].startswith("stale")


def test_other_scene_needs_fresh(cli):
    assert cli("run", "scene.toml", "--out", "r.nc", "--quiet")[0] == 0
    before = open("r.nc", "rb").read()
    code, _, err = cli("run", "scene.toml", "--out", "r.nc", "--set", "fixed.b=3")
    assert code == 2 and len(err) == 1 and "--fresh" in err[0] and open("r.nc", "rb").read() == before
    assert cli("run", "scene.toml", "--out", "r.nc", "--set", "fixed.b=3", "--fresh", "--quiet")[0] == 0
    assert open("r.nc", "rb").read() != before


def test_status_tells_why_a_run_would_be_refused(cli):
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    code, out, _ = cli("status", "scene.toml", "--out", "r.nc", "--set", "fixed.b=3", "--set", "axes.a.num=5")
    assert code == 0 and out.startswith("stale: 0 of 5 points done, 0 without a value\n  a run would stop: ")
    assert "fixed.b is 3.0, was 2.0; axes.a is 5 values from 0 to 10, was 21 values" in out
    answer = json.loads(cli("status", "scene.toml", "--out", "r.nc", "--set", "fixed.b=3", "--json")[1])
    assert (
        answer["state"] == "stale" and "fixed.b is 3.0, was 2.0" in answer["reason"] and "--fresh" in answer["reason"]
    )


def test_a_larger_scene_takes_over_the_smaller_result(cli):
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    larger = ("scene.toml", "--out", "r.nc", "--set", "axes.a.num=41")
    found = json.loads(cli("status", *larger, "--json")[1])
    assert (found["state"], found["done"]) == ("partial", 21)
    assert cli("run", *larger, "--quiet")[2] == ["points: total=41 computed=20 reused=21 failed=4"]
    other = ("scene.toml", "--out", "other.nc", "--set", "axes.a.num=11", "--reuse", "r.nc", "--quiet")
    assert cli("run", *other)[2] == ["points: total=11 computed=0 reused=11 failed=1"]
    code, _, err = cli("run", "scene.toml", "--out", "new.nc", "--reuse", "nothing.nc")
    assert (code, len(err)) == (2, 1) and "reuse = 'nothing.nc': does not exist" in err[0]


def test_verify(cli):
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    code, out, err = cli("verify", "r.nc")
    assert (code, err) == (0, []) and out.startswith("checksums: all agree\noutcome is one of its 6 codes: holds at 21")
    with h5py.File("r.nc", "r+") as file:
        file["value"][3] = 1.0
    code, _, err = cli("verify", "r.nc", "--json")
    assert (code, len(err)) == (2, 1) and "value: damaged" in err[0]
    answer = json.loads(cli("verify", "r.nc", "--json")[1])
    assert answer["state"] == "damaged" and answer["checks"] == ["checksums: 1 differ: value"]
    open("r.nc", "r+").truncate(100)
    code, _, err = cli("verify", "r.nc")
    assert (code, len(err)) == (2, 1) and "not a readable" in err[0]
    cli("run", "scene.toml", "--out", "u.nc", "--set", "analysis=broken", "--quiet")
    assert cli("verify", "u.nc") == (3, "unfinished: 0 of 0 finished blocks are intact\n", [])
    code, _, err = cli("verify", "nothing.nc")
    assert (code, len(err)) == (2, 1) and "does not exist" in err[0]


def change(old, new):
    return lambda: open("scene.toml", "w").write(SCENE.replace(old, new))


WRONG_RUNS = {
    "unknown key": (change("[fixed]", "colour = 1\n[fixed]"), [], "axes.colour"),
    "unknown table": (change("[fixed]", "[fixd]"), [], "fixd"),
    "missing key": (change('system = "toy"', ""), [], "missing required field `system`"),
    "missing parameter": (change("[axes]\na = { start = 0.0, stop = 10.0, num = 21 }", ""), [], "fixed.a: missing"),
    "unknown parameter": (change("b = 2.0", "bb = 2.0"), [], "fixed.bb"),
    "wrong type": (change("b = 2.0", 'b = "two"'), [], "b = 'two'"),
    "out of range": (change("b = 2.0", "b = -2.0"), [], "b = -2.0"),
    "axis end out of range": (change("stop = 10.0", "stop = 11"), [], "axes.a = 11"),
    "not a number": (change("b = 2.0", "b = nan"), [], "b = nan"),
    "empty axis": (change("{ start = 0.0, stop = 10.0, num = 21 }", "{ values = [] }"), [], "empty axis"),
    "num = 0": (change("num = 21", "num = 0"), [], "num = 0"),
    "too many points": (change("num = 21", "num = 3000000000"), [], "3000000000 points"),
    "axis and fixed": (change("b = 2.0", "b = 2.0\na = 1.0"), [], "also in [axes]"),
    "malformed file": (change("[fixed]", "[fixed"), [], "not valid TOML"),
    "absent file": (lambda: os.remove("scene.toml"), [], "No such file"),
    "scene is a folder": (lambda: (os.remove("scene.toml"), os.mkdir("scene.toml")), [], "scene"),
    "unknown system": (change('"toy"\nanalysis', '"tractor"\nanalysis'), [], "tractor"),
    "unknown option": (change("[fixed]", "[options]\nspeed = 1\n[fixed]"), [], "options.speed"),
    "unreadable result": (lambda: open("r.nc", "w").write("rubbish"), [], "not a readable"),
    "unreadable result, fresh": (lambda: open("r.nc", "w").write("rubbish"), ["--fresh"], "not a readable"),
    "foreign result": (
        lambda: xr.Dataset({"x": 1.0}).to_netcdf("r.nc", engine="h5netcdf"),
        ["--fresh"],
        "not a result of",
    ),
    "result is the scene": (None, ["--out", "scene.toml", "--fresh"], "out = 'scene.toml': a result is netCDF or Zarr"),
    "name too long": (None, ["--out", "r" * 300], "rrrr: File name too long"),
    "name of the parts too long": (None, ["--out", "r" * 252], "(with '.parts')"),
    "no folder can be made": (None, ["--out", "/proc/r.nc"], "a path in a writable folder"),
    "reuse of a foreign file": (
        lambda: xr.Dataset({"x": 1.0}).to_netcdf("x.nc", engine="h5netcdf"),
        ["--reuse", "x.nc"],
        "reuse = 'x.nc': not a result of",
    ),
    "result is a folder": (lambda: os.mkdir("r.nc"), [], "is a folder"),
    "parts are a file": (lambda: open("r.nc.parts", "w").close(), [], "r.nc.parts"),
    "folder missing": (None, ["--out", "nowhere/r.nc"], "does not exist"),
    "set without value": (None, ["--set", "fixed.b"], "name=value"),
    "set twice": (None, ["--set", "fixed.b=1", "--set", "fixed.b=2"], "twice"),
    "set an unknown key": (None, ["--set", "fixed.zeta=1"], "fixed.zeta"),
    "set into a value": (None, ["--set", "system.b=1"], "not a table"),
    "no workers": (None, ["--workers", "0"], "workers = 0"),
    "workers of the wrong type": (None, ["--workers", "two"], "--workers"),
    "unknown flag": (None, ["--fast"], "--fast"),
}


def snapshot(folder):
    return {p.relative_to(folder): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.mark.parametrize("case", WRONG_RUNS)
def test_wrong_run_is_one_line_and_writes_nothing(cli, folder, case):
    prepare, extra, part = WRONG_RUNS[case]
    if prepare:
        prepare()
    before = snapshot(folder)
    code, out, err = cli("run", "scene.toml", "--out", "r.nc", *extra)
    assert (code, out, len(err)) == (2, "", 1), err
    assert err[0].startswith("drivetrain: ") and part in err[0]
    assert snapshot(folder) == before


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((), "COMMAND"),
        (("status", "scene.toml", "--out", "r.nc", "more"), "unrecognized arguments: more"),
        (("run", "scene.toml", "--out", "r.nc", "--set", "b=3"), "did you mean fixed.b?"),
        (("run", "scene.toml", "--out", "r.nc", "--set", "a.num=3"), "did you mean axes.a.num?"),
        (("run", "scene.toml", "--out", "r.nc", "--dask", "nowhere"), "tcp://HOST:PORT"),
        (("run", "scene.toml", "--out", "r.nc", "--set", "system=cardna"), "(did you mean cardan?)"),
        (
            ("point", "cardan", "floquet"),
            "beta: missing; expected -1.570796327 < beta < 1.570796327, in rad (missing too",
        ),
        (("point", "cardan", "floqet"), "analysis = 'floqet': unknown to cardan (did you mean floquet?)"),
        (("run",), "the following arguments are required: SCENE.toml, --out; see drivetrain run --help"),
        (("verify", "."), "is a folder"),
        (("design", "widest-angle", "r.nc", "--margin", "0.1"), "--margin = 0.1: not used by widest-angle"),
        (("run", "scene.toml"), "--out"),
        (("status", "nothing.toml", "--out", "r.nc"), "No such file"),
        (("list", "tractor"), "tractor"),
        (("point", "toy", "toy", "a"), "name=value"),
        (("point", "toy", "toy", "a=11"), "a = 11"),
        (("point", "toy", "toy", "a=1", "outputs=nothing"), "nothing"),
        (("point", "toy", "toy", "a=1", "outputs=5"), "outputs = 5: expected `array"),
        (("point", "toy", "toy", "a=1", "outputs=true"), "outputs = True: expected `array"),
        (("point", "toy", "toy", "a=1", "system=toy"), "system = 'toy': given twice"),
        (("point", "toy", "toy", "a=1", "analysis=toy"), "analysis = 'toy': given twice"),
        (
            ("point", "toy", "toy", "a=1", "amplitude=2"),
            "amplitude = 2: not a parameter; did you mean the option --ampl",
        ),
        (("point", "toy", "toy", "a=1", "sensitivities=true"), "did you mean the option --sensitivities?"),
        (
            ("plot", "r.nc", "--out", "t.csv"),
            "expected a name that ends in .png, .pdf, .svg; a table is written by `drivet",
        ),
        (("point", "toy", "toy", "a=" + "9" * 5000), "a = inf: expected 0 <= a <= 10"),
        (("plot", "nothing.nc", "--out", "f.png"), "does not exist"),
        (("plot", "scene.toml", "--out", "f.png"), "not a readable"),
        (("plot", "scene.toml", "--out", "nowhere/f.png"), "folder"),
        (("plot", "scene.toml", "--out", "f.xyz"), "expected a name that ends in ."),
        (("plot", ".", "--out", "f.png"), "'.': is a folder; give a result"),
        (("query", "r.nc", "a=true"), "a = True: expected a number or LOW:HIGH"),
        (("plot", "r" * 300, "--out", "f.png"), "rrrr: File name too long"),
    ],
)
def test_wrong_command_is_one_line(cli, folder, arguments, part):
    before = snapshot(folder)
    code, out, err = cli(*arguments)
    assert (code, out, len(err)) == (2, "", 1) and part in err[0]
    assert snapshot(folder) == before


# What another program made of a chart, its new attributes, and what the answer says.
CHANGED = {
    "of another program": (lambda _: xr.Dataset({"x": 1.0}), {}, "not a result of drivetrain_jax"),
    "without variables": (lambda ds: ds.drop_vars(list(ds)), {"analysis": "parameters"}, "damaged (a"),
    "without cells": (lambda ds: ds.isel(a=slice(0, 0)), {"analysis": "parameters"}, "damaged (a"),
    "attributes rubbish": (
        lambda ds: ds,
        {"analysis": "parameters", "fixed_parameters": "rubbish"},
        "damaged (attributes of the file",
    ),
    "no atlas": (lambda ds: ds, {"analysis": "atlas"}, "damaged (attributes of the file"),
}


@pytest.mark.parametrize("case", CHANGED)
def test_a_changed_file_is_one_line(cli, folder, case):
    change, attrs, part = CHANGED[case]
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    chart = xr.load_dataset("r.nc", engine="h5netcdf")
    change(chart).assign_attrs(attrs).to_netcdf("changed.nc", engine="h5netcdf")
    before = snapshot(folder)
    code, out, err = cli("plot", "changed.nc", "--out", "f.png")
    assert (code, out, len(err)) == (2, "", 1) and part in err[0]
    assert snapshot(folder) == before


def test_failing_chunk_is_incomplete_and_resumable(cli):
    code, out, err = cli("run", "scene.toml", "--out", "r.nc", "--set", "analysis=broken", "--quiet")
    assert (code, out, len(err)) == (3, "", 2)
    assert err[0].endswith("broken: RuntimeError: no luck today")
    assert err[1] == "points: total=21 computed=0 reused=0 failed=0"
    assert os.path.isdir("r.nc.parts") and not os.path.exists("r.nc")


def test_a_computation_that_fails_is_one_line(cli):
    line = ["drivetrain: broken: RuntimeError: no luck today"]
    assert cli("point", "toy", "broken", "a=1") == (3, "", line)


@pytest.mark.parametrize("words", [("query", "a.nc", "a=1"), ("design", "widest-angle", "a.nc", "a=1:2")])
def test_a_direct_solve_of_an_atlas_that_fails_is_one_line(cli, monkeypatch, words):
    def fails(_):
        raise ChunkError("chunk 3 (direct): MemoryError: ")

    monkeypatch.setattr("drivetrain_jax.runs.atlas_file.open_atlas", fails)
    assert cli(*words) == (3, "", ["drivetrain: chunk 3 (direct): MemoryError:"])


def test_parts_that_cannot_be_read_are_wrong_input(cli, monkeypatch):
    os.mkdir("r.nc.parts")
    monkeypatch.setattr("drivetrain_jax.runs.output.os.access", lambda path, mode: Path(path).suffix != ".parts")
    code, _, err = cli("run", "scene.toml", "--out", "r.nc")
    assert (code, len(err)) == (2, 1) and "'r.nc.parts' is no readable folder; move it away" in err[0]


def test_parts_that_cannot_be_written_are_wrong_input(cli, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("drivetrain_jax.store.parts.FileLock.acquire", refuse)
    code, _, err = cli("run", "scene.toml", "--out", "r.nc")
    assert (code, len(err)) == (2, 1) and "r.nc.parts': not writable; move it away" in err[0]


def test_an_interrupt_while_all_is_loaded_counts_nothing(cli, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("drivetrain_jax.runs.run.load_scene", interrupted)
    monkeypatch.setattr("drivetrain_jax.cli.os._exit", sys.exit)
    counts = "points: total=0 computed=0 reused=0 failed=0"
    line = "drivetrain: interrupted; the same command resumes"
    assert cli("run", "scene.toml", "--out", "r.nc") == (130, "", [line, counts])
    assert cli("run", "scene.toml", "--out", "r.nc", "--workers", "1") == (130, "", [line, counts])


def test_values_may_stand_behind_options(cli):
    before, between = (
        cli("point", "toy", "toy", *words) for words in (("a=.5", "b=1", "--json"), ("a=.5", "--json", "b=1"))
    )
    assert between == before and before[0] == 0
    assert cli("point", "toy", "toy", "--json", "a=.5", "b=1", "c")[0] == 2


def test_point(cli):
    code, out, _ = cli("point", "toy", "toy", "a=.5", "b=1", "outputs=value,sign", "rtol=1e-9")
    assert code == 0 and "value   = 324.5 m" in out and "sign    = small (0)" in out
    code, out, _ = cli("point", "toy", "toy", "a=0.5", "kind=fancy", "length=[1, 1]", "method=other", "--json")
    answer = json.loads(out)
    assert code == 0 and answer["values"]["value"] == {"value": 18.0, "units": "m"} and answer["method"] == "other"


def test_a_run_that_is_refused_on_the_way_leaves_nothing(cli, monkeypatch):
    def nobody(*_):
        raise InputError("dask = 'tcp://nowhere:1': no scheduler answers there")

    monkeypatch.setattr("drivetrain_jax.runs.work.Threads.run", nobody)
    code, _, err = cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    assert (code, len(err)) == (2, 1) and "no scheduler" in err[0] and os.listdir() == ["scene.toml"]


def test_list(cli):
    code, out, _ = cli("list")
    assert code == 0 and "cardan" in out and "floquet" in out
    code, out, _ = cli("list", "cardan")
    assert code == 0
    for part in ("beta", "rad", "joint angle", "required", "0 <= zeta", "spectral_radius", "rtol", "default 1e-10"):
        assert part in out


def test_sets_of_values_can_be_copied_into_a_scene(cli):
    lines = cli("list", "bicardan")[1].splitlines()
    given = next(line for line in lines if line.startswith("  paper  ")).split(maxsplit=1)[1]
    wanted = get_system("bicardan").presets["paper"]
    assert tomllib.loads(f"set = {{ {given} }}")["set"] == {k: _listed(v) for k, v in wanted.items()}


def _listed(value):
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.full
def test_titles_that_an_output_cannot_write_are_escaped(folder):
    (folder / "sweeps").mkdir()
    (folder / "sweeps" / "one.toml").write_text('title = "Gelenk für β"\nsystem = "cardan"', "utf-8")
    command, ascii_only = (
        [sys.executable, "-m", "drivetrain_jax.cli", "list"],
        os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    done = subprocess.run(command, env=ascii_only, capture_output=True, text=True, check=True)
    assert r"sweeps/one.toml  Gelenk f\xfcr \u03b2" in done.stdout and done.stderr == ""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """A function that installs a package of modules and entry points by group."""

    def install(modules, **entries):
        info = tmp_path / "site" / "other-1.dist-info"
        info.mkdir(parents=True)
        for name, code in modules.items():
            (info.parent / f"{name}.py").write_text(code)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
        groups = [f"[drivetrain_jax.{group}]\n" + "\n".join(lines) for group, lines in entries.items()]
        (info / "entry_points.txt").write_text("\n".join(groups) + "\n")
        monkeypatch.syspath_prepend(str(info.parent))

    yield install
    for name in [n for n, m in sys.modules.items() if str(tmp_path) in str(getattr(m, "__file__", ""))]:
        del sys.modules[name]


def test_a_package_that_fails_spoils_no_other_system(cli, install):
    code = "from drivetrain_jax.systems.cardan import Cardan\n"
    entries = ["broken = broken_shafts:Cardan", "renamed = renamed_shafts:Cardan"]
    install({"broken_shafts": f"{code}1 / 0\n", "renamed_shafts": code}, systems=entries)
    code, out, _ = cli("list")
    fails = "broken_shafts:Cardan cannot be loaded: ZeroDivisionError: division by zero"
    assert code == 0 and "cardan     Cardan" in out and f"broken     {fails}" in out
    assert "renamed    renamed_shafts:Cardan is named cardan, not renamed" in out
    code, _, err = cli("list", "broken")
    assert (code, err) == (2, [f"drivetrain: system = 'broken': {fails}"])


def test_an_analysis_that_fails_spoils_no_other_one(cli, install):
    copies = (
        "from dataclasses import replace\nfrom drivetrain_jax.analysis import get_analysis\n"
        "NAMED = get_analysis('modes')\nUSER = replace(NAMED, name='user', uses='floqet')\n"
        "from drivetrain_jax.systems import System, serves\n"
        "class Own(System):\n    name = title = 'own'\n    @serves('modos', 'unsound')\n    def model(self): pass\n"
    )
    entries = ["unsound = unsound_analysis:ANALYSIS", "named = copies:NAMED", "user = copies:USER"]
    modules = {"unsound_analysis": "1 / 0\n", "copies": copies}
    install(modules, analyses=entries, systems=["own = copies:Own"])
    fails = "unsound_analysis:ANALYSIS cannot be loaded: ZeroDivisionError: division by zero"
    listed, system, own = cli("list")[1], cli("list", "cardan")[1], cli("list", "own")[1]
    for line in (
        "  named    copies:NAMED is named modes, not named\n",
        f"  unsound  {fails}\n",
        "  user     uses = 'floqet': no analysis (did you mean floquet?); expected floquet, ",
    ):
        assert line in listed and line in system and line in own
    assert "Analysis floquet" in system and "own; analyses: modos: unknown (did you mean modes?), unsound" in listed
    assert "Analysis modos: unknown (did you mean modes?); expected" in own and f"Analysis unsound: {fails}" in own
    code, _, err = cli("point", "cardan", "unsound", "beta=0.1")
    assert (code, err) == (2, [f"drivetrain: analysis = 'unsound': {fails}"])


_RULES = "from drivetrain_jax.invariants import Declared, Rule\n"


@pytest.mark.parametrize(
    ("group", "code", "wanted"),
    [
        ("figures", "def X(ds): pass", "figure bad:X returned NoneType; expected a matplotlib Figure"),
        ("figures", "def X(ds): ds['q']", "figure bad:X raised KeyError: "),
        ("rules", f"{_RULES}X = Declared((Rule('q > 0', (), lambda ds: ds['q']),))", "rule 'q > 0' of bad:X raised Key"),
        ("rules", f"{_RULES}X = Declared((Rule('r', (), lambda ds: 1),))", "rule 'r' of bad:X returned int; expected "),
        ("rules", f"{_RULES}X = Declared((Rule('r', 'q', len),))", "variables = 'q': expected a tuple of names, ('q',)"),
        ("rules", f"{_RULES}X = Declared(Rule('r', (), len))", "bad:X cannot be loaded: TypeError: rules: got Rule"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("foreign", full_after(1, [False, True]))
def test_a_figure_or_rule_that_fails_is_named(cli, install, group, code, wanted, foreign):
    install({"bad": code}, **{group: ["toy = bad:X"]})
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    if foreign:
        os.utime("r.nc")
    command = ("plot", "r.nc", "--out", "f.png") if group == "figures" else ("verify", "r.nc")
    code, _, err = cli(*command)
    assert (code, len(err)) == (2, 1) and wanted in err[0]


def test_list_shows_the_scenes_of_this_folder(cli, folder):
    (folder / "sweeps").mkdir()
    (folder / "sweeps" / "one.toml").write_text('title = "Hello"\nsystem = "cardan"')
    (folder / "sweeps" / "two.toml").write_text('title = "Other"\nsystem = "toy"')
    (folder / "sweeps" / "deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    assert "sweeps/one.toml  Hello" in cli("list", "cardan")[1] and "Other" not in cli("list", "cardan")[1]
    assert "Other" in cli("list")[1]


def test_plot_writes_the_figure(cli, monkeypatch):
    from matplotlib.figure import Figure

    monkeypatch.setattr("drivetrain_jax.view.plot", lambda *datasets: Figure())
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    assert cli("plot", "r.nc", "--out", "f.png")[0] == 0 and open("f.png", "rb").read(4) == b"\x89PNG"
    assert cli("plot", "r.nc", "r.nc", "--out", "two.png")[0] == 0
    os.symlink("two.png", "link.png")
    os.truncate("two.png", 0)
    assert cli("plot", "r.nc", "--out", "link.png")[0] == 0
    assert os.path.islink("link.png") and os.path.getsize("two.png")

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("drivetrain_jax.store.files.os.fsync", full)
        code, _, err = cli("plot", "r.nc", "--out", "g.png")
    assert (code, len(err)) == (2, 1) and "No space left" in err[0] and not [n for n in os.listdir() if n[0] == "g"]
    code, _, err = cli("plot", "r.nc", "--out", "f.png", "--cells", "9")
    assert code == 2 and len(err) == 1 and "cells = 9" in err[0]
    code, _, err = cli("plot", "r.nc", "--out", "f.txt")
    assert code == 2 and len(err) == 1 and ".png" in err[0]


def test_several_atlases_are_refused_before_one_is_evaluated(cli, monkeypatch):
    cli("run", "scene.toml", "--out", "r.nc", "--quiet")
    xr.load_dataset("r.nc", engine="h5netcdf").assign_attrs(analysis="atlas").to_netcdf("a.nc", engine="h5netcdf")
    monkeypatch.setattr("drivetrain_jax.runs.atlas_chart.chart", lambda *_: 1 / 0)
    line = "drivetrain: results: an atlas among several; expected an atlas alone, or a chart and its atlas"
    assert cli("plot", "r.nc", "a.nc", "--out", "f.png") == (2, "", [line])


def test_version_and_help(cli):
    assert cli("--version")[1].strip() == __version__
    code, out, _ = cli("--help")
    assert code == 0 and all(name in out for name in ("list", "run", "status", "verify", "plot", "point"))


def test_h5py_is_quiet_about_objects_after_a_failed_write(monkeypatch):
    told = []
    monkeypatch.setattr(sys, "excepthook", lambda _, error, __: told.append(str(error)))
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: told.append(str(unraisable.exc_value)))
    quiet_hdf5()
    for text in ("Can't decrement id ref count (file write failed)", "another error"):
        sys.excepthook(RuntimeError, RuntimeError(text), None)
        sys.unraisablehook(SimpleNamespace(exc_value=RuntimeError(text)))
    assert told == ["another error", "another error"]


def test_help_is_light():
    """Nothing heavy is loaded; a measured time would depend on the load of the machine."""
    code = (
        "import sys, drivetrain_jax.cli as c\ntry:\n    c.main(['--help'])\nexcept SystemExit:\n    print(*sys.modules)"
    )
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "drivetrain_jax.cli" in loaded
    assert not {"jax", "numpy", "scipy", "xarray", "h5py", "matplotlib", "msgspec"} & set(loaded)


def test_a_call_from_python_leaves_its_garbage_collector_alone(cli):
    """Only a process that is a command, and ends with it, does without."""
    before = gc.get_threshold(), gc.get_freeze_count()
    assert cli("list")[0] == 0 and (gc.get_threshold(), gc.get_freeze_count()) == before


@pytest.mark.full
def test_looking_at_a_result_loads_no_integrator_and_no_tables(folder):
    """These packages would take half of the time until a finished result is recognised."""
    scene = Path(__file__).parents[2] / "sweeps" / "quickstart.toml"
    code = (
        "import sys, drivetrain_jax.runs.run as run; from drivetrain_jax.cli import main\n"
        f"assert main(['status', {str(scene)!r}, '--out', 'r.nc']) == 0\nprint(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "drivetrain_jax.systems.cardan" in done.stdout
    assert not {"xarray", "pandas", "scipy.integrate", "diffrax", "matplotlib"} & set(done.stdout.split())


@pytest.mark.full
def test_a_command_does_not_load_an_installed_dask_for_its_arrays(folder):
    """xarray would, to recognise them."""
    import dask.array  # noqa: F401  # pyright: ignore[reportUnusedImport]

    code = "import sys; from drivetrain_jax.cli import main\nmain(); import xarray; xarray.Variable('x', [1.0])\n"
    code += "print([n for n in sys.modules if n.startswith('dask.array.')])"
    done = subprocess.run([sys.executable, "-c", code, "list"], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.full
@pytest.mark.parametrize("scene", ["quickstart.toml", "cardan_atlas.toml"])
def test_a_run_writes_its_file_without_tables(folder, scene):
    """A third of the time of a short run would go into loading these packages."""
    path = Path(__file__).parents[2] / "sweeps" / scene
    small = ["axes.beta.stop=0.2", "axes.Omega.start=1.0", "axes.Omega.stop=1.2"]
    small += ["axes.beta.num=2", "axes.Omega.num=3"] if scene == "quickstart.toml" else []
    given = ["run", str(path), "--out", "r.nc", "--quiet", *(word for entry in small for word in ("--set", entry))]
    code = f"import sys; from drivetrain_jax.cli import main\nassert main({given!r}) == 0\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "h5py" in done.stdout.split() and Path("r.nc").is_file()
    assert not {"xarray", "pandas", "dask", "distributed", "h5netcdf", "matplotlib"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("where", "code", "said"),
    full_after(
        1, [(">/dev/full", 2, "drivetrain: standard output: No space left on device\n"), (">&-", 0, "")], several=True
    ),
)
def test_an_output_that_takes_nothing(where, code, said):
    command = f"{sys.executable} -m drivetrain_jax.cli list {where}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, said)


@pytest.mark.full
def test_a_reader_that_leaves_is_no_error():
    command = f"{sys.executable} -m drivetrain_jax.cli list cardan | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert done.stderr == ""


@pytest.mark.parametrize("text", ["1500rpm:2000", "1500:2000rpm", "1500rpm:2000rpm"])
def test_a_range_has_one_unit(text):
    assert _number_or_range("speed", text) == ("1500.0 rpm", "2000.0 rpm")
