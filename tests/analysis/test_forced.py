"""Forced response against an independent model: the disks' rotations, NumPy, SciPy's DOP853 and root finder."""

from __future__ import annotations

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar, root

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import Outcome, Request, get_analysis
from drivetrain_jax.analysis.forced import orbit
from drivetrain_jax.analysis.forced.analysis import _cubic_root, amplitudes, distinct, predicted_steps
from drivetrain_jax.analysis.forced.orbit import along_forcing, corrected, integrate
from drivetrain_jax.systems import ForcedModel, get_system
from tests.quick_jit import quick_jit
from tests.sizes import full_after

SYSTEM = get_system("cardan")
ANALYSIS = get_analysis("forced").for_system(SYSTEM)
EVERYTHING = tuple(v.name for v in ANALYSIS.variables)
BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
UPPER = 1.4159846397203325  # natural frequency omega2 at beta = 0


def solver(outputs=EVERYTHING, rtol=1e-10):
    return ANALYSIS.solvers(SYSTEM, Request(tuple(outputs), "shooting", {"rtol": rtol}))[0]


@cache
def compiled(outputs=EVERYTHING, rtol=1e-10):
    return quick_jit(lambda values: solver(outputs, rtol).solve(values, jnp.array(0)))


@pytest.fixture(scope="module")
def point():
    solve = compiled()

    def at(**given):
        values = {k: np.float64(v) for k, v in (BASE | given).items()}
        return {k: np.asarray(v) for k, v in solve(values).items()}

    return at


class Disks:
    """The same machine in other coordinates: theta1 and the lag D = angle - tau of the driven disk.

    The output angle of the joint is atan(c tan(phi)), so neither eta' nor eta'' appears in the nonlinear equations.
    """

    def __init__(self, **given):
        self.p = BASE | given
        self.c = math.cos(self.p["beta"])

    def ratio(self, phi):
        return self.c / (math.cos(phi) ** 2 + self.c**2 * math.sin(phi) ** 2)

    def lag(self, phi):
        s, k = math.sin(phi), math.cos(phi)
        return -math.atan2((1 - self.c) * s * k, k * k + self.c * s * s)

    def torques(self, x1, x2, v1, v2):
        p = self.p
        s, d = 1 / p["Omega"], 2 * p["zeta"] / p["Omega"]
        return d * v1 + s * s * x1, p["alpha"] * d * v2 + p["mu"] * s * s * x2

    def twist(self, tau, y):
        phi = tau + y[0]
        return y[1] - self.lag(phi) - y[0], 1 + y[3] - self.ratio(phi) * (1 + y[2])

    def nonlinear(self, tau, y):
        twist, rate = self.twist(tau, y)
        first, second = self.torques(y[0], twist, y[2], rate)
        return [y[2], y[3], self.ratio(tau + y[0]) * second - first, -second / self.p["gamma"]]

    def linear(self, tau, y):
        """Linear field about theta = 0; ``y[1]`` is relative to the lag of the rigid joint, whose second derivative is the
        forcing."""
        step = 1e-30
        eta = self.ratio(tau)
        slope = _complex_ratio(self.c, tau + 1j * step).imag / step
        first, second = self.torques(y[0], y[1] - eta * y[0], y[2], y[3] - eta * y[2] - slope * y[0])
        return [y[2], y[3], eta * second - first, -second / self.p["gamma"] - slope]

    def flow(self, field, start, dense_output=False):
        return solve_ivp(field, (0, math.pi), start, method="DOP853", rtol=1e-12, atol=1e-15, dense_output=dense_output)

    def periodic_linear(self):
        ends = [self.flow(self.linear, start).y[:, -1] for start in (np.zeros(4), *np.eye(4))]
        monodromy = np.array(ends[1:]).T - ends[0][:, None]
        return np.linalg.solve(np.eye(4) - monodromy, ends[0])

    def periodic_nonlinear(self, guess):
        """Central differences, because the one-sided ones of SciPy stall at 1e-10 without damping."""
        found = root(
            lambda y: self.flow(self.nonlinear, y).y[:, -1] - y,
            guess,
            jac=lambda y: self.monodromy(y) - np.eye(4),
            tol=1e-13,
        )
        assert np.abs(found.fun).max() < 1e-10
        return found.x

    def monodromy(self, start, step=1e-5):
        def end(y):
            return self.flow(self.nonlinear, y).y[:, -1]

        return np.array([(end(start + step * e) - end(start - step * e)) / (2 * step) for e in np.eye(4)]).T

    def spectral_radius(self, start):
        return np.abs(np.linalg.eigvals(self.monodromy(start))).max()

    def to_angles(self, y):
        """(theta, theta') at tau = 0."""
        return np.array([y[0], self.twist(0.0, y)[0], y[2], self.twist(0.0, y)[1]])

    def to_disks(self, theta):
        phi = theta[0]
        return np.array(
            [theta[0], theta[1] + self.lag(phi) + phi, theta[2], theta[3] - 1 + self.ratio(phi) * (1 + theta[2])]
        )


