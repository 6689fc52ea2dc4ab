"""Constants, field and Floquet model of the double-tripod driveshaft."""

from __future__ import annotations

import json
import math
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems import get_system, tripod
from tests.oracles import tripod_reference as oracle

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "tripod.json").read_text())
SYSTEM = get_system("tripod")
DEFAULTS = {p.name: p.default for p in SYSTEM.parameters if p.default is not None}
NINE_DEGREES = math.radians(9)
INPUT = DEFAULTS | {"element": "input", "beta": NINE_DEGREES, "zeta": 0.0016}
OUTPUT = INPUT | {"element": "output"}


def test_frequencies_and_inertias_over_the_joint_angle():
    rows = REFERENCE["omega_vs_beta"]
    beta = np.radians([row["beta"] for row in rows])
    for name, k in (("input", 1), ("output", 3)):
        element = tripod.element_of(DEFAULTS | {"element": name, "beta": beta})
        for field, key in (("frequency", f"Omega{k}"), ("mean_inertia", f"Ibar{k}"), ("chi_n", f"chi{k}_derived")):
            np.testing.assert_allclose(getattr(element, field), [row[key] for row in rows], rtol=1e-12, atol=0)


@pytest.mark.parametrize(("name", "k"), [("input", "1"), ("output", "3")])
def test_constants_at_nine_degrees(name, k):
    expected, values = REFERENCE["elements9"][k], INPUT | {"element": name}
    e = tripod.element_of(values)
    names = {"J_A": "JA", "J_B": "JB", "mean_inertia": "I", "chi_n": "chi", "c_stiffness": "c1", "c_inertia": "c2"}
    names |= {"stiffness": "kt", "frequency": "Om"}
    for field, key in names.items():
        assert float(getattr(e, field)) == pytest.approx(expected[key], rel=1e-12)
    assert float(tripod.joint_amplitude(values)) == pytest.approx(expected["A"], rel=1e-12)
    excitation = tripod.Tripod.of(values).constants()["parametric_excitation"]
    assert float(excitation) == pytest.approx(expected["h"], rel=1e-10)


def test_coefficients_are_those_of_the_moments_of_area():
    """k_t/I at any twist, computed from J_A and J_B as in appendix A, equals Omega^2 g."""
    for name in ("input", "output"):
        e = tripod.element_of(INPUT | {"element": name})
        for phi in np.linspace(0, math.pi, 7):
            exact = oracle.stiffness(name, NINE_DEGREES, phi) / oracle.inertia(name, NINE_DEGREES, phi)
            assert float(e.frequency**2 * tripod.stiffness_ratio(e, math.cos(2 * phi))) == pytest.approx(
                exact, rel=1e-13
            )


def test_where_chi_n_comes_from():
    row = REFERENCE["omega_vs_beta"][9]
    for values, k, stated in ((INPUT, 1, 0.0026), (OUTPUT, 3, 0.0027)):
        printed = tripod.element_of(values | {"chi_source": "printed_formula"})
        assert float(printed.chi_n) == pytest.approx(row[f"chi{k}_as_printed"], rel=1e-12)
        value, given = (
            tripod.element_of(values | more) for more in ({"chi_source": "printed_value"}, {"chi_n": stated})
        )
        assert float(value.chi_n) == given.chi_n == stated
        assert float(value.c_stiffness) == float(given.c_stiffness)
    # A given chi_n enters c1..c4 too.
    given = tripod.element_of(INPUT | {"chi_n": 0.0026})
    assert float(given.c_stiffness) == pytest.approx(REFERENCE["params"]["c1"], rel=1e-12)
    assert float(given.c_inertia) == pytest.approx(REFERENCE["params"]["c2"], rel=1e-12)


@pytest.mark.parametrize("equation", ["25", "26", "29", "30"])
@pytest.mark.parametrize("chi_n", [None, 0.3])
def test_field_against_the_plain_equations(equation, chi_n):
    name = oracle.EQUATIONS[equation]
    given = {} if chi_n is None else {"chi_n": chi_n}
    flow = tripod.Tripod.of(
        INPUT | given | {"element": name, "equation": equation, "excitation_frequency": 3000.0}
    ).flow_model()
    s = oracle.shaft(name, chi_n=chi_n)
    for strobe, fraction, phi, rate in ((0, 0.0, 0.0, 0.0), (3, 0.21, 0.7, -2e3), (50, 0.9, -2.0, 5e3)):
        y = jnp.array([phi, rate / s.omega])
        t = (strobe + fraction) / 3000.0
        expected = oracle.acceleration(s, equation, 0.0016, 3000.0, 600 * math.pi, t, (phi, rate))
        found = flow.vector(strobe, fraction, y) * jnp.array(flow.scale)
        np.testing.assert_allclose(found, [rate, expected], rtol=1e-10, atol=1e-6)


