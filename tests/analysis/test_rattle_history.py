"""Histories of oscillators with play: the exact motion with its events, and averaged amplitude and phase."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.frequency_response.closed_form_response import cubic_fit
from drivetrain_jax.analysis.history.analysis import averaged_flow
from tests.oracles.rattle_reference import field
from tests.sizes import full_after

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())["transient"]
TABLE1 = dt.Rattle.presets["table1"]
GEARS = TABLE1 | {"omega": 0.86, "u0": 0.5, "v0": 0.5}
EXACT = ["u", "v", "acceleration", "event_time", "event_flank", "event_velocity", "event_count"]
AVERAGED = ["u", "v", "amplitude", "phase"]


def exact(values, times, outputs=("u", "v"), **options):
    return dt.history(dt.Rattle(**values), outputs=list(outputs), times=list(times), **options)


@pytest.mark.parametrize("case", full_after(3, REFERENCE), ids=lambda case: case["name"])
def test_transients_of_the_reference(case):
    """State after whole periods, and the number of crossings until then."""
    values = case["params"] | {"u0": float(case["u0"]), "v0": float(case["v0"])}
    period = 2 * math.pi / values["omega"]
    found = exact(values, [0.3 * period, case["periods"] * period], ["u", "v", "event_count"])
    slack = 1e-9 * max(1, case["sensitivity"] / 100)
    assert abs(float(found.u[-1]) - case["u"]) < slack and abs(float(found.v[-1]) - case["v"]) < slack
    assert int(found.event_count) == case["crossings"]


def test_motion_and_events_against_scipy():
    times = np.linspace(0, 60, 401)
    found = exact(GEARS, times, EXACT)
    flanks = [lambda t, y, b=side * TABLE1["b"]: y[0] - b for side in (1, -1)]
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "max_step": 0.05, "events": flanks}
    other = solve_ivp(field(GEARS), (0, 60), (0.5, 0.5), t_eval=times, **options)
    np.testing.assert_allclose(found.u, other.y[0], atol=2e-9)
    np.testing.assert_allclose(found.v, other.y[1], atol=2e-9)
    slopes = np.array([field(GEARS)(t, y)[1] for t, y in zip(times, other.y.T, strict=True)])
    np.testing.assert_allclose(found.acceleration, slopes, atol=1e-8)
    count, sizes = int(found.event_count), [len(t) for t in other.t_events]
    assert count == sum(sizes) and np.isnan(found.event_time[count:]).all() and (found.event_flank[count:] == 2).all()
    order = np.argsort(np.concatenate(other.t_events))
    np.testing.assert_allclose(found.event_time[:count], np.concatenate(other.t_events)[order], atol=1e-8)
    np.testing.assert_array_equal(found.event_flank[:count], np.repeat([0, 1], sizes)[order])
    rates = np.concatenate([y[:, 1] for y in other.y_events])[order]
    np.testing.assert_allclose(found.event_velocity[:count], rates, atol=1e-8)


@pytest.mark.full
def test_a_full_list_of_events_goes_on_counting():
    found, all_of_them = (exact(GEARS, [60.0], EXACT, most_events=n) for n in (3, 64))
    assert int(found.event_count) == int(all_of_them.event_count) > 3
    np.testing.assert_array_equal(found.event_time, all_of_them.event_time[:3])


def test_the_acceleration_is_that_of_the_vector_field():
    gears, times = dt.Rattle(**GEARS), [0.0, 1.0, 7.5]
    found = dt.history(gears, outputs=["u", "v", "acceleration"], times=times)
    rates = [gears.vector_field(t, jnp.stack([u, v])) for t, u, v in zip(times, found.u, found.v, strict=True)]
    np.testing.assert_allclose([r[1] for r in rates], found.acceleration, rtol=1e-12)
    np.testing.assert_array_equal([r[0] for r in rates], found.v)


@pytest.mark.full
def test_requested_times_do_not_change_the_motion():
    """The state after a hundred periods is the same up to rounding, even if times coincide with ends of drive periods."""
    period = 2 * math.pi / 0.86
    few = exact(GEARS, [50 * period, 100 * period])
    many = exact(GEARS, np.arange(1, 401) * period / 4)
    np.testing.assert_allclose(many.u[199::200], few.u, atol=1e-12)
    np.testing.assert_allclose(many.v[199::200], few.v, atol=1e-12)


def test_a_batch_is_its_points():
    omega = jnp.array([0.5, 0.86, 1.3])
    batch = jax.vmap(lambda w: exact(TABLE1 | {"omega": w}, [3.0, 40.0], EXACT))(omega)
    for i, w in enumerate(omega):
        alone = exact(TABLE1 | {"omega": float(w)}, [3.0, 40.0], EXACT)
        for name in EXACT:
            np.testing.assert_allclose(batch[name][i], alone[name], rtol=1e-12, atol=1e-13)


@pytest.mark.full
def test_derivatives_by_every_parameter():
    """Derivatives agree with central differences after many contacts and drive periods."""
    times = (5.0, 40.0)
    slopes = jax.jacrev(lambda g: dt.history(g, times=list(times)).u)(dt.Rattle(**GEARS))
    for name, value in GEARS.items():
        h = 1e-6 * max(abs(value), 0.1)
        up, down = (np.asarray(exact(GEARS | {name: value + d}, times).u) for d in (h, -h))
        numeric = (up - down) / (2 * h)
        np.testing.assert_allclose(getattr(slopes, name), numeric, atol=1e-6 * max(1, np.abs(numeric).max()))


def test_resonance_without_damping_is_not_finite():
    values = TABLE1 | {"omega": 1.0, "c": 0.0, "u0": 1.0}
    assert exact(values, [1.0]).outcome == Outcome.NOT_FINITE


def averaged(times, **options):
    found = dt.history(dt.Rattle(**GEARS), outputs=AVERAGED, method="slow_flow", times=list(times), **options)
    assert found.outcome == Outcome.SUCCESS
    return found


@pytest.mark.full
@pytest.mark.parametrize("reach", [0.0, 1.0])
def test_slow_flow_against_the_polar_equations(reach):
    """The slow flow agrees with (42), (43) by SciPy, from the amplitude and phase of the start."""
    times = np.linspace(0, 120, 31)
    found = averaged(times, fit_range=reach)
    model = dt.Rattle(**GEARS).oscillator()
    own = TABLE1["B1"] / TABLE1["c"]
    if not reach:
        # Self-consistent: R = B1/(c' sqrt(l1(R))).
        reach = 0.8
        for _ in range(60):
            reach = own / math.sqrt(float(cubic_fit(model, jnp.asarray(reach)).stiffness))
    fit = cubic_fit(model, jnp.asarray(reach))
    w0 = math.sqrt(float(fit.stiffness))
    mu, drive, bend = TABLE1["c"] / 2, TABLE1["B1"] / (2 * w0), 3 * float(fit.cubic) / (8 * w0)

    def polar(_, y):
        a, beta = y
        return -mu * a + drive * math.sin(beta), 0.86 - w0 - bend * a * a + drive * math.cos(beta) / a

    start = math.hypot(0.5, 0.5 / w0), math.atan2(0.5 / w0, 0.5)
    other = solve_ivp(polar, (0, 120), start, t_eval=times, method="DOP853", rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.amplitude, other.y[0], rtol=1e-8)
    turns = (np.asarray(found.phase) - other.y[1]) / (2 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-8)
    np.testing.assert_allclose([found.u[0], found.v[0]], [0.5, 0.5], rtol=1e-14)
    np.testing.assert_allclose(found.u, other.y[0] * np.cos(0.86 * times - other.y[1]), atol=1e-8)
    np.testing.assert_allclose(found.v, -w0 * other.y[0] * np.sin(0.86 * times - other.y[1]), atol=1e-8)


@pytest.mark.full
@pytest.mark.parametrize("sign", [1, -1])
def test_the_slow_flow_settles_at_the_response(sign):
    """The final amplitude and phase are those of a branch of ``frequency_response``, for a drive of either sign."""
    values = GEARS | {"B1": sign * TABLE1["B1"]}
    found = dt.history(dt.Rattle(**values), outputs=AVERAGED, method="slow_flow", times=[1500.0])
    line = dt.Rattle(**{name: x for name, x in values.items() if name not in ("u0", "v0")})
    steady = dt.frequency_response(line, method="averaging", outputs=["branch_u_max", "phase"])
    distance = np.abs(np.asarray(steady.branch_u_max) - float(found.amplitude[0]))
    assert np.nanmin(distance) < 1e-10
    if np.nanargmin(distance) == 0:
        assert float(found.phase[0]) == pytest.approx(float(steady.phase[0]), abs=1e-9)


@pytest.mark.full
def test_averaging_gives_the_equations_of_multiple_scales():
    """(59), (60) averaged by quadrature over the fast phase are (42), (43), and `averaging` is `multiple_scales`."""
    model = dt.Rattle(**GEARS).oscillator()
    reach = jnp.asarray(1.0)
    flow, w0 = averaged_flow(model, reach, jnp.asarray(0.1), jnp.asarray(0.0))
    cubic = float(cubic_fit(model, reach).cubic)
    theta = 2 * np.pi * np.arange(64) / 64
    for a, beta in ((0.3, 0.4), (0.8, 2.0), (0.05, -1.3)):
        rest = TABLE1["c"] * a * w0 * np.sin(theta) - cubic * (a * np.cos(theta)) ** 3
        rest = rest + TABLE1["B0"] + TABLE1["B1"] * np.cos(theta + beta)
        slow_a = -np.mean(rest * np.sin(theta)) / w0
        slow_beta = 0.86 - w0 + np.mean(rest * np.cos(theta)) / (a * w0)
        rates = flow.field((), (a * math.cos(beta), a * math.sin(beta)))
        turned = complex(*map(float, rates)) * np.exp(-1j * beta)
        np.testing.assert_allclose([turned.real, turned.imag / a], [slow_a, slow_beta], atol=1e-14)
    scene = {"system": "rattle", "analysis": "frequency_response", "fixed": TABLE1}
    found = dt.run(scene | {"axes": {"omega": {"values": [0.7, 0.9]}}, "options": {"method": "averaging"}})
    assert found.attrs["method"] == "multiple_scales"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"outputs": ["amplitude"]}, "method exact does not give amplitude; expected slow_flow"),
        ({"outputs": ["event_time"], "method": "slow_flow"}, "expected exact"),
        ({"method": "diffrax"}, "unknown"),
        ({"rtol": 1e-6}, "not used by method exact, but by slow_flow"),
    ],
)
def test_refusals(given, said):
    with pytest.raises(dt.InputError, match=said):
        dt.history(dt.Rattle(**GEARS), times=[1.0], **given)


def test_an_oscillator_far_faster_than_its_drive_is_not_begun():
    """It made a batch wait for hours: the contact's fastest rate is 1e14, and a period lasts 7 s."""
    fast = {"B0": 88.0, "B1": 0.0, "b": 2e-13, "c": 3e7, "alpha": 2e8, "k": 3e-15, "I": 0.64, "omega": 0.9, "u0": -1e3}
    found = exact(fast, [5.0, 10.0])
    assert found.outcome == Outcome.STEP_LIMIT and np.isnan(found.u).all()


