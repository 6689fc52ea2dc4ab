"""Time histories by diffrax: closed forms, error estimates, drift, lanes that fail."""

from __future__ import annotations

import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import lorenz
from scipy.integrate import solve_ivp

import drivetrain_jax as dt
from drivetrain_jax import systems
from drivetrain_jax._errors import InputError
from drivetrain_jax.analyses import analyse
from drivetrain_jax.analysis import Outcome, Request
from drivetrain_jax.analysis.history import analysis as history
from drivetrain_jax.analysis.history import integration
from drivetrain_jax.analysis.numerics.kernels import options_for_few
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems import Component, Flow, ForcedModel, System, parameter, serves
from tests.oracles import tripod_reference as oracle
from tests.sizes import full_after

NINE_DEGREES = math.radians(9)
FIXED = {"element": "input", "equation": "25", "beta": NINE_DEGREES}
TIMES = (0.0, 0.001, 0.004, 0.02)
# A free linear oscillator; one outside its model (c1 > 1, g < 0); a large swing; the paper's case.
POINTS = {
    "chi_n": [0.0, 0.6, 0.3, 0.0026],
    "zeta": [0.02, 0.02, 0.0016, 0.0073],
    "phi0": [0.3, math.pi / 2, 0.5, 0.0],
    "velocity0": [500.0, 0.0, 0.0, 0.0],
    "M_AEM": [0.0, 2550.0, 2550.0, 2550.0],
}
FREE, ENDS, LARGE, PAPER = range(4)
OUTPUTS = ["phi", "velocity", "phi_error", "velocity_error"]


def scene(options: dict, **more: object) -> dict:
    return {"system": "tripod", "analysis": "history", "outputs": OUTPUTS, "fixed": FIXED, "options": options} | more


@pytest.fixture(scope="module")
def histories():
    return dt.run(scene({"times": list(TIMES), "rtol": 1e-9}, points=POINTS))


def test_free_linear_oscillator_has_its_closed_form(histories):
    omega, zeta, t = oracle.shaft("input").omega, 0.02, np.array(TIMES)
    damped = omega * math.sqrt(1 - zeta**2)
    decay, sine, cosine = np.exp(-zeta * omega * t), np.sin(damped * t), np.cos(damped * t)
    slope = (500.0 + zeta * omega * 0.3) / damped
    phi = decay * (0.3 * cosine + slope * sine)
    velocity = decay * (500.0 * cosine - (zeta * omega * slope + damped * 0.3) * sine)
    np.testing.assert_allclose(histories.phi[FREE], phi, rtol=0, atol=3e-10)
    np.testing.assert_allclose(histories.velocity[FREE], velocity, rtol=0, atol=3e-10 * omega)


def test_histories_against_scipy(histories):
    for k in (LARGE, PAPER):
        start = (POINTS["phi0"][k], 0.0)
        phi, velocity = oracle.history("25", TIMES, POINTS["zeta"][k], POINTS["chi_n"][k], start=start)
        size = max(0.5 * start[0], 1e-4)
        np.testing.assert_allclose(histories.phi[k], phi, rtol=0, atol=3e-9 * size)
        np.testing.assert_allclose(histories.velocity[k], velocity, rtol=0, atol=3e-9 * size * 1e4)


def test_error_estimate_holds_and_is_of_use(histories):
    for k in (LARGE, PAPER):
        start = (POINTS["phi0"][k], 0.0)
        exact = oracle.history("25", TIMES, POINTS["zeta"][k], POINTS["chi_n"][k], start=start)
        for name, values in zip(("phi", "velocity"), exact, strict=True):
            error, bound = np.abs(histories[name][k] - values), histories[f"{name}_error"][k]
            # SciPy's own error, 1e-11 of the size, is the limit of the comparison.
            assert (error <= bound + 2e-11 * np.abs(values).max()).all()
            assert bound.max() < 1e-8 * np.abs(values).max()
            assert bound[-1] > 0


def test_one_bad_lane_is_an_outcome_and_spoils_no_other(histories):
    names = histories.outcome.attrs["flag_meanings"].split()
    assert [names[i] for i in histories.outcome.values] == ["success", "not_finite", "success", "success"]
    assert np.isnan(histories.phi[ENDS, 1:]).all()
    good = {name: values[LARGE:] * 2 for name, values in POINTS.items()}
    alone = dt.run(scene({"times": list(TIMES), "rtol": 1e-9}, points=good))
    np.testing.assert_allclose(alone.phi[:2], histories.phi[LARGE:], rtol=1e-9, atol=1e-15)


LONG = {"element": "input", "equation": "29", "beta": 0.157, "zeta": 1e-9, "chi_n": 0.0, "M_AEM": 0.0}
LONG |= {"phi0": 1e-3, "excitation_frequency": 1000.0}


