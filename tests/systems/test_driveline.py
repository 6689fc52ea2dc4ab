"""Drivelines against references in 80 bits, the cardan shaft, closed forms, and equations with Lagrange multipliers."""

from __future__ import annotations

import json
import math
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

import drivetrain_jax as dt
from drivetrain_jax.resonances import Orders, driveline_resonances, orders_of, stored_orders
from drivetrain_jax.runs.physical import read_table
from drivetrain_jax.runs.reply import with_unstable_ranges
from drivetrain_jax.systems.driveline import MOST_TURNS, best_phases, range_of, uneven_rotation
from drivetrain_jax.view.style import unstable_text
from tests.oracles import driveline_reference as oracle
from tests.quick_jit import quick_jit
from tests.sizes import full_after

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "driveline.json").read_text())
CASES = {case["name"]: case for case in REFERENCE["cases"]}
LISTS = ("k", "c", "J", "beta", "phase", "ratio")
MULTIPLIERS = ["floquet_multiplier", "floquet_multiplier_error"]


def of_case(name: str, **changes) -> dt.Driveline:
    case = CASES[name]
    ratio = [f"{p}/{q}" for p, q in case["ratio_fraction"]]
    values: dict[str, Any] = {n: case[n] for n in ("speed", *LISTS)} | {"ratio": ratio} | changes
    return dt.Driveline(**values)


def random_chain(rng, n: int, joints: int, gears: bool = False) -> dict[str, Any]:
    """Parameters with moderate damping; the first joints bend, and a gear of 3/2 follows the first element."""
    beta = np.zeros(n)
    beta[rng.choice(np.arange(1, n), joints, replace=False)] = rng.uniform(0.1, 0.8, joints)
    return {
        "speed": float(rng.uniform(8, 20)),
        "k": rng.uniform(5, 150, n).tolist(),
        "c": rng.uniform(0.005, 0.1, n).tolist(),
        "J": rng.uniform(0.05, 0.8, n).tolist(),
        "beta": beta.tolist(),
        "phase": rng.uniform(0, math.pi, n).tolist(),
        "ratio": [1.5 if gears and i == 0 else 1.0 for i in range(n)],
    }


def farthest(found, expected) -> float:
    """The largest distance of an expected number from the nearest one found."""
    return max(np.abs(np.asarray(found) - x).min() for x in np.asarray(expected))


def multipliers_by_scipy(form) -> np.ndarray:
    """Multipliers of a linear periodic form, with its reversal if it is half a period."""
    matrix, n = quick_jit(form.matrix), form.size
    end = solve_ivp(
        lambda t, y: (np.asarray(matrix(t)) @ y.reshape(n, n)).ravel(),
        (0.0, form.span),
        np.eye(n).ravel(),
        method="DOP853",
        rtol=1e-12,
        atol=1e-14,
    )
    phi, ends = end.y[:, -1].reshape(n, n), form.ends()
    return np.linalg.eigvals(phi if ends is None else np.array(ends[0]) @ phi.T @ np.array(ends[1]) @ phi)


@pytest.mark.parametrize("name", CASES)
def test_field_linearisation_and_forcing_are_those_of_the_reference(name):
    case, shaft = CASES[name], of_case(name)
    n, linear = len(case["k"]), case["linear"]
    field = quick_jit(shaft.vector_field)(case["field"]["tau"], jnp.array(case["field"]["y"]))
    np.testing.assert_allclose(field, case["field"]["dy"], rtol=0, atol=1e-12)
    model = shaft.floquet_model()
    matrix = np.asarray(quick_jit(model.natural.matrix)(linear["tau"]))
    np.testing.assert_allclose(matrix[n:, :n], -np.array(linear["P_absolute"]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(matrix[n:, n:], -np.array(linear["E"]), rtol=0, atol=1e-11)
    forcing = quick_jit(shaft.linear_field)(linear["tau"], jnp.zeros(2 * n))
    np.testing.assert_allclose(forcing[n:], linear["f"], rtol=0, atol=1e-12)
    assert model.natural.span == pytest.approx(math.pi * case["period_over_pi"], rel=1e-15)
    if model.natural.log_determinant:
        assert float(model.natural.log_determinant()) == pytest.approx(case["log_det"], abs=1e-13)
    else:
        assert set(case["ratio"]) != {1.0}


@pytest.mark.parametrize("name", full_after(1, ["ref1", "ref2", "ref3", "ref4", "ref5", "ref6"]))
def test_multipliers_are_those_of_the_reference(name):
    found = dt.floquet(of_case(name), outputs=[*MULTIPLIERS, "liouville_residual"], rtol=1e-12)
    expected = [complex(*z) for z in CASES[name]["multipliers_absolute"]]
    assert farthest(found.floquet_multiplier, expected) < 1e-11
    assert farthest(found.floquet_multiplier, expected) <= np.max(found.floquet_multiplier_error)
    assert abs(found.liouville_residual) < 1e-11


def pairs(count: int) -> tuple[list[dt.Driveline], list[dt.Cardan]]:
    """Random cardan shafts, and the same as drivelines of two inertias."""
    rng, chains, shafts = np.random.default_rng(5), [], []
    for _ in range(count):
        speed, k, j = rng.uniform(3, 30), rng.uniform(5, 100, 2), rng.uniform(0.05, 1, 2)
        c, beta = rng.uniform(0.001, 0.5, 2), rng.uniform(-1.3, 1.3)
        chains.append(dt.Driveline(speed=speed, k=k, c=c, J=j, beta=[0.0, beta]))
        data = {"J1": j[0], "J2": j[1], "k1": k[0], "k2": k[1], "c1": c[0], "c2": c[1]}
        shafts.append(dt.Cardan.from_physical(**data, speed=speed * 60 / (2 * math.pi), beta=beta))
    return chains, shafts


def batch(systems: list):
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(each, float) for each in x]), *systems)


