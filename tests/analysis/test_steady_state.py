"""Attractors, their measures, and the branches and special points of exact orbits, against the reference values."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome, Request, get_analysis
from drivetrain_jax.analysis.impacts import attractor, exact_response
from drivetrain_jax.analysis.impacts.attractor import Attractors, attractors
from drivetrain_jax.analysis.impacts.exact_response import describe, sweeps
from drivetrain_jax.analysis.impacts.orbit_measures import measure
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.systems import PiecewiseLinearOscillator, get_system
from drivetrain_jax.systems.rattle import PRESETS, Rattle

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())
STEADY = REFERENCE["steady"]
TABLE1 = PRESETS["table1"]
ANALYSIS = get_analysis("steady_state")
NAMES = ("omega", "B0", "B1", "b", "c", "alpha", "k", "I", "u0", "v0")


def request(**options):
    defaults = {p.name: p.default for p in ANALYSIS.options}
    return Request(tuple(v.name for v in ANALYSIS.variables), "exact", defaults | options)


@pytest.fixture(scope="module")
def steady():
    """The compiled solver over all parameters, for up to 64 points."""
    solver, _ = ANALYSIS.solvers(get_system("rattle"), request(most_periods=800))
    compiled = jax.jit(lambda columns: solver.solve(columns, jnp.int32(1)))

    def solve(cases):
        count = len(cases)
        padded = cases + [TABLE1 | {"omega": 2.5}] * (64 - count)
        results = compiled({name: jnp.array([float(case.get(name, 0.0)) for case in padded]) for name in NAMES})
        return {name: np.asarray(value)[..., :count] for name, value in results.items()}

    return solve


def from_orbits(factor=1.0):
    return [c["params"] | {"u0": factor * c["z0"][0], "v0": factor * c["z0"][1]} for c in STEADY]


def test_every_steady_reference_value(steady):
    found = steady(from_orbits(1 + 1e-4))
    assert np.all(found["outcome"] == Outcome.SUCCESS)
    for i, case in enumerate(STEADY):
        name = case["name"]
        assert found["period_multiple"][i] == case["period_multiple"], name
        for ours, theirs in (("u_max", "max"), ("u_min", "min"), ("u_mean", "mean"), ("u_rms", "rms")):
            assert found[ours][i] == pytest.approx(case[theirs], abs=1e-9), (name, ours)
        assert np.cos(found["phase"][i] - case["phase_lag_rad"]) > 1 - 1e-15, name
        assert found["spectral_radius"][i] == pytest.approx(max(case["floquet_abs"]), abs=1e-8), name
        np.testing.assert_array_equal(found["impacts"][:, i], [case["drive_impacts"], case["back_impacts"]], name)
        fractions = [case["frac_drive"], case["frac_back"]]
        np.testing.assert_allclose(found["contact_fraction"][:, i], fractions, atol=1e-9, err_msg=name)
        assert found["impact_velocity"][:, i].max() == pytest.approx(case["v_impact_max"], abs=1e-9), name


def test_the_error_estimate_covers_the_error(steady):
    found = steady(from_orbits(1 + 1e-4))
    single = [i for i, case in enumerate(STEADY) if case["period_multiple"] == 1]
    error = np.abs(found["orbit_state"][0] - [c["z0"][0] for c in STEADY])[single]
    assert np.all(error <= found["state_error"][single] + 1e-14)
    assert found["state_error"].max() < 1e-10


def test_multipliers_obey_liouville(steady):
    found = steady(from_orbits(1 + 1e-4))
    product = np.prod(found["floquet_multiplier"], axis=0)
    span = [c["period_multiple"] * 2 * np.pi / c["params"]["omega"] for c in STEADY]
    exact = np.exp([-c["params"]["c"] * t for c, t in zip(STEADY, span, strict=True)])
    np.testing.assert_allclose(product, exact, rtol=1e-12)


def test_the_attractor_is_the_one_that_the_motion_reaches(steady):
    """The attractor agrees with the motion itself after 480 periods."""
    rng = np.random.default_rng(5)
    cases = []
    for _ in range(48):
        case = TABLE1 | {"omega": rng.uniform(0.6, 1.5), "B1": rng.uniform(0.01, 0.06), "alpha": rng.uniform(0, 1.5)}
        cases.append(case | {"u0": rng.uniform(-1, 1), "v0": rng.uniform(-1, 1)})
    found = steady(cases)
    table = {name: jnp.array([case[name] for case in cases]) for name in NAMES}

    @jax.jit
    def settled(values):
        lanes = prepare(Rattle.models["basins"].build(values))
        return march(lanes, start(lanes, values["u0"], values["v0"], jnp.full(48, 480, jnp.int32)), 100_000)

    motion = settled(table)
    # Compare motions of period one only: others may be shifted by whole drive periods.
    periodic = np.isin(found["period_multiple"], (1,))
    assert periodic.sum() > 35
    assert np.abs(found["orbit_state"][0] - motion.u)[periodic].max() < 1e-6
    assert np.abs(found["orbit_state"][1] - motion.v)[periodic].max() < 1e-6


def test_chaos_is_non_periodic_with_its_exponent(steady):
    cases = [TABLE1 | {"alpha": 0.0, "B1": 0.2, "omega": w} for w in (1.2, 1.5)]
    found = steady(cases)
    np.testing.assert_array_equal(found["period_multiple"], 0)
    np.testing.assert_array_equal(found["regime"], 3)
    np.testing.assert_array_equal(found["outcome"], Outcome.SUCCESS)
    # Averages over only 600 periods.
    np.testing.assert_allclose(found["lyapunov_exponent"], [0.057, 0.097], atol=0.02)


@pytest.mark.full
def test_the_exponent_of_chaos_is_the_mean_growth_of_a_tangent():
    """The exponent is right even if most_periods is no multiple of 4; few periods keep rounding small."""
    case, most = TABLE1 | {"alpha": 0.0, "B1": 0.2, "omega": 1.2}, 67
    scene = {"system": "rattle", "analysis": "steady_state", "outputs": ["lyapunov_exponent", "regime"]}
    found = dt.run(scene | {"points": {k: [v] for k, v in case.items()}, "options": {"most_periods": most}})
    lanes = prepare(Rattle.models["basins"].build({k: jnp.array([v]) for k, v in case.items()}))
    one_period = jax.jit(lambda u, v: march(lanes, start(lanes, u, v, jnp.asarray(1, jnp.int32)), 100_000))
    u = v = jnp.zeros(1)
    tangent, growth = np.array([0.6, 0.8]), []
    for _ in range(most):
        end = one_period(u, v)
        u, v, tangent = end.u, end.v, np.array(end.matrix).reshape(2, 2) @ tangent
        size = abs(tangent[0]) + abs(tangent[1]) / case["omega"]
        growth.append(np.log(size))
        tangent = tangent / size
    assert found["regime"].item() == 3
    mean = np.mean(growth[most // 4 :]) * case["omega"] / (2 * np.pi)
    assert found["lyapunov_exponent"].item() == pytest.approx(mean, rel=3e-3)


def test_a_lane_alone_is_the_lane_in_its_batch(steady):
    cases = from_orbits()[:12]
    together, alone = steady(cases), steady(cases[4:5])
    for name, values in alone.items():
        np.testing.assert_array_equal(values[..., 0], together[name][..., 4], name)


@pytest.mark.full
def test_underdamped_motions_have_a_faster_solver_with_the_same_results(steady):
    """Without a spring in the gap, or with strong damping, the solver for oscillating free motion does not apply."""
    names = ("u_max", "u_min", "spectral_radius", "period_multiple")
    both = ANALYSIS.solvers(get_system("rattle"), Request(names, "exact", request(most_periods=800).options))
    edge = {"k": 4.0, "I": 1.0, "alpha": 0.25, "c": 2.0}
    damped = [TABLE1 | {"omega": 0.7} | change for change in ({"alpha": 0.0}, {"c": 1.01}, {"c": 0.99}, edge)]
    table = {name: np.array([float(case.get(name, 0.0)) for case in damped]) for name in NAMES}
    assert np.isfinite(both[1].effort(table)).tolist() == [False, False, True, False]
    cases = [case for case in from_orbits() if case["alpha"] > (case["c"] / 2) ** 2][:16]
    table = {name: jnp.array([float(case.get(name, 0.0)) for case in cases]) for name in NAMES}
    found, general = jax.jit(lambda columns: both[1].solve(columns, jnp.int32(1)))(table), steady(cases)
    for name in names:
        np.testing.assert_allclose(found[name], general[name], rtol=1e-11, atol=1e-13, err_msg=name)


def test_an_undamped_motion_does_not_settle_and_says_so(steady):
    found = steady([TABLE1 | {"c": 0.0, "omega": 0.7, "B1": 0.001, "u0": 0.3}, TABLE1 | {"omega": 0.7}])
    assert found["outcome"][0] == Outcome.NOT_CONVERGED and np.isnan(found["u_max"][0])
    assert found["outcome"][1] == Outcome.SUCCESS


@pytest.mark.full
def test_sweeps_jump_where_the_folds_are():
    omega = np.arange(0.74, 0.885, 0.002)
    found = jax.jit(lambda w: sweeps(Rattle.models["basins"].build(TABLE1 | {"omega": w})))(omega)
    assert np.all(found["outcome"] == Outcome.SUCCESS)
    swing = np.asarray(found["u_max"] - found["u_min"])
    up, down = (omega[:-1][np.abs(np.diff(swing[:, k])) > 0.2] for k in (0, 1))
    assert up.shape == down.shape == (1,)
    assert up[0] < 0.874372741 < up[0] + 0.002 and down[0] < 0.753850046 < down[0] + 0.002
    peak = np.argmax(swing[:, 0])
    assert swing[peak, 0] == pytest.approx(1.388317, abs=2e-4) and omega[peak] == pytest.approx(0.8717, abs=2e-3)


def test_a_motion_beside_a_period_doubling_is_found(steady):
    """Just beyond a period doubling a motion without Newton's method does not arrive within 2,000 periods."""
    found = steady([TABLE1 | {"omega": 0.1 + 15 * 2.4 / 159, "B1": 0.0005 + 50 * 0.0995 / 79}])
    assert found["outcome"][0] <= Outcome.TOLERANCE_NOT_MET and found["period_multiple"][0] > 0
    assert 0.98 < found["spectral_radius"][0] < 1


