"""Derivatives of the analyses: at random points of every system against complex steps and mpmath through other programs;
of further results against differences; and where there is none."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.linalg import eigh

import drivetrain_jax as dt
from tests.oracles import complex_step
from tests.oracles.bicardan_precise_reference import determinant
from tests.oracles.planetary_reference import matrices
from tests.quick_jit import quick_jit
from tests.sizes import but_full

POINTS = 8
CARDAN_NAMES = ("beta", "Omega", "zeta", "alpha", "mu", "gamma")
TRIPOD_NAMES = ("beta", "zeta", "chi_n", "J_m", "d_A", "L_B", "G", "rho")
RATTLE_NAMES = ("omega", "B0", "B1", "b", "c", "alpha", "k", "I")
# The tables of the input element, which the system fills in.
ELEMENT = {
    **{"L_B": 0.190, "L_A": 0.130, "R": 0.070, "d_A": 0.054, "d_C": 0.098, "S_B": 0.0076, "J_m": 1.4645e-5},
    **{"chi_B": 0.22, "M_AEM": 2550.0, "chi_AEM": 0.05, "rho": 7850.0, "G": 77.3e9, "L_DM2": 0.940, "motor_order": 6.0},
}


def cardan(rng):
    values = {"beta": rng.uniform(0.2, 1.3), "Omega": rng.uniform(0.4, 2), "zeta": rng.uniform(1e-3, 0.2)}
    values |= {"alpha": rng.uniform(0.2, 5), "mu": rng.uniform(0.3, 5), "gamma": rng.uniform(1, 100)}
    return dt.Cardan(**values)


def tripod(rng):
    frequency = {"excitation_frequency": rng.uniform(1500.0, 5000.0), "chi_n": rng.uniform(0.05, 0.4)}
    return dt.Tripod(element="input", beta=rng.uniform(0.05, 0.6), zeta=rng.uniform(1e-3, 0.1), **frequency, **ELEMENT)


def bicardan(rng):
    paper = dt.Bicardan.presets["paper"]
    lists = {name: tuple(x * np.exp(rng.normal(0, 0.3)) for x in paper[name]) for name in ("length", "EI", "rhoA")}
    return dt.Bicardan(**lists, k_A=10 ** rng.uniform(5, 9), k_D=10 ** rng.uniform(5, 9))


def planetary(rng):
    values = dt.Planetary().values
    numbers = {n: x * np.exp(rng.normal(0, 0.4)) for n, x in values.items() if n[:2] in ("m_", "I_", "k_")}
    numbers |= {name: 1e8 * np.exp(rng.normal(0, 0.4)) for name in ("k_sx", "k_ry")}
    numbers |= {name: rng.uniform(0.3, 0.5) for name in ("pressure_angle", "pressure_angle_s")}
    return dt.Planetary(planet_angle=tuple(np.arange(4) * np.pi / 2 + rng.uniform(-0.2, 0.2, 4)), **numbers)


def rattle(rng):
    values = {"omega": rng.uniform(0.3, 1.5), "B0": rng.uniform(0.02, 0.15), "B1": rng.uniform(0.02, 0.2)}
    values |= {"b": rng.uniform(0.02, 0.3), "c": rng.uniform(0.02, 0.3), "alpha": rng.uniform(0.05, 0.6)}
    return dt.Rattle(**values, k=rng.uniform(0.5, 2), I=rng.uniform(0.5, 2))


def floquet_radius(system):
    return dt.floquet(system, outputs="spectral_radius").spectral_radius


def cardan_radius_slopes(shaft):
    slopes, apart = complex_step.radius_slopes(
        complex_step.cardan_monodromy(shaft.values, CARDAN_NAMES), shaft.values, CARDAN_NAMES
    )
    return slopes if apart > 1e-3 else None


def tripod_radius_slopes(shaft):
    slopes, apart = complex_step.radius_slopes(
        complex_step.tripod_monodromy(shaft.values, TRIPOD_NAMES), shaft.values, TRIPOD_NAMES
    )
    return slopes if apart > 1e-3 else None


def linear_response(shaft):
    found = dt.forced(shaft, outputs=["periodic_state", "amplitude"])
    return jnp.concatenate([found.periodic_state, found.amplitude])


def orbit(shaft):
    found = dt.forced(shaft, outputs=["orbit_state", "orbit_amplitude"])
    return jnp.concatenate([found.orbit_state, found.orbit_amplitude])


def linear_slopes(shaft):
    state = np.asarray(dt.forced(shaft, outputs="periodic_state").periodic_state)
    field = complex_step.cardan_linear
    return np.concatenate(complex_step.periodic_slopes(field, state, np.pi, (0, 1), shaft.values, CARDAN_NAMES))


def orbit_slopes(shaft):
    found = dt.forced(shaft, outputs=["orbit_state", "orbit_spectral_radius"])
    if found.outcome > 0 or found.orbit_spectral_radius > 1.5:
        return None
    field, state = complex_step.cardan_nonlinear, np.asarray(found.orbit_state)
    return np.concatenate(complex_step.periodic_slopes(field, state, np.pi, (0, 1), shaft.values, CARDAN_NAMES))


TIMES = (2e-4, 1e-3)


def motion(shaft):
    found = dt.history(shaft, times=TIMES)
    return jnp.concatenate([found.phi, 1e-3 * found.velocity])


def motion_slopes(shaft):
    found = complex_step.tripod_history(shaft.values, TRIPOD_NAMES, TIMES)
    return np.concatenate([found[:, 0], 1e-3 * found[:, 1]])


SPEEDS = [f"{name}[{i}]" for name in ("length", "EI", "rhoA") for i in range(3)] + ["k_A", "k_D"]


def speeds(shaft):
    return dt.critical_speeds(shaft, modes=3).critical_speed


def speed_slopes(shaft):
    """``dn/dp = -n 2/q D_p/D_q`` of the paper's determinant D, with 60 digits."""
    rows = []
    with mpmath.workdps(60):
        for speed in np.asarray(speeds(shaft)):
            rough = mpmath.sqrt(mpmath.mpf(float(speed)) * mpmath.pi / 30)
            q = mpmath.findroot(lambda x: determinant(x, shaft.values), rough)
            by_q = mpmath.diff(lambda x, q=q: determinant(q * x, shaft.values), 1)
            rows.append([float(-2 * speed * _by(shaft.values, name, q) / by_q) for name in SPEEDS])
    return np.array(rows)