def test_equations_of_one_joint_are_those_of_cardan():
    chains, shafts = map(batch, pairs(200))
    rng = np.random.default_rng(6)
    tau, y = rng.uniform(0, 10, 200), rng.normal(0, 0.5, (200, 4))
    for name in ("vector_field", "linear_field"):
        found, expected = (
            jax.vmap(lambda s, t, y, name=name: getattr(s, name)(t, y))(each, tau, y) for each in (chains, shafts)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.full
def test_multipliers_of_one_joint_are_those_of_cardan():
    chains, shafts = map(batch, pairs(1000))
    found, expected = (
        jax.vmap(lambda s: dt.floquet(s, outputs=MULTIPLIERS, rtol=1e-12))(each) for each in (chains, shafts)
    )
    distances = [
        farthest(a, b) / abs(b).max()
        for a, b in zip(found.floquet_multiplier, expected.floquet_multiplier, strict=True)
    ]
    # Multipliers that nearly coalesce move by the root of the error of the matrix, which their bounds say.
    bounds = np.max(found.floquet_multiplier_error + expected.floquet_multiplier_error, axis=1)
    assert np.median(distances) < 1e-12
    assert np.all(np.array(distances) < np.maximum(1e-11, bounds))


@pytest.mark.parametrize("n", [1, 2, 7])
def test_frequencies_of_a_uniform_chain_are_the_closed_form(n):
    shaft = dt.Driveline(speed=1.0, k=[250.0] * n, c=[0.0] * n, J=[0.4] * n)
    found = 2 * math.pi * np.asarray(dt.modes(shaft, outputs=["natural_frequency"]).natural_frequency)
    expected = 2 * math.sqrt(250 / 0.4) * np.sin((2 * np.arange(1, n + 1) - 1) * math.pi / (2 * (2 * n + 1)))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_frequencies_of_a_geared_chain_are_generalised_eigenvalues():
    shaft = of_case("ref6")
    found = np.asarray(dt.modes(shaft, outputs=["natural_frequency"]).natural_frequency)
    n = np.eye(5) - np.diag(CASES["ref6"]["ratio"][1:], -1)
    squares = eigh(n.T @ np.diag(shaft.k) @ n, np.diag(shaft.J), eigvals_only=True)
    np.testing.assert_allclose(2 * math.pi * found, np.sqrt(squares), rtol=1e-13)


@pytest.mark.parametrize(
    ("ratio", "turns"), [((), 0.5), ((1, 1.5, 1, 1), 1.0), ((2, 1, 1, 1), 0.25), ((1, "4.1/1.1", 1, 1), 5.5)]
)
def test_period_follows_from_the_ratios_before_the_joints(ratio, turns):
    shaft = dt.Driveline(speed=9.0, k=[9.0] * 4, c=[0.0] * 4, J=[1.0] * 4, beta=[0.0, 0.2, 0.3, 0.0], ratio=ratio)
    assert isinstance(shaft.half_turns(), float)
    assert shaft.half_turns() == 2 * turns
    assert float(jax.jit(lambda s: jnp.asarray(s.half_turns()))(shaft)) == 2 * turns


def test_traced_ratios_without_a_common_period_have_none():
    shaft = dt.Driveline(speed=9.0, k=[9.0] * 2, c=[0.0] * 2, J=[1.0] * 2, beta=[0.2, 0.3], ratio=[0.3333, 1.0])
    assert np.isnan(jax.jit(lambda s: s.half_turns())(shaft))


def test_ratios_before_a_joint_alone_have_no_derivative():
    """The period depends on them by steps."""
    shaft = dt.Driveline(speed=9.0, k=[9.0] * 3, c=[0.1] * 3, J=[1.0] * 3, beta=[0.2, 0.3, 0.0], ratio=[1.5, 1.0, 0.5])
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes = quick_jit(derivative(lambda s: s.half_turns() * s.linear_field(0.3, jnp.full(6, 0.1))))(shaft)
        missing = jax.tree.map(lambda x: bool(jnp.any(jnp.isnan(x))), slopes)
        assert missing.ratio == (True, False, False)
        assert not any(jax.tree.leaves((missing.speed, missing.k, missing.c, missing.J, missing.beta)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ratio": [1.0, 0.3333, 1.0]}, f"common period of up to {MOST_TURNS} turns"),
        ({"ratio": [1.0, "50/49", 1.0]}, "common period"),
        ({"ratio": [1.0, 0.0, 1.0]}, r"ratio\[1\] = 0"),
        ({"ratio": [1.0, 0.0, 1.0], "beta": []}, r"ratio\[1\] = 0"),
        ({"J": [1.0, 2.0]}, "J: 2 entries where k has 3"),
        ({"beta": [0.1]}, "beta: 1 entry where k has 3"),
    ],
)
def test_lists_that_do_not_match_are_refused_in_one_line(changes, message):
    values: dict[str, Any] = {"speed": 9.0, "k": [9.0] * 3, "c": [0.0] * 3, "J": [1.0] * 3, "beta": [0.0, 0.2, 0.3]}
    shaft = dt.Driveline(**values | changes)
    with pytest.raises(dt.InputError, match=message) as raised:
        dt.floquet(shaft)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("gears", [False, True])
def test_half_a_period_is_enough_for_phases_of_a_quarter_turn(gears):
    chain = random_chain(np.random.default_rng(7), 3, 2, gears)
    chain["phase"] = [0.0, math.pi / 2, 0.0]
    model = dt.Driveline(**chain).floquet_model()
    assert model.reduced.span == model.natural.span / 2
    assert farthest(multipliers_by_scipy(model.reduced), multipliers_by_scipy(model.natural)) < 1e-11
    chain["phase"] = [0.0, 1.5, 0.0]
    whole = dt.Driveline(**chain).floquet_model()
    assert whole.reduced.span == whole.natural.span


@cache
def lagrange_cases() -> list:
    rng = np.random.default_rng(8)
    sizes = [(3, 1), (4, 2), (3, 2), (5, 3), (4, 3), (5, 1), (8, 3), (6, 2), (7, 3), (6, 1)]
    return [random_chain(rng, n, joints, gears=i % 3 == 1) for i, (n, joints) in enumerate(sizes)]


def test_linearisation_is_that_of_lagrange_multipliers():
    for chain in lagrange_cases()[:3]:
        shaft = dt.Driveline(**chain)
        root = np.sqrt(np.array([*chain["J"], *chain["J"]]))
        found = np.asarray(quick_jit(shaft.floquet_model().reduced.matrix)(1.3)) / root[:, None] * root
        np.testing.assert_allclose(found, oracle.linear_matrix(chain, 1.3), rtol=0, atol=1e-11 * abs(found).max())


@pytest.mark.full
@pytest.mark.parametrize("number", range(3))
def test_forced_twists_and_torques_are_those_of_harmonics(number):
    chain = lagrange_cases()[number]
    shaft = dt.Driveline(**chain)
    found = dt.forced(shaft)
    twist, torque = oracle.harmonic_response(chain, float(shaft.forced_model().period), 96)
    np.testing.assert_allclose(found.amplitude, twist, rtol=2e-6)
    np.testing.assert_allclose(found.torque, torque, rtol=2e-6)


@pytest.mark.full
@pytest.mark.parametrize("name", ["torque", "orbit_torque"])
def test_derivatives_of_torques_are_those_of_differences(name):
    chain: dict[str, Any] = lagrange_cases()[0] | {"beta": [0.0, 0.3, 0.2]}
    torque = lambda s: getattr(dt.forced(s, outputs=[name], rtol=1e-12), name)[1]  # noqa: E731
    slope = jax.grad(torque)(dt.Driveline(**chain))
    for key, i in (("k", 1), ("c", 1), ("J", 0), ("beta", 1), ("phase", 1), ("ratio", 2)):
        step = 1e-4 * chain[key][i]
        moved: list[Any] = [[x + s * (j == i) for j, x in enumerate(chain[key])] for s in (-step, step)]
        ends = [float(torque(dt.Driveline(**{**chain, key: values}))) for values in moved]
        assert getattr(slope, key)[i] == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5)
    assert np.isnan(slope.ratio[0])


