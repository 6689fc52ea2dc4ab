"""Coexisting forced orbits, their branches, and motions of the cardan shaft, against SciPy and closed forms."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import drivetrain_jax as dt
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.analysis.numerics.continuation import Mapped, folds_and_doublings, follow
from drivetrain_jax.analysis.numerics.linear_algebra import determinant
from drivetrain_jax.systems import get_system
from drivetrain_jax.systems.cardan import PRESETS
from tests.oracles.cardan_orbit_reference import geometry, nonlinear_field
from tests.quick_jit import quick_jit

BASE = PRESETS["base"]


@pytest.mark.full
def test_branches_of_the_shaft_have_the_orbits_of_single_points():
    scene = {"system": "cardan", "analysis": "frequency_response", "fixed": BASE | {"beta": 0.55}}
    found = dt.run(scene | {"axes": {"Omega": {"start": 0.65, "stop": 0.775, "num": 6}}})
    at = found.sel(Omega=0.725, method="nearest")
    np.testing.assert_allclose(at.branch_spectral_radius[:2], [1.000121, 0.999893], atol=1e-6)
    np.testing.assert_allclose(at.branch_amplitude.max("shaft")[:2], [0.4157, 0.7333], atol=1e-4)
    np.testing.assert_array_equal(at.branch_stability[:3], [1, 0, 1])
    np.testing.assert_allclose(found.fold_frequency[0, :2], [0.68966724, 0.72764226], atol=1e-8)
    np.testing.assert_array_equal((found.branch_stability < 2).sum("branch"), [1, 1, 3, 3, 1, 1])
    assert (found.outcome == 0).all()


def test_folds_and_doublings_of_a_map():
    """Orbits of y -> y + p - 1 - y^2: y^2 = p - 1, multiplier 1 - 2 y, so a fold at p = 1 and a doubling at p = 2."""

    def mapped(x):
        y, p = x
        return Mapped((y + p - 1 - y**2)[None], (1 - 2 * y)[None, None], jnp.ones_like(x[:1]), jnp.ones_like(y))

    start = jnp.asarray([[1.3], [2.69]])

    def branch():
        ends = {"attempts": 200, "limits": (0.5, 2.7)}
        return follow(mapped, start, jnp.ones((2, 1)), direction=jnp.asarray([-1.0]), **ends)

    found = quick_jit(branch)()
    x = found.x[np.isfinite(found.x[:, 0, 0]), :, 0]
    np.testing.assert_allclose(x[:, 0] ** 2, x[:, 1] - 1, atol=1e-12)
    assert x[-1, 0] < 0 and x[-1, 1] > 2.7
    shifted = quick_jit(lambda: folds_and_doublings(lambda _: mapped, found, (0.5, 2.7), 2, 4, 1))()
    np.testing.assert_allclose(shifted[0][:, 0, 0], [1.0, 2.0], atol=1e-9)
    assert np.isnan(shifted[0][:, 1:]).all() and shifted[1].all()


@pytest.mark.full
@pytest.mark.parametrize(
    ("beta", "zeta", "expected"),
    [
        (0.05, 1e-5, [1.415542246836, 1.416426686514]),
        (0.02, 1e-5, [1.415916730317, 1.416052539991]),
        (0.1, 1e-4, [1.414220311353, 1.417743392982]),
    ],
)
def test_doublings_of_a_narrow_tongue_are_found(beta, zeta, expected):
    """They are the edges that ``floquet`` of the equilibrium has, but for the small motion about it."""
    fixed = {"beta": beta, "zeta": zeta, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    axes = {"Omega": {"start": 1.35, "stop": 1.5, "num": 4}}
    found = dt.run({"system": "cardan", "analysis": "frequency_response", "axes": axes, "fixed": fixed})
    np.testing.assert_allclose(found.doubling_frequency[0, :2], expected, rtol=1e-9)
    assert (found.outcome == 0).all()


def test_determinants_are_those_of_numpy():
    a = np.random.default_rng(0).standard_normal((5, 5, 3))
    np.testing.assert_allclose(determinant(jnp.asarray(a)), np.linalg.det(np.moveaxis(a, -1, 0)), rtol=1e-12)


@pytest.mark.full
def test_history_of_the_shaft_against_scipy():
    start = {"theta1_0": 0.1, "theta2_0": -0.05, "theta1_rate_0": 0.2, "theta2_rate_0": 0.3}
    shaft = dt.Cardan(beta=0.8, Omega=1.3, **BASE, **start)
    found = dt.history(shaft, times=[1.0, 10.0], rtol=1e-9)
    p = geometry(BASE | {"beta": 0.8, "Omega": 1.3})
    exact = solve_ivp(
        nonlinear_field, (0, 10), list(start.values()), "DOP853", [1, 10], args=(p,), rtol=1e-12, atol=1e-13
    )
    names = ("theta1", "theta2", "theta1_rate", "theta2_rate")
    np.testing.assert_allclose([getattr(found, name) for name in names], exact.y, atol=1e-8)


@pytest.mark.full
def test_exponents_of_the_straight_shaft():
    """Without joint angle the first and the last exponent are real parts of eigenvalues; those between converge slowly."""
    damped = {"beta": 0.0, "Omega": 1.0, "zeta": 0.05, "alpha": 1.0, "mu": 1.0, "gamma": 2.0}
    found = dt.lyapunov(dt.Cardan(**damped, theta1_0=0.1), max_time=300.0)
    matrix = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, -0.1, 0.1], [1, -1.5, 0.1, -0.15]])
    expected = -np.sort(-np.linalg.eigvals(matrix).real)
    np.testing.assert_allclose(found.lyapunov_spectrum[::3], expected[::3], atol=2e-3)
    assert abs(float(found.sum_rule_residual)) < 1e-9 and math.isclose(sum(expected), -0.25)


def test_times_of_a_shaft_without_unit_are_angles():
    of_shaft, of_tripod = (get_analysis("lyapunov").for_system(get_system(name)) for name in ("cardan", "tripod"))
    assert [a.variable("lyapunov_spectrum").units for a in (of_shaft, of_tripod)] == ["1/rad", "1/s"]
    assert [a.options[1].units for a in (of_shaft, of_tripod)] == ["rad", "s"]
