"""The four-parameter grid by diffrax under vmap against the direct method, cell by cell."""

from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt

SCENE = Path(__file__).parents[2] / "sweeps" / "cardan_4d.toml"
AXES = ("beta", "Omega", "mu", "alpha")


def worst_relative_difference(**overrides):
    by_diffrax = dt.run(SCENE, overrides=overrides)
    direct = dt.run(SCENE, overrides=overrides | {"options.method": "direct"})
    assert by_diffrax.attrs["method"] == "diffrax"
    assert by_diffrax.spectral_radius.dims == AXES
    assert not (by_diffrax.outcome >= 2).any()
    return float(np.abs(by_diffrax.spectral_radius / direct.spectral_radius - 1).max())


def test_coarse_grid_agrees_in_every_cell():
    coarse = {"axes.beta.num": 3, "axes.Omega.num": 7, "axes.mu.values": [0.25, 20.0], "axes.alpha.values": [0.0, 20.0]}
    assert worst_relative_difference(**coarse) < 1e-8


@pytest.mark.full
def test_whole_grid_agrees_in_every_cell():
    assert worst_relative_difference() < 1e-8