@pytest.mark.full
@pytest.mark.parametrize("number", range(10))
def test_multipliers_are_those_of_lagrange_multipliers(number):
    chain = lagrange_cases()[number]
    found = dt.floquet(dt.Driveline(**chain), outputs=["floquet_multiplier", "floquet_multiplier_error"])
    period = float(dt.Driveline(**chain).floquet_model().natural.span)
    expected = oracle.multipliers(chain, period)
    assert farthest(found.floquet_multiplier, expected) < 1e-9
    bound = np.max(found.floquet_multiplier_error)
    assert farthest(found.floquet_multiplier, expected) < bound + 1e-10


@pytest.mark.full
def test_gradient_of_the_spectral_radius_is_that_of_differences():
    shaft = of_case("ref2")
    radius = lambda s: dt.floquet(s, outputs=["spectral_radius"], rtol=1e-13).spectral_radius  # noqa: E731
    slope = jax.grad(radius)(shaft)
    for name, i in (("k", 1), ("c", 2), ("J", 0), ("beta", 2), ("phase", 1)):
        values = CASES["ref2"][name]
        step = 1e-4 * max(abs(values[i]), 0.1)
        ends = [
            radius(of_case("ref2", **{name: [*values[:i], values[i] + s, *values[i + 1 :]]})) for s in (-step, step)
        ]
        assert getattr(slope, name)[i] == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-5, abs=1e-8)
    # The period depends on the ratios before a joint, so a derivative exists by the last one alone.
    assert np.isnan(slope.ratio[0])
    assert np.isfinite(slope.ratio[2])