@pytest.mark.parametrize("equation", ["25", "26", "29", "30"])
def test_divergence_is_the_trace_of_the_jacobian(equation):
    values = INPUT | {"element": oracle.EQUATIONS[equation], "equation": equation, "chi_n": 0.3}
    flow = tripod.Tripod.of(values).flow_model()
    y = jnp.array([0.7, -0.3])
    jacobian = jax.jacfwd(lambda x: flow.vector(4, 0.3, x))(y)
    assert float(jnp.trace(jacobian)) == pytest.approx(float(flow.divergence(flow.angles(4, 0.3), y)), rel=1e-12)


def test_readings_of_the_torque_sums():
    angle = 0.37
    octave = sum(math.cos(2**i * angle) / 2 ** (i + 1) for i in range(6))
    harmonic = sum(math.cos(2 * i * angle) / (2 * i + 1) for i in range(6))
    assert float(tripod.motor_ripple(angle, "octave")) == pytest.approx(octave, rel=1e-14)
    assert float(tripod.motor_ripple(angle, "harmonic")) == pytest.approx(harmonic, rel=1e-14)
    octave = sum(math.cos(2 ** (j - 1) * angle) / 2**j for j in range(1, 8))
    harmonic = sum(math.cos((2 * j - 1) * angle) / (2 * j) for j in range(1, 8))
    assert float(tripod.mill_ripple(angle, "octave")) == pytest.approx(octave, rel=1e-14)
    assert float(tripod.mill_ripple(angle, "harmonic")) == pytest.approx(harmonic, rel=1e-14)


def test_phase_does_not_drift():
    """The motor's angle after 50,000 strobes agrees with rational arithmetic; from the time it would be off by 1e-11."""
    flow = tripod.Tripod.of(INPUT | {"excitation_frequency": 3066.5}).flow_model()
    turns = Fraction(float(flow.turns[1]))
    for strobe in (1, 12_345, 50_000, 5_000_000):
        exact = float((turns * strobe) % 1)
        found = float(flow.angles(strobe, 0.0)[1]) / (2 * math.pi)
        assert (found - exact + 0.5) % 1 - 0.5 == pytest.approx(0, abs=2e-15)
        assert float(flow.angles(strobe, 0.25)[0]) == math.pi / 2


def test_determinant_against_quadrature():
    for chi in (0.0026, 0.3, 0.45):
        values = INPUT | {"chi_n": chi, "excitation_frequency": 3066.5}
        expected = oracle.determinant("input", 0.0016, 3066.5, chi)
        assert float(jnp.exp(tripod.Tripod.of(values).floquet_model().natural.log_determinant())) == pytest.approx(
            expected, rel=1e-13
        )
    both = INPUT | {"chi_n": np.array([0.3, 0.45]), "excitation_frequency": 3066.5}
    batch = tripod.Tripod.of(both).floquet_model().natural.log_determinant()
    assert batch.shape == (2,)
    assert float(jnp.exp(batch[1])) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize(
    ("analysis", "given", "message"),
    [
        ("history", {"equation": "26"}, "equation = '26': expected 25 or 29 .*of the input element"),
        ("floquet", {"equation": "25"}, "equation = '25': expected 29 .*of the input element"),
        ("floquet", {"chi_n": 0.0026, "chi_source": "printed_value"}, "chi_n = 0.0026: given together with chi_source"),
        ("floquet", {"beta": math.pi / 2}, "beta = 1.57"),
        ("floquet", {"zeta": 0.0}, "zeta = 0.0: expected 0 < zeta"),
        ("floquet", {"element": "middle"}, "expected one of input, output"),
    ],
)
def test_wrong_input_is_one_line(analysis, given, message):
    fixed = {"element": "input", "beta": 0.1, "zeta": 0.01} | given
    options = {"stop": 0.1} if analysis == "history" else {}
    with pytest.raises(InputError, match=message) as raised:
        load_scene({"system": "tripod", "analysis": analysis, "fixed": fixed, "options": options})
    assert "\n" not in str(raised.value)