# Initial states (u0, v0) at omega = .755 whose motion comes near the low orbit and then ends on the high one.
DECEPTIVE = (
    (0.5215775691669651, -0.6393525366740063),
    (-0.20141797302680953, -0.4049613732416695),
    (0.0822821066084174, -0.6127611172405938),
)
# Slow multipliers with little damping, -.974 +- .043 i: the motion agrees with the linearisation for long and then leaves.
SLOWLY_TURNING = {
    "B0": 0.03536850717732474, "B1": 0.19509840689750588, "b": 0.28155540255385003, "c": 0.010425846488197542,
    "alpha": 0.40617438718382726, "omega": 1.2927647146195436, "u0": 0.8661239613011145, "v0": 0.8055098434824857,
}  # fmt: skip


def test_initial_states_lead_where_the_motion_goes(steady):
    """Near the fold at .75385 the basin of the low motion is small; reference: the motions after 600 periods."""
    place = np.linspace(-0.9, 0.9, 7)
    cases = [TABLE1 | {"omega": 0.755, "u0": u, "v0": v} for u, v in DECEPTIVE]
    cases += [TABLE1 | {"omega": 0.757, "u0": float(u), "v0": float(v)} for u in place for v in place]
    found = steady(cases)
    table = {name: jnp.array([case[name] for case in cases]) for name in NAMES}

    def end(values):
        lanes = prepare(Rattle.models["basins"].build(values))
        return march(lanes, start(lanes, values["u0"], values["v0"], jnp.full(len(cases), 600, jnp.int32)), 100_000).u

    assert np.all(found["outcome"] == Outcome.SUCCESS)
    np.testing.assert_allclose(found["orbit_state"][0], jax.jit(end)(table), rtol=0, atol=1e-5)