def _complex_ratio(c, phi):
    return c / (np.cos(phi) ** 2 + c**2 * np.sin(phi) ** 2)


def largest(function):
    grid = np.linspace(0, math.pi, 2001)
    i = int(np.argmax([abs(function(t)) for t in grid]))
    left, right = max(grid[i] - 0.002, 0.0), min(grid[i] + 0.002, math.pi)
    best = minimize_scalar(lambda t: -abs(function(t)), bounds=(left, right), method="bounded", options={"xatol": 1e-9})
    return -best.fun


@pytest.mark.parametrize(
    ("beta", "omega", "amplitude", "digit"),
    [(0.3, 1.0, (0.0115, 0.034), (5e-5, 5e-4)), (0.5236, 1.416, (0.012, 0.084), 5e-4), (0.5, 0.72, (0.93, 1.01), 5e-3)],
)
def test_known_linear_amplitudes(point, beta, omega, amplitude, digit):
    assert np.all(np.abs(point(beta=beta, Omega=omega)["amplitude"] - amplitude) <= digit)


LINEAR_POINTS = [
    {"beta": 0.8, "Omega": 1.3},
    {"beta": 0.5, "Omega": 0.72},
    {"beta": 1.4, "Omega": 1.0},
    {"beta": 0.7, "Omega": 0.1, "alpha": 3.0},
    {"beta": 0.8, "Omega": 50.0},
    {"beta": 0.01, "Omega": 1.1, "zeta": 0.0},
    {"beta": 0.8, "Omega": 1.3, "mu": 200.0, "gamma": 0.5},
]
LINEAR = ("periodic_state", "periodic_state_error", "amplitude")
linear_only = quick_jit(lambda values: solver(LINEAR).solve(values, 0))


@pytest.mark.full
@pytest.mark.parametrize("given", LINEAR_POINTS, ids=str)
def test_linear_response_against_scipy(given):
    disks = Disks(**given)
    result = linear_only({k: np.float64(v) for k, v in (BASE | given).items()})
    reference = disks.periodic_linear()
    eta = disks.c
    theta = np.array([reference[0], reference[1] - eta * reference[0], reference[2], reference[3] - eta * reference[2]])
    scale = np.abs(theta).max()
    tolerance = 1e-9 if given["Omega"] < 10 else 1e-7
    np.testing.assert_allclose(result["periodic_state"], theta, atol=tolerance * scale)
    path = disks.flow(disks.linear, reference, dense_output=True).sol
    expected = largest(lambda t: path(t)[0]), largest(lambda t: path(t)[1] - disks.ratio(t) * path(t)[0])
    np.testing.assert_allclose(result["amplitude"], expected, rtol=10 * tolerance)


@pytest.mark.parametrize(
    ("beta", "omega", "zeta"),
    [(0.8, 1.3, 0.001), (0.5236, 1.416, 0.001), (0.5, 0.72, 0.001), (0.5, 0.709, 0.001), (1.2, 0.8, 0.1)],
)
def test_nonlinear_orbit_against_scipy(point, beta, omega, zeta):
    result = point(beta=beta, Omega=omega, zeta=zeta)
    disks = Disks(beta=beta, Omega=omega, zeta=zeta)
    start = disks.periodic_nonlinear(disks.to_disks(result["orbit_state"]) + 1e-4)
    np.testing.assert_allclose(result["orbit_state"], disks.to_angles(start), atol=2e-9)
    assert result["orbit_spectral_radius"] == pytest.approx(disks.spectral_radius(start), abs=2e-7)
    path = disks.flow(disks.nonlinear, start, dense_output=True).sol
    expected = largest(lambda t: path(t)[0]), largest(lambda t: disks.twist(t, path(t))[0])
    np.testing.assert_allclose(result["orbit_amplitude"], expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("beta", "omega", "radius", "largest"),
    [(0.55, 0.725, 0.999893, 0.7332783), (0.925, 0.725, 0.999982, 0.5534705), (0.975, 0.725, 0.999983, 0.5441110)],
)
def test_a_stable_orbit_is_reported_where_one_exists(point, beta, omega, radius, largest):
    """The orbits on the path of growing forcing are unstable; continuation by another code found these."""
    result = point(beta=beta, Omega=omega)
    assert result["orbit_spectral_radius"] == pytest.approx(radius, abs=1e-6)
    assert result["orbit_amplitude"].max() == pytest.approx(largest, abs=1e-7)
    assert result["orbit_count"] >= 2 and result["outcome"] == Outcome.SUCCESS
    disks = Disks(beta=beta, Omega=omega)
    start = disks.periodic_nonlinear(disks.to_disks(np.round(result["orbit_state"], 3)))
    np.testing.assert_allclose(result["orbit_state"], disks.to_angles(start), atol=2e-9)