def _by(values, name, q):
    """Derivative of the determinant at ``q`` by the entry ``name``."""
    key, index = name.rstrip("]").split("[") if "[" in name else (name, None)

    def at(x):
        if index is None:
            return determinant(q, values | {key: x})
        return determinant(q, values | {key: [x if i == int(index) else old for i, old in enumerate(values[key])]})

    value = values[key] if index is None else values[key][int(index)]
    return mpmath.diff(lambda x: at(value * x), 1) / value


MODES = [f"planet_angle[{i}]" for i in range(4)] + [
    *("m_s", "m_r", "m_c", "m_p", "I_s", "I_r", "I_c", "I_p", "k_sp", "k_rp", "k_p", "k_s", "k_r", "k_c", "k_su"),
    *("k_ru", "k_cu", "k_sx", "k_ry", "pressure_angle", "pressure_angle_s"),
]


def frequencies(gear):
    return dt.modes(gear, outputs="natural_frequency").natural_frequency


def frequency_slopes(gear):
    """``d lambda = x^T (dK - lambda dM) x``, dK and dM by complex steps; None unless all frequencies are apart."""
    mass, stiffness = (np.array(x, float) for x in matrices(gear.values, np))
    squares, shapes = eigh(stiffness, np.diag(mass))
    f = np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)
    if np.min(np.diff(f) / f[1:]) < 1e-3:
        return None
    columns = []
    for name in MODES:
        stepped, h = _stepped(gear.values, name)
        d_mass, d_stiffness = (np.array(x, complex).imag / h for x in matrices(stepped, np))
        change = np.einsum("ik,ij,jk->k", shapes, d_stiffness, shapes)
        change -= squares * np.einsum("ik,i,ik->k", shapes, d_mass, shapes)
        columns.append(change / (8 * np.pi**2 * np.where(f > 1, f, np.nan)))
    return np.stack(columns, axis=1)


def _stepped(values, name):
    key, index = name.rstrip("]").split("[") if "[" in name else (name, None)
    if index is None:
        return values | {key: values[key] + 1e-20j}, 1e-20
    angles = list(values[key])
    angles[int(index)] += 1e-20j
    return values | {key: angles}, 1e-20


def gears_at_work(gears):
    found = dt.steady_state(gears, outputs=["u_max", "u_min", "u_rms", "orbit_state"])
    return jnp.append(jnp.stack([found.u_max, found.u_min, found.u_rms]), found.orbit_state)


