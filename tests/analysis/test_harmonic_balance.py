"""Harmonic balance against automatic differentiation, the describing function and the reference motions."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.frequency_response import harmonic_balance as hb
from drivetrain_jax.analysis.frequency_response import harmonic_response
from drivetrain_jax.analysis.frequency_response.closed_form_response import response as closed_form
from drivetrain_jax.analysis.frequency_response.harmonic_balance import half_trace, spectral_radius
from drivetrain_jax.analysis.frequency_response.harmonic_response import settle, trace
from drivetrain_jax.systems import PiecewiseLinearOscillator
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.quick_jit import quick_jit
from tests.sizes import full_after

TABLE1 = PRESETS["table1"]
REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())
STEADY = {case["name"]: case for case in REFERENCE["steady"]}
OMEGAS = np.array([0.44, 0.6, 0.7, 0.755, 0.8, 0.87, 1.0])
OUTPUTS = ("u_max", "u_min", "u_rms", "phase", "stability", "spectral_radius", "residual", "regime",
           "branch_u_max", "branch_u_min", "branch_stability")  # fmt: skip
# Table 1, then b = 0, no drive, no separation.
CASES = ({}, {"b": 0.0}, {"B1": 0.0}, {"B1": 1e-4, "B0": 0.3})


def lanes(cases) -> dict[str, np.ndarray]:
    tables = [TABLE1 | case for case in cases]
    return {name: np.array([table[name] for table in tables]) for name in TABLE1}


def model_of(cases, omega) -> PiecewiseLinearOscillator:
    return Rattle.models["basins"].build(lanes(cases) | {"omega": omega})


@pytest.fixture(scope="module")
def swept():
    def run(values):
        return harmonic_response.response(
            Rattle.models["basins"].build(values | {"omega": OMEGAS}), hb.Basis(7), (len(CASES),), OUTPUTS
        )

    return {name: np.asarray(value) for name, value in quick_jit(run)(lanes(CASES)).items()}


def linear(values, omega):
    stiffness, damping = values["k"] / values["I"], values["c"] / values["I"]
    return values["B1"] / np.hypot(stiffness - omega**2, damping * omega)


@pytest.mark.full
def test_jacobian_is_the_derivative_up_to_the_quadrature():
    """The Jacobian neglects that weights move with the crossings, an effect of fourth order in the sample distance."""
    model, omega, errors = model_of(({},), 0.8), jnp.array([0.8]), []
    x = jnp.asarray(np.random.default_rng(1).normal(size=(17, 1)) * 0.2)
    for samples in (256, 1024):
        basis = hb.Basis(4, 2, samples)

        def force(x, basis=basis):
            return hb.residual(model, basis, x, omega, hb.contact(model, basis, x))[0]

        ours = hb.jacobian(model, basis, omega, hb.contact(model, basis, x))[..., 0]
        errors.append(float(jnp.abs(ours - jax.jacfwd(force)(x)[:, 0, :, 0]).max()))
    assert errors[1] < 1e-6
    assert errors[1] < errors[0] / 50


@pytest.mark.full
def test_error_falls_with_the_harmonics():
    case, errors = STEADY["T1 w.7 double-sided"], []
    model = model_of(({},), 0.7)
    for harmonics in (1, 3, 7, 15, 31):
        basis = hb.Basis(harmonics)
        start = jnp.zeros((basis.size, 1)).at[0].set(0.06).at[1].set(0.3)
        found = quick_jit(lambda x, basis=basis: hb.balance(model, basis, x, jnp.array([0.7])))(start)
        assert bool(found.converged[0])
        fine = hb.Basis(harmonics, 1, 20_000).values @ np.asarray(found.x[:, 0])
        errors.append(abs(fine.max() - case["max"]))
    # The note gives 2e-2, 2e-3, 1e-4, 1e-6, 8e-8.
    assert (np.array(errors) < [2.5e-2, 2.2e-3, 1.2e-4, 1.3e-6, 8.5e-8]).all()
    assert (np.diff(errors) < 0).all()


@pytest.mark.full
def test_stability_is_that_of_the_exact_motion():
    """With 31 harmonics the multipliers of the balanced motion are those of the exact attractor."""
    model, basis = model_of(({},), 0.7), hb.Basis(31)
    case = STEADY["T1 w.7 double-sided"]
    omega = jnp.array([0.7])
    start = jnp.zeros((basis.size, 1)).at[0].set(0.06).at[1].set(0.3)
    x = hb.balance(model, basis, start, omega).x
    half = half_trace(model, basis, omega, hb.contact(model, basis, x))
    assert float(spectral_radius(model, basis, omega, half)[0]) == pytest.approx(max(case["floquet_abs"]), rel=1e-6)


def test_sweeps_of_table_1(swept):
    for name, row, direction in (
        ("T1 w.7 double-sided", 2, 0), ("T1 w.8 high", 4, 0), ("T1 w.8 low", 4, 1),
        ("T1 w1.0", 6, 0), ("T1 w.6 single-sided", 1, 1),
    ):  # fmt: skip
        case = STEADY[name]
        ours = [swept[key][row, direction, 0] for key in ("u_max", "u_min", "u_rms", "phase")]
        np.testing.assert_allclose(ours, [case[k] for k in ("max", "min", "rms", "phase_lag_rad")], atol=4e-4)
        assert swept["stability"][row, direction, 0] == 0
    between = (OMEGAS > 0.7539) & (OMEGAS < 0.8743)
    np.testing.assert_array_equal(swept["u_max"][:, 0, 0] - swept["u_max"][:, 1, 0] > 1e-9, between)
    # The period doubles at 0.44; a basis without subharmonics can report the instability, but has no such motion.
    assert swept["stability"][0, 0, 0] == 1
    assert (swept["outcome"] == 0).all()


def test_branch_passes_the_folds(swept):
    """The sweeps lie on the branch, whose middle motions are unstable."""
    between = (OMEGAS > 0.7539) & (OMEGAS < 0.8743)
    count = np.isfinite(swept["branch_u_max"][..., 0]).sum(axis=1)
    np.testing.assert_array_equal(count, np.where(between, 3, 1))
    np.testing.assert_array_equal(swept["branch_stability"][between, :4, 0], [[0, 1, 0, 2]] * between.sum())
    branch = swept["branch_u_max"][between, :, 0]
    np.testing.assert_allclose(branch[:, [2, 0]], swept["u_max"][between, :, 0], rtol=1e-9)


@pytest.mark.full
def test_folds_of_the_branch():
    model, basis = model_of(({},), 0.7), hb.Basis(15)
    start = jnp.zeros((basis.size, 1)).at[0].set(0.06).at[1].set(0.3)

    @quick_jit
    def follow(x):
        begun = hb.balance(model, basis, x, jnp.array([0.7])).x
        return trace(model, basis, begun, 0.7, 1.0, jnp.array([0.2]))[0]

    omega = np.asarray(follow(start)[:, -1, 0])
    omega = omega[np.isfinite(omega)]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(omega)))) + 1
    folds = [np.polynomial.Polynomial.fit([-1, 0, 1], omega[i - 1 : i + 2], 2) for i in turns]
    found = [float(p(p.deriv().roots()[0])) for p in folds]
    exact = [s["omega"] for s in REFERENCE["specials"]["table1"] if s["type"] == "fold"][:2]
    np.testing.assert_allclose(sorted(found), sorted(exact), atol=2e-4)
    assert omega.max() >= 1.0


@pytest.mark.parametrize(("begin", "end"), full_after(1, [(0.163, 0.05), (0.05, 0.163)], several=True))
def test_branch_passes_contacts_that_come_and_go(begin, end):
    """With seven harmonics the branch has several folds near .12, where short contacts appear."""
    model, basis = model_of(({},), begin), hb.Basis(7)

    @quick_jit
    def follow():
        settled = settle(model, basis, jnp.zeros((basis.size, 1)), jnp.array([begin]))
        x = hb.balance(model, basis, settled, jnp.array([begin])).x
        return settled, x, trace(model, basis, x, begin, end, jnp.array([0.2]))[0]

    settled, x, branch = follow()
    # The transient has decayed to 1e-4; seven harmonics leave 1.6e-3 of the exact motion.
    assert np.abs(settled - x).max() < 3e-3 * np.linalg.norm(x)
    omega = np.asarray(branch[:, -1, 0])
    assert ((omega - end) * np.sign(end - begin) >= 0).any()
    np.testing.assert_allclose([np.nanmin(omega), np.nanmax(omega)], [0.05, 0.163], atol=0.02)


def test_linear_limits_are_exact(swept):
    for lane in (1, 3):
        values = TABLE1 | CASES[lane]
        amplitude = (swept["u_max"] - swept["u_min"])[..., lane] / 2
        np.testing.assert_allclose(amplitude, np.stack([linear(values, OMEGAS)] * 2, axis=1), rtol=1e-10)
        np.testing.assert_allclose(swept["residual"][..., lane], 0, atol=1e-12)
    np.testing.assert_allclose(swept["u_max"][..., 2], swept["u_min"][..., 2], rtol=1e-12)


@pytest.mark.full
def test_one_harmonic_is_the_describing_function():
    """Each balanced motion is one of the motions of the closed form; with alpha = 0 several of them are stable."""
    cases = ({}, {"alpha": 0.0}, {"alpha": 1.5})

    def run(values):
        model = Rattle.models["basins"].build(values | {"omega": np.array([0.6, 0.7])})
        ours = harmonic_response.response(model, hb.Basis(1, 1, 4096), (3,), ("u_max", "u_min"))
        return ours, closed_form(model, "describing_function", None, (3,), ("branch_u_max", "branch_u_min"))

    ours, closed = quick_jit(run)(lanes(cases))
    for name in ("u_max", "u_min"):
        distance = np.abs(np.asarray(closed[f"branch_{name}"]) - np.asarray(ours[name])[:, :1])
        assert np.nanmin(distance, axis=1).max() < 2e-9


@pytest.mark.full
@pytest.mark.parametrize("samples", [63, 100])
def test_any_number_of_samples(samples):
    omegas = np.array([0.7, 0.9])

    def run(values):
        model = Rattle.models["basins"].build(values | {"omega": omegas})
        return [
            harmonic_response.response(model, hb.Basis(5, 1, count), (1,), ("u_max", "spectral_radius"))
            for count in (samples, 1024)
        ]

    ours, fine = quick_jit(run)(lanes(({},)))
    np.testing.assert_allclose(ours["u_max"], fine["u_max"], rtol=1e-5)
    np.testing.assert_allclose(ours["spectral_radius"], fine["spectral_radius"], rtol=1e-3)


@pytest.mark.full
def test_spectral_radius_is_over_the_period_of_the_motion():
    """The radius does not depend on the order of subharmonics: simple motions at .7 and .9, a doubled period at .45."""
    omegas = np.array([0.44, 0.45, 0.7, 0.9])

    def run(values, order):
        return harmonic_response.response(
            Rattle.models["basins"].build(values | {"omega": omegas}),
            hb.Basis(5, order, 128),
            (1,),
            ("spectral_radius", "u_max"),
        )

    one, two, four = (quick_jit(lambda values, m=m: run(values, m))(lanes(({},))) for m in (1, 2, 4))
    np.testing.assert_allclose(two["u_max"][2:], one["u_max"][2:], rtol=1e-6)
    for kept in (two, four):
        np.testing.assert_allclose(kept["spectral_radius"][2:], one["spectral_radius"][2:], rtol=1e-5)
    np.testing.assert_allclose(four["spectral_radius"][1], two["spectral_radius"][1], rtol=1e-5)


@pytest.mark.full
def test_subharmonics_follow_a_doubled_period():
    case = STEADY["T1 P2 w.45"]

    def run(values):
        model = Rattle.models["basins"].build(values | {"omega": np.array([0.44, 0.45])})
        return harmonic_response.response(model, hb.Basis(7, 2), (1,), ("u_max", "u_min", "stability"))

    found = quick_jit(run)(lanes(({},)))
    np.testing.assert_allclose(
        [found["u_max"][1, 0, 0], found["u_min"][1, 0, 0]], [case["max"], case["min"]], atol=1e-3
    )
    assert (np.asarray(found["stability"]) == 0).all()


@pytest.mark.full
def test_a_lane_does_not_depend_on_the_others():
    """The length and steps of the integration depend on the lane alone, also after a sweep has lost its motion."""
    omegas = np.array([0.7, 0.8, 0.9])

    def run(values):
        return harmonic_response.response(
            Rattle.models["basins"].build(values | {"omega": omegas}), hb.Basis(3), (2,), ("u_max", "u_min", "residual")
        )

    run = quick_jit(run)
    ours, others = run(lanes(({}, {}))), run(lanes(({}, {"c": 0.001, "k": 30.0})))
    for name, value in ours.items():
        np.testing.assert_array_equal(value[..., 0], others[name][..., 0], err_msg=name)


@pytest.mark.full
@pytest.mark.parametrize("harmonics", [1, 2])
def test_what_lies_between_two_folds_is_a_saddle(harmonics):
    """The motion is a saddle even if disturbances with few harmonics decay, in agreement with the describing function."""
    omegas = np.linspace(0.65, 0.95, 31)
    cases = ({"c": 0.01, "B1": 0.006}, {"c": 0.01, "B1": 0.006, "B0": 0.0})

    def run(values):
        names = ("branch_u_max", "branch_stability")
        model = Rattle.models["basins"].build(values | {"omega": omegas})
        return harmonic_response.response(model, hb.Basis(harmonics, 1, 256), (2,), names)

    found = quick_jit(run)(lanes(cases))
    three = np.isfinite(found["branch_u_max"]).sum(axis=1) == 3
    assert (np.asarray(found["outcome"]) == 0).all()
    assert three.sum() > 15
    assert (np.asarray(found["branch_stability"])[:, 1][three] == 1).all()