def test_a_motion_that_obeys_and_then_leaves_is_not_taken(steady):
    """The motion agrees with the linearisation for 13 periods, at distances from .13 to .1, and then ends elsewhere."""
    found = steady([TABLE1 | SLOWLY_TURNING])
    assert found["outcome"][0] == Outcome.NOT_CONVERGED or abs(found["orbit_state"][0, 0] + 0.06712527) > 0.1


def test_an_undamped_drive_at_resonance_has_no_value(steady):
    found = steady([TABLE1 | {"c": 0.0, "omega": 1.0}, TABLE1 | {"c": 0.0, "omega": 0.5}, TABLE1 | {"omega": 0.7}])
    assert np.all(found["outcome"][:2] == Outcome.NOT_FINITE) and np.isnan(found["u_max"][:2]).all()
    assert found["outcome"][2] == Outcome.SUCCESS


def test_an_overflow_is_no_steady_state(steady):
    found = steady([TABLE1 | {"omega": 0.7, "B1": 1.7e308}])
    assert found["outcome"] == Outcome.NOT_FINITE
    assert np.isnan(found["u_max"]).all() and not found["period_multiple"].any()


@pytest.mark.full
def test_an_unstable_orbit_is_no_steady_state():
    growing = PiecewiseLinearOscillator(damping=-0.1, stiffness=1.0, alpha=1.0, b=0.0, B0=0.0, B1=1.0, omega=2.0)
    orbit = 1.0 / (1 - 2.0**2 - 0.2j)
    start = jnp.array([orbit.real]), jnp.array([-2.0 * orbit.imag])
    count, none = jnp.ones(1, jnp.int32), jnp.zeros(1)
    found = Attractors(*start, count, (none,) * 4, none + 1e-15, count, none, 0 * count)
    seen = describe(growing.driven_at(jnp.array([2.0])), found, rtol=1e-10)
    assert seen["outcome"] == Outcome.NOT_CONVERGED and np.isnan(seen["spectral_radius"])