def test_one_orbit_away_from_resonances(point):
    assert point(beta=0.8, Omega=1.3)["orbit_count"] == 1


def test_no_forcing_without_joint_angle(point):
    result = point(beta=0.0, Omega=1.0)
    for name in ("periodic_state", "amplitude", "orbit_state", "orbit_amplitude"):
        assert np.all(result[name] == 0)
    # Constant coefficients: the exponents are those of the damped two-disk chain.
    d, inertia = 0.002, 1.01
    matrix = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, -d, d], [1, -inertia, d, -d * inertia]])
    expected = np.exp(math.pi * np.linalg.eigvals(matrix).real.max())
    assert result["orbit_spectral_radius"] == pytest.approx(expected, rel=1e-10)
    assert result["outcome"] == Outcome.SUCCESS


def test_sign_of_the_joint_angle_is_irrelevant(point):
    plus, minus = point(beta=0.8, Omega=1.3), point(beta=-0.8, Omega=1.3)
    for name in EVERYTHING:
        np.testing.assert_array_equal(plus[name], minus[name])


def test_resonance_without_damping_is_reported(point):
    result = point(beta=0.0, Omega=UPPER / 2, zeta=0.0)
    assert result["outcome"] == Outcome.NOT_CONVERGED
    assert result["condition"] > 1e9
    assert np.all(np.isnan(result["periodic_state"])) and np.all(np.isnan(result["orbit_state"]))


def test_error_beyond_the_target_is_reported(point):
    result = point(beta=0.3, Omega=UPPER / 2, zeta=0.0)
    assert result["outcome"] == Outcome.TOLERANCE_NOT_MET
    assert result["periodic_state_error"] > 1e-10 * np.abs(result["periodic_state"]).max()


@pytest.mark.full
def test_lost_orbit_keeps_the_linear_response(point, monkeypatch):
    """The orbit needs several corrections near its guess, so that a limit loses it."""
    solve = quick_jit(lambda v: solver(("periodic_state", "orbit_state", "orbit_state_error")).solve(v, 0))
    with monkeypatch.context() as patch:
        patch.setattr(orbit, "MAX_POLISH", 0)
        result = solve({k: np.float64(v) for k, v in (BASE | {"beta": 0.5, "Omega": 0.72}).items()})
    assert result["outcome"] == Outcome.NOT_CONVERGED
    assert np.all(np.isnan(result["orbit_state"])) and np.isnan(result["orbit_state_error"])
    expected = point(beta=0.5, Omega=0.72)["periodic_state"]
    np.testing.assert_allclose(result["periodic_state"], expected, rtol=1e-9)


@pytest.mark.full
def test_batch_equals_loop(point):
    rng = np.random.default_rng(2)
    columns = {"beta": rng.uniform(-1.0, 1.0, 6), "Omega": rng.uniform(0.2, 2, 6), "zeta": np.full(6, 0.01)}
    columns |= {k: np.full(6, BASE[k]) for k in ("alpha", "mu", "gamma")}
    outputs = ("amplitude", "condition", "orbit_state", "orbit_spectral_radius")
    batch = quick_jit(jax.vmap(solver(outputs).solve, in_axes=(0, None)))(columns, jnp.array(0))
    for i in range(6):
        alone = point(**{k: v[i] for k, v in columns.items()})
        for name in (*outputs, "outcome"):
            np.testing.assert_allclose(batch[name][i], alone[name], rtol=1e-8, atol=1e-11, err_msg=name)


