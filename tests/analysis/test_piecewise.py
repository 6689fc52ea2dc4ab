"""The exact flow against the independent event solver, the reference values and the linear response."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.impacts.orbit_measures import history
from drivetrain_jax.analysis.impacts.piecewise_march import march, piece, prepare, responses, start, usual_steps
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.oracles.rattle_reference import extended, random_case

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())
TABLE1 = PRESETS["table1"]


@jax.jit
def kernel(values, u, v, periods):
    lanes = prepare(Rattle.models["basins"].build(values))
    return march(lanes, start(lanes, u, v, periods), 400_000), usual_steps(lanes)


def run(*arguments):
    """Motions and usual steps; up to 200 lanes are padded to the width of one kernel."""
    count = len(arguments[-1])
    padded = jax.tree.map(lambda x: np.pad(x, (0, max(200 - count, 0)), mode="edge"), arguments)
    return jax.tree.map(lambda x: x[..., :count], kernel(*padded))


def columns(cases):
    return {name: jnp.array([case[name] for case in cases]) for name in cases[0]}


@pytest.mark.parametrize("stiffness", [0.0, 1e-9, 0.01, 0.25, 0.2500001, 1.0, 1e6])
def test_step_response_solves_its_equation(stiffness):
    """The responses agree with the closed form in 60 digits, for short and long steps."""
    mp = pytest.importorskip("mpmath")
    model = Rattle.models["basins"].build(TABLE1 | {"c": 1.0, "omega": 1.0})
    for d in (1e-6, 0.01, 0.3, 0.7, 3.0, 20.0):
        got = [float(x) for x in responses(piece(model, jnp.asarray(stiffness), model.damping), jnp.asarray(d))]
        with mp.workdps(60):
            h, k, t = mp.mpf("0.5"), mp.mpf(stiffness), mp.mpf(d)
            root = mp.sqrt(mp.mpc(h * h - k)) if h * h != k else mp.mpf("1e-25")
            one, two = -h + root, -h - root
            impulse = (mp.exp(one * t) - mp.exp(two * t)) / (one - two)
            rate = (one * mp.exp(one * t) - two * mp.exp(two * t)) / (one - two)
            step = (1 - rate - impulse) / k if k else t + mp.exp(-t) - 1
            expected = [float(mp.re(x)) for x in (step, impulse, rate)]
        size = [min(d * d, 1 / max(stiffness, 1e-300)), min(d, 1 / max(stiffness, 1e-300) ** 0.5), 1.0]
        # The phase sqrt(K) d has the error of its rounding.
        slack = 1e-15 * (4 + stiffness**0.5 * d)
        assert np.all(np.abs(np.subtract(got, expected)) <= slack * np.array(size) * 4), (d, got, expected)


def test_transients_of_the_reference():
    cases = REFERENCE["transient"]
    motion, _ = run(
        columns([c["params"] for c in cases]),
        jnp.array([float(c["u0"]) for c in cases]),
        jnp.array([float(c["v0"]) for c in cases]),
        jnp.array([c["periods"] for c in cases], jnp.int32),
    )
    slack = 1e-9 * np.maximum(1, [c["sensitivity"] / 100 for c in cases])
    assert np.all(np.abs(motion.u - np.array([c["u"] for c in cases])) < slack)
    assert np.all(np.abs(motion.v - np.array([c["v"] for c in cases])) < slack)


def test_the_determinant_of_the_transition_is_liouvilles():
    omega = jnp.linspace(0.2, 2.5, 64)
    periods = jnp.full(64, 5, jnp.int32)
    motion, _ = run(columns([TABLE1 | {"omega": float(w)} for w in omega]), jnp.zeros(64), jnp.zeros(64), periods)
    a, b, c, d = motion.matrix
    exact = np.exp(-0.05 * 5 * 2 * np.pi / omega)
    assert np.abs((a * d - b * c) / exact - 1).max() < 1e-12


def test_without_backlash_the_response_is_linear():
    omega = np.linspace(0.3, 3.0, 50)
    values = columns([TABLE1 | {"b": 0.0, "omega": float(w)} for w in omega])
    response = 0.03 / (1 - omega**2 + 0.05j * omega)
    u, v = 0.05 + response.real, -omega * response.imag
    motion, _ = run(values, jnp.asarray(u), jnp.asarray(v), jnp.full(50, 3, jnp.int32))
    assert np.abs(motion.u - u).max() < 1e-13 and np.abs(motion.v - v).max() < 1e-13


def random_against_oracle(count, seed):
    rng = np.random.default_rng(seed)
    cases = [random_case(rng) for _ in range(count)]
    u, v, periods = (np.array([case[k] for case in cases]) for k in (1, 2, 3))
    motion, usual = run(columns([case[0] for case in cases]), u, v, periods.astype(np.int32))
    assert np.all(motion.left == 0) and np.all(motion.steps <= periods * usual)
    exact = np.array([extended(*case)[:2] for case in cases])
    norm = np.sqrt(sum(np.square(entry) for entry in motion.matrix))
    error = np.maximum(np.abs(motion.u - exact[:, 0]), np.abs(motion.v - exact[:, 1]))
    # Where damping has erased the start, the error is the rounding of displacements and velocities near 1.
    bad = np.flatnonzero(error > 1e-8 * norm + 1e-15)
    assert bad.size == 0, [(cases[i], error[i], norm[i]) for i in bad[:3]]
    return error / np.maximum(norm, 1.0)


def test_random_cases_against_the_event_solver():
    error = random_against_oracle(200, seed=0)
    assert np.median(error) < 1e-14 and error.max() < 1e-10


@pytest.mark.full
def test_5000_random_cases_against_the_event_solver():
    for seed in range(1, 11):
        random_against_oracle(500, seed)


@pytest.mark.parametrize("excess", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, -1e-12, -1e-6])
def test_grazing_contact(excess):
    """Orbits that pass the flank, or stay clear of it, by ``excess`` times their amplitude."""
    values = TABLE1 | {"omega": 2.0, "k": 1e4, "b": 0.1, "B0": 500.0}
    response = 1.0 / complex(1e4 - 4.0, 0.1)
    margin = values["B0"] / 1e4 - values["alpha"] * values["b"]
    values["B1"] = margin / abs(response) * (1 + excess)
    response *= values["B1"]
    u, v = values["B0"] / 1e4 + 0.75 * 0.1 + response.real, -2.0 * response.imag
    motion, _ = run(columns([values]), jnp.array([u]), jnp.array([v]), jnp.array([4], jnp.int32))
    assert int(motion.left[0]) == 0 and int(motion.steps[0]) < 4000
    exact = extended(values, u, v, 4)
    norm = float(np.sqrt(sum(np.square(entry) for entry in motion.matrix))[0])
    assert abs(float(motion.u[0]) - exact[0]) < 1e-8 * norm and abs(float(motion.v[0]) - exact[1]) < 1e-8 * norm


def test_rest_exactly_on_a_flank():
    """The mean drive holds the teeth on the flank without load: u = b, u' = u'' = 0."""
    values = TABLE1 | {"b": 0.125, "B0": 0.25 * 0.125, "B1": 0.0, "omega": 1.0}
    motion, usual = run(columns([values]), jnp.array([0.125]), jnp.array([0.0]), jnp.array([2], jnp.int32))
    assert int(motion.left[0]) == 0 and motion.steps[0] < 2 * usual[0]
    assert motion.u[0] == 0.125 and abs(float(motion.v[0])) < 1e-16


def test_a_lane_that_is_not_finite_does_not_hold_up_the_others():
    # Driven at the resonance of an undamped region: its harmonic response is infinite.
    cases = [TABLE1 | {"omega": 0.7}, TABLE1 | {"omega": 1.0, "c": 0.0}]
    motion, _ = run(columns(cases), jnp.zeros(2), jnp.zeros(2), jnp.array([10, 10], jnp.int32))
    assert motion.u[0] == pytest.approx(0.393047067155833, abs=1e-12)
    assert not np.isfinite(motion.u[1])


@pytest.mark.full
def test_a_history_is_right_however_far_apart_its_times_are():
    """More than 10,000 steps lie between two times; an independent event solver has -.3245944 after half a period."""
    slow = Rattle.models["basins"].build(TABLE1 | {"omega": 1e-4, "c": 1e-3, "alpha": 0.0, "B1": 0.2})
    u, v, one = jnp.array([0.5]), jnp.array([0.1]), jnp.array([1])
    far, near = (np.asarray(history(slow, u, v, one, samples)[0])[:, 0] for samples in (2, 64))
    assert far[1] == pytest.approx(-0.3245944, abs=1e-6)
    assert far[1] == pytest.approx(near[32], abs=1e-6)
