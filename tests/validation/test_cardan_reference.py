"""The cardan shaft against the 200-bit reference values and against SciPy."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from tests.analysis.floquet_batch import FloquetBatch
from tests.oracles.cardan_reference import BASE_CASE, NAMES, monodromy, spectral_radius, stacked_monodromy
from tests.sizes import full_after

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


USUAL = [i for i, point in enumerate(POINTS) if not extremes(point) and point["Omega"] >= 0.1 and point["zeta"] <= 0.1]


@pytest.fixture(scope="module", params=full_after(1, [USUAL, list(range(len(POINTS)))]), ids=["usual", "all"])
def result(request):
    """Points of the reference at once, with the exact radius: usual ones by the solvers, all by a run."""
    outputs = ["spectral_radius", "spectral_radius_error", "verdict", "floquet_multiplier"]
    columns = {name: [POINTS[i][name] for i in request.param] for name in NAMES}
    if request.param is USUAL:
        found = FloquetBatch("direct", outputs=outputs)(columns)
        dataset = xr.Dataset({name: (("point", "multiplier")[: x.ndim], x) for name, x in found.items()})
    else:
        dataset = dt.run({"system": "cardan", "analysis": "floquet", "outputs": outputs, "points": columns})
    return dataset.assign_coords(point=request.param, exact=("point", RHO[request.param]))


def failures(result: xr.Dataset, bad: np.ndarray) -> list[str]:
    return [LABELS[i] for i in result.point.values[bad]]


def test_every_point_is_computed(result):
    """At extreme parameters the bound may exceed the target, up to 60 times, which the outcome then shows."""
    assert set(result.outcome.values.tolist()) <= {Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET}
    hard = [extremes(p) > 1 or p["zeta"] >= 10 or p["gamma"] <= 1e-3 for p in (POINTS[i] for i in result.point.values)]
    assert not failures(result, (result.outcome.values != 0) & ~np.array(hard))
    assert (result.spectral_radius_error <= 6e-8).all()


def test_spectral_radius(result):
    error = np.abs(result.spectral_radius / result.exact - 1).values
    assert not failures(result, ~(error <= TOLERANCE[result.point])), error


def test_error_bound_holds(result):
    error = np.abs(result.spectral_radius - result.exact).values
    # The reference has 18 digits; reading it rounds to one unit in the last place of float64.
    assert not failures(result, ~(error <= result.spectral_radius_error.values + np.spacing(result.exact.values)))


def test_error_bound_is_useful(result):
    assert not failures(result, ~(result.spectral_radius_error <= 1e-6 * np.maximum(result.exact, 1)).values)


def test_verdict_is_never_wrong(result):
    verdict, exact = result.verdict.values, result.exact.values
    assert not failures(result, (verdict == STABLE) & (exact >= 1) & ~undamped(result))
    assert not failures(result, (verdict == UNSTABLE) & (exact <= 1))
    assert not failures(result, (verdict == UNDECIDED) & (np.abs(exact - 1) > 1e-6))


def undamped(result: xr.Dataset) -> np.ndarray:
    return np.array([POINTS[i]["zeta"] == 0 for i in result.point.values])


def test_undamped_points_are_stable_on_the_unit_circle(result):
    bounded = undamped(result) & (np.abs(result.exact.values - 1) < 1e-15)
    assert bounded.any() and (result.verdict.values[bounded] == STABLE).all()


def test_multipliers(result):
    for i, multipliers in zip(result.point.values, result.floquet_multiplier.values, strict=True):
        exact = np.array([complex(float(re), float(im)) for re, im in POINTS[i]["multipliers"]])
        # Those far below the largest are not known.
        multipliers = multipliers[np.isfinite(multipliers)]
        assert (np.abs(exact) > 1e-5 * RHO[i]).sum() <= len(multipliers)
        distance = np.abs(multipliers[:, None] - exact)
        orders = permutations(range(4), len(multipliers))
        nearest = min(distance[range(len(multipliers)), list(order)].max() for order in orders)
        assert nearest <= TOLERANCE[i] * RHO[i], LABELS[i]


def test_multipliers_fall_in_modulus(result):
    moduli = np.abs(result.floquet_multiplier.values)
    steps = np.diff(moduli, axis=-1)
    assert (np.isnan(steps) | (steps <= 1e-14 * moduli[:, :1])).all()


def test_one_point_alone_gives_the_same():
    point = {name: POINTS[2][name] for name in NAMES}
    assert float(dt.point("cardan", "floquet", **point).spectral_radius) == pytest.approx(RHO[2], rel=1e-9)


@pytest.mark.parametrize("index", [2, 4, 12, 26])
def test_the_oracle_itself(index):
    assert spectral_radius(monodromy(POINTS[index])) == pytest.approx(RHO[index], rel=1e-11)


@pytest.mark.full
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