@pytest.mark.full
def test_undamped_multipliers_are_on_the_circle_outside_tongues():
    """The Jacobian in twists is not Hamiltonian: it says 1.000881 for this chain (theory/driveline.md)."""
    found = dt.floquet(of_case("ref2", c=[0.0] * 3), outputs=["spectral_radius", "verdict"])
    assert found.verdict == 0
    assert found.spectral_radius == 1


@pytest.mark.full
def test_energy_is_balanced_without_damping():
    """Kinetic and elastic energy plus the work at the driving end, over 1,000 turns of the nonlinear field."""
    case = CASES["ref2"]
    shaft = of_case("ref2", c=[0.0] * 3)
    n, w = 3, case["speed"]

    def extended(tau, y):
        slopes = shaft.vector_field(tau, y[:-1])
        # No joint at the driving end: the source feels the first torque.
        return jnp.append(slopes, shaft.k[0] * y[0] / w**2)

    field = jax.jit(extended)
    start = jnp.array([0.3, -0.2, 0.1, 0.05, 0.2, -0.1, 0.0])

    def step(k, y, h):
        # Gauss-Legendre collocation of order 8 by fixed-point iteration.
        from drivetrain_jax.analysis.numerics.collocation import gauss

        a, b, c = gauss(4)
        tau = (k + c) * h

        def iterate(_, slopes):
            return jax.vmap(lambda t, x: extended(t, x))(tau, y + h * a @ slopes)

        slopes = jax.lax.fori_loop(0, 9, iterate, jnp.broadcast_to(field(k * h, y), (4, 7)))
        return y + h * b @ slopes

    def energy(tau, y):
        theta, rates = y[:n], y[n : 2 * n]
        speeds = absolute(shaft, tau, theta, rates)
        return (
            0.5 * sum(j * v**2 for j, v in zip(shaft.J, speeds, strict=True))
            + 0.5 / w**2 * sum(k * x**2 for k, x in zip(shaft.k, theta, strict=True))
            + y[-1]
        )

    per_turn = 150
    h = 2 * math.pi / per_turn
    turns = 1000
    end = jax.jit(lambda y: jax.lax.fori_loop(0, turns * per_turn, lambda k, y: step(k, y, h), y))(start)
    first, last = energy(0.0, start), energy(2 * math.pi * turns, end)
    assert abs(last - first) < 1e-10 * abs(first)


def absolute(shaft, tau, theta, rates):
    """Rates of the inertias, by the formula of a joint with atan2."""
    a, speeds = tau, [1.0]
    for beta, phase, r, x, v in zip(*shaft.chain, theta, rates, strict=True):
        c, phi = math.cos(beta), a + phase
        rho = (1 - c) / (1 + c)
        eta = c / (1 - math.sin(beta) ** 2 * jnp.sin(phi) ** 2)
        a = r * (a - jnp.arctan2(rho * jnp.sin(2 * phi), 1 + rho * jnp.cos(2 * phi))) + x
        speeds.append(r * eta * speeds[-1] + v)
    return speeds[1:]