@pytest.mark.parametrize(
    ("omega", "multiple", "high", "low"), [(1.9, 4, 0.93220042, -3.14377962), (1.4, 3, 1.25707643, -4.71151325)]
)
def test_far_from_the_origin_the_motion_about_a_flank_is_the_same(steady, omega, multiple, high, low):
    """With the gap's spring in balance the motion is that of a bilinear oscillator about u = b."""
    bilinear = TABLE1 | {"alpha": 0.1, "k": 1.0, "I": 1.0, "c": 0.05, "B1": 1.0, "omega": omega}
    far = [1e3, 1e5, 1e7, 1e9, 1e13]
    found = steady([bilinear | {"b": b, "B0": 0.1 * b, "u0": b} for b in far])
    assert list(found["outcome"]) == [Outcome.SUCCESS] * 4 + [Outcome.TOLERANCE_NOT_MET]
    assert list(found["period_multiple"][:4]) == [multiple] * 4
    for name, exact in (("u_max", high), ("u_min", low)):
        assert np.all(np.abs(found[name][:4] - far[:4] - exact) <= 1e-8 + found["state_error"][:4])


@pytest.mark.parametrize("ripple", [0.0, 1e-13, 1e-12])
def test_gears_at_rest_under_load_are_a_steady_state(steady, ripple):
    """Gears rest at u = (1 - alpha) b + B0/(k/I), with a velocity of rounding."""
    still = TABLE1 | {"B1": ripple}
    found = steady([still | {"omega": omega} for omega in (1 / 3, *np.linspace(0.1, 5, 60))])
    assert np.all(found["outcome"] == Outcome.SUCCESS) and np.all(found["period_multiple"] == 1)
    rest = (1 - TABLE1["alpha"]) * TABLE1["b"] + TABLE1["B0"] * TABLE1["I"] / TABLE1["k"]
    for name in ("u_max", "u_min", "u_mean", "u_rms"):
        np.testing.assert_allclose(found[name], rest, atol=1e-13 + 30 * ripple)


