"""The four-parameter grid by diffrax under vmap against the direct method, cell by cell."""

from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt

SCENE = Path(__file__).parents[2] / "sweeps" / "cardan_4d.toml"


@pytest.mark.full
def test_whole_grid_agrees_and_no_cell_is_flagged():
    by_diffrax = dt.run(SCENE)
    direct = dt.run(SCENE, overrides={"options.method": "direct"})
    assert by_diffrax.attrs["method"] == "diffrax"
    assert by_diffrax.spectral_radius.dims == ("beta", "Omega", "mu", "alpha")
    assert not by_diffrax.outcome.any()
    assert float(np.abs(by_diffrax.spectral_radius / direct.spectral_radius - 1).max()) < 1e-9
