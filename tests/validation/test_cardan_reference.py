"""The cardan shaft against the 200-bit reference values and against SciPy."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt
from tests.oracles.cardan_reference import BASE_CASE, NAMES, monodromy, spectral_radius, stacked_monodromy

POINTS = json.loads((Path(__file__).parents[1] / "reference" / "cardan.json").read_text())["points"]
RHO = np.array([float(point["rho"]) for point in POINTS])
LABELS = [" ".join(f"{name}={point[name]:g}" for name in NAMES) for point in POINTS]
STABLE, UNSTABLE, UNDECIDED = 0, 1, 2


def extremes(point: dict) -> int:
    """Number of parameters at the limits of the direct method, which guarantees 1e-9 for one of them at a time."""
    at_limit = (
        point["beta"] >= 1.55,
        point["Omega"] <= 0.01,
        point["zeta"] >= 1,
        point["mu"] >= 1e4,
        point["gamma"] <= 1e-3,
    )
    return sum(at_limit)


TOLERANCE = np.array([1e-7 if extremes(point) > 1 else 1e-9 for point in POINTS])


@pytest.fixture(scope="module")
def result():
    """All points of the reference in one run."""
    outputs = ["spectral_radius", "spectral_radius_error", "verdict", "floquet_multiplier"]
    columns = {name: [point[name] for point in POINTS] for name in NAMES}
    return dt.run({"system": "cardan", "analysis": "floquet", "outputs": outputs, "points": columns})


def failures(bad: np.ndarray) -> list[str]:
    return [LABELS[i] for i in np.flatnonzero(bad)]


def test_every_point_is_computed(result):
    """With several extreme parameters the bound may exceed the target, which the outcome then shows."""
    names = result.outcome.attrs["flag_meanings"].split()
    allowed = {0, names.index("tolerance_not_met")}
    assert set(result.outcome.values.tolist()) <= allowed
    assert not failures((result.outcome.values != 0) & (TOLERANCE == 1e-9))


def test_spectral_radius(result):
    error = np.abs(result.spectral_radius.values / RHO - 1)
    assert not failures(~(error <= TOLERANCE)), error


def test_error_bound_holds(result):
    error = np.abs(result.spectral_radius.values - RHO)
    # The reference has 18 digits; reading it rounds to one unit in the last place of float64.
    assert not failures(~(error <= result.spectral_radius_error.values + np.spacing(RHO)))


def test_error_bound_is_useful(result):
    assert not failures(~(result.spectral_radius_error.values <= 1e-6 * np.maximum(RHO, 1)))


def test_verdict_is_never_wrong(result):
    verdict = result.verdict.values
    assert not failures((verdict == STABLE) & (RHO >= 1))
    assert not failures((verdict == UNSTABLE) & (RHO <= 1))
    assert not failures((verdict == UNDECIDED) & (np.abs(RHO - 1) > 1e-6))


def test_undamped_points_are_undecided(result):
    undamped = np.array([point["zeta"] == 0 for point in POINTS])
    assert undamped.any()
    assert (result.verdict.values[undamped] == UNDECIDED).all()


def test_multipliers(result):
    for i, point in enumerate(POINTS):
        exact = np.array([complex(float(re), float(im)) for re, im in point["multipliers"]])
        distance = np.abs(result.floquet_multiplier.values[i][:, None] - exact)
        nearest = min(distance[list(order), range(4)].max() for order in permutations(range(4)))
        assert nearest <= TOLERANCE[i] * RHO[i], LABELS[i]


def test_multipliers_fall_in_modulus(result):
    moduli = np.abs(result.floquet_multiplier.values)
    assert (np.diff(moduli, axis=-1) <= 1e-14 * moduli[:, :1]).all()


def test_one_point_alone_gives_the_same():
    point = {name: POINTS[2][name] for name in NAMES}
    assert float(dt.point("cardan", "floquet", **point).spectral_radius) == pytest.approx(RHO[2], rel=1e-9)


@pytest.mark.parametrize("index", [2, 4, 12, 26])
def test_the_oracle_itself(index):
    assert spectral_radius(monodromy(POINTS[index])) == pytest.approx(RHO[index], rel=1e-11)


def test_random_points_agree_with_scipy():
    """A seeded subset of the comparison of 500 random points, by both formulations in SciPy."""
    rng = np.random.default_rng(20)
    columns = {"beta": rng.uniform(0, 1.5, 32), "Omega": rng.uniform(0.1, 2, 32)}
    columns |= {"alpha": rng.uniform(0.1, 20, 32), "mu": 10 ** rng.uniform(-1, 1.3, 32)}
    fixed = {name: value for name, value in BASE_CASE.items() if name not in columns}
    scene = {"system": "cardan", "analysis": "floquet", "outputs": ["spectral_radius"], "fixed": fixed}
    ours = dt.run(scene | {"points": {name: list(map(float, v)) for name, v in columns.items()}}).spectral_radius.values
    stacked = spectral_radius(stacked_monodromy(columns | fixed, 1e-12, 1e-13))
    np.testing.assert_allclose(ours, stacked, rtol=1e-9)
    alone = [spectral_radius(monodromy({**fixed, **{name: v[i] for name, v in columns.items()}})) for i in range(4)]
    np.testing.assert_allclose(ours[:4], alone, rtol=1e-9)
