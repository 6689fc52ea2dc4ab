"""The accessor ``.drivetrain``, figures of several kinds of results, and captions that tell the truth."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import dask
import h5py
import matplotlib.figure
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.datasets import figure as figures
from drivetrain_jax.resonances import BUILT_IN
from drivetrain_jax.systems import get_system, system_names
from drivetrain_jax.view.style import caption
from tests.atlases import atlas_file
from tests.sizes import full_after

SHAFT = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
CHART = {
    "system": "cardan",
    "analysis": "floquet",
    "axes": {"beta": {"start": 0.0, "stop": 0.6, "num": 7}, "Omega": {"start": 1.2, "stop": 1.6, "num": 9}},
    "fixed": SHAFT,
}
ATLAS = CHART | {
    "analysis": "atlas",
    "axes": {"beta": {"start": 0.0, "stop": 0.6}, "Omega": {"start": 1.0, "stop": 2.0}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    dt.run(CHART, out=folder / "chart.nc")
    shutil.copy(atlas_file(ATLAS), folder / "atlas.nc")
    return folder


@pytest.fixture
def chart(folder):
    with xr.open_dataset(folder / "chart.nc", engine="h5netcdf") as dataset:
        yield dataset


def captions(figure):
    texts = [*figure.texts, *(legend.get_title() for legend in figure.legends)]
    return " ".join(text.get_text() for text in texts).replace("\u00a0", " ")


@pytest.mark.parametrize(
    "lines",
    full_after(
        1,
        [
            ["import drivetrain_jax", "import xarray as xr"],
            ["import xarray as xr", "import drivetrain_jax"],
            ["import drivetrain_jax, sys", "assert 'xarray' not in sys.modules", "from xarray import Dataset"],
            ["import xarray as xr", "xr.backends.list_engines()"],
            ["from drivetrain_jax.datasets.accessor import write_csv"],
        ],
    ),
)
def test_every_dataset_has_the_accessor(lines):
    check = ["import sys, xarray", "assert xarray.Dataset().drivetrain.named", "assert 'jax' not in sys.modules"]
    check.append("assert not [f for f in sys.meta_path if 'drivetrain' in type(f).__module__]")
    subprocess.run([sys.executable, "-W", "error", "-c", "\n".join(lines + check)], check=True)


def test_codes_become_words(chart):
    named = chart.drivetrain.named()
    assert not named["verdict"].variable._in_memory
    unstable = int((chart["verdict"] == 1).sum())
    assert int((named["verdict"] == "unstable").sum()) == unstable > 0
    assert set(np.unique(named["outcome"])) <= {"success", "tolerance_not_met"}
    assert "flag_values" not in named["verdict"].attrs and named["verdict"].attrs["long_name"]
    for name, value in SHAFT.items():
        assert float(named[name]) == value and named[name].attrs["units"] == "1"
    assert named.sel(beta=0.6, Omega=1.6)["verdict"].item() in ("stable", "unstable")
    with dask.config.set(scheduler="synchronous"):
        chunked = chart.chunk(beta=3).drivetrain.named()
        assert chunked["verdict"].chunks is not None
        xr.testing.assert_identical(chunked.compute(), named.compute())


def test_words_of_codes_that_are_missing(chart):
    masked = chart.load().copy()
    masked["verdict"] = chart["verdict"].where(chart["beta"] > 0.3).assign_attrs(chart["verdict"].attrs)
    words = masked.drivetrain.named()["verdict"]
    assert (words.sel(beta=slice(0, 0.3)) == "").all() and (words.sel(beta=slice(0.35, 1)) != "").all()


def test_entries_of_lists_become_coordinates():
    shaft = {"length": [1.0, 0.8], "EI": [1e5, 2e5], "rhoA": [10.0, 12.0], "k_A": 1e7, "k_D": 1e8}
    scene = {"system": "bicardan", "analysis": "critical_speeds", "fixed": shaft, "options": {"modes": 2}}
    named = dt.run(scene | {"axes": {"length[1]": {"values": [0.7, 0.8]}}}).drivetrain.named()
    assert float(named["EI_1"]) == 2e5 and named["EI_1"].attrs["parameter"] == "EI[1]"
    assert float(named["length_0"]) == 1.0 and named["length_1"].values.tolist() == [0.7, 0.8]
    assert "EI" not in caption(named).replace("$EI$", "", 1) and caption(named).count("10 MN/m") == 1


def test_results_that_are_joined(chart):
    other = dt.run(CHART | {"fixed": SHAFT | {"zeta": 0.01}})
    joined = xr.concat([chart.drivetrain.named(), other.drivetrain.named()], "zeta")
    assert joined["zeta"].values.tolist() == [0.001, 0.01]
    assert r"\zeta" not in caption(joined.isel(zeta=[0, 1])) and r"$\mu$ = 1" in caption(joined)
    assert caption(joined.isel(zeta=1)).startswith(r"$\zeta$ = 0.01, ")
    # Nobody knows in what those along a dimension of the user's differ.
    plain = xr.concat([chart, other], "run")
    assert "zeta" not in captions(dt.plot(plain))
    assert {"run 0", "run 1"} <= {axes.get_title() for axes in dt.plot(plain).axes}
    assert caption(plain) == "" and r"$\zeta$ = 0.001" in caption(chart)


@pytest.mark.full
def test_the_caption_of_a_part_of_an_atlas(tmp_path):
    axes = ATLAS["axes"] | {"zeta": {"start": 0.0, "stop": 0.01}}
    fixed = {name: value for name, value in SHAFT.items() if name != "zeta"}
    atlas = dt.open_atlas(dt.run(ATLAS | {"axes": axes, "fixed": fixed}))
    part = atlas.grid(beta=np.linspace(0, 0.6, 5), Omega=np.linspace(1.2, 1.6, 6), zeta=5e-4)
    assert float(part["zeta"]) == 5e-4 and part["zeta"].attrs["units"] == "1"
    assert r"$\zeta$ = 0.0005" in captions(dt.plot(part))
    assert captions(dt.plot(part)).count(r"\zeta") == 1
    assert captions(dt.plot(part.drivetrain.named().assign(part.data_vars))).count(r"\zeta") == 1


@pytest.mark.full
def test_what_plot_takes(folder, chart):
    for result in (chart, folder / "chart.nc", str(folder / "chart.nc"), [chart], [folder / "chart.nc"]):
        assert isinstance(dt.plot(result), matplotlib.figure.Figure)
    assert captions(chart.drivetrain.plot()) == captions(dt.plot(chart))
    part = {"Omega": (1.3, 1.5)}
    zoom = dt.plot(folder / "atlas.nc", part=part, cells=40)
    with xr.open_dataset(folder / "atlas.nc", engine="h5netcdf") as panels:
        same = panels.drivetrain.plot(part=part, cells=40)
    assert zoom.axes[0].get_xlim() == same.axes[0].get_xlim() and 1.29 < zoom.axes[0].get_xlim()[0] < 1.31


@pytest.mark.full
def test_a_chart_shows_the_tongues_of_its_atlas(folder, chart):
    """The cells of this chart step over the tip of S21."""
    lines = {line.get_label(): line for line in dt.plot(chart, folder / "atlas.nc").axes[0].get_lines()}
    tip = lines["tip"].get_xydata()
    assert np.allclose(tip, [[1.41599, 0.10633]], atol=1e-5)
    boundary = lines["boundary"].get_xydata()
    assert np.nanmin(boundary[:, 1]) < 0.107 and np.nanmax(boundary[:, 0]) <= 1.6
    speeds = {"J1": 2.0, "k1": 8.0, "k2": 8.0, "J2": 200.0, "c1": 0.008, "c2": 0.008}
    axes = {"angle": {"start": "0 deg", "stop": "30 deg", "num": 4}, "speed": {"start": 24.0, "stop": 30.0, "num": 3}}
    physical = dt.run(CHART | {"axes": axes, "fixed": speeds})
    (mark,) = (x for x in dt.plot(physical, folder / "atlas.nc").axes[0].get_lines() if x.get_label() == "tip")
    assert np.allclose(mark.get_xydata(), [[1.41599 * 2 * 30 / np.pi, np.degrees(0.10633)]], rtol=1e-4)
    with pytest.raises(dt.InputError, match=r"zeta = 0.01: the atlas is made for zeta = 0.001; expected that value"):
        dt.plot(dt.run(CHART, overrides={"fixed.zeta": 0.01}), folder / "atlas.nc")
    with pytest.raises(dt.InputError, match=r"Omega = 0.5: expected 1 <= Omega <= 2"):
        dt.plot(dt.run(CHART, overrides={"axes.Omega.start": 0.5}), folder / "atlas.nc")


@pytest.mark.parametrize(
    ("results", "options", "message"),
    [
        (
            ["atlas.nc", "chart.nc"],
            {},
            "results: an atlas among several; expected an atlas alone, or a chart and its atlas",
        ),
        (["chart.nc"], {"cells": 5}, "cells = 5: a result on a grid is drawn whole; expected an atlas"),
        ([], {}, "result = []: expected a result, or a list of one or more"),
        (["chart.nc"], {"units": 5}, 'units = 5: expected units such as "rpm,deg", or a list of them'),
        (
            ["chart.nc"],
            {"units": ["rpm", 5]},
            "units = ['rpm', 5]: expected units such as \"rpm,deg\", or a list of them",
        ),
        (["atlas.nc"], {"cells": "many"}, "cells = 'many': expected a whole number, 2 <= cells <= 20000"),
        (["atlas.nc"], {"part": 5}, "part = 5: expected numbers or (low, high) by the name of a parameter"),
        (["atlas.nc"], {"part": {"beta": [0, 1, 2]}}, "part.beta = [0, 1, 2]: expected a number or (low, high)"),
        ([5], {}, "result: got a int; expected a Dataset, the path of a result, or a list of them"),
    ],
)
def test_what_plot_does_not_take(folder, results, options, message):
    with pytest.raises(dt.InputError) as refused:
        dt.plot([folder / r if isinstance(r, str) else r for r in results], **options)
    assert str(refused.value) == message


def test_a_grid_without_end_is_not_drawn(folder):
    with pytest.raises(dt.InputError, match=r"has 1e\+10 cells; expected up to 1e\+08 in a figure: select some"):
        xr.open_dataset(folder / "atlas.nc", engine="drivetrain", grid=100_000).drivetrain.plot()


@pytest.mark.full
def test_what_a_part_lacks_is_named(chart):
    with pytest.raises(dt.InputError, match="result: without 'outcome', which its figure needs; expected a whole"):
        dt.plot(chart.load().drop_vars("outcome"))
    modes = dt.run({"system": "planetary", "analysis": "modes"})
    with pytest.raises(dt.InputError, match="result: without 'mode', which a rule needs; expected a whole result"):
        modes.isel(mode=0).drivetrain.verify()
    assert not modes.isel(mode=[0, 1]).drivetrain.verify().problem


def test_wrong_input_of_a_rule_keeps_its_line(chart, monkeypatch):
    """``InputError`` is a ``ValueError``, and says more than that something is missing."""

    def refuse(*_):
        raise dt.InputError("rule 'own': fails")

    monkeypatch.setattr("drivetrain_jax.invariants.verify_dataset", refuse)
    with pytest.raises(dt.InputError, match=r"^rule 'own': fails$"):
        chart.drivetrain.verify()


def test_words_are_not_verified(chart):
    with pytest.raises(dt.InputError, match=r"outcome: no codes; expected the result itself, as before \.named\(\) or"):
        chart.drivetrain.named().drivetrain.verify()


def test_words_are_not_drawn(chart):
    with pytest.raises(dt.InputError, match="result: has words for codes; expected the result itself"):
        chart.drivetrain.named().drivetrain.plot()


@pytest.mark.full
def test_a_lazy_grid_is_evaluated_once_for_its_figure(folder, monkeypatch):
    from drivetrain_jax.runs.atlas_file import StoredAtlas

    calls, arrays = [], StoredAtlas.arrays
    monkeypatch.setattr(StoredAtlas, "arrays", lambda *a, **k: calls.append(1) or arrays(*a, **k))
    xr.open_dataset(folder / "atlas.nc", engine="drivetrain", grid=40).drivetrain.plot()
    assert len(calls) == 1


def test_a_figure_shows_itself(chart):
    png, size = dt.plot(chart)._repr_png_()
    assert png.startswith(b"\x89PNG") and size["width"] == 700


@pytest.mark.full
def test_a_figure_of_a_stored_result_needs_no_jax(folder):
    """Its predicted resonances neither; jax takes longer to import than the figure to draw."""
    check = [
        "import sys, drivetrain_jax as dt, xarray as xr",
        "chart = xr.open_dataset(sys.argv[1], engine='h5netcdf')",
        "for figure in (dt.plot(sys.argv[1]), chart.isel(beta=slice(3)).drivetrain.plot()):",
        "    assert [text.get_text() for text in figure.axes[0].texts] == ['$S_{21}$']",
        "assert 'jax' not in sys.modules",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(check), folder / "chart.nc"], check=True)


def test_built_in_systems_have_the_predictions_that_figures_know():
    assert {name: get_system(name).resonances for name in BUILT_IN} == BUILT_IN
    assert set(BUILT_IN) == set(system_names())


def test_every_figure_is_one_that_shows_itself():
    view = Path(figures.__file__).parents[1] / "view"
    assert [p.name for p in view.glob("*.py") if " Figure(" in p.read_text()] == []


def test_verify(chart, folder, tmp_path):
    report = chart.drivetrain.verify()
    assert not report.problem and "all agree in" in str(report) and repr(report) == str(report)
    wrong = chart.load().copy(deep=True)
    wrong["verdict"][0, 0] = 1
    assert "verdict follows from spectral_radius" in wrong.drivetrain.verify().problem
    assert "not of a file" in str(dt.run(CHART).drivetrain.verify())
    shutil.copy(folder / "chart.nc", tmp_path / "damaged.nc")
    with h5py.File(tmp_path / "damaged.nc", "r+") as store:
        store["spectral_radius"][0, 0] += 1e-12
    with xr.open_dataset(tmp_path / "damaged.nc", engine="h5netcdf") as damaged:
        assert "spectral_radius: damaged" in damaged.drivetrain.verify().problem


def test_query(folder, chart):
    with xr.open_dataset(folder / "atlas.nc", engine="h5netcdf") as panels:
        answer = panels.drivetrain.query(beta=0.31, Omega=1.2)
    assert answer.data["meanings"]["verdict"] == "stable" and repr(answer) == str(answer)
    lazily = xr.open_dataset(folder / "atlas.nc", engine="drivetrain", grid={"beta": 0.1}).isel(Omega=slice(5))
    assert lazily.drivetrain.query(beta=0.31, Omega=1.2).data == answer.data
    with pytest.raises(dt.InputError, match="query: the result holds values on a grid; expected an atlas"):
        chart.drivetrain.query(beta=0.31, Omega=1.2)


@pytest.mark.parametrize("ask", ["named", "verify", "query", "plot"])
def test_a_dataset_of_others(ask):
    with pytest.raises(dt.InputError, match="analysis"):
        getattr(xr.Dataset({"a": 1}).drivetrain, ask)()
