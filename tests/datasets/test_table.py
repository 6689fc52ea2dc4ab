"""Results as CSV: one row a point, and nothing lost."""

import errno
import os

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.cli import main

SHAFT = {"length": [0.3, 1.2, 0.3], "EI": [8e4, 5e4, 8e4], "rhoA": [20.0, 15.0, 20.0], "k_A": 5e6}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    out = tmp_path_factory.mktemp("table") / "shaft.nc"
    axes = {"length[1]": {"values": [1.2, 1.3]}, "k_D": {"start": 1e5, "stop": 1e7, "num": 3}}
    scene = {"system": "bicardan", "analysis": "critical_speeds", "axes": axes, "fixed": SHAFT, "options": {"modes": 2}}
    dt.run(scene, out=out)
    return out


def test_every_number_is_in_its_column(file):
    assert main(["export", str(file), "--csv"]) == 0
    found, dataset = pd.read_csv(file.with_suffix(".csv")), dt.open_result(file)
    assert list(found.columns[:2]) == ["length[1] [m]", "k_D [N/m]"]
    assert len(found) == dataset.outcome.size == 6
    for mode in (1, 2):
        values = dataset.critical_speed.sel(mode=mode).values
        np.testing.assert_array_equal(found[f"critical_speed_{mode} [rpm]"], values.ravel())
    np.testing.assert_array_equal(found["k_D [N/m]"], np.tile(dataset.k_D.values, 2))
    assert (found.outcome == "success").all()
    assert list(dataset.drivetrain.table().columns) == list(found.columns)


def test_a_home_folder_may_be_written_as_one(file, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["export", str(file), "--csv=~/t.csv"]) == 0
    assert (tmp_path / "t.csv").is_file()


def test_a_link_to_a_table_stays_one(file, tmp_path):
    (tmp_path / "link.csv").symlink_to(tmp_path / "t.csv")
    assert main(["export", str(file), "--csv", str(tmp_path / "link.csv")]) == 0
    assert (tmp_path / "link.csv").is_symlink() and len(pd.read_csv(tmp_path / "t.csv")) == 6


def test_two_results_are_never_one_column():
    chart = dt.sweep(lambda p: {"y": np.array([1, 2]) * p["x"], "y_1": p["x"]}, {"x": 0.0}, over={"x": [1.0, 2.0]})
    with pytest.raises(dt.InputError, match="table: 'y_1' names two columns"):
        chart.drivetrain.table()


def test_a_dataset_without_outcome_has_no_table():
    with pytest.raises(dt.InputError, match="outcome: missing; expected a result on a grid"):
        xr.Dataset({"a": 1}).drivetrain.table()


@pytest.mark.full
def test_complex_numbers_have_two_columns(tmp_path):
    shaft = dt.Cardan(beta=0.3, Omega=1.4, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    over = {"Omega": [1.2, 1.415]}
    chart = dt.sweep(dt.floquet, shaft, over=over, outputs=["floquet_multiplier"], out=tmp_path / "m.nc")
    assert main(["export", str(tmp_path / "m.nc"), "--csv", str(tmp_path / "t.csv")]) == 0
    found = pd.read_csv(tmp_path / "t.csv")
    for k in range(4):
        values = found[f"floquet_multiplier_{k + 1}_real"] + 1j * found[f"floquet_multiplier_{k + 1}_imag"]
        np.testing.assert_array_equal(values, chart.floquet_multiplier[:, k])


@pytest.mark.full
def test_samples_of_a_history_are_rows(tmp_path):
    shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    over = {"zeta": [0.0016, 0.01]}
    found = dt.sweep(dt.history, shaft, over=over, outputs=["phi"], stop=0.001, num=40, out=tmp_path / "h.nc")
    assert main(["export", str(tmp_path / "h.nc"), "--csv"]) == 0
    rows = pd.read_csv(tmp_path / "h.csv")
    assert list(rows.columns) == ["zeta", "time [s]", "phi [rad]", "outcome"]
    np.testing.assert_array_equal(rows["phi [rad]"], found.phi.values.ravel())
    np.testing.assert_array_equal(rows["time [s]"], np.tile(found.time.values, 2))


def test_a_disk_that_takes_no_more_is_named(file, tmp_path, monkeypatch, capsys):
    def full(*given, **how):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    monkeypatch.setattr(pd.DataFrame, "to_csv", full)
    assert main(["export", str(file), "--csv", str(tmp_path / "t.csv")]) == 2
    assert capsys.readouterr().err == f"drivetrain: {tmp_path / 't.csv.tmp'}: File too large\n"


def test_wrong_names_leave_nothing_behind(file, tmp_path, capsys):
    for arguments, word in (
        ([str(file), "--csv", str(tmp_path / "t.txt")], "ends in .csv"),
        ([str(file), str(tmp_path / "t.nc"), "--csv"], "not used with --csv"),
        ([str(file)], "FILE.nc: missing"),
        ([".", "--csv"], "is a folder"),
        (["/", "--csv"], "ends in .csv"),
    ):
        assert main(["export", *arguments]) == 2
        assert word in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_not_exported(file, tmp_path, capsys):
    content, bad = bytearray(file.read_bytes()), tmp_path / "bad.nc"
    content[content.find(dt.open_result(file).critical_speed.values.tobytes())] ^= 1
    bad.write_bytes(content)
    assert main(["export", str(bad), "--csv"]) == 2
    assert "damaged (critical_speed)" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["bad.nc"]
