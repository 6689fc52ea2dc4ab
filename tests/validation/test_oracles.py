"""References and rivals of the benchmarks against each other."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import cardan, planetary, rattle
from tests.oracles.bicardan_precise_reference import determinant
from tests.oracles.bicardan_reference import transfer_determinant
from tests.oracles.cardan_orbit_reference import nonlinear_orbit
from tests.oracles.cardan_reference import BASE_CASE, monodromy, spectral_radius, stacked_half_period_monodromy
from tests.oracles.planetary_reference import extension_matrix
from tests.oracles.rattle_reference import scipy_events


def test_half_a_period_gives_the_radius_of_a_whole_one():
    """SciPy gets the same form of the problem as the package and heyoka."""
    columns = {name: np.full(3, value) for name, value in (BASE_CASE | {"zeta": 0.05, "alpha": 2.0}).items()}
    columns |= {"beta": np.array([0.3, 1.0, 1.4]), "Omega": np.array([1.4, 0.4, 0.9])}
    points = [{name: column[i] for name, column in columns.items()} for i in range(3)]
    expected = [spectral_radius(monodromy(point)) for point in points]
    found = spectral_radius(stacked_half_period_monodromy(columns, 1e-12, 1e-12))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.full
def test_rivals_of_the_forced_motion_and_of_attractors_find_it():
    """The references of the new studies, against each other."""
    region = cardan.MOTIONS["orbit"]
    found = cardan.scipy_shooting(region, 1e-9)
    np.testing.assert_allclose(found, nonlinear_orbit(region.point)[0], rtol=0, atol=1e-9 * np.abs(found).max())
    values = rattle.LIMITS["attractor, both flanks"]
    periods = rattle.periods_to(values, 1e-6)
    states = np.array([scipy_events(values, 0.0, 0.0, periods, 1e-7)])
    assert rattle.limit_error("attractor, both flanks", None, states).error < 1e-5


def test_exact_shapes_are_those_of_lapack():
    gear = planetary.TABLE_2 | {"planet_angle": (0.0, 1.9, 4.4)}
    squares = extension_matrix(gear).T @ extension_matrix(gear)
    assert planetary.shape_error(gear, np.linalg.eigh(squares)[1].T).error < 1e-11


def test_the_plain_determinant_is_that_of_many_digits():
    shaft = {"length": (0.07, 0.59, 0.25), "EI": (64427.2, 22156.5, 8349.76), "rhoA": (15.288, 2.808, 5.5068)}
    shaft |= {"k_A": 85e6, "k_D": 20e6}
    for p in (100.0, 1500.0, 9000.0):
        exact = float(determinant(p**0.5, shaft)) * (1 + shaft["k_A"]) * (1 + shaft["k_D"])
        assert abs(transfer_determinant(p, shaft) / exact - 1) < 1e-11