def test_exponents_need_a_time_in_seconds():
    fixed = {"beta": 0.3, "Omega": 1.4, "zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    scene = {"system": "cardan", "analysis": "floquet", "outputs": ["floquet_exponent"], "fixed": fixed}
    with pytest.raises(
        InputError, match="'floquet_exponent': a rate in 1/s, and the time of cardan has no unit; expected"
    ):
        load_scene(scene)


@pytest.mark.full
@pytest.mark.parametrize("method", ["direct", "diffrax"])
def test_both_exponents_of_a_strongly_damped_element(method):
    zetas = np.array([0.5, 1.5, 5.0, 10.0, 100.0])
    scene = {"system": "tripod", "analysis": "floquet", "outputs": ["floquet_exponent", "floquet_multiplier"]}
    fixed = {"element": "input", "beta": NINE_DEGREES, "chi_n": 0.0}
    ds = dt.run({**scene, "points": {"zeta": zetas.tolist()}, "fixed": fixed, "options": {"method": method}})
    frequency = float(tripod.element_of(INPUT).frequency)
    root = np.sqrt(zetas[1:] ** 2 - 1)
    slow = np.append(-0.5, -1 / (zetas[1:] + root)) * frequency
    fast = np.append(-0.5, -(zetas[1:] + root)) * frequency
    np.testing.assert_allclose(ds.floquet_exponent, np.stack([slow, fast], axis=1), rtol=1e-8)
    determinant = np.exp((slow + fast) * math.pi / frequency)
    np.testing.assert_allclose(np.prod(ds.floquet_multiplier[:4], axis=1), determinant[:4], rtol=1e-8)


def test_equation_may_be_a_number():
    fixed = {"element": "input", "beta": 0.1, "zeta": 0.01, "equation": 29}
    assert load_scene({"system": "tripod", "analysis": "floquet", "fixed": fixed}).fixed["equation"] == "29"


@pytest.mark.full
def test_coefficients_beyond_one_are_an_outcome():
    """c1 reaches 1 at chi_n = 0.4987; beyond, the stiffness vanishes during a turn and the model is not valid."""
    point = dt.point("tripod", "floquet", element="input", beta=NINE_DEGREES, zeta=0.01, chi_n=0.6)
    assert point.outcome.name == "NOT_FINITE"
    assert math.isnan(point.spectral_radius)


@jax.jit
def radius_and_slopes(chi_n, frequency, zeta):
    """Spectral radius of the input element and its derivatives by chi_n and the excitation frequency."""

    def radius(chi_n, frequency):
        shaft = dt.Tripod(element="input", beta=NINE_DEGREES, zeta=zeta, chi_n=chi_n, excitation_frequency=frequency)
        return dt.floquet(shaft, rtol=1e-13).spectral_radius

    return jax.value_and_grad(radius, argnums=(0, 1))(chi_n, frequency)


@pytest.mark.full
@pytest.mark.parametrize("case", REFERENCE["critical_chi_n"], ids=lambda case: str(case["zeta"]))
def test_least_chi_n_that_makes_the_element_unstable(case):
    """At the tip of the principal tongue the radius is 1, and largest over the frequency; errors are Newton steps."""
    chi_n, frequency, zeta = (case[name] for name in ("chi_n", "excitation_frequency_Hz", "zeta"))
    radius, (slope, along) = radius_and_slopes(chi_n, frequency, zeta)
    assert abs(radius - 1) / slope < 1e-12
    before, after = (radius_and_slopes(chi_n, frequency + step, zeta)[1][1] for step in (-0.01, 0.01))
    bend = (after - before) / 0.02
    assert bend < 0 and abs(along / bend) < 1e-4


@pytest.mark.full
def test_least_chi_n_at_the_lowest_damping_of_the_paper():
    """The tip lies 6.68 times above the nonuniformity .0026 that the paper states (docs/theory/tripod.md)."""
    chi_n = 0.0173632641
    radius, (slope, _) = radius_and_slopes(chi_n, 3066.2178899, 0.0016)
    assert abs(radius - 1) / slope < 2e-10
    assert round(chi_n / 0.0026, 2) == 6.68


@pytest.mark.full
@pytest.mark.parametrize("case", REFERENCE["critical_chi_n_at_2_Omega"], ids=lambda case: str(case["zeta"]))
def test_edge_of_the_tongue_at_twice_the_natural_frequency(case):
    constants = dt.point("tripod", "parameters", element="input", beta=NINE_DEGREES, outputs="resonance_frequency")
    radius, (slope, _) = radius_and_slopes(case["chi_n"], float(constants.resonance_frequency), case["zeta"])
    assert abs(radius - 1) / slope < 1e-11
