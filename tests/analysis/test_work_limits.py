"""The work of a point is bounded: every analysis ends for parameters of any size, with finite values after a success."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.systems import get_system
from tests.sizes import but_full

INPUT = {"element": "input"}
RADIUS = ("spectral_radius", "spectral_radius_error", "verdict")
# System, analysis, fixed values, options and outputs (None: the default ones).
CASES = {
    "lyapunov": ("tripod", "lyapunov", INPUT, {}, None),
    "history": ("tripod", "history", INPUT, {"stop": 1.0, "num": 5}, None),
    "poincare": ("tripod", "poincare", INPUT, {"strobes": 128, "discard": 16}, None),
    "adaptive section": (
        "tripod", "poincare", INPUT, {"method": "adaptive", "strobes": 128, "discard": 16}, None,
    ),
    "floquet, adaptive": ("cardan", "floquet", {}, {"method": "diffrax", "form": "published"}, RADIUS),
    "floquet, equal": ("cardan", "floquet", {}, {"method": "diffrax", "form": "reduced"}, RADIUS),
    "forced": ("cardan", "forced", {}, {}, None),
}  # fmt: skip
FEW, MANY = 4, 16
# Infinite or unknown after a success.
GAPS = {"condition", "spectral_radius_error", "lyapunov_standard_error", "chaos_k01"}


def points(name: str, decades: float, count: int, seed: int = 0) -> dict[str, list[float]]:
    """Values of all numbers of the model, log-uniform over 2 ``decades`` decades and with both signs where allowed."""
    system, analysis, fixed, *_ = CASES[name]
    rng, kind = np.random.default_rng(seed), get_system(system)
    found = {}
    for parameter in kind.parameters:
        if parameter.name in fixed or parameter.choices or parameter.name not in kind.models[analysis].parameters:
            continue
        values = 10 ** rng.uniform(-decades, decades, count)
        values = np.where(values < parameter.upper, values, parameter.upper * rng.uniform(0, 1, count))
        found[parameter.name] = (values * rng.choice([-1, 1], count) if parameter.lower < 0 else values).tolist()
    return found


def assert_ends(name: str, decades: float, count: int, seed: int = 0) -> None:
    system, analysis, fixed, options, outputs = CASES[name]
    scene = {"system": system, "analysis": analysis, "fixed": fixed, "options": options}
    scene |= {"points": points(name, decades, count, seed)}
    found = dt.run(scene | ({"outputs": list(outputs)} if outputs else {}))
    assert found.outcome.size == count and (found.outcome != Outcome.LOST).all()
    for key, values in found.data_vars.items():
        if values.dtype.kind in "fc" and key not in GAPS:
            assert np.isfinite(values.where(found.outcome == Outcome.SUCCESS, 0.0)).all(), key


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_the_widest_points_end(name):
    assert_ends(name, 300, FEW)


@pytest.mark.full
@pytest.mark.parametrize("decades", [3, 300])
@pytest.mark.parametrize("name", CASES)
def test_wide_batches_end(name, decades):
    assert_ends(name, decades, MANY, seed=1)


# Module with the limit, name of the limit, a small value, function, system, options and the outcome at the limit. Options
# differ from those of other tests, whose compiled functions have the usual limits.
SHAFT = {"element": "input", "beta": 0.157, "zeta": 0.0016}
JOINT = {"beta": 0.3, "Omega": 1.1, "zeta": 0.01, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
LIMITS = {
    "lyapunov": ("lyapunov.analysis", "MOST_WORK", 1.0, dt.lyapunov, dt.Tripod(**SHAFT), {"max_time": 0.0417}),
    "history": ("history.integration", "_STROBES", 1.0, dt.history, dt.Tripod(**SHAFT), {"stop": 0.0417, "num": 3}),
    "poincare": (
        "poincare", "_MEAN_STEPS", 0, dt.poincare, dt.Tripod(**SHAFT),
        {"method": "adaptive", "strobes": 419, "rtol": 1e-11},
    ),
    "floquet": (
        "floquet.diffrax_solvers", "MAX_STEPS", 8, dt.floquet, dt.Cardan(**JOINT), {"method": "diffrax", "rtol": 4.17e-9},
    ),
    "panels": (
        "floquet.effort", "MAX_PANELS", 8, dt.floquet, dt.Cardan(**JOINT | {"zeta": 1e6, "Omega": 0.01}), {"rtol": 4.17e-9},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", but_full(LIMITS, *(LIMITS.keys() - {"history"})))
def test_a_usual_point_beyond_a_small_limit_is_not_finished(name, monkeypatch):
    module, limit, value, function, system, options = LIMITS[name]
    monkeypatch.setattr(f"drivetrain_jax.analysis.{module}.{limit}", value)
    assert function(system, **options).outcome == Outcome.STEP_LIMIT


@pytest.mark.full
def test_a_search_for_an_orbit_ends_at_its_limit(monkeypatch):
    monkeypatch.setattr("drivetrain_jax.analysis.forced.orbit.MAX_SEARCH", 1)
    monkeypatch.setattr("drivetrain_jax.analysis.forced.analysis._others", lambda *_: jnp.full((1, 4), jnp.nan))
    found = dt.forced(dt.Cardan(**JOINT), outputs=["orbit_state"], rtol=4.17e-8)
    assert found.outcome == Outcome.NOT_CONVERGED