@pytest.mark.full
def test_forced_response_and_history_of_one_joint_are_those_of_cardan():
    chains, shafts = pairs(4)
    for chain, shaft in zip(chains, shafts, strict=True):
        found, expected = (dt.forced(s, outputs=["periodic_state", "amplitude"]) for s in (chain, shaft))
        np.testing.assert_allclose(found.periodic_state, expected.periodic_state, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(found.amplitude, expected.amplitude, rtol=1e-7)
        found, expected = (dt.history(s, stop=20.0, num=11) for s in (chain, shaft))
        np.testing.assert_allclose(found.theta[:, 1], expected.theta2, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.theta_rate[:, 0], expected.theta1_rate, rtol=0, atol=1e-8)


@pytest.mark.full
@pytest.mark.parametrize("case", REFERENCE["orbit"]["cases"], ids=lambda case: case["case"])
def test_nonlinear_orbits_are_those_of_the_reference(case):
    """The first-order orbit of the reference, and the orbit itself unless it is far from the first-order one."""
    beta = [case["beta_scale"] * b for b in CASES[case["case"]]["beta"]]
    outputs = ["periodic_state", "orbit_state", "orbit_spectral_radius"]
    found = dt.forced(of_case(case["case"], beta=beta), outputs=outputs)
    np.testing.assert_allclose(found.periodic_state, case["first_order_y0"], rtol=0, atol=1e-8)
    if case["case"] != "ref3":
        np.testing.assert_allclose(found.orbit_state, case["y0"], rtol=0, atol=1e-7)
        assert found.orbit_spectral_radius == pytest.approx(max(case["abs_multipliers"]), abs=1e-7)


def rotation(beta, phase, **more) -> Any:
    return dt.point("driveline", "phasing", beta=list(beta), phase=list(phase), **more)


@pytest.mark.parametrize("case", REFERENCE["speed_variation"]["cases"], ids=lambda case: str(case["beta"]))
def test_uneven_rotation_is_that_of_the_reference(case):
    ones = (1.0,) * len(case["beta"])
    variation, lead = uneven_rotation(case["beta"], case["phase"], ones, 1.0)
    assert variation == pytest.approx(case["unevenness"], abs=1e-13)
    rho = math.tan(case["equivalent_beta"] / 2) ** 2
    assert lead == pytest.approx(2 * math.asin(rho), abs=1e-12)
    # The same by sampling the rotation, as a chain with gears needs it.
    by_samples = uneven_rotation(case["beta"], case["phase"], tuple(map(np.array, ones)), 1.0)
    np.testing.assert_allclose(by_samples, (variation, lead), rtol=0, atol=1e-12)


def test_the_answer_on_forced_motion_names_the_largest_twist_and_torque():
    lists = {
        "k": [9e3, 8e3],
        "c": [0.5, 0.5],
        "J": [0.03, 0.5],
        "beta": ["9 deg", "5 deg"],
        "parts": ["tube", "pinion"],
    }
    found = dt.point("driveline", "forced", speed="3000 rpm", **lists)
    assert found.labels["state"] == ("theta 1 tube", "theta 2 pinion", "theta_rate 1 tube", "theta_rate 2 pinion")
    shaft, twist = ("1 tube", "2 pinion")[int(np.argmax(found.amplitude))], np.degrees(max(found.amplitude))
    assert found.sentence.startswith(
        f"The forced motion of the linear model reaches {twist:.4g} deg (shaft {shaft}) and "
    )
    unnamed = dt.point("driveline", "forced", speed="3000 rpm", **{**lists, "parts": []})
    assert unnamed.labels["state"] == ("theta 1", "theta 2", "theta_rate 1", "theta_rate 2")


@pytest.mark.parametrize(
    "lengths", [(0.3,), (0.2, 0.2), (0.1, 0.3), (0.3, 0.2, 0.4), (0.1, 0.5, 0.2), (0.2, 0.2, 0.2, 0.5)]
)
def test_best_phases_close_the_polygon_of_the_joints(lengths):
    """No phases do better than the longest l = ln sec(beta) less all others, eq. (8)."""
    beta = np.arccos(np.exp(-np.array(lengths))).tolist()
    ones = (1.0,) * len(beta)
    best = best_phases(beta, (0.4,) * len(beta), ones)
    least, _ = uneven_rotation(beta, best, ones, 1.0)
    assert best[0] == pytest.approx(0.4)
    assert least == pytest.approx(2 * math.sinh(max(0.0, 2 * max(lengths) - sum(lengths))), abs=1e-12)


def test_joints_that_cancel_have_no_derivative():
    """The range of the speed has a corner there: one-sided differences by a phase are +-0.0805."""
    line = {"speed": 100.0, "k": [1e4] * 2, "c": [1.0] * 2, "J": [0.1] * 2, "beta": [0.2, 0.2]}

    def slopes(**change):
        chain = dt.Driveline(**line | change)
        return jax.grad(lambda s: dt.phasing(s, outputs=["speed_variation"]).speed_variation)(chain)

    crossed = slopes(phase=[0.0, np.pi / 2])
    assert np.isnan([*crossed.beta, *crossed.phase]).all() and crossed.k == (0, 0)
    assert slopes(beta=[0.0, 0.0]).beta == (0, 0)
    np.testing.assert_allclose(slopes(phase=[0.0, np.pi / 2 + 1e-3]).phase, [-0.0805, 0.0805], rtol=2e-3)


@pytest.mark.parametrize(
    ("function", "slope"),
    [(lambda t, p: jnp.cos(4 * t) + p * jnp.cos(2 * t), 1.05), (lambda t, p: p * jnp.cos(2 * t), 2.0)],
)
def test_equal_extremes_that_move_apart_have_no_derivative(function, slope):
    """The ranges are 2 + |p| + p^2/8 and 2 |p|: corners as of joints behind a gear, and of those that cancel."""
    found = quick_jit(jax.vmap(jax.jacfwd(lambda p: range_of(partial(function, p=p), math.pi))))(jnp.array([0.0, 0.2]))
    np.testing.assert_allclose(found, [math.nan, slope], rtol=1e-12)


def test_the_highest_of_many_peaks_is_found_between_samples():
    """The best of 4,096 samples lies at a lower peak, which gives 21.8068; bounded searches around all peaks gave this."""
    found = quick_jit(lambda p: uneven_rotation((1.3, 1.4), (0.0, p), (20.0, 1.0), 1.0)[0])(0.1)
    assert float(found) == pytest.approx(21.838741160731, rel=1e-11)


def test_the_answer_on_phasing_agrees_with_published_rules():
    """Elbe: U = .0027 at 2.9765 deg; 5 and 4 deg make 3.000 deg by the makers' rule, 3.0024 exactly; 30 + 30 deg."""
    assert rotation(["2.9765 deg"], [0.0]).speed_variation == pytest.approx(0.0027, abs=2e-8)
    well = rotation(["5 deg", "4 deg"], [0.0, "90 deg"])
    rho = math.tan(math.radians(3.0024) / 2) ** 2
    assert well.speed_variation == pytest.approx(4 * rho / (1 - rho**2), rel=1e-4)
    with pytest.raises(dt.InputError, match="600 rpm:900 rpm: a range"):
        rotation(["5 deg"], [0.0], speed=("600 rpm", "900 rpm"))
    badly = rotation(["30 deg", "30 deg"], [0.0, 0.0], speed="600 rpm")
    assert badly.speed_variation == pytest.approx(4 / 3 - 3 / 4, rel=1e-12)
    np.testing.assert_allclose(badly.best_phase, [0.0, math.pi / 2], rtol=1e-12)
    assert badly.least_variation < 1e-12
    assert badly.sentence == (
        "The output speed varies by 58.33 % peak to peak (16.43 deg, 350 rpm at 600 rpm); "
        "with the phases [0, 90] deg by 0 %."
    )
    assert json.loads(badly.to_json())["answer"] == badly.sentence
    assert str(badly).startswith(badly.sentence)


def test_phases_across_a_gear_make_up_for_nothing():
    found = rotation(["20 deg", "20 deg"], [0.0, 0.3], ratio=[2, 1])
    alone = rotation(["20 deg"], [0.0])
    np.testing.assert_allclose(found.best_phase, [0.0, 0.3], rtol=1e-12)
    assert found.speed_variation == pytest.approx(found.least_variation, rel=1e-12)
    assert found.sentence.endswith("the best phases of each run of joints at one speed do not make it less.")
    # The first joint's speed, doubled, passes a joint of the double speed.
    assert alone.speed_variation < found.speed_variation < 2 * alone.speed_variation * 1.01


@pytest.mark.parametrize(
    ("beta", "ratio"),
    [([0.2, 0.2], [-1, 1]), ([0.2, 0.0, 0.2], [2, 0.5, 1]), ([0.3, 0.0, 0.2, 0.4], [3, "-1/3", -1, 1])],
)
def test_gears_that_multiply_to_one_do_not_part_joints(beta, ratio):
    """A reversed shaft turns the other way, unevenly by the same; the least is that of the joints without gears."""
    phase = [0.0] * (len(beta) - 1) + [0.3]
    found = rotation(beta, phase, ratio=ratio)
    alone = rotation(beta, phase)
    assert found.least_variation == pytest.approx(alone.least_variation, abs=1e-12)
    assert rotation(beta, list(found.best_phase), ratio=ratio).speed_variation == pytest.approx(
        found.least_variation, abs=1e-12
    )


def test_best_phases_of_joints_at_several_speeds_are_no_worse():
    """Each part made even by itself would add up to .538."""
    beta, phase = [0.57190071, 0.16340855, 0.53238915], [1.45645401, 1.01023857, 2.27633892]
    found = rotation(beta, phase, ratio=[0.5, 1, 1])
    assert found.speed_variation == pytest.approx(0.481553, rel=1e-6) and found.least_variation == found.speed_variation
    np.testing.assert_allclose(found.best_phase, phase)


@pytest.mark.full
def test_branches_over_the_speed_contain_the_steady_states():
    """Stable orbits attract the motion from rest; an unstable one is not met."""
    chain: dict[str, Any] = {"k": [90.0, 60.0], "c": [0.6, 0.5], "J": [0.4, 0.3], "beta": [0.0, 0.4]}
    chain |= {"phase": [0.0, 0.0], "ratio": [1.0, 1.0]}
    speeds = np.linspace(3.0, 9.0, 13)
    outputs = ["branch_amplitude", "branch_stability", "branch_spectral_radius"]
    found = dt.frequency_response(dt.Driveline(**{**chain, "speed": speeds}), outputs=outputs)
    assert np.all(found.outcome == 0)
    for i in (0, 6, 12):
        steady = oracle.steady_twists({**chain, "speed": speeds[i]}, math.pi, 120)
        stable = np.asarray(found.branch_amplitude[i])[np.asarray(found.branch_stability[i]) == 0]
        assert np.abs(stable / steady - 1).max(axis=1).min() < 1e-4
        orbit = dt.forced(dt.Driveline(**{**chain, "speed": speeds[i]}), outputs=["orbit_spectral_radius"])
        radii = np.asarray(found.branch_spectral_radius[i])
        assert np.nanmin(np.abs(radii - orbit.orbit_spectral_radius)) < 1e-8


def test_unstable_ranges_are_those_between_changes_of_the_verdict(monkeypatch):
    """A wide range, and one that is narrower than the distance of samples, at a predicted resonance."""
    shaft = {"k": (4e4, 1e4), "J": (0.1, 0.4), "ratio": ()}
    found = driveline_resonances(2)
    narrow = found.values(shaft)[found.labels.index("C+121")]

    def run(scene):
        x = np.array([float(text.split()[0]) for text in scene["axes"]["speed"]["values"]])
        radius = np.where(abs(x - narrow) < 1e-3, 1.1, 1 - 1e-3 * ((x - 400.25) ** 2 - 25.0))
        codes = (radius > 1).astype(int)
        return xr.Dataset({"spectral_radius": ("speed", radius), "verdict": ("speed", codes)})

    monkeypatch.setattr("drivetrain_jax.runs.run.run", run)
    axis = xr.DataArray(np.linspace(200.0, 500.0, 31), dims="speed", attrs={"units": "rad/s"})
    fixed = {name: {"value": value, "units": "1"} for name, value in shaft.items()}
    attrs = {"system": "driveline", "scene": "[axes]\nspeed = {}", "fixed_parameters": json.dumps(fixed)}
    result = xr.Dataset({"outcome": ("speed", np.zeros(31, int))}, {"speed": axis}, attrs)
    answer, worst = with_unstable_ranges(result)
    expected = sorted([(narrow - 1e-3, narrow + 1e-3), (395.25, 405.25)])
    np.testing.assert_allclose(answer["unstable_speed"], expected, rtol=0, atol=3e-4)
    assert sorted(answer["unstable_resonance"].values) == ["", "C+121"]
    assert worst == pytest.approx(narrow, abs=1e-3)
    assert unstable_text(answer, "speed").count("(C+121)") == 1


@pytest.mark.full
def test_ends_of_unstable_ranges_are_those_of_lagrange_multipliers():
    chain: dict[str, Any] = {
        "k": [9e3, 8e3, 4e4],
        "c": [0.05, 0.05, 2.0],
        "J": [0.03, 0.05, 8.0],
        "beta": [0.2, 0.4, 0.0],
    }
    chain |= {"phase": [0.0, 0.3, 0.0], "ratio": [1.0, 1.0, 0.25]}
    found = dt.point("driveline", "floquet", speed=("1500 rpm", "9000 rpm"), **chain)
    assert found.unstable is not None
    name, ranges = found.unstable
    assert name == "speed" and len(ranges) > 0 and found.verdict == 1
    low, high = ranges[0]
    assert f"Unstable at speed = {30 * low / math.pi:.6g} to {30 * high / math.pi:.6g}" in found.sentence
    for speed, unstable in ((low - 0.01, 0), (low, 1), (high, 1), (high + 0.01, 0)):
        largest = abs(oracle.multipliers({**chain, "speed": speed}, math.pi)).max()
        assert (largest > 1) == unstable


TRUCK = """part,outer_diameter [mm],inner_diameter [mm],length [mm],J [kg cm2],c [N m s/rad],beta [deg],phase [deg],ratio
front tube,63.5,60,700,300,0.5,8,0,1
rear tube,63.5,60,1300,300,0.5,20,0,1
pinion,32,0,150,500,1,20,90,1
half shafts,30,0,600,80000,20,0,0,11/41
"""


def test_a_table_of_parts_is_a_driveline(tmp_path):
    """One row a part in an engineer's units, with its name."""
    path = tmp_path / "truck.csv"
    path.write_text(TRUCK)
    data = read_table(path)
    assert data["parts"] == ["front tube", "rear tube", "pinion", "half shafts"]
    phases = dt.point("driveline", "phasing", material="steel", **data)
    assert phases.labels["joint"] == ("1 front tube", "2 rear tube", "3 pinion", "4 half shafts")
    with pytest.raises(dt.InputError, match=r"parts = \['tube'\]: expected one name per element, 4"):
        dt.point("driveline", "phasing", material="steel", **{**data, "parts": ["tube"]})
    found = dt.point("driveline", "modes", material="steel", **data)
    g = 2.1e11 / 2.6
    tube = g * math.pi / 32 * (0.0635**4 - 0.060**4) / 1.3
    assert found.parameters["k"][1] == pytest.approx(tube, rel=1e-12)
    assert found.parameters["J"] == pytest.approx((0.03, 0.03, 0.05, 8.0), rel=1e-12)
    assert found.parameters["ratio"][3] == 11 / 41
    # Joints turn at the speed of the driving end: their orders are 2 and 4.
    first = found.natural_frequency[1]
    assert set(found.crossings) == {"order 2 (joints)", "order 4 (joints)"}
    assert found.crossings["order 2 (joints)"][1] == pytest.approx(30 * first, rel=1e-12)
    engine = dt.point("driveline", "modes", material="steel", orders=[3], **data)
    assert engine.crossings["order 3"][1] == pytest.approx(20 * first, rel=1e-12)


def test_a_table_of_parts_may_be_toml(tmp_path):
    """One table a part, with a name and values with units; a part without a value is refused as an empty cell is."""
    paths = [tmp_path / f"truck.{kind}" for kind in ("csv", "toml")]
    paths[0].write_text(TRUCK)
    header, *parts = (line.split(",") for line in TRUCK.splitlines())
    lines = []
    for part in parts:
        lines += ["[[part]]", f'name = "{part[0]}"']
        for column, cell in zip(header[1:], part[1:], strict=True):
            name, _, unit = column.partition(" [")
            text = f'"{float(cell)} {unit[:-1]}"' if unit else f'"{cell}"' if "/" in cell else cell
            lines.append(f"{name} = {text}")
    paths[1].write_text("\ufeff" + "\n".join(lines))
    assert read_table(paths[1]) == read_table(paths[0])
    paths[1].write_text("\n".join(line for line in lines if line != 'c = "0.5 N m s/rad"'))
    with pytest.raises(dt.InputError, match="column c has an empty cell between values"):
        read_table(paths[1])
    paths[1].write_text("k = 3")
    with pytest.raises(dt.InputError, match=r"expected tables \[\[part\]\]"):
        read_table(paths[1])


def test_predicted_resonances_are_sums_of_the_frequencies_of_modes():
    case = CASES["ref6"]
    found = driveline_resonances(2)
    values = {n: tuple(case[n]) for n in ("k", "J", "ratio")} | {"beta": (0.2, 0.0, 0.0, 0.0, 0.0)}
    speeds = dict(zip(found.labels, found.values(values), strict=True))
    omega = 2 * math.pi * np.asarray(dt.modes(of_case("ref6"), outputs=["natural_frequency"]).natural_frequency)
    assert speeds["H12"] == pytest.approx(omega[0] / 4)
    assert speeds["S41"] == pytest.approx(omega[3])
    assert speeds["C+132"] == pytest.approx((omega[0] + omega[2]) / 4)
    # A joint that turns twice as fast meets them at half the speed; joints at several speeds have no common order.
    behind = found.values(values | {"beta": (0.0, 0.2, 0.0, 0.3, 0.0)})
    np.testing.assert_allclose(behind, np.array([*speeds.values()]) / 2)
    assert np.isnan(found.values(values | {"beta": (0.2, 0.2, 0.0, 0.0, 0.0)})).all()
    few = found.values({"k": (4.0,), "J": (1.0,)})
    assert few[found.labels.index("S11")] == pytest.approx(2.0)
    assert np.isnan(few[found.labels.index("S21")])


def test_orders_follow_from_the_speed_of_each_joint():
    found = orders_of("driveline", {"k": (1.0,) * 3, "beta": (0.1, 0.0, 0.2), "ratio": (1.5, -2.0, 1.0)})
    assert found is not None and found.per_turn == {
        "order 2 (joints)": 2.0,
        "order 4 (joints)": 4.0,
        "order 6 (joints)": 6.0,
        "order 12 (joints)": 12.0,
    }
    straight: dict[str, Any] = {"k": (1.0,), "beta": (0.0,)}
    assert orders_of("driveline", straight) is None
    # An engine of four cylinders excites the order 2, and one with a half order, without any joint.
    engine = orders_of("driveline", straight, (2.0, 0.5))
    assert engine is not None and engine.per_turn == {"order 2": 2.0, "order 0.5": 0.5}
    attrs = {"system": "driveline", "options": json.dumps({"orders": [6]}), "fixed_parameters": "{}"}
    assert stored_orders(attrs) == Orders("driving end", {"order 6": 6.0})
