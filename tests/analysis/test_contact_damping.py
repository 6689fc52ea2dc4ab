"""A damper that acts in contact only: motions, multipliers and derivatives against independent computations."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

import drivetrain_jax as dt

TABLE = dict(dt.Rattle.presets["table1"])
# Free vibration in a gap of 45 degrees; displacements at .2 s and 1 s by an independent program.
FREE = {"omega": 1.0, "B0": 0.0, "B1": 0.0, "b": math.radians(22.5), "c": 50.0, "alpha": 0.0, "k": 20e3, "I": 5.0}


def test_free_vibration_loses_energy_in_contact_only():
    gears = dt.Rattle(**FREE, u0=math.radians(90), damping="contact")
    np.testing.assert_allclose(dt.history(gears, times=[0.2, 1.0]).u, [-0.939, 0.365], atol=5e-4)


@pytest.mark.full
@pytest.mark.parametrize(("omega", "multiple"), [(0.7, 1), (0.45, 2)])
def test_multipliers_and_derivatives_are_those_of_the_motion(omega, multiple):
    """Against differences of the exact motion over a period, with contact on both flanks and on one."""

    def solved(c):
        gears = dt.Rattle(omega=omega, damping="contact", **(TABLE | {"c": c}))
        return dt.steady_state(gears, outputs=["u_max", "spectral_radius", "orbit_state", "period_multiple"])

    def after_a_period(state):
        gears = dt.Rattle(omega=omega, damping="contact", u0=float(state[0]), v0=float(state[1]), **TABLE)
        found = dt.history(gears, times=[2 * math.pi * multiple / omega])
        return np.array([found.u[0], found.v[0]])

    orbit = solved(TABLE["c"])
    assert orbit.period_multiple == multiple
    state = np.asarray(orbit.orbit_state)
    np.testing.assert_allclose(after_a_period(state), state, atol=1e-13)
    steps = 1e-6 * np.eye(2)
    matrix = np.stack([(after_a_period(state + h) - after_a_period(state - h)) / 2e-6 for h in steps], axis=1)
    assert orbit.spectral_radius == pytest.approx(abs(np.linalg.eigvals(matrix)).max(), rel=1e-7)
    for name in ("u_max", "spectral_radius"):
        slope = jax.grad(lambda c, name=name: getattr(solved(c), name))(TABLE["c"])
        apart = [float(getattr(solved(TABLE["c"] + h), name)) for h in (1e-5, -1e-5)]
        assert slope == pytest.approx((apart[0] - apart[1]) / 2e-5, rel=1e-6)


@pytest.mark.full
def test_each_contact_begins_once_in_any_batch():
    """The factor of a flank is in the matrix once, however compiled code rounds the displacement there."""
    rng, count = np.random.default_rng(2), 20
    values = {
        "omega": 10 ** rng.uniform(-0.7, 0.6, count),
        "B0": rng.normal(size=count) * 10 ** rng.uniform(-2, 0, count),
        "B1": rng.normal(size=count) * 10 ** rng.uniform(-2, 0, count),
        "b": 10 ** rng.uniform(-2, 0, count),
        "c": 10 ** rng.uniform(-1.5, 0.7, count),
        "alpha": np.where(rng.random(count) < 0.3, 0, 10 ** rng.uniform(-2, 0.7, count)),
        "k": 10 ** rng.uniform(-0.3, 2, count),
        "I": np.ones(count),
        "u0": rng.normal(size=count),
        "v0": rng.normal(size=count),
    }
    names = "u_max u_min u_mean u_rms phase spectral_radius impacts impact_velocity contact_fraction orbit_state "
    names += "period_multiple regime state_error lyapunov_exponent"

    def solved(point):
        gears = dt.Rattle(**point, damping="contact")
        return dt.steady_state(gears, outputs=names.split(), most_periods=500).spectral_radius

    batch = jax.vmap(solved)(values)
    # By central differences of the exact motion, with events by SciPy.
    assert batch[6] == pytest.approx(0.011372024990, rel=1e-8)


@pytest.mark.full
def test_sweeps_and_branches_pass_through_the_steady_states():
    scene = {
        "system": "rattle",
        "axes": {"omega": {"values": [0.66, 0.8, 1.0]}},
        "fixed": {**TABLE, "damping": "contact"},
    }
    swept = dt.run(scene | {"analysis": "frequency_response", "outputs": ["u_max", "branch_u_max"]})
    steady = dt.run(scene | {"analysis": "steady_state", "outputs": ["u_max"]})
    np.testing.assert_allclose(swept.u_max.sel(sweep_direction="down"), steady.u_max, rtol=1e-9)
    assert (abs(swept.branch_u_max - steady.u_max).min("branch") < 1e-9).all() and not swept.outcome.any()


@pytest.mark.parametrize("method", ["harmonic_balance", "multiple_scales", "describing_function"])
def test_approximations_refuse_it(method):
    scene = {"system": "rattle", "analysis": "frequency_response", "options": {"method": method}}
    scene |= {"axes": {"omega": {"values": [0.7, 0.8]}}, "fixed": {**TABLE, "damping": "contact"}}
    with pytest.raises(
        dt.InputError, match=rf"^options\.method = '{method}': expected 'exact' for a damper in contact only$"
    ):
        dt.run(scene)