def test_a_motion_without_a_fundamental_has_no_phase(steady):
    """A ripple of a hundred times the rounding of a motion at rest already has a phase."""
    omegas = np.linspace(0.2, 3.0, 30)
    none, some = (steady([TABLE1 | {"B1": ripple, "omega": omega} for omega in omegas]) for ripple in (0.0, 1e-11))
    assert np.isnan(none["phase"]).all() and np.all(none["outcome"] == Outcome.SUCCESS)
    lag = np.arctan2(TABLE1["c"] * omegas, 1 - omegas**2)
    np.testing.assert_allclose(some["phase"], lag, atol=1e-3)


GENTLE = {"omega": 1.35, "B0": 0.25, "b": 1.0, "c": 0.02, "alpha": 0.25, "k": 1.0, "I": 1.0}


@pytest.mark.full
@pytest.mark.parametrize(("drive", "above"), [(1e-5, 4.7868552319e-5), (1e-6, 4.786855232e-6), (1e-7, 4.78685528e-7)])
def test_a_flank_is_passed_however_gently(drive, above):
    """About a rest on the flank motions are similar at any scale; reference: Taylor series with 64 bits."""
    found = dt.point(
        "rattle", "steady_state", **GENTLE, B1=drive, u0=1 + 2 * drive, outputs=["u_max", "spectral_radius"]
    )
    assert found.outcome == Outcome.SUCCESS
    assert found.u_max - 1 == pytest.approx(above, rel=1e-7, abs=0)
    assert found.spectral_radius == pytest.approx(0.91111675664, abs=1e-9)


@pytest.mark.full
def test_a_motion_far_smaller_than_the_gap_has_its_extremes():
    outputs = ["u_max", "u_min", "u_rms"]
    found = dt.point(
        "rattle", "steady_state", **GENTLE | {"omega": 0.7, "B0": 0.0, "c": 0.1}, B1=1e-16, outputs=outputs
    )
    exact = 1e-16 / math.hypot(0.25 - 0.49, 0.07)
    assert [found.u_max, found.u_min] == pytest.approx([exact, -exact], rel=1e-10, abs=0)
    assert found.u_rms == pytest.approx(exact / math.sqrt(2), rel=1e-10, abs=0)


@pytest.mark.full
def test_transition_matrix_changes_at_the_flank():
    """Stiff contacts after long flights amplify the delay of each step at a flank; reference: 128-bit Taylor series.

    The radius changes by 2.3e4 per metre: the rounding of the orbit, 3e-12 m, explains 7e-8.
    """
    stiff = {"omega": 0.16774254954145118, "B0": 0.6614757353230992, "B1": 2.8471279515012524, "b": 2.034211854040951}
    stiff |= {"c": 0.12066008631247528, "alpha": 0.0, "k": 6027.824857365027, "I": 0.14705915661446092}
    start = {"u0": 0.4651093238943746, "v0": 0.9787693424178078}
    found = dt.point("rattle", "steady_state", **stiff, **start, outputs=["spectral_radius"])
    assert found.spectral_radius == pytest.approx(0.41481220923, abs=1e-7)