@pytest.mark.full
def test_only_what_is_asked_for():
    values = BASE | {"beta": 0.8, "Omega": 1.3}

    def size(*outputs):
        solve = solver(outputs).solve
        program, shapes = jax.make_jaxpr(solve, return_shape=True)(values, 0)
        assert set(shapes) == {*outputs, "outcome"}
        return len(str(program))

    state, amplitude, nonlinear = size("periodic_state"), size("amplitude"), size("orbit_state")
    assert state < amplitude and state < nonlinear < size("orbit_state", "orbit_spectral_radius", "orbit_amplitude")


def test_effort_grows_with_oscillations():
    columns = {k: np.full(3, v) for k, v in (BASE | {"beta": 0.8}).items()} | {"Omega": np.array([1.0, 0.1, 0.01])}
    steps = solver().effort(columns)
    assert steps.shape == (3,) and np.all(np.diff(steps) > 0)


def test_a_field_that_overflows_needs_infinitely_many_steps():
    columns = {k: np.full(3, v) for k, v in (BASE | {"beta": 0.5}).items()}
    columns |= {"Omega": np.array([1e-200, 0.5, 0.5]), "zeta": np.array([0.01, 1.7e308, 0.01])}
    assert list(np.isinf(solver().effort(columns))) == [True, True, False]


def test_a_model_of_one_displacement_is_refused():
    model = ForcedModel(lambda t, y: y, lambda t, y: y, 1.0, (0,))
    with pytest.raises(InputError, match=r"^system: its model has 1 displacements; expected 2, as it says$"):
        predicted_steps(lambda columns: model, 4, 2, {"a": np.ones(1)})


def test_an_orbit_behind_missing_ones_is_distinct():
    states = np.full((54, 4), np.nan)
    states[[2, 12, 13]] = np.array([[0.1], [0.2], [0.1]])
    assert np.flatnonzero(distinct(jnp.asarray(states), 1e-3)).tolist() == [2, 12]


@pytest.mark.full
@pytest.mark.parametrize("frequency", [1.0, 7.3, 1000.0])
def test_peaks_between_steps(frequency):
    def field(t, y):
        return jnp.stack([y[1], -(frequency**2) * y[0]])

    start = jnp.array([math.cos(0.4), -frequency * math.sin(0.4)]) / frequency
    peak, when, end, outcome = quick_jit(lambda y: amplitudes(field, y, 6.1, jnp.eye(2), 1e-12))(start)
    assert outcome == Outcome.SUCCESS
    np.testing.assert_allclose(peak, (1 / frequency, 1.0), rtol=2e-9)
    angle = frequency * when + 0.4
    np.testing.assert_allclose((math.sin(angle[0]), math.cos(angle[1])), 0, atol=1e-6)
    assert end[1] == pytest.approx(-math.sin(6.1 * frequency + 0.4), abs=1e-8)


@pytest.mark.full
def test_field_that_is_not_finite():
    for broken in (lambda t, y: y * jnp.nan, lambda t, y: y**2):
        assert integrate(broken, jnp.ones(2), 3.0, 1e-8)[1] == Outcome.NOT_FINITE
        assert amplitudes(broken, jnp.ones(2), 3.0, jnp.eye(1, 2), 1e-8)[3] == Outcome.NOT_FINITE


@pytest.mark.full
def test_no_orbit_without_restoring_force():
    """y'' = 1 + sin t drifts: the linear problem is singular, and no orbit exists."""
    found = along_forcing(lambda t, y: jnp.stack([y[1], 1 + jnp.sin(t)]), 2 * math.pi, 2)
    assert jnp.all(jnp.isnan(found))


@pytest.mark.full
def test_lanes_that_wait_take_no_steps():
    """One lane needs few motions of many steps, the other many motions of few steps; a batch adds no more work."""
    calls = []

    def orbit_of(stiffness, force):
        def field(t, y):
            jax.debug.callback(lambda _: calls.append(1), t)
            return jnp.stack([y[1], force * jnp.cos(t) - 0.05 * y[1] - stiffness * y[0] - y[0] ** 3])

        return corrected(field, along_forcing(field, 2 * math.pi, 2), 2 * math.pi, 1e-10).state

    def counted(function, *arguments):
        calls.clear()
        states = np.asarray(quick_jit(function)(*arguments))
        jax.effects_barrier()
        return len(calls), states

    stiffness, force = jnp.array([1e3, 1.3]), jnp.array([1.0, 3.0])
    alone = [counted(orbit_of, a, b) for a, b in zip(stiffness, force, strict=True)]
    calls_of_both, states = counted(jax.vmap(orbit_of), stiffness, force)
    np.testing.assert_allclose(states, [state for _, state in alone], rtol=1e-9)
    # A batch calls the field for each of its lanes.
    assert calls_of_both / 2 < 1.1 * sum(n for n, _ in alone)


