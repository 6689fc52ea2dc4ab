"""Claims of the cardan paper against the package and SciPy: equations, criterion, damping, forced orbit."""

from __future__ import annotations

import numpy as np
import pytest

import drivetrain_jax as dt
from tests.oracles.cardan_orbit_reference import linear_response, nonlinear_orbit
from tests.oracles.cardan_paper import printed_matrices, unstable_fraction
from tests.oracles.cardan_reference import BASE_CASE, damping_and_stiffness

# Every tenth angle and speed of the base chart: 16 x 20 cells.
STRIDE = 10


def test_printed_equations_are_unstable_everywhere():
    assert unstable_fraction(printed_matrices(1.0), STRIDE)[0] > 0.98


def test_correcting_one_sign_alone_gives_a_blank_chart():
    assert unstable_fraction(printed_matrices(-1.0), STRIDE)[0] == 0


def test_second_clause_of_the_criterion_drops_most_cells():
    fraction, dropped = unstable_fraction(damping_and_stiffness, STRIDE)
    assert fraction == pytest.approx(0.256, abs=0.03)
    assert 0.6 < dropped < 0.8


@pytest.mark.full
@pytest.mark.parametrize(
    ("beta", "Omega", "about_orbit"),
    [
        (0.55, 0.725, 0.999893),
        (0.8, 1.3, 1.18959556),
        (0.5236, 1.416, 1.11394778),
    ],
)
def test_forced_response_and_orbit(beta, Omega, about_orbit):
    p = BASE_CASE | {"beta": beta, "Omega": Omega}
    outputs = ["periodic_state", "amplitude", "orbit_state", "orbit_amplitude", "orbit_spectral_radius"]
    points = {"beta": [beta], "Omega": [Omega]}
    scene = {"system": "cardan", "analysis": "forced", "outputs": outputs, "points": points, "fixed": BASE_CASE}
    ds = dt.run(scene).isel(point=0)
    state, amplitude = linear_response(p)
    np.testing.assert_allclose(ds.periodic_state, state, rtol=1e-7, atol=1e-9)
    # SciPy's maximum is over 4001 instants.
    np.testing.assert_allclose(ds.amplitude, amplitude, rtol=1e-5)
    # Two digits decide which one of several orbits Newton's method finds.
    state, amplitude, rho = nonlinear_orbit(p, np.round(ds.orbit_state.values, 2))
    np.testing.assert_allclose(ds.orbit_state, state, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(ds.orbit_amplitude, amplitude, rtol=1e-5)
    assert float(ds.orbit_spectral_radius) == pytest.approx(rho, rel=1e-8)
    assert float(ds.orbit_spectral_radius) == pytest.approx(about_orbit, abs=1e-5 if about_orbit < 1.01 else 1e-8)
