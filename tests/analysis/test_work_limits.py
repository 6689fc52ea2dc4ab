"""The work of a point is bounded: every analysis ends for parameters of any size, with finite values after a success."""

from __future__ import annotations

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


@pytest.mark.parametrize("name", but_full(CASES, "adaptive section"))
def test_the_widest_points_end(name):
    assert_ends(name, 300, FEW)


@pytest.mark.full
@pytest.mark.parametrize("decades", [3, 10, 300])
@pytest.mark.parametrize("name", CASES)
def test_wide_batches_end(name, decades):
    assert_ends(name, decades, MANY, seed=1)
