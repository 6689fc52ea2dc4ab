"""The analysis in the engine: methods on the same axes, order of the path, results that a method does not have."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.systems.rattle import PRESETS

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())
STEADY = {case["name"]: case for case in REFERENCE["steady"]}
# Frequencies in no order.
OMEGAS = [0.8, 0.6, 0.7, 0.9]


def run(method: str, omegas=OMEGAS, outputs=("u_max", "u_min", "regime"), **options):
    scene = {"system": "rattle", "analysis": "frequency_response", "outputs": list(outputs)}
    return dt.run(
        scene
        | {"axes": {"omega": {"values": omegas}}, "fixed": PRESETS["table1"], "options": {"method": method} | options}
    )


LINE = sorted([*np.linspace(0.163, 2.0, 40).tolist(), 0.187, 0.24, 0.755, 0.873, *OMEGAS])
BRANCH = ("branch_u_max", "branch_u_min", "branch_stability", "fold_frequency", "doubling_frequency")


@pytest.fixture(scope="module")
def exact():
    return run("exact", LINE, ("u_max", "u_min", "regime", *BRANCH))


def test_exact_sweeps_meet_the_reference(exact):
    for name, omega, direction in (
        ("T1 w.8 high", 0.8, "up"), ("T1 w.8 low", 0.8, "down"), ("T1 w.7 double-sided", 0.7, "up"),
        ("T1 w.87 high (near fold)", 0.873, "up"),
    ):  # fmt: skip
        at = exact.sel(omega=omega, sweep_direction=direction)
        assert STEADY[name]["params"]["omega"] == omega
        assert float(at.u_max) == pytest.approx(STEADY[name]["max"], abs=1e-9)
        assert float(at.u_min) == pytest.approx(STEADY[name]["min"], abs=1e-9)
    assert (exact.outcome == 0).all()


def test_folds_and_period_doublings_of_the_branch(exact):
    """The branch has all folds and doublings of the reference within the line, and no others."""
    for output, kind in (("fold_frequency", "fold"), ("doubling_frequency", "PD")):
        expected = sorted(s["omega"] for s in REFERENCE["specials"]["table1"] if s["type"] == kind)
        found = exact[output].values
        np.testing.assert_allclose(found[:, : len(expected)], np.tile(expected, (len(LINE), 1)), rtol=0, atol=1e-12)
        assert np.isnan(found[:, len(expected) :]).all()


# Table 1 with c = .02: the 16 highest of 28 folds above .05, and all doublings, by root finding with an independent flow.
LIGHTLY_DAMPED = {
    "fold_frequency": [
        0.1084329346, 0.1097529355, 0.1272030868, 0.1287217594, 0.1517450130, 0.1539605314, 0.1788804262, 0.1869507587,
        0.2327749420, 0.2413158083, 0.3421909362, 0.3424009290, 0.3435402888, 0.3440647758, 0.7575930369, 0.9469773899,
    ],
    "doubling_frequency": [
        0.1349864731, 0.1412645359, 0.1771333890, 0.1796209576, 0.2875297488, 0.3015438111, 0.4027082976, 0.4684277383,
        1.2384267559, 1.9652211413,
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("lowest", "outcome"),
    [pytest.param(0.05, Outcome.TOLERANCE_NOT_MET, marks=pytest.mark.full), (0.1, Outcome.SUCCESS)],
)
@pytest.mark.full
def test_where_the_line_begins_decides_no_fold_or_doubling(lowest, outcome):
    """Close pairs are not missed; of more than 16 the results are the highest."""
    scene = {"system": "rattle", "analysis": "frequency_response", "outputs": list(LIGHTLY_DAMPED)}
    axes = {"omega": {"start": lowest, "stop": 2.0, "num": 3}}
    found = dt.run(scene | {"axes": axes, "fixed": PRESETS["table1"] | {"c": 0.02}, "options": {"method": "exact"}})
    for name, expected in LIGHTLY_DAMPED.items():
        np.testing.assert_allclose(found[name].values[0, : len(expected)], expected, rtol=0, atol=2e-10)
        assert np.isnan(found[name].values[0, len(expected) :]).all()
    assert (found.outcome == outcome).all()


def test_the_exact_branch_has_the_saddles_between_folds(exact):
    omega = exact.omega.values
    folds = exact.fold_frequency.values[0, :6].reshape(3, 2)
    between = np.any([(low < omega) & (omega < high) for low, high in folds], axis=0)
    np.testing.assert_array_equal(np.isfinite(exact.branch_u_max).sum("branch"), np.where(between, 3, 1))
    near = exact.sel(omega=[0.755, 0.873])
    assert near.branch_stability.values[:, :4].tolist() == [[0, 1, 0, 2], [0, 1, 0, 2]]
    up, down = (near[name].sel(sweep_direction="up") for name in ("u_max", "u_min"))
    np.testing.assert_allclose(near.branch_u_max.sel(branch=3), up, rtol=0, atol=1e-12)
    np.testing.assert_allclose(near.branch_u_min.sel(branch=3), down, rtol=0, atol=1e-12)
    # Beyond the period doubling the simple orbit is unstable, and the sweep is on another motion.
    doubled = (omega > 1.2425788605) & (omega < 1.9590767455)
    assert (exact.branch_stability.values[doubled, 0] == 1).all()


@pytest.mark.full
def test_direction_without_a_motion_is_absent_and_the_other_kept():
    """Without a mean torque no force acts within the play: at some frequencies the sweep down finds no attractor."""
    fixed = {"B0": 0.0, "B1": 0.03, "b": 0.05, "alpha": 0.0, "c": 0.05, "k": 1.0, "I": 1.0}
    axes = {"omega": {"start": 0.7, "stop": 0.9, "num": 5}}
    outputs = ["u_max", "stability"]
    found = dt.run(
        {"system": "rattle", "analysis": "frequency_response", "axes": axes, "fixed": fixed, "outputs": outputs}
    )
    known = found["u_max"].notnull().values
    assert known.sum(axis=0).tolist() == [5, 2]
    np.testing.assert_array_equal(found["stability"].values, np.where(known, 0, 2))
    np.testing.assert_array_equal(found["outcome"].values, np.where(known.all(axis=1), 0, Outcome.NOT_CONVERGED))


@pytest.mark.full
def test_order_of_the_path_does_not_matter():
    given = run("describing_function")
    rising = run("describing_function", sorted(OMEGAS))
    np.testing.assert_array_equal(given.u_max.sortby("omega").values, rising.u_max.values)
    assert given.u_max.dims == ("omega", "sweep_direction")
    assert given.regime.sel(omega=0.8).values.tolist() == [2, 1]


def test_a_range_that_is_given_is_kept():
    found = run("multiple_scales", outputs=("fit_range", "peak_frequency"), fit_range=1.0)
    np.testing.assert_array_equal(found.fit_range.values, 1.0)
    np.testing.assert_allclose(found.peak_frequency.values, 0.8729, atol=5e-5)


@pytest.mark.parametrize(
    ("method", "output", "allowed"),
    [
        ("exact", "peak_frequency", "multiple_scales, describing_function"),
        ("harmonic_balance", "fit_range", "multiple_scales"),
        ("describing_function", "period_multiple", "exact"),
    ],
)
def test_results_that_a_method_lacks_are_refused(method, output, allowed):
    with pytest.raises(InputError, match=f"method {method} does not give {output}; expected {allowed}"):
        run(method, outputs=(output,))


def test_options_of_another_method_are_refused():
    with pytest.raises(InputError, match=r"options.fit_range = 1.0: not used by method harmonic_balance"):
        run("harmonic_balance", fit_range=1.0)


def test_too_few_samples_for_the_harmonics_are_refused():
    with pytest.raises(InputError, match=r"options.samples = 10: expected 0 \(by the harmonics\) or at least 11"):
        run("harmonic_balance", harmonics=5, samples=10)


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "size"),
    [
        ("exact", 0.1808996938995747),
        ("multiple_scales", 0.0),
        pytest.param("harmonic_balance", 0.1808996938995747, marks=pytest.mark.full),
    ],
)
def test_a_motion_without_a_fundamental_has_no_phase(method, size):
    scene = {"system": "rattle", "analysis": "frequency_response", "outputs": ["u_max", "phase"]}
    scene |= {"fixed": PRESETS["table1"] | {"B1": 0.0}, "options": {"method": method}}
    found = dt.run(scene | {"axes": {"omega": {"values": [0.6, 0.9, 1.3]}}})
    assert (found.outcome == Outcome.SUCCESS).all() and found.phase.isnull().all()
    np.testing.assert_allclose(found.u_max, size, rtol=1e-11)