@pytest.mark.full
def test_slow_drive_without_a_spring_in_the_gap_shows_rounding():
    """The subtracted harmonic response is 3e5 times the motion; reference: Taylor series with 64 bits."""
    slow = {"omega": 5e-5, "B0": 0.01, "B1": 0.03, "b": math.pi / 18, "c": 1e-3, "alpha": 0.0, "k": 1.0, "I": 1.0}
    found = dt.point("rattle", "steady_state", **slow, most_periods=64, outputs=["u_rms", "state_error"])
    assert abs(found.u_rms - 0.1941257696104358) < found.state_error < 1e-8
    assert found.outcome == Outcome.TOLERANCE_NOT_MET


@pytest.mark.full
@pytest.mark.parametrize("outputs", [["impacts"], ["impacts", "u_rms"]])
def test_every_impact_is_counted_once(outputs):
    """Impacts agree with samples of the motion, for any outputs; a few percent were once missed or counted twice."""
    scene = {"system": "rattle", "analysis": "steady_state", "fixed": TABLE1}
    scene |= {"axes": {"omega": {"start": 0.1, "stop": 3.0, "num": 120}}}
    found, sampled = (dt.run(scene | {"outputs": names}) for names in (outputs, ["u_history"]))
    u = sampled.u_history.values
    side = np.where(u > TABLE1["b"], 1, np.where(u < -TABLE1["b"], -1, 0))
    counted = [np.sum((side == flank) & (np.roll(side, 1, axis=1) != flank), axis=1) for flank in (1, -1)]
    np.testing.assert_array_equal(found.impacts, np.transpose(counted))


def test_a_motion_of_far_too_many_steps_is_not_begun(steady):
    """A period that is 1e8 times the oscillator's would hold up a whole batch for minutes."""
    usual = TABLE1 | {"omega": 1.0}
    found = steady([usual, *(usual | {name: value} for name, value in (("c", 1e8), ("omega", 1e-8), ("I", 1e-16)))])
    assert list(found["outcome"]) == [Outcome.SUCCESS] + [Outcome.STEP_LIMIT] * 3
    assert np.isnan(found["u_max"][1:]).all()


@pytest.mark.full
def test_a_motion_stops_at_a_number_of_steps_in_all(monkeypatch):
    """Chaos never settles; without a budget it would end with ``most_periods``."""
    chaos = TABLE1 | {"alpha": 0.0, "B1": 0.2, "omega": 1.2, "u0": 0.0, "v0": 0.0}
    model = Rattle.models["steady_state"].build({name: jnp.full(1, chaos[name]) for name in NAMES})
    point, rest = jnp.zeros((1, 1), jnp.int32), jnp.zeros(1)

    def stalled():
        found = attractors(model, point, rest, rest, most_periods=300, width=1)
        return found.stalled.item(), found.periods.item()

    assert stalled() == (0, 300)
    monkeypatch.setattr(attractor, "_BUDGET", 500)
    monkeypatch.setattr(attractor, "_PER_PERIOD", 1)
    stopped, periods = stalled()
    assert stopped == 1 and 0 < periods < 300


@pytest.mark.full
def test_searches_count_as_steps_and_stopped_motions_are_not_measured(monkeypatch):
    """The first search is stopped, before a period has settled."""
    slow = TABLE1 | {"alpha": 0.0, "omega": 1e-3, "u0": 0.0, "v0": 0.0}
    model = Rattle.models["steady_state"].build({name: jnp.full(1, slow[name]) for name in NAMES})
    monkeypatch.setattr(attractor, "_BUDGET", 100)
    monkeypatch.setattr(attractor, "_PER_PERIOD", 0)
    found = attractors(model, jnp.zeros((1, 1), jnp.int32), jnp.zeros(1), jnp.zeros(1), most_periods=64, width=1)
    assert (found.stalled.item(), found.periods.item()) == (1, 0)
    measured = []
    monkeypatch.setattr(exact_response, "measure", lambda *of, **more: measured.append(of[1]) or measure(*of, **more))
    result = exact_response.describe(model, jax.tree.map(lambda x: x[:, 0], found), rtol=1e-10)
    assert np.isnan(measured[0]).all() and result["outcome"] == Outcome.STEP_LIMIT and np.isnan(result["u_max"])
