"""Numbers of any size: every point has a value or an outcome, and infinity and NaN never pass for success."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.invariants import check
from drivetrain_jax.systems import get_system

POINTS, MANY = 32, 512
# Largest size: numbers that have squares and fourth powers.
LARGEST = 1e20
STEEP = np.nextafter(math.pi / 2, 0.0)
PATH = np.array([1e-18, 1e-3, 0.5, 0.9, 1.3, 1e19])
# Amplitudes and ranges are infinite without damping, and an unknown error has an infinite bound.
INFINITE = {"peak_amplitude", "fit_range", "spectral_radius_error"}


def size(rng, count, centre=1.0, zero=0.1, signed=False):
    """Usual numbers, numbers of any size, coincident ones and zeros."""
    any_size = np.exp(rng.uniform(-1, 1, count) * math.log(LARGEST))
    usual = centre * np.exp(rng.uniform(-7, 7, count))
    kind = rng.random(count)
    found = np.select([kind < 0.4, kind < 0.45], [usual, np.full(count, centre)], any_size)
    found = np.where(rng.random(count) < zero, 0.0, found)
    return found * rng.choice([-1, 1], count) if signed else found


def cardan(rng, count):
    ends = [0.0, 1e-300, 1e-8, STEEP, -STEEP, 1.5]
    beta = np.where(rng.random(count) < 0.3, rng.choice(ends, count), rng.uniform(-1.57, 1.57, count))
    mu = np.where(rng.random(count) < 0.3, 1.0, size(rng, count, zero=0))
    rest = {name: size(rng, count, centre) for name, centre in (("zeta", 1e-2), ("alpha", 1.0))}
    return {"beta": beta, "mu": mu, "Omega": size(rng, count, zero=0), "gamma": size(rng, count, zero=0)} | rest


def rattle(rng, count, start=False):
    forces = {name: size(rng, count, signed=True) for name in ("B0", "B1", *(("u0", "v0") * start))}
    rest = {name: size(rng, count, centre) for name, centre in (("b", 1.0), ("c", 0.1), ("alpha", 0.25))}
    return forces | rest | {name: size(rng, count, zero=0) for name in ("omega", "k", "I")}


def moving(rng, count):
    return rattle(rng, count, start=True)


def tripod(rng, count):
    beta = np.where(rng.random(count) < 0.3, rng.choice([0.0, 1e-8, STEEP], count), rng.uniform(0, 1.57, count))
    usual = {"zeta": 1e-2, "excitation_frequency": 100.0, "L_A": 0.13, "rho": 7850.0, "G": 7.7e10, "d_A": 0.05}
    return {"beta": beta} | {name: size(rng, count, centre, zero=0) for name, centre in usual.items()}


def planetary(rng, count):
    masses = {name: size(rng, count, zero=0) for name in ("m_s", "m_p", "I_r", "I_p")}
    return masses | {name: size(rng, count, 1e8, zero=0.2) for name in ("k_sp", "k_p", "k_su", "k_r")}


CASES = {
    "parameters": (tripod, "parameters", {"element": "input"}, {}),
    "describing function": (rattle, "frequency_response", {}, {"method": "describing_function"}),
    "multiple scales": (rattle, "frequency_response", {}, {"method": "multiple_scales"}),
    "harmonic balance": (rattle, "frequency_response", {}, {"method": "harmonic_balance", "harmonics": 3}),
    "exact response": (rattle, "frequency_response", {}, {"method": "exact", "most_periods": 32}),
    "slow flow": (moving, "history", {}, {"method": "slow_flow", "stop": 1.0, "num": 5}),
    "history": (moving, "history", {}, {"stop": 10.0, "num": 5, "most_events": 4}),
    "steady state": (moving, "steady_state", {}, {"most_periods": 64}),
    "basins": (rattle, "basins", {}, {"samples": 4, "most_periods": 64}),
    "modes": (planetary, "modes", {}, {}),
    "response": (planetary, "harmonic_response", {}, {"stop": 3000.0, "num": 5}),
    "floquet of the tripod": (tripod, "floquet", {"element": "input"}, {"method": "direct"}),
    "floquet": (cardan, "floquet", {}, {"method": "direct"}),
    "forced": (cardan, "forced", {}, {}),
    "poincare": (tripod, "poincare", {"element": "input"}, {"strobes": 128, "discard": 4}),
    "lyapunov": (tripod, "lyapunov", {"element": "input"}, {"max_time": 0.05}),
}  # fmt: skip
SHORT = "parameters", "multiple scales"
# A batch of these takes as long as if each point were its slowest one.
LONG = ("exact response", "forced")
SYSTEMS = {moving: "rattle"}


def computed(name, count, seed=0):
    """The results of random points, as a dataset."""
    draw, analysis, fixed, options = CASES[name]
    points = draw(np.random.default_rng(seed), count)
    system = get_system(SYSTEMS.get(draw, draw.__name__))
    known = get_analysis(analysis).for_system(system)
    lacks = {*known.lacks(system), "branch", "mac"} if analysis == "modes" else set(known.lacks(system))
    outputs = [v.name for v in known.variables if v.name not in lacks and v.name not in points]
    if analysis != "frequency_response":
        outputs = [n for n in outputs if n in SOME.get(name, (n,))]
        scene = {"system": system.name, "analysis": analysis, "fixed": fixed, "outputs": outputs, "options": options}
        return dt.run(scene | {"points": {key: value.tolist() for key, value in points.items()}})
    del points["omega"]
    from drivetrain_jax.analysis.frequency_response.analysis import _ONLY

    method = options["method"]
    outputs = [
        n for n in outputs if method in _ONLY.get(n, (method,)) and n not in ("doubling_frequency", "fold_frequency")
    ]

    def one(own):
        return dt.frequency_response(dt.Rattle(omega=PATH, **own), outputs=outputs, **options).variables

    found = jax.vmap(one)(points)
    dims = {v.name: v.dims for v in known.variables} | {"outcome": ()}
    variables = {key: (("point", "omega", *dims[key]), np.asarray(x)) for key, x in found.items()}
    return xr.Dataset(variables, attrs={"analysis": analysis})


SOME = {"slow flow": ("u", "v", "amplitude", "phase"), "history": ("u", "v", "acceleration", "event_velocity")}


def assert_sound(found):
    broken = [str(finding) for finding in check(found) if finding.broken and "event" not in finding.rule]
    assert not broken
    for name, values in found.data_vars.items():
        if values.dtype.kind in "fc" and "point" in values.dims and name not in INFINITE:
            assert not (np.isinf(values) & (found.outcome < 2)).any(), name


@pytest.mark.parametrize("name", SHORT)
def test_some_extreme_points_are_sound(name):
    found = computed(name, POINTS)
    assert_sound(found)
    assert (found.outcome == 0).any()


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_many_extreme_points_are_sound(name):
    for seed in range(2 if name in SHORT else 1):
        count = MANY if name in SHORT else POINTS // 4 if name in LONG else POINTS
        assert_sound(computed(name, count, seed + 1))


@pytest.mark.full
def test_a_heavily_damped_orbit_has_no_exponent():
    """Its multipliers, exp(-4000), underflow: they are 0, and their logarithm has no value."""
    gears = dt.Rattle(omega=0.061, B0=0.0081, B1=-0.0026, b=0.0016, c=0.1, alpha=0.35, k=2.3, I=0.0025)
    found = dt.steady_state(gears, outputs=["floquet_multiplier", "lyapunov_exponent", "spectral_radius", "u_max"])
    assert found.outcome == 0 and np.isfinite(found.u_max)
    np.testing.assert_array_equal(found.floquet_multiplier, [0.0, 0.0])
    assert found.spectral_radius == 0 and jnp.isnan(found.lyapunov_exponent)
