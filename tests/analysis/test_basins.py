"""Shares of initial conditions against the values of the note."""

import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.basins import shares
from drivetrain_jax.systems.rattle import PRESETS

# Share of the high branch, initial conditions in [-1, 1]^2.
NOTE = {0.76: 0.976, 0.80: 0.84, 0.84: 0.67, 0.87: 0.41}
# Rounding of the note.
ROUNDING = {0.76: 0.0005, 0.80: 0.005, 0.84: 0.005, 0.87: 0.005}


def run(**options):
    scene = {"system": "rattle", "analysis": "basins", "fixed": PRESETS["table1"], "options": options}
    return dt.run(scene | {"axes": {"omega": {"values": list(NOTE)}}})


@pytest.fixture(scope="module")
def found():
    return run(samples=1000, seed=3)


def test_shares_of_the_high_branch(found):
    """Within three standard errors of the expected share, and the rounding of the note."""
    expected, rounding = np.array(list(NOTE.values())), np.array(list(ROUNDING.values()))
    distance = np.abs(found.sel(attractor=1).basin_fraction.values - expected)
    assert np.all(distance < 3 * np.sqrt(expected * (1 - expected) / 1000) + rounding)
    np.testing.assert_allclose(found.basin_fraction.sum("attractor"), 1.0, rtol=1e-15)
    assert (found.outcome == 0).all() and (found.unsettled_fraction == 0).all()
    assert (found.attractor_multiple.values[:, :2] == 1).all()


def test_the_seed_decides(found):
    again, other = run(samples=1000, seed=3), run(samples=1000, seed=4)
    np.testing.assert_array_equal(again.basin_fraction.values, found.basin_fraction.values)
    assert (other.basin_fraction.values[:, 0] != found.basin_fraction.values[:, 0]).any()


def test_motions_are_sorted_into_attractors():
    high = jnp.array([[1.0], [2.0], [1.0], [5.0], [np.nan], [1.0], [7.0]])
    multiple = jnp.array([[1], [2], [1], [0], [0], [2], [0]])
    outcome = jnp.array([[0], [0], [0], [0], [Outcome.NOT_CONVERGED], [0], [0]])
    sorted_ = {name: np.asarray(x) for name, x in shares(high, -high, multiple, outcome).items()}
    np.testing.assert_allclose(sorted_["basin_fraction"][:4, 0], np.array([1, 2, 1, 2]) / 7)
    np.testing.assert_array_equal(sorted_["attractor_multiple"][:4, 0], [2, 1, 2, 0])
    np.testing.assert_array_equal(sorted_["attractor_u_max"][:3, 0], [2.0, 1.0, 1.0])
    assert sorted_["unsettled_fraction"][0] == 1 / 7 and sorted_["outcome"][0] == Outcome.TOLERANCE_NOT_MET