@pytest.mark.parametrize(
    "given",
    full_after(1, [{"Omega": 1.2}, {"Omega": 2.0}, {"Omega": 0.75, "zeta": 0.0, "alpha": 0.0, "gamma": 1.0}]),
    ids=str,
)
@pytest.mark.parametrize("rtol", full_after(1, [1e-6, 1e-4]))
@pytest.mark.full
def test_stated_error_of_the_orbit_bounds_the_true_one(given, rtol):
    """The last Newton correction is no estimate of the error: it is up to 2e5 times smaller."""
    given = {"beta": 0.3} | given
    values = {k: np.float64(v) for k, v in (BASE | given).items()}
    found = compiled(("orbit_state", "orbit_state_error"), rtol)(values)
    state, stated = np.asarray(found["orbit_state"]), float(found["orbit_state_error"])
    disks = Disks(**given)
    reference = disks.to_angles(disks.periodic_nonlinear(disks.to_disks(state)))
    assert found["outcome"] == Outcome.SUCCESS
    assert np.abs(state - reference).max() <= 3 * stated + 1e-12
    assert stated <= rtol * np.abs(reference).max()


@pytest.mark.full
@pytest.mark.parametrize("omega", [2.64, 3.0])
def test_amplitude_of_the_smaller_shaft_meets_the_target(omega):
    """This amplitude is about 30 times smaller than the other; from interpolated steps its errors were 2e-7 and 1e-8."""
    values = {k: np.float64(v) for k, v in (BASE | {"beta": 0.3, "Omega": omega}).items()}
    found = compiled(("amplitude", "orbit_amplitude", "orbit_state"), 1e-8)(values)
    disks = Disks(beta=0.3, Omega=omega)
    path = disks.flow(disks.linear, disks.periodic_linear(), dense_output=True).sol
    expected = largest(lambda t: path(t)[0]), largest(lambda t: path(t)[1] - disks.ratio(t) * path(t)[0])
    np.testing.assert_allclose(found["amplitude"], expected, rtol=1e-8)
    start = disks.periodic_nonlinear(disks.to_disks(np.asarray(found["orbit_state"])))
    path = disks.flow(disks.nonlinear, start, dense_output=True).sol
    expected = largest(lambda t: path(t)[0]), largest(lambda t: disks.twist(t, path(t))[0])
    np.testing.assert_allclose(found["orbit_amplitude"], expected, rtol=1e-8)


def test_root_of_a_straight_line():
    """Newton's method finds the root in one step, and must keep it."""
    x, inside = _cubic_root(*jnp.array([-1.0, 1.0, 2.0, 2.0]))
    assert inside and x == 0.5


@pytest.mark.full
def test_loosest_request_has_an_answer():
    values = {k: np.float64(v) for k, v in (BASE | {"beta": 0.3, "Omega": 1.2}).items()}
    found = quick_jit(lambda v: solver(("periodic_state", "orbit_state"), rtol=1e-2).solve(v, 0))(values)
    disks = Disks(beta=0.3, Omega=1.2)
    reference, eta = disks.periodic_linear(), disks.c
    theta = np.array([reference[0], reference[1] - eta * reference[0], reference[2], reference[3] - eta * reference[2]])
    assert found["outcome"] == Outcome.SUCCESS
    np.testing.assert_allclose(found["periodic_state"], theta, atol=1e-2 * np.abs(theta).max())
    assert np.all(np.isfinite(found["orbit_state"]))


@pytest.mark.full
def test_error_covers_that_of_the_second_integration():
    """A condition of 300 with a loose tolerance; reference: extrapolation of two numbers of steps in extended precision."""
    shaft = {"beta": 1.406319971883954, "Omega": 5.025357952450546, "zeta": 0.028807120682004222, "alpha": 0.0}
    shaft |= {"mu": 1.000570502262628, "gamma": 9.05935896640445}
    outputs = ["periodic_state", "periodic_state_error", "amplitude"]
    found = dt.point("cardan", "forced", **shaft, rtol=1e-2, outputs=outputs)
    exact = [-5.05439250e-05, 7.17251239e-06, -6.41006818e-03, 8.38673975e-01]
    assert np.abs(found.periodic_state - exact).max() < found.periodic_state_error < 1e-6
