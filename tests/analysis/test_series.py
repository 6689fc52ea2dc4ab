"""Propagators as power series along a coordinate, against closed forms and direct solves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis.numerics.collocation import propagators_along
from drivetrain_jax.systems import LinearPeriodic
from tests.oracles.atlas_direct import BASE, CARDAN, monodromy, propagators

LANES = 3
X = np.array([1.0, -0.35, 0.0, 0.6])


def along(form, parts, x=X):
    phi, left_out = propagators_along(form, LANES, jnp.int64(parts), jnp.asarray(x))
    return np.moveaxis(np.asarray(phi), -1, 0), np.asarray(left_out)


def rotation(speed):
    """q' = x (1 + t) p, p' = -x (1 + t) q: a rotation by x (t + t^2/2), ``speed`` times as fast."""
    return LinearPeriodic(lambda t: ((0, speed * (1 + t)), (-speed * (1 + t), 0)), 1.5)


def test_a_rotation():
    found, left_out = along(rotation(2.0), 4)
    angle = 2.0 * X * (1.5 + 1.5**2 / 2)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    assert found[2] == pytest.approx(np.moveaxis(turn, -1, 0), abs=1e-13) and left_out.max() < 1e-12


def test_fewer_parts_leave_out_more_and_say_so():
    exact, _ = along(rotation(20.0), 200)
    before = np.inf
    for parts in (20, 30, 45):
        found, left_out = along(rotation(20.0), parts)
        error = np.abs(found - exact).max()
        # The error consists of the next term and of the truncation by the time nodes.
        assert error < 0.1 * before and error < 100 * left_out.max()
        before = error
    assert before < 1e-10


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "steepest"),
    [
        ({}, 1.569),
        pytest.param({"zeta": 0.0}, 1.57, marks=pytest.mark.full),
        pytest.param({"zeta": 0.1, "alpha": 3.0}, 1.3, marks=pytest.mark.full),
        pytest.param({"mu": 20.0, "gamma": 0.5}, 1.55, marks=pytest.mark.full),
    ],
)
def test_lines_of_the_cardan_shaft_against_direct_solves(change, steepest):
    """Propagators agree with direct solves at steep angles, with strong damping and at speeds down to 0.05."""
    fixed = {**BASE, **change}
    beta, omega = np.array([0.0, 1.0, steepest]), 0.05
    form = CARDAN.models["floquet"].build({**fixed, "beta": jnp.asarray(beta), "Omega": omega}).reduced
    x = np.array([1.0, 0.5, 0.02])
    found, left_out = jax.jit(lambda x: propagators_along(form, LANES, jnp.int64(250), x))(jnp.asarray(x))
    assert np.asarray(left_out).max() < 1e-14
    for k, angle in enumerate(beta):
        exact = propagators({**fixed, "beta": angle, "Omega": omega / x}).reshape(-1, 4, 4)
        error = np.linalg.norm(np.asarray(found)[..., k] - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
        assert error.max() < 3e-12


@pytest.mark.full
def test_very_slow_speeds():
    """Omega = 0.001 needs 10,000 panels. Reference: power series."""
    omega = [1.0, 1e-3, 1.1e-3]
    scene = {
        "system": "cardan",
        "analysis": "floquet",
        "outputs": ["spectral_radius", "spectral_radius_error"],
        "points": {"Omega": omega},
        "fixed": {**BASE, "beta": 1.2},
        "options": {"method": "direct"},
    }
    found = dt.run(scene)

    form = CARDAN.models["floquet"].build({**BASE, "beta": 1.2, "Omega": 1e-3}).reduced
    x = 1e-3 / np.array(omega)
    phi, left_out = jax.jit(lambda x: propagators_along(form, 1, jnp.int64(2500), x))(jnp.asarray(x))
    exact = np.abs(np.linalg.eigvals(monodromy(np.asarray(phi)[..., 0].reshape(3, 16)))).max(axis=1)
    assert float(left_out[0]) < 1e-13
    assert (np.abs(found.spectral_radius - exact) <= found.spectral_radius_error).all()
    assert found.spectral_radius.values == pytest.approx(exact, abs=1e-11)
