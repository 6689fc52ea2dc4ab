"""The cardan equations against their derivation, in 40 digits where float64 would hide differences."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp
from scipy.integrate import quad

from drivetrain_jax import InputError
from drivetrain_jax.analysis.floquet import propagator
from drivetrain_jax.resonances import natural_frequencies
from drivetrain_jax.systems import cardan, get_system, system_names

SYSTEM = get_system("cardan")
NEAR_PERPENDICULAR = 1.57


def random_points(count: int, seed: int, beta: float | None = None) -> list[dict[str, float]]:
    rng = np.random.default_rng(seed)
    ranges = {"Omega": (0.05, 5), "zeta": (1e-3, 1), "alpha": (0.1, 20), "mu": (0.1, 20), "gamma": (0.1, 1e3)}
    columns = {name: np.exp(rng.uniform(np.log(a), np.log(b), count)) for name, (a, b) in ranges.items()}
    columns["beta"] = rng.uniform(-1.5, 1.5, count) if beta is None else np.full(count, beta)
    return [{name: float(column[i]) for name, column in columns.items()} for i in range(count)]


POINTS = random_points(6, 1) + random_points(3, 2, NEAR_PERPENDICULAR)


def relative(found, exact) -> float:
    found, exact = np.asarray(found, float), np.asarray(exact, float)
    return np.abs(found - exact).max() / np.abs(exact).max()


@pytest.fixture(scope="module")
def model_matrices():
    """``A`` of the natural, the reduced, the absolute and the twist form, each at an instant of its clock."""

    @jax.jit
    def both(values, tau, psi):
        model = SYSTEM.models["floquet"].build(values)
        return model.natural.matrix(tau), *(form.matrix(psi) for form in (model.reduced, model.marched, model.damped))

    return lambda values, tau=0.0, psi=0.0: tuple(map(np.asarray, both(values, tau, psi)))


# The same equations once more, in mpmath: eta from eq. (1), its derivatives by hand.


def exact_ratio(beta, tau):
    c, s2 = mp.cos(beta), mp.sin(beta) ** 2
    d = 1 - s2 * mp.sin(tau) ** 2
    first = c * s2 * mp.sin(2 * tau) / d**2
    second = 2 * c * s2 * mp.cos(2 * tau) / d**2 + 2 * c * s2**2 * mp.sin(2 * tau) ** 2 / d**3
    return c / d, first, second


def exact_natural(v, tau):
    eta, first, second = exact_ratio(v["beta"], tau)
    s, damping = 1 / mp.mpf(v["Omega"]), 2 * mp.mpf(v["zeta"]) / v["Omega"]
    inertia = eta**2 + 1 / mp.mpf(v["gamma"])
    e = [[damping, -v["alpha"] * damping * eta], [2 * first - damping * eta, v["alpha"] * damping * inertia]]
    p = [[s**2, -v["mu"] * s**2 * eta], [second - s**2 * eta, v["mu"] * s**2 * inertia]]
    return mp.matrix([[0, 0, 1, 0], [0, 0, 0, 1], *([*(-x for x in p[i]), *(-x for x in e[i])] for i in range(2))])


def exact_transformation(v, tau):
    """``(q, p) = T (theta, theta')``: eq. (8), then p = Omega q' + zeta F q of eq. (10)."""
    eta, first, _ = exact_ratio(v["beta"], tau)
    g = 1 / mp.sqrt(v["gamma"])
    to_q = mp.matrix([[1, 0, 0, 0], [eta / g, 1 / g, 0, 0], [0, 0, 1, 0], [first / g, 0, eta / g, 1 / g]])
    a, zeta, omega = v["alpha"], mp.mpf(v["zeta"]), v["Omega"]
    f = [[zeta * (1 + a * eta**2), 0], [-2 * zeta * a * eta * g, zeta * a * g**2]]
    rows = [[f[i][0], f[i][1], omega * (i == 0), omega * (i == 1)] for i in range(2)]
    return mp.matrix([[1, 0, 0, 0], [0, 1, 0, 0], *rows]) * to_q


def exact_twists(v, tau):
    """``(x, v) = T (theta, theta')``: x = (theta_1, sqrt(mu) theta_2), v = Omega q'."""
    eta, first, _ = exact_ratio(v["beta"], tau)
    g, omega = 1 / mp.sqrt(v["gamma"]), mp.mpf(v["Omega"])
    second = [omega * first / g, 0, omega * eta / g, omega / g]
    return mp.matrix([[1, 0, 0, 0], [0, mp.sqrt(v["mu"]), 0, 0], [0, 0, omega, 0], second])


def exact_absolute(v, tau):
    """``(q, q_psi) = T (theta, theta')``."""
    c, r = mp.cos(v["beta"]), mp.tan(mp.mpf(v["beta"]) / 2) ** 2
    doubled = 2 * mp.atan2(mp.sqrt(c) * mp.sin(tau), mp.cos(tau))
    psi, step = mp.atan2(mp.sin(doubled), mp.sqrt(1 - r**2) * mp.cos(doubled)) / 2, mp.mpf(10) ** -20
    # Towards the middle: the clock of the half period ends at both ends.
    step = step if psi < 0.6 else -step
    rate = (exact_time(v["beta"], psi + step) - exact_time(v["beta"], psi)) / step
    eta, first, _ = exact_ratio(v["beta"], tau)
    g = 1 / mp.sqrt(v["gamma"])
    second = [rate * first / g, 0, rate * eta / g, rate / g]
    return mp.matrix([[1, 0, 0, 0], [eta / g, 1 / g, 0, 0], [0, 0, rate, 0], second])


def exact_time(beta, psi):
    """tau of the clock psi, eqs (11)-(12), for 0 < psi < pi/4 and beyond."""
    c, r = mp.cos(beta), mp.tan(mp.mpf(beta) / 2) ** 2
    doubled = mp.atan2(mp.sqrt(1 - r**2) * mp.sin(2 * psi), mp.cos(2 * psi))
    return mp.atan2(mp.sin(doubled / 2), mp.sqrt(c) * mp.cos(doubled / 2))


def exact_form(v, psi, transformation):
    """(T' + T A) T^-1 dtau/dpsi, derivatives by differences in 60 digits."""
    with mp.workdps(60):
        psi = mp.mpf(psi)
        tau, step = exact_time(v["beta"], psi), mp.mpf(10) ** -20
        rate = (exact_time(v["beta"], psi + step) - exact_time(v["beta"], psi - step)) / (2 * step)
        slope = (transformation(v, tau + step) - transformation(v, tau - step)) / (2 * step)
        t = transformation(v, tau)
        return ((slope + t * exact_natural(v, tau)) * t**-1 * rate).tolist()


@jax.jit
def nonlinear_jacobian(values, tau):
    return jax.jacfwd(lambda y: cardan.Cardan.of(values).vector_field(tau, y))(jnp.zeros(4))


@pytest.mark.parametrize("point", range(len(POINTS)))
def test_linearisation_is_the_derivative_of_the_equations(point, model_matrices):
    v = POINTS[point]
    # Next to pi/2 both sides lose digits in 1 - sin(beta)^2 sin(phi)^2.
    tolerance = 1e-14 if abs(v["beta"]) < NEAR_PERPENDICULAR else 1e-13
    for tau in (0.0, 0.37, 1.5, 2.9):
        jacobian = np.asarray(nonlinear_jacobian(v, tau))
        assert relative(jacobian, model_matrices(v, tau=tau)[0]) <= tolerance
        e, p = cardan.Cardan(**v).damping_and_stiffness(tau)
        assert relative(-jacobian[2:], np.hstack([np.array(p, float), np.array(e, float)])) <= tolerance


def test_linearisation_against_the_equations_written_out(model_matrices):
    for v in POINTS[:6]:
        for tau in (0.2, 1.1, 2.5):
            assert relative(model_matrices(v, tau=tau)[0], exact_natural(v, mp.mpf(tau)).tolist()) <= 1e-13


def test_forcing_is_what_the_nonlinear_equations_have_at_rest():
    for v in POINTS[:6]:
        for tau in (0.3, 1.4, 2.2):
            forcing = [0, 0, 0, -float(exact_ratio(v["beta"], mp.mpf(tau))[1])]
            shaft = cardan.Cardan(**v)
            for field in (shaft.vector_field, shaft.linear_field):
                np.testing.assert_allclose(field(tau, jnp.zeros(4)), forcing, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("point", range(len(POINTS)))
def test_all_forms_are_the_transformed_natural_system(point, model_matrices):
    v = POINTS[point]
    for psi in (0.0, 0.1, 0.7, math.pi / 4, 0.9, 1.5):
        found = model_matrices(v, psi=psi)[1:]
        for form, transformation in zip(found, (exact_transformation, exact_absolute, exact_twists), strict=True):
            assert relative(form, exact_form(v, psi, transformation)) <= 3e-14


@pytest.mark.parametrize("point", range(len(POINTS)))
def test_other_forms_run_back_as_the_reduced_one_does(point):
    """R0 = Y^-1 X Y^-T at the start, R1 = Y^T X Y at the end, with (q, P) = Y times the states of the form."""
    v = POINTS[point]
    model = cardan.Cardan(**v).floquet_model()
    for form, transformation in ((model.marched, exact_absolute), (model.damped, exact_twists)):
        with mp.workdps(60):
            swap = mp.matrix(model.reduced.reversor)
            first, last = (exact_transformation(v, t) * transformation(v, t) ** -1 for t in (mp.mpf(0), mp.pi / 2))
            exact = first**-1 * swap * (first**-1).T, last.T * swap * last
            for found, e in zip(form.reversal(), exact, strict=True):
                assert relative(np.array(found, float), e.tolist()) <= 1e-14


@pytest.mark.parametrize("beta", [0.0, 0.4, -1.2, 1.5, NEAR_PERPENDICULAR])
def test_clock_runs_through_the_speed_ratio(beta, model_matrices):
    """eta and dtau/dpsi from entries of the undamped reduced matrix; both are even about the middle of the half period."""
    v = {"beta": beta, "Omega": 1.0, "zeta": 0.0, "alpha": 0.0, "mu": 1.0, "gamma": 1.0}
    for psi in (0.05, 0.6, 1.3, math.pi / 2):
        matrix = model_matrices(v, psi=psi)[1]
        rate = matrix[0, 2]
        with mp.workdps(40):
            exact = exact_ratio(beta, exact_time(beta, mp.mpf(psi)))[0]
            slope = mp.diff(lambda x: exact_time(beta, x), mp.mpf(psi))
        assert matrix[2, 1] / rate == pytest.approx(float(exact), rel=1e-13)
        assert rate == pytest.approx(float(slope), rel=1e-13)
        np.testing.assert_allclose(model_matrices(v, psi=math.pi - psi)[1], matrix, rtol=1e-13, atol=1e-13)


def test_speed_ratio_and_its_derivatives():
    """eta is exact to rounding even at its maximum, and for joints that nearly jam."""
    for beta in (0.0, 0.3, -0.9, 1.5, 1.55, NEAR_PERPENDICULAR):
        for phi in (-1.0, 0.0, 0.4, 1.55, 1.57, 3.0):
            with mp.workdps(60):
                exact = [float(x) for x in exact_ratio(beta, mp.mpf(phi))]
            np.testing.assert_allclose(cardan.speed_ratio(beta, phi), exact, rtol=1e-14, atol=1e-15)
            by_autodiff = jax.grad(lambda x: cardan.speed_ratio(beta, x)[0])(phi)  # noqa: B023
            assert by_autodiff == pytest.approx(exact[1], rel=1e-12, abs=1e-15)
    eta = np.asarray(cardan.speed_ratio(0.7, np.pi * np.arange(64) / 64)[0])
    assert eta.mean() == pytest.approx(1, rel=1e-14)


@pytest.mark.parametrize("point", range(len(POINTS)))
def test_determinant_is_the_exponential_of_the_trace(point, model_matrices):
    v = POINTS[point]
    exact = float(cardan.Cardan(**v).log_determinant())
    model = SYSTEM.models["floquet"].build(v)
    half, _ = quad(lambda psi: float(np.trace(model_matrices(v, psi=psi)[1])), 0, math.pi / 2, epsabs=0, epsrel=1e-11)
    assert 2 * half == pytest.approx(exact, rel=1e-9)
    for form in (model.natural, model.reduced):
        assert float(form.log_determinant()) == exact
    if abs(v["beta"]) < NEAR_PERPENDICULAR:
        trace = [np.trace(model_matrices(v, tau=t)[0]) for t in math.pi * np.arange(512) / 512]
        # The trapezoidal rule converges exponentially, but slowly near pi/2.
        assert math.pi * np.mean(trace) == pytest.approx(exact, rel=1e-9)


def test_natural_frequencies():
    one, two = natural_frequencies(1.0, 100.0)
    assert one == pytest.approx(0.070622235012, abs=5e-13)
    assert two == pytest.approx(1.415984639720, abs=5e-13)


@pytest.mark.parametrize("mu", [1e-12, 1e-3, 1.0, 50.0, 1e12])
@pytest.mark.parametrize("gamma", [1e-12, 1e-3, 1.0, 100.0, 1e12])
def test_natural_frequencies_are_eigenvalues(mu, gamma):
    """Squares are eigenvalues of e1 e1^T + mu G G^T of eq. (9) at beta = 0; float64 would lose the small eigenvalue."""
    with mp.workdps(60):
        g = 1 / mp.sqrt(mp.mpf(gamma))
        stiffness = mp.matrix([[1 + mp.mpf(mu), -mu * g], [-mu * g, mu * g * g]])
        exact = [float(mp.sqrt(x)) for x in mp.eigsy(stiffness, eigvals_only=True)]
    np.testing.assert_allclose(natural_frequencies(mu, gamma), exact, rtol=1e-14)


def test_natural_frequencies_broadcast():
    mu, gamma = np.array([1.0, 20.0]), np.array([[100.0], [3.0], [0.2]])
    found = natural_frequencies(mu, gamma)
    assert found.shape == (3, 2, 2)
    np.testing.assert_array_equal(found[1, 1], natural_frequencies(20.0, 3.0))


def test_resonances():
    one, two = 0.070622235012, 1.415984639720
    expected = {f"H{i}{k}": w / (2 * k) for i, w in ((1, one), (2, two)) for k in (1, 2, 3)}
    expected |= {f"S{i}{k}": w / (2 * k - 1) for i, w in ((1, one), (2, two)) for k in (1, 2, 3)}
    expected |= {f"C+{k}": (two + one) / (2 * k) for k in (1, 2, 3)}
    expected |= {f"C-{k}": (two - one) / (2 * k) for k in (1, 2, 3)}
    resonances = SYSTEM.resonances
    assert (resonances.axis, set(resonances.labels)) == ("Omega", set(expected))
    speeds = resonances.values({"mu": 1.0, "gamma": 100.0})
    for label, speed in zip(resonances.labels, speeds, strict=True):
        assert speed == pytest.approx(expected[label], abs=1e-12), label
    assert resonances.values({"mu": np.ones(5), "gamma": 100.0}).shape == (5, 18)


def test_presets_are_the_cases_of_the_paper():
    base = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    assert SYSTEM.presets == {"base": base, "alpha20": base | {"alpha": 20.0}, "mu20": base | {"mu": 20.0}}
    for preset in SYSTEM.presets.values():
        for name, value in preset.items():
            assert SYSTEM.parameter(name).check(value) == value


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("beta", (0, -1.57, 1.5707), (math.pi / 2, -math.pi / 2, 2.0)),
        ("Omega", (1e-9, 1e6), (0.0, -1.0)),
        ("zeta", (0.0, 100.0), (-1e-12,)),
        ("alpha", (0.0, 100.0), (-1e-12,)),
        ("mu", (1e-9, 1e9), (0.0, -1.0)),
        ("gamma", (1e-9, 1e9), (0.0, -1.0)),
    ],
)
def test_parameter_ranges(name, good, bad):
    parameter = SYSTEM.parameter(name)
    assert parameter.default is None
    assert parameter.units == ("rad" if name == "beta" else "1")
    assert all(parameter.check(value) == value for value in good)
    for value in (*bad, math.nan, math.inf, "1", True):
        with pytest.raises(ValueError, match=f"^{name} = .*expected"):
            parameter.check(value)


def test_predicted_panels_grow_with_what_makes_a_point_harder():
    base = {"beta": 0.5, "Omega": 0.5, "zeta": 0.01, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}

    def panels(rtol=1e-10, **changed):
        return cardan.Cardan(**(base | changed)).panels(rtol)

    easy = panels()
    for harder in ({"Omega": 0.1}, {"beta": 1.4}, {"mu": 20.0}, {"zeta": 5.0}, {"gamma": 1e-2}):
        assert panels(**harder) > 1.2 * easy, harder
    assert panels(1e-13) > 1.5 * easy
    assert panels(beta=np.linspace(0, 1, 7)).shape == (7,)


def test_systems_are_found_by_name():
    assert system_names()[0] == "cardan"
    assert SYSTEM.name == "cardan"
    assert set(SYSTEM.models) == {"floquet", "atlas", "forced", "frequency_response", "history", "lyapunov"}
    with pytest.raises(InputError, match="expected cardan"):
        get_system("cardn")


@pytest.mark.full
@pytest.mark.parametrize("rtol", [1e-10, 1e-7])
def test_predicted_panels_are_enough_and_not_many_more(rtol, monkeypatch, retraced):
    """Too few panels repeat a block of lanes with twice as many."""
    monkeypatch.setattr(propagator, "_MAX_REFINEMENTS", 0)
    rng, count = np.random.default_rng(3), 500
    points = {"beta": rng.uniform(0, 1.5, count), "Omega": np.exp(rng.uniform(np.log(0.03), np.log(3), count))}
    shaft = partial(cardan.Cardan, zeta=1e-3, alpha=1.0, mu=1.0, gamma=100.0)

    def met(part):
        # One at a time, because lanes share the largest number of panels.
        def one(p):
            panels = jnp.ceil(part * shaft(**p).panels(rtol)).astype(int)
            return propagator.monodromy(shaft(**p).floquet_model().direct, panels, rtol / 4, 4).met

        return np.mean(jax.jit(lambda points: jax.lax.map(one, points))(points))

    assert met(1.0) > 0.99 and met(0.5) < 0.4
