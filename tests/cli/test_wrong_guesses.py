"""Mistakes that people type: each is answered in one line that helps, with exit code 2, and nothing is written."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from decimal import Decimal
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import drivetrain_jax as dt
from drivetrain_jax import _units
from drivetrain_jax.cli import main, parser

SCENE = """
system = "cardan"
analysis = "floquet"
[axes]
beta = { start = 0.1, stop = 0.3, num = 3 }
Omega = { start = 1.0, stop = 1.4, num = 3 }
[fixed]
zeta = 0.001
alpha = 1.0
mu = 1.0
gamma = 100.0
"""
POINT = "point cardan floquet beta=0.3 Omega=1.4 zeta=0.001 alpha=1 mu=1 gamma=100"
TRUCK = "point cardan floquet J1=2 J2=0.5 k1=6e4 k2=4e4 c1=0.3 c2=0.1 speed=1425 angle=12"
RATTLE = "point rattle steady_state omega=0.7 B0=0.05 B1=0.03 b=0.17 c=0.05 alpha=0.25 k=1 I=1"
SHAFT = "point bicardan critical_speeds length=[0.3,0.3] EI=[1e4,1e4] rhoA=[15,15] k_A=1e6 k_D=1e6"
RUN = "run scene.toml --out r.nc"

GUESSES = [
    # Commands and options, in argparse's words.
    ("runn scene.toml --out r.nc", "invalid choice: 'runn' (choose from 'list', 'run'"),
    ("run scene.toml --output r.nc", "arguments are required: --out"),
    ("run --out r.nc", "arguments are required: SCENE.toml"),
    (f"{RUN} --thread 2", "unrecognized arguments: --thread 2"),
    (f"{RUN} zeta=0.1", "unrecognized arguments: zeta=0.1"),
    (f"{RUN} --set", "--set: expected one argument"),
    (f"{RUN} --threads two", "--threads: invalid int value: 'two'"),
    (f"{RUN} --store hdf", "--store: invalid choice: 'hdf'"),
    ("design least_damping r.nc Omega=1:2", "invalid choice: 'least_damping'"),
    ("design speed-windows r.nc --margin much", "--margin: invalid number value: 'much'"),
    (f"{POINT} --amplitude -2deg", "--amplitude: expected one argument"),
    (f"{RUN} --threads 0", "threads = 0"),
    ("run scene.toml --out q.csv", "expected a name that ends in .nc or .zarr"),
    ("run scene.toml --out q.zr", "(did you mean .zarr?)"),
    ("run scene.toml --out ~/nowhere/at/all/r.nc", "does not exist; expected a file in an existing folder"),
    ("run quickstrt --out r.nc", "did you mean quickstart?"),
    ("run cardan --out r.nc", "give the path of a scene file"),
    ("plot r.nc --out r.png", "file = 'r.nc': does not exist"),
    ("plot scene.toml --out r.png", "scene.toml"),
    ("plot r.nc --out r", "expected a name that ends in .png, .pdf, .svg"),
    ("query scene.toml beta=0.1", "scene.toml"),
    ("query r.nc beta", "beta"),
    ("list Cardan", "did you mean cardan?"),
    # Scenes changed on the command line.
    (f"{RUN} --set zeta=0.1", "did you mean fixed.zeta?"),
    (f"{RUN} --set fixed.zeta", "expected name=value"),
    (f"{RUN} --set fixed.zeta=1/1000", "fixed.zeta = '1/1000'"),
    (f"{RUN} --set fixed.zeta=0,001", "fixed.zeta = '0,001'"),
    (f"{RUN} --set fixed.zeta=-0.1", "expected 0 <= zeta"),
    (f"{RUN} --set fixed.zeta=[0.1,0.2]", "fixed.zeta = [0.1, 0.2]: expected a number"),
    (f"{RUN} --set fixed.zeta=nan", "expected 0 <= zeta"),
    (f"{RUN} --set fixed.Zeta=0.1", "did you mean zeta?"),
    (f"{RUN} --set fixed.beta=0.1", "also in [axes]"),
    (f"{RUN} --set axes.beta.step=0.1", "unknown key"),
    (f"{RUN} --set axes.beta.num=0", "empty axis"),
    (f"{RUN} --set axes.beta=18", "expected a table { start, stop, num } or { values }"),
    (f"{RUN} --set axes.beta.stop=30", 'did you mean "30 deg"?'),
    (f"{RUN} --set axes.beta.stop=30rpm", "rpm is a unit of another quantity; expected a number in rad"),
    (f"{RUN} --set axes.beta.start=0:1", "':1' is not a unit"),
    (f"{RUN} --set axes.Omega.scale=logarithmic", "expected one of lin, log"),
    (f"{RUN} --set outputs=[radius]", "is not a result of floquet"),
    (f"{RUN} --set analysis=stability", "unknown to cardan; expected one of floquet"),
    (f"{RUN} --set system=carden", "did you mean cardan?"),
    (f"{RUN} --set options.tol=1e-6", "not used by method auto"),
    (f"{RUN} --set options.method=exact", "options.method = 'exact'"),
    # Points.
    (POINT.replace("beta=0.3", "beta=18"), 'in rad; did you mean "18 deg"?'),
    (POINT.replace("beta=0.3", "beta=18degrees_of_arc"), "'degrees_of_arc' is not a unit; expected a number in rad"),
    (POINT.replace("beta=0.3", "beta=18kg"), "kg is a unit of another quantity"),
    (POINT.replace("beta=0.3", "beta=95"), "in rad"),
    (POINT.replace("beta=0.3", "Beta=0.3"), "unknown (did you mean beta?)"),
    (POINT.replace("beta=0.3", ""), "beta: missing; expected"),
    (POINT.replace("beta=0.3", "--beta=0.3"), "unrecognized arguments: --beta=0.3"),
    (POINT.replace("beta=0.3", "beta=0.3+0.1j"), "beta = '0.3+0.1j'"),
    (POINT.replace("Omega=1.4", "Omega=1500rpm"), "rpm is a unit of another quantity; expected a number without unit"),
    (POINT.replace("Omega=1.4", "speed=1500"), "J1: missing"),
    (POINT.replace("zeta=0.001", "zeta=0.1%%"), "is not a unit"),
    (f"{POINT} beta=0.2", "beta is given twice"),
    (f"{POINT} angle=12", "given besides angle; expected one of the two"),
    (f"{POINT} J1=2", "J1: nothing follows from it"),
    (POINT.replace("floquet", "stability"), "unknown to cardan; expected one of floquet"),
    (POINT.replace("floquet", "atlas"), "expected at a point one of"),
    (POINT.replace("cardan", "shaft"), "system = 'shaft': unknown"),
    (f"{POINT} outputs=radius", "is not a result of floquet"),
    (f"{POINT} tolerance=1e-6", "unknown"),
    (TRUCK.replace("angle=12", "angle=120"), "angle = 120: expected -90 < angle < 90, in deg"),
    (TRUCK.replace("angle=12", "angle=12rpm"), "rpm is a unit of another quantity; expected a number in deg"),
    (TRUCK.replace("speed=1425", "speed=fast"), "speed = 'fast': expected a number"),
    (TRUCK.replace("speed=1425", "speed=-1425"), "expected 0 < speed < inf, in rpm"),
    (TRUCK.replace("J1=2", "J1=2kg"), "kg is a unit of another quantity; expected a number in kg m2"),
    (TRUCK.replace("c1=0.3", "c1=0"), "expected 0 if c1 = 0"),
    (TRUCK.replace("c1=0.3", ""), "c1: missing; alpha = c2/c1 needs c1"),
    (RATTLE.replace("omega=0.7", "omega=0.7deg"), "expected a number in rad/s"),
    (RATTLE.replace("omega=0.7", "frequency=0.7"), "unknown"),
    (RATTLE.replace("b=0.17", "backlash=-1mm"), "expected 0 <= backlash < inf, in m"),
    (RATTLE.replace("c=0.05", "damping_ratio=0.05 c=1"), "c = 1: given besides damping_ratio, k, I"),
    (SHAFT.replace("[1e4,1e4]", "1e4"), "expected a list of numbers"),
    (SHAFT.replace("[1e4,1e4]", "[1e4]"), "EI = [10000.0]: 1 entry where length has 2"),
    (SHAFT.replace("[0.3,0.3]", "[300mm,300kg]"), "length[1] = '300 kg'".replace("300 kg", "300kg")),
    (SHAFT.replace("EI=[1e4,1e4]", "outer_diameter=[60mm,60mm] material=iron"), "one of steel, aluminium, titanium"),
    (SHAFT.replace("EI=[1e4,1e4]", "outer_diameter=[60mm,60mm]"), "E: missing"),
    (SHAFT.replace("EI=[1e4,1e4]", "outer_diameter=60mm inner_diameter=70mm E=2e11"), "less than outer_diameter"),
    (f"{POINT} --amplitude 2", 'did you mean "2 deg"?'),
    (f"{SHAFT} operating_min=4500 operating_max=3000", "at least operating_min = 4500"),
    ("point planetary modes teeth=[20,26,72] operating_min=500", "at least operating_min = 500"),
    ("point planetary modes teeth=[20,72]", "those of sun, planet and ring"),
    ("point planetary modes planet_angle=[0,120,240]", 'did you mean "120 deg"?'),
    ("plot r.nc --out f.png --part speed=1000-2000", "expected a number or LOW:HIGH"),
    ("export r.nc out.csv", "a table is written by --csv out.csv"),
    # Values as people write them.
    (f"{RUN} --set axes.beta.values=[0.1,0.2]", "axes.beta = [...] replaces the whole axis"),
    (f"{RUN} --set outputs=verdict,radius", "'radius' is not a result of floquet (did you mean spectral_radius?)"),
    (f"{RUN} --set fixed.damping=0.1", "did you mean c1 or c2 or zeta or alpha?"),
    (POINT.replace("beta=0.3", "beta=17,2deg"), "did you mean 17.2?"),
    (POINT.replace("beta=0.3 Omega=1.4", "beta=0.1:0.3 Omega=1:2"), "Omega = [1.0, 2.0]: expected a number"),
    (POINT.replace("mu=1", "mu=1/2"), "a quotient is written as a number: 0.5"),
    (POINT.replace("mu=1", "mu=0/0"), "mu = '0/0': "),
    (POINT.replace("mu=1", "mu=1.2.3/4"), "mu = '1.2.3/4': "),
    (POINT.replace("mu=1", "mu=inf"), "mu = inf: expected 0 < mu < inf"),
    (POINT.replace("zeta=0.001", "damping=0.001"), "did you mean c1 or c2 or zeta or alpha?"),
    (f"{POINT} tol=1e-6", "did you mean rtol?"),
    (TRUCK.replace("J1=2", "J1=2kgm"), "'kgm' is not a unit"),
    (TRUCK.replace("angle=12", "joint_angle=12"), "did you mean angle?"),
    (SHAFT.replace("[0.3,0.3]", "0.3,0.3"), "expected a list of numbers"),
]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


@pytest.mark.parametrize(("command", "answer"), GUESSES, ids=[command for command, _ in GUESSES])
def test_a_guess_is_answered_in_one_line(folder, capsys, command, answer):
    try:
        code = main(command.split())
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if not line.startswith("points: ")]
    assert code == 2 and out == "" and len(lines) == 1 and answer in lines[0], (code, out, err)
    assert os.listdir(folder) == ["scene.toml"]


@pytest.mark.parametrize(
    ("written", "units", "value"),
    [
        ("1425 RPM", "rpm", 1425.0),
        ("2 kgm2", "kg m2", 2.0),
        ("2 kgm^2", "kg m2", 2.0),
        ("3 Ns/m", "N s/m", 3.0),
        ("3 kNs/m", "N s/m", 3000.0),
        ("0.3 Nms/rad", "N m s/rad", 0.3),
        ("300 Nmms", "N m s/rad", 0.3),
        ("60 kNm/rad", "N m/rad", 60000.0),
    ],
)
def test_units_are_read_as_they_are_written(written, units, value):
    assert _units.number(written, units) == pytest.approx(value, rel=1e-14)


def test_spaces_and_percent_are_understood(capsys):
    assert (
        main([*shlex.split("point cardan floquet 'beta = 0.3' Omega=1.4 zeta=0.1% alpha=1 mu=1 gamma=100"), "--json"])
        == 0
    )
    assert json.loads(capsys.readouterr().out)["parameters"]["zeta"]["value"] == 0.001
    options = parser().parse_args(["design", "speed-windows", "r.nc", "--margin", "2%"])
    assert options.margin == 0.02


@pytest.mark.full
def test_a_warning_is_one_line_without_code(folder):
    shaft = "length=[300,300] outer_diameter=[0.06,0.06] material=steel k_A=1e6 k_D=1e6 modes=1"
    words = [sys.executable, "-m", "drivetrain_jax.cli", "point", "bicardan", "critical_speeds", *shaft.split()]
    found = subprocess.run(words, capture_output=True, text=True, check=True)
    lines = found.stderr.splitlines()
    assert lines[0] == 'drivetrain: warning: length[0] = 300 m: more than 100 m; is "300 mm" meant?' and len(lines) == 2


BASE = {"beta": 0.3, "Omega": 1.4, "zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
TABLE = pd.DataFrame({"beta": [0.1, 0.2]})


@pytest.mark.parametrize("value", [0.3 + 0.1j, TABLE, Path("beta.csv"), {"beta": 0.3}, b"0.3", {0.3}, "0.3"])
def test_what_is_no_number_is_refused_by_name(value):
    for call in (dt.Cardan, partial(dt.point, "cardan", "floquet")):
        with pytest.raises(dt.InputError, match=r"^beta") as error:
            call(**{**BASE, "beta": value})
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", [Fraction(1, 2), Decimal("0.5"), np.float32(0.5), np.array(0.5), "0.5 rad"])
def test_every_number_is_one(value):
    assert float(dt.Cardan(**{**BASE, "beta": value}).beta) == 0.5
    scene = {"system": "cardan", "analysis": "floquet", "axes": {"Omega": [1.0]}, "fixed": {**BASE, "beta": value}}
    del scene["fixed"]["Omega"]
    from drivetrain_jax.runs.scene import load_scene

    assert load_scene(scene).fixed["beta"] == 0.5


def test_columns_and_lists_are_axes():
    shaft = dt.Cardan(**BASE)
    for values in ([0.1, 0.2], (Fraction(1, 10), Fraction(1, 5)), TABLE["beta"], np.array([0.1, 0.2])):
        assert dt.sweep(lambda s: s.beta, shaft, over={"beta": values}).beta.values.tolist() == [0.1, 0.2]
    for values in (TABLE, [1j], [[0.1]], 0.1, Path("beta.csv"), None):
        with pytest.raises(dt.InputError, match=r"^over\.beta"):
            dt.sweep(lambda s: s.beta, shaft, over={"beta": values})


def test_calls_that_miss_the_point_are_answered_by_name():
    shaft = dt.Cardan(**BASE)
    for call, answer in (
        (lambda: dt.Cardan(J1=2.0, **BASE), "J1: physical data; expected in Cardan.from_physical"),
        (lambda: dt.Cardan(**BASE, Zeta=0.1), r"Zeta: unknown \(did you mean zeta\?\); expected beta, Omega"),
        (lambda: dt.Cardan(0.3, 1.4), r"Cardan: 2 values without names; expected Cardan\(name=value"),
        (lambda: dt.sweep("floquet", shaft, over={"beta": [0.1]}), "function = 'floquet': expected a function"),
        (lambda: dt.sweep(shaft, dt.floquet, over={"beta": [0.1]}), "function = Cardan"),
        (lambda: dt.sweep(dt.floquet, shaft, over=["beta"]), r"over = \['beta'\]; expected values by the name"),
        (
            lambda: dt.sweep(lambda s: None, shaft, over={"beta": [0.1]}),
            "function: returns a NoneType; expected an array",
        ),
    ):
        with pytest.raises(dt.InputError, match=answer) as error:
            call()
        assert "\n" not in str(error.value)


def test_an_axis_takes_the_place_of_a_fixed_value():
    from drivetrain_jax.runs.scene import load_scene

    scene = load_scene("scene.toml", {"axes.zeta": [0.0, 0.001]})
    assert [axis.name for axis in scene.axes] == ["beta", "Omega", "zeta"] and "zeta" not in scene.fixed


def test_a_home_folder_may_be_written_as_one(monkeypatch, folder, capsys):
    monkeypatch.setenv("HOME", str(folder))
    assert main(["status", "~/scene.toml", "--out=~/r.nc"]) == 0
    assert "absent: 0 of 9" in capsys.readouterr().out
    with pytest.raises(dt.InputError, match=str(folder)):
        dt.open_result("~/r.nc")


def test_a_name_that_begins_with_a_tilde_may_be_no_user(folder, capsys):
    """Editors leave such files, and a shell gives an unknown user's name as it is."""
    assert main(["status", "scene.toml", "--out", "~no-such-user.nc"]) == 0
    assert "absent: 0 of 9" in capsys.readouterr().out
    for read in (dt.open_result, dt.open_atlas, dt.run):
        with pytest.raises(dt.InputError, match="= '~no-such-user"):
            read("~no-such-user.nc")


@pytest.mark.full
def test_a_point_that_has_not_converged_names_the_option():
    gears = {"omega": 0.7, "B0": 0.05, "B1": 0.03, "b": 0.17, "c": 1e-5, "alpha": 0.25, "k": 1.0, "I": 1.0}
    found = dt.point("rattle", "steady_state", **gears, most_periods=64)
    assert found.outcome.name == "NOT_CONVERGED"
    assert "not_converged (a larger most_periods than 64 may help)" in repr(found)