@pytest.mark.parametrize("omega", full_after(1, [1e-9, 1e-15, 1e-200]))
def test_a_short_part_of_a_long_period_is_computed(omega):
    """The drive stands still. The least step was a part of its period, and carried the motion over contacts."""
    times = [1.0, 5.0, 10.0, 20.0]
    found = exact(GEARS | {"omega": omega}, times, ["u", "event_count"])
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "max_step": 0.02}
    other = solve_ivp(field(GEARS | {"omega": 0.0}), (0, 20), (0.5, 0.5), t_eval=times, **options)
    assert found.outcome == Outcome.SUCCESS and found.event_count == 10
    np.testing.assert_allclose(found.u, other.y[0], atol=1e-9)


def test_derivatives_at_whole_periods():
    """A requested time at which the march already stands moves with the frequency."""
    values = {"B0": 0.05, "B1": 0.3, "b": 0.1, "c": 0.2, "alpha": 0.3, "k": 1.0, "I": 1.0, "u0": 0.5}
    at = jax.jit(lambda omega: dt.history(dt.Rattle(omega=omega, **values), times=[5.0, 8.0, 20.0]).u)
    omega = 2 * math.pi / 5
    found = jax.jacfwd(at)(omega)
    expected = [(at(omega + h) - at(omega - h)) / (2 * h) for h in (1e-4, 2e-4)]
    np.testing.assert_allclose(found, (4 * expected[0] - expected[1]) / 3, rtol=1e-6)