def rattle_slopes(gears):
    found = dt.steady_state(gears, outputs=["period_multiple", "orbit_state", "spectral_radius", "impacts"])
    if found.outcome > 0 or not 0 < found.period_multiple < 5 or found.spectral_radius > 0.9 or found.impacts.sum() < 1:
        return None
    orbit = complex_step.RattleOrbit(gears.values, np.asarray(found.orbit_state), int(found.period_multiple))
    slopes = orbit.slopes(RATTLE_NAMES)
    return np.concatenate([np.stack([slopes[key] for key in ("u_max", "u_min", "u_rms")]), slopes["orbit_state"]])


CASES = {
    "cardan floquet": (cardan, floquet_radius, cardan_radius_slopes, CARDAN_NAMES),
    "cardan forced": (cardan, linear_response, linear_slopes, CARDAN_NAMES),
    "cardan orbit": (cardan, orbit, orbit_slopes, CARDAN_NAMES),
    "tripod floquet": (tripod, floquet_radius, tripod_radius_slopes, TRIPOD_NAMES),
    "tripod history": (tripod, motion, motion_slopes, TRIPOD_NAMES),
    "bicardan critical_speeds": (bicardan, speeds, speed_slopes, SPEEDS),
    "planetary modes": (planetary, frequencies, frequency_slopes, MODES),
    "rattle steady_state": (rattle, gears_at_work, rattle_slopes, RATTLE_NAMES),
}


def entry(system, name):
    if "[" in name:
        key, index = name.rstrip("]").split("[")
        return getattr(system, key)[int(index)]
    return getattr(system, name)


@pytest.mark.parametrize(
    "case",
    but_full(
        CASES,
        "cardan orbit",
        "planetary modes",
        "cardan forced",
        "tripod floquet",
        "tripod history",
        "rattle steady_state",
        "bicardan critical_speeds",
    ),
)
def test_derivatives_at_random_points(case):
    """Each entry within 1e-6 of the largest logarithmic derivative of its result."""
    draw, function, oracle, names = CASES[case]
    rng, checked = np.random.default_rng(1), 0
    jacobian = quick_jit(jax.jacrev(function))
    while checked < POINTS:
        system = draw(rng)
        expected = oracle(system)
        if expected is None:
            continue
        found = jacobian(system)
        rows = np.stack([np.asarray(entry(found, name)) for name in names], axis=-1)
        size = np.array([entry(system, name) for name in names])
        known = np.isfinite(expected)
        scale = np.abs(np.where(known, expected, 0) * size).max(axis=-1, keepdims=True)
        error = np.where(known, np.abs((rows - expected) * size), 0) / np.where(scale > 0, scale, 1)
        assert np.nanmax(error) < 1e-6 and not np.isnan(rows[known]).any(), (system, error, rows, expected)
        checked += 1


@pytest.mark.full
@pytest.mark.parametrize("case", CASES)
def test_both_modes_at_random_points(case):
    """By logarithms of the parameters, which differ by ten orders of magnitude."""
    draw, function, oracle, _ = CASES[case]
    rng, checked = np.random.default_rng(2), 0
    scaled = jax.jit(lambda system, x: function(jax.tree.map(lambda p, f: p * jnp.exp(f), system, x)))
    while checked < 3:
        system = draw(rng)
        if oracle(system) is None:
            continue
        size = jnp.abs(scaled(system, jax.tree.map(jnp.zeros_like, system)))
        size = jnp.where(size > 1e-6 * jnp.max(size), size, jnp.inf)
        check_grads(
            lambda x, system=system, size=size: scaled(system, x) / size,
            (jax.tree.map(jnp.zeros_like, system),),
            order=1, modes=("fwd", "rev"), eps=1e-6, atol=1e-3, rtol=1e-4,
        )  # fmt: skip
        checked += 1


