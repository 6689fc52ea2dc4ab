"""Shares of initial conditions against the published values of the theory note."""

import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.basins import shares
from drivetrain_jax.systems.rattle import PRESETS

# Share of the high branch by omega, for initial conditions in [-1, 1]^2.
NOTE = {0.76: 0.976, 0.80: 0.84, 0.84: 0.67, 0.87: 0.41}
# Rounding of the note.
ROUNDING = {0.76: 0.0005, 0.80: 0.005, 0.84: 0.005, 0.87: 0.005}


def run(**options):
    scene = {"system": "rattle", "analysis": "basins", "fixed": PRESETS["table1"], "options": options}
    return dt.run(scene | {"axes": {"omega": {"values": list(NOTE)}}})


@pytest.fixture(scope="module")
def found():
    return run(samples=1000, seed=3)


@pytest.mark.full
def test_shares_of_the_high_branch(found):
    """Shares agree within three standard errors plus the rounding of the note."""
    expected, rounding = np.array(list(NOTE.values())), np.array(list(ROUNDING.values()))
    distance = np.abs(found.sel(attractor=1).basin_fraction.values - expected)
    assert np.all(distance < 3 * np.sqrt(expected * (1 - expected) / 1000) + rounding)
    np.testing.assert_allclose(found.basin_fraction.sum("attractor"), 1.0, rtol=1e-15)
    assert (found.outcome == 0).all() and (found.unsettled_fraction == 0).all()
    assert (found.attractor_multiple.values[:, :2] == 1).all()


@pytest.mark.full
def test_the_seed_decides():
    one, again, other = (run(samples=128, seed=seed).basin_fraction.values for seed in (3, 3, 4))
    np.testing.assert_array_equal(again, one)
    assert (other[:, 0] != one[:, 0]).any()


# More than a quarter of the motions are chaotic for 4,000 periods, yet all end on motions of three or four periods.
TRANSIENT = {
    "omega": 3.092670827609387, "B0": 0.05, "B1": 0.05091904949046652, "b": 0.01, "c": 0.05, "alpha": 0.0,
    "k": 39.37800020979253, "I": 0.5943969385434771,
}  # fmt: skip


@pytest.mark.full
def test_chaos_beside_periodic_motions_may_be_a_transient():
    """Motions that are still chaotic count as unsettled; their number falls with ``most_periods``."""
    left = []
    for periods in (1000, 8000):
        scene = {"system": "rattle", "analysis": "basins", "fixed": TRANSIENT}
        found = dt.run(scene | {"options": {"samples": 64, "most_periods": periods}})
        counted = found.attractor_multiple.values[found.basin_fraction.values > 0]
        np.testing.assert_array_equal(counted, [3, 4])
        assert found.outcome == Outcome.TOLERANCE_NOT_MET
        left.append(float(found.unsettled_fraction))
    assert left[0] > 2 * left[1] > 0


def sorted_motions(high, multiple, outcome):
    high, multiple, outcome = (jnp.array(x)[:, None] for x in (high, multiple, outcome))
    return {name: np.asarray(x)[..., 0] for name, x in shares(high, -high, multiple, outcome).items()}


def test_motions_are_sorted_into_attractors():
    """Three motions count as unsettled: one has failed, and the two non-periodic ones may be transients."""
    found = sorted_motions(
        [1.0, 2.0, 1.0, 5.0, np.nan, 1.0, 7.0], [1, 2, 1, 0, 0, 2, 0], [0, 0, 0, 0, Outcome.NOT_CONVERGED, 0, 0]
    )
    np.testing.assert_allclose(found["basin_fraction"], np.array([1, 2, 1] + [np.nan] * 5) / 7)
    np.testing.assert_array_equal(found["attractor_multiple"], [2, 1, 2] + [0] * 5)
    np.testing.assert_array_equal(found["attractor_u_max"][:3], [2.0, 1.0, 1.0])
    assert found["unsettled_fraction"] == 3 / 7 and found["outcome"] == Outcome.TOLERANCE_NOT_MET


def test_non_periodic_motions_alone_are_one_attractor():
    found = sorted_motions([1.0, 2.0, 3.0], [0, 0, 0], [0, 0, 0])
    np.testing.assert_array_equal(found["basin_fraction"], [1.0] + [np.nan] * 7)
    assert found["unsettled_fraction"] == 0 and found["outcome"] == Outcome.SUCCESS


def test_roundings_of_one_rest_are_one_attractor():
    high, zeros = jnp.array([[0.0], [5e-33], [-2e-33], [0.3]]), jnp.zeros((4, 1), int)
    apart, together = (shares(high, -high, zeros + 1, zeros, rest)["basin_fraction"][:, 0] for rest in (0.0, 1e-15))
    assert not jnp.isnan(apart[3])
    np.testing.assert_array_equal(together, [0.25, 0.75] + [np.nan] * 6)


@pytest.mark.full
def test_gears_at_rest_are_one_attractor():
    """Without a drive amplitude all motions come to rest, at any frequency."""
    scene = {"system": "rattle", "analysis": "basins", "fixed": PRESETS["table1"] | {"B1": 0.0}}
    found = dt.run(scene | {"axes": {"omega": {"values": [0.9, 0.9719, 1.2]}}, "options": {"samples": 128}})
    assert (found.outcome == Outcome.SUCCESS).all() and (found.unsettled_fraction == 0).all()
    np.testing.assert_array_equal(found.basin_fraction.sel(attractor=1), 1.0)
