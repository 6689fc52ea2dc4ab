"""Results that commit 4378b52 (version 0.1.0) wrote: they open, verify and plot, and their numbers still hold."""

from __future__ import annotations

from pathlib import Path

import pytest

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from tests.sizes import full_after

OLD = Path(__file__).parent.parent / "old_results"
FILES = "chart", "response", "atlas"


@pytest.mark.parametrize("name", full_after(2, FILES))
def test_old_results_verify_and_plot(name, tmp_path, capsys):
    main(["verify", str(OLD / f"{name}.nc")])
    assert "checksums: all agree" in capsys.readouterr().out
    main(["plot", str(OLD / f"{name}.nc"), "--out", str(tmp_path / "figure.png")])
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_an_old_chart_has_the_values_of_today():
    chart = dt.open_result(OLD / "chart.nc")
    point = chart.isel(beta=7, Omega=9)
    shaft = dt.Cardan(beta=float(point.beta), Omega=float(point.Omega), mu=1.0, alpha=1.0, zeta=0.01, gamma=100.0)
    now = dt.floquet(shaft)
    error = float(point.spectral_radius_error) + float(now.spectral_radius_error)
    assert abs(float(point.spectral_radius) - float(now.spectral_radius)) <= error


def test_an_old_atlas_answers(capsys):
    main(["query", str(OLD / "atlas.nc"), "beta=0.5", "Omega=1.45"])
    assert "spectral_radius          1.0302749513" in capsys.readouterr().out
