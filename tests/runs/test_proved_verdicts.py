"""Files of atlases hold proved bounds, commands and opened atlases say what is proved, and `verify --proof` checks it."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax import view
from drivetrain_jax.atlas import proof
from drivetrain_jax.atlas.tips import find_tips
from drivetrain_jax.cli import main
from drivetrain_jax.report.statements import statements
from drivetrain_jax.runs import atlas_file
from drivetrain_jax.runs.atlas_answers import query, widest_angle
from drivetrain_jax.runs.atlas_chart import chart

BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
AXES = {"beta": {"start": 0.0, "stop": 0.6}, "Omega": {"start": 1.2, "stop": 1.6}}
SCENE = {"system": "cardan", "analysis": "atlas", "axes": AXES, "fixed": BASE}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    out = tmp_path_factory.mktemp("proved") / "atlas.nc"
    dt.run(SCENE, out=out)
    return out


@pytest.fixture(autouse=True)
def few_cells(monkeypatch):
    monkeypatch.setattr(atlas_file, "_CELLS", 40)
    monkeypatch.setattr(atlas_file, "_BALLS", 2)


def printed(capsys, *arguments):
    assert main([*map(str, arguments)]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_file_holds_the_theorem_and_its_bound(path):
    file = dt.open_result(path)
    assert file.attrs["theorem"] == proof.THEOREM
    assert (file["value_error"] < file["proved_error"]).all() and (file["proved_error"] < 1e-9).all()


def test_verify_computes_the_bound_again(path, capsys):
    assert main(["verify", str(path), "--proof"]) == 0
    *_, line = capsys.readouterr().out.splitlines()
    assert line.startswith("proof: errors of 1 of 1 panels at most ") and "1600 of 1600 verdicts" in line


def test_verify_refuses_a_bound_ten_times_too_small(path, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(proof, "_ROOM", 0.1)
    out = tmp_path / "wrong.nc"
    dt.run(SCENE, out=out)
    assert main(["verify", str(out)]) == 0 and main(["verify", str(out), "--proof"]) == 2
    assert "proved_error" in capsys.readouterr().err


def test_verify_refuses_verdicts_that_contradict_the_proof(path, monkeypatch, capsys):
    real = proof.verdicts
    monkeypatch.setattr(proof, "verdicts", lambda *given: np.array([1, 0, 2], np.int8)[real(*given)])
    assert main(["verify", str(path), "--proof"]) == 2
    assert "contradict" in capsys.readouterr().err


def test_answers_say_whether_the_verdict_is_proved(path, capsys):
    for beta, omega in ((0.3, 1.3), (0.3, 1.416)):
        given = f"beta={beta}", f"Omega={omega}"
        assert printed(capsys, "query", path, *given, "--json")["proved"] is True
        fixed = (f"{name}={value}" for name, value in BASE.items())
        assert printed(capsys, "point", "cardan", "floquet", *given, *fixed, "--json")["proved"] is True
    strong = {"beta": 0.3, "Omega": 1.3, **BASE, "zeta": 300.0}
    assert not dt.point("cardan", "floquet", **strong).proved
    # At a boundary found by bisection the proof leaves open what rounding decides.
    atlas, low, high = dt.open_atlas(path), 1.3, 1.416
    for _ in range(50):
        middle = (low + high) / 2
        stable = atlas(beta=0.3, Omega=middle, proved=False).spectral_radius < 1
        low, high = (middle, high) if stable else (low, middle)
    assert not atlas(beta=0.3, Omega=low).proved


def test_an_opened_atlas_has_a_flag_for_every_cell(path):
    grid = {"beta": 7, "Omega": (1.2, 1.6, 9)}
    with xr.open_dataset(path, engine="drivetrain", grid=grid) as chart:
        assert chart.proved.dims == chart.verdict.dims and chart.proved.dtype == bool
        assert chart.proved.values.all() and chart.proved[2:4, 3].values.all()
        points = xr.DataArray([1, 5], dims="point")
        assert chart.proved.isel(beta=points, Omega=points).values.all()
        found = dt.open_atlas(path)(beta=chart.beta, Omega=chart.Omega)
        assert found.proved.dims == ("beta", "Omega") and found.proved.values.all()


@pytest.mark.full
def test_nothing_is_said_to_be_proved_without_a_proof(tmp_path, capsys):
    """Over the stiffness ratio."""
    axes = {"mu": {"start": 0.9, "stop": 1.1}, "Omega": {"start": 1.2, "stop": 1.6}}
    out = tmp_path / "atlas.nc"
    dt.run({**SCENE, "axes": axes, "fixed": {"beta": 0.3, **{n: x for n, x in BASE.items() if n != "mu"}}}, out=out)
    file = dt.open_result(out)
    assert "theorem" not in file.attrs and "proved_error" not in file
    assert printed(capsys, "query", out, "mu=1", "Omega=1.3", "--json")["proved"] is False
    assert main(["verify", str(out), "--proof"]) == 2 and "holds no proof" in capsys.readouterr().err


@pytest.mark.full
def test_charts_reports_pages_tips_and_design_say_what_is_proved(path, monkeypatch):
    monkeypatch.setattr(atlas_file, "_TESTED", 30)
    drawn, all_cells = chart(path, {}, 8), "the verdicts of all 16 cells tested are proved; boundaries and tips hold by"
    assert drawn.attrs["proof"].startswith(all_cells)
    text = view.plot(drawn).legends[0].get_title().get_text()
    assert all_cells in " ".join(text.split())
    assert f"{all_cells.capitalize()} estimate." in statements(drawn)
    atlas = dt.open_atlas(path)
    flags = atlas.grid(Omega=np.linspace(1.2, 1.6, 3), beta=np.array([0.1, 0.3]), proved=True).proved
    assert flags.dims == ("Omega", "beta") and flags.values.all()
    assert "drivetrain query says which are proved" in atlas.explore().text
    tips = find_tips(atlas.stability.atlas, atlas.scene.system)
    assert tips.proof == "1 tip is certain within the bounds of the atlas, which are estimates."
    answer = widest_angle(atlas, {"Omega": (1.3, 1.5)})
    pattern = "the verdicts of (1[0-9]+) of 105 points checked are proved; between them they hold by estimate"
    (proved,) = re.findall(pattern, answer.text)
    assert answer.data["proofs"] == {"proved": int(proved), "points": 105}
    assert "the verdict is proved" in query(atlas, {"beta": 0.3, "Omega": 1.3}).text


def test_a_run_and_verify_say_why_nothing_is_proved(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(proof, "_MOST_NODES", 100)
    scene, out = tmp_path / "scene.toml", tmp_path / "atlas.nc"
    axes = "\n".join(f"{name} = {{ start = {ends['start']}, stop = {ends['stop']} }}" for name, ends in AXES.items())
    fixed = "\n".join(f"{name} = {value}" for name, value in BASE.items())
    scene.write_text(f'system = "cardan"\nanalysis = "atlas"\n[axes]\n{axes}\n[fixed]\n{fixed}\n')
    assert main(["run", str(scene), "--out", str(out)]) == 0
    assert re.search(
        "verdicts are estimates: a proof would need [0-9,]+ polynomials, more than 100", capsys.readouterr().err
    )
    assert main(["verify", str(out), "--proof"]) == 2
    assert "holds no proof; a proof would need" in capsys.readouterr().err