@pytest.mark.full
@pytest.mark.parametrize("rtol", [1e-6, 1e-3])
def test_long_memory_meets_the_target(rtol):
    """1500 undamped oscillations: steps for a short memory exceed the target 12 to 26 times."""
    omega = float(dt.point("tripod", "parameters", element="input", beta=0.157, chi_n=0.0).natural_angular_frequency)
    found = dt.run(scene({"times": [1.0], "rtol": rtol}, fixed=LONG, outputs=["phi"]))
    assert found.outcome.attrs["flag_meanings"].split()[int(found.outcome)] == "success"
    exact = 1e-3 * math.exp(-1e-9 * omega) * math.cos(omega * math.sqrt(1 - 1e-18))
    assert float(found.phi[0]) == pytest.approx(exact, abs=1e-3 * rtol)


@pytest.mark.parametrize(
    ("solver", "frequency", "rtol", "end"),
    full_after(
        1,
        [
            ("Dopri8", 20e3, 1e-7, 0.2),
            ("Dopri8", 12e3, 1e-5, 0.2),
            ("Tsit5", 40e3, 1e-5, 0.1),
            ("Kvaerno5", 60e3, 1e-4, 0.1),
        ],
        several=True,
    ),
)
def test_errors_of_strobes_of_one_step_are_told(solver, frequency, rtol, end):
    """One step per strobe meets any tolerance of a step, but its errors add up, in some cases beyond the target."""
    fixed = LONG | {"equation": "25", "excitation_frequency": frequency}
    omega = float(dt.point("tripod", "parameters", element="input", beta=0.157, chi_n=0.0).natural_angular_frequency)
    found = dt.run(scene({"times": [end / 2, end], "rtol": rtol, "solver": solver}, fixed=fixed))
    times = found.time.values
    error = np.abs(found.phi - 1e-3 * np.exp(-1e-9 * omega * times) * np.cos(omega * times)).values
    # The closed form is known up to the rounding of its phase.
    assert (error <= found.phi_error.values + 1e-16 * omega * end * 1e-3).all()
    assert error.max() < 1e-3 * rtol
    assert found.phi_error.max() > 1e-15
    assert found.outcome == Outcome.SUCCESS


SMALL_TIMES = [8.599242134871764e-06, 7e-5, 0.00016045592865949728]
SMALL_PHI = [1.2821017705e-06, 9.8387921093e-05, 4.1201858577e-05]


@pytest.mark.full
def test_errors_are_judged_by_what_the_motion_reaches():
    """A torque with a static twist of 16,000 rad moves the shaft by 1e-4 rad; reference: extrapolation in quadruple
    precision."""
    fixed = {"element": "input", "equation": "29", "torque_reading": "harmonic", "beta": 1.5707788521486836}
    fixed |= {"zeta": 1.836882956274104e-10, "chi_n": -0.3682093308629297, "velocity0": 0.06097371567118005}
    fixed |= {"M_AEM": 33521620.341835044, "G": 6263419.058853511, "rho": 177.70386264775507}
    fixed |= {"excitation_frequency": 180.52219606105336}
    options = {"times": SMALL_TIMES, "rtol": 0.003976833237362977}
    found = dt.run(scene(options, fixed=fixed))
    np.testing.assert_allclose(found.phi, SMALL_PHI, rtol=0, atol=1e-3 * 1e-4)
    assert (np.abs(found.phi - np.array(SMALL_PHI)) <= found.phi_error).all()
    assert found.outcome == Outcome.SUCCESS


@pytest.mark.full
def test_outcome_does_not_depend_on_the_outputs():
    options = {"times": [1.0], "rtol": 1e-13}
    outcomes = [int(dt.run(scene(options, fixed=LONG, outputs=o)).outcome) for o in (["phi"], ["phi", "phi_error"])]
    assert outcomes == [Outcome.TOLERANCE_NOT_MET] * 2


@pytest.mark.full
@pytest.mark.parametrize("end", [0.75, pytest.param(16.5, marks=pytest.mark.full)])
def test_phase_does_not_drift(end):
    """Excitation at 3200 Hz and motor at 300 Hz repeat after 32 strobes, and so does the settled motion."""
    fixed = FIXED | {"equation": "29", "zeta": 0.03, "chi_n": 0.3, "excitation_frequency": 3200.0}
    options = {"times": [0.5, end], "rtol": 1e-11}
    ds = dt.run(scene(options, fixed=fixed, outputs=["phi", "velocity"]))
    assert (end - 0.5) * 3200 % 32 == 0
    assert float(ds.phi[0]) > 1e-5
    assert float(ds.phi[1] - ds.phi[0]) == pytest.approx(0, abs=1e-12 * 1e-4)
    assert float(ds.velocity[1] - ds.velocity[0]) == pytest.approx(0, abs=1e-12 * 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "options.times: missing; expected times, or stop and num"),
        ({"times": [0.1], "stop": 0.2}, "options.stop = 0.2: given together with times"),
        ({"times": [0.2, 0.1]}, "options.times: expected rising times"),
        ({"times": [-0.1, 0.1]}, r"options.times\[0\] = -0.1: expected 0 <= times"),
        ({"stop": 0.1, "num": 1}, "options.num = 1: expected integer 2 <= num"),
    ],
)
def test_times_are_checked(options, message):
    with pytest.raises(InputError, match=message):
        load_scene(scene(options, fixed=FIXED | {"zeta": 0.01}))