SHAFT = dt.Cardan(beta=0.3, Omega=1.416, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
GEARS = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
TRIPOD = dt.Tripod(element="input", beta=0.157, zeta=0.0016, chi_n=0.3)
MEASURES = ["u_mean", "phase", "spectral_radius", "lyapunov_exponent", "contact_fraction", "impact_velocity"]


def measures(gears):
    found = dt.steady_state(gears, outputs=MEASURES)
    return jnp.hstack([found[name] for name in MEASURES])


def second_order(shaft):
    found = dt.forced(shaft, outputs=["condition", "orbit_spectral_radius"])
    return jnp.stack([found.condition, found.orbit_spectral_radius])


# Function, point, parameters, relative step and error. A narrow resonance asks for small steps.
FURTHER = {
    "floquet_exponent": (
        lambda s: dt.floquet(s, outputs="floquet_exponent").floquet_exponent, TRIPOD, ("beta", "zeta"), 1e-3, 1e-7
    ),
    "floquet_multiplier": (
        lambda s: jnp.abs(dt.floquet(s, outputs="floquet_multiplier").floquet_multiplier)[:2],
        SHAFT, ("beta", "zeta", "mu"), 2e-4, 1e-6,
    ),
    "condition and orbit_spectral_radius": (second_order, SHAFT, ("zeta", "gamma"), 1e-3, 1e-6),
    "measures of rattle": (measures, GEARS, ("omega", "B0", "c", "alpha"), 1e-3, 1e-7),
    "samples of rattle": (
        lambda g: dt.steady_state(g, outputs="u_history").u_history, GEARS, ("omega", "B1"), 1e-5, 1e-6
    ),
}  # fmt: skip


@pytest.mark.full
@pytest.mark.parametrize("case", FURTHER)
def test_derivatives_equal_differences(case):
    """Central differences of order four."""
    function, system, names, step, rtol = FURTHER[case]
    jacobian, value_of = quick_jit(jax.jacrev(function))(system), quick_jit(function)
    for name in names:
        value = system.values[name]
        f = [
            np.asarray(value_of(type(system).of(system.values | {name: value * (1 + k * step)})))
            for k in (-2, -1, 1, 2)
        ]
        slope = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step * value)
        found = np.asarray(getattr(jacobian, name))
        np.testing.assert_allclose(found, slope, rtol=rtol, atol=rtol * np.abs(slope).max(), err_msg=name)


@pytest.mark.full
def test_a_state_alone_has_the_derivatives_that_it_has_with_its_amplitude():
    shaft = dt.Cardan(**SHAFT.values | {"Omega": 1.0})
    alone = quick_jit(jax.jacrev(lambda s: dt.forced(s, outputs=["periodic_state"]).periodic_state))(shaft)
    found = quick_jit(jax.jacrev(linear_response))(shaft)
    for name in CARDAN_NAMES:
        np.testing.assert_allclose(getattr(alone, name), getattr(found, name)[:4], rtol=1e-7, atol=1e-9)


def test_where_there_is_no_derivative_there_is_none():
    """All multipliers are on the unit circle."""
    undamped = dt.Cardan(beta=0.3, Omega=1.2, zeta=0.0, alpha=1.0, mu=1.0, gamma=100.0)
    slopes = quick_jit(jax.jacrev(floquet_radius))(undamped)
    # The initial state of motions has no part in it.
    assert all(np.isnan(getattr(slopes, name)) for name in dt.Cardan.models["floquet"].parameters)


@pytest.mark.full
def test_angles_that_split_a_pair_have_no_derivative():
    gear = dt.Planetary(planet_angle=(0.0, 2 * np.pi / 3, 4 * np.pi / 3))
    slopes = quick_jit(jax.jacrev(lambda s: dt.modes(s).natural_frequency[1:3]))(gear)
    assert np.isnan(slopes.planet_angle[1]).all() and np.isfinite(slopes.k_p).all()
    slopes = jax.grad(lambda s: dt.modes(s, outputs=["participation"]).participation[0, 0])(gear)
    assert np.isnan(slopes.k_p)


@pytest.mark.full
def test_an_oscillator_at_its_ends_has_no_derivative_by_them():
    """Without backlash, and without a spring in the gap."""
    slopes = quick_jit(jax.jacrev(gears_at_work))
    found = slopes(dt.Rattle(**GEARS.values | {"b": 0.0}))
    assert np.isnan(found.b).all() and np.isfinite(found.B1).all()
    found = slopes(dt.Rattle(**GEARS.values | {"alpha": 0.0}))
    assert np.isnan(found.alpha).all() and np.isfinite(found.B1).all() and not np.any(found.u0)


@pytest.mark.full
def test_errors_and_codes_count_as_constants():
    slopes = jax.grad(lambda s: dt.floquet(s).spectral_radius + dt.floquet(s).spectral_radius_error)(SHAFT)
    alone = jax.grad(lambda s: dt.floquet(s).spectral_radius)(SHAFT)
    assert jax.tree.leaves(slopes) == jax.tree.leaves(alone)