def test_stop_and_num_are_equal_steps():
    dimension = load_scene(scene({"stop": 0.1, "num": 5}, fixed=FIXED | {"zeta": 0.01})).dimensions[0]
    assert dimension.values == pytest.approx((0.0, 0.025, 0.05, 0.075, 0.1), rel=1e-15)
    assert dimension.units == "s"


def test_hopelessly_many_strobes_are_not_begun():
    ds = dt.run(scene({"times": [1e6]}, fixed=FIXED | {"zeta": 0.01}))
    assert ds.outcome.attrs["flag_meanings"].split()[int(ds.outcome)] == "step_limit"
    assert np.isnan(ds.phi).all()


class Lorenz(System):
    """A system with three components under its own names."""

    name = "lorenz"
    title = "Lorenz"
    state = (Component("x", "m", "width"), Component("y", "m", "depth"), Component("z", "K", "heat"))

    @serves("history")
    def flow(self):
        start = (1.0, 1.0, 20.0)
        return Flow(lorenz(1).field, start, period=0.5)


def test_a_system_names_the_components_of_its_state():
    variables = history.ANALYSIS.for_system(Lorenz).variables
    assert [v.name for v in variables] == ["x", "y", "z", "x_error", "y_error", "z_error"]
    assert [v.units for v in variables[:3]] == ["m", "m", "K"]
    found = analyse("history", Lorenz(), ["x", "z"], {"times": [0.0, 0.2]})
    states = solve_ivp(lambda t, y: lorenz(1).field((), y), (0, 0.2), (1, 1, 20), rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose([found.x[1], found.z[1]], states[[0, 2]], rtol=1e-8)


def test_a_flow_has_the_components_that_the_system_says():
    own = {"name": "short", "title": "short", "flow": Lorenz.flow, "state": Lorenz.state[:2]}
    system = type("Short", (System,), own)
    defaults = {option.name: option.default for option in history.ANALYSIS.options}
    request = Request(("x",), "diffrax", defaults | {"times": (1.0,)})
    (solver,) = history.ANALYSIS.solvers(system, request)
    # A plan predicts the effort, a transformation does not.
    for call in (lambda: solver.effort({}), lambda: jax.eval_shape(lambda: solver.solve({}, 1))):
        with pytest.raises(InputError, match=r"(?m)^system: its flow has 3 components; expected one for each of its"):
            call()


@pytest.mark.parametrize("varying", ["axes", "points"])
def test_a_parameter_that_is_called_like_a_dimension_does_not_vary(varying, monkeypatch):
    monkeypatch.setattr(systems, "_REGISTERED", {})
    body = {"__annotations__": {"time": float}, "time": parameter("1", "a time constant"), "flow": Lorenz.flow}
    timed = type("Timed", (System,), {"name": "timed", "title": "timed", "state": Lorenz.state} | body)
    scene = {"system": timed, "analysis": "history", varying: {"time": [1.0, 2.0]}, "options": {"times": [0.0, 1.0]}}
    with pytest.raises(
        InputError, match=rf"^{varying}\.time: results have a dimension 'time'; expected a parameter of"
    ):
        load_scene(scene)


def test_a_system_without_a_state_has_no_history():
    with pytest.raises(ValueError, match="models of nameless: history needs state"):
        type("Nameless", (System,), {"name": "nameless", "flow": Lorenz.flow})


def test_a_system_without_a_state_has_no_branches_of_orbits():
    orbits = serves("frequency_response", returns=ForcedModel)(lambda self: None)
    with pytest.raises(ValueError, match="models of nameless: frequency_response needs state"):
        type("Nameless", (System,), {"name": "nameless", "orbits": orbits})
    with pytest.raises(ValueError, match="models of nameless: frequency_response needs displacements"):
        type("Nameless", (System,), {"name": "nameless", "orbits": orbits, "state": Lorenz.state})


def test_derivatives_at_whole_strobes():
    """A requested time at which the integration already stands moves with the period."""

    def sine(w):
        flow = Flow(lambda angles, _: (jnp.cos(angles[0]),), (0.0,), period=2 * math.pi / w, turns=(1,))
        return integration.trajectory(flow, jnp.asarray(t), 1e-9, 1.0, diffrax.Tsit5(), integration.Limits(9, 1e4))[0]

    w, t = 2 * math.pi, np.array([0.0, 0.25, 1.0, 1.5, 2.0])
    found = jax.jit(jax.jacfwd(sine), compiler_options=options_for_few())(w)[:, 0]
    np.testing.assert_allclose(found, t * np.cos(w * t) / w - np.sin(w * t) / w**2, atol=1e-8)
