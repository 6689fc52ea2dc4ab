"""The outcome marks only those frequencies at which the branch has more motions than the results hold."""

import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis._base import Request
from drivetrain_jax.analysis.frequency_response import analysis as frequency_response
from drivetrain_jax.analysis.frequency_response import harmonic_response
from drivetrain_jax.analysis.impacts import exact_response
from drivetrain_jax.analysis.numerics import continuation
from drivetrain_jax.analysis.numerics.continuation import distinct
from drivetrain_jax.systems import rattle
from tests.quick_jit import quick_jit

# Frequencies of Table 1; at .8 there are three motions.
OMEGAS = np.array([0.65, 0.8, 0.95])
OPTIONS = {
    "exact": {"rtol": 1e-10, "most_periods": 1000},
    "harmonic_balance": {"harmonics": 3, "subharmonic": 1, "samples": 256},
}


def branch(method):
    request = Request(("branch_u_max",), method, OPTIONS[method])
    solve = frequency_response.ANALYSIS.solvers(rattle.Rattle, request)[0].solve
    values = rattle.PRESETS["table1"] | {"omega": OMEGAS}
    found = quick_jit(lambda: solve(values, jnp.asarray(1)))()
    return np.isfinite(found["branch_u_max"]).sum(axis=1), np.asarray(found["outcome"])


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "module"),
    [pytest.param("exact", exact_response, marks=pytest.mark.full), ("harmonic_balance", harmonic_response)],
)
def test_more_motions_than_there_is_room_for(method, module, monkeypatch):
    monkeypatch.setattr(module, "BRANCHES", 2)
    number, outcome = branch(method)
    np.testing.assert_array_equal(number, [1, 2, 1])
    np.testing.assert_array_equal(outcome, [Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS])


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "module", "name"),
    [
        pytest.param("exact", exact_response, "_CORRECTIONS", marks=pytest.mark.full),
        ("harmonic_balance", harmonic_response, "_POLISH"),
    ],
)
def test_a_motion_that_cannot_be_corrected(method, module, name, monkeypatch):
    monkeypatch.setattr(module, name, 1)
    number, outcome = branch(method)
    assert number[1] < 3
    np.testing.assert_array_equal(outcome == Outcome.TOLERANCE_NOT_MET, number < [1, 3, 1])


@pytest.mark.full
def test_a_branch_of_too_many_steps_is_not_complete(monkeypatch):
    monkeypatch.setattr(continuation, "_BUDGET", 500.0)
    np.testing.assert_array_equal(branch("exact")[1], Outcome.TOLERANCE_NOT_MET)


def test_two_places_that_are_corrected_to_one_motion():
    high = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [np.nan, 0.3, 0.3]])
    low = np.array([[-0.1, -0.1, -0.3], [-0.2, -0.1, -0.1], [np.nan, -0.3, -0.3]])
    np.testing.assert_array_equal(distinct(jnp.asarray(high), jnp.asarray(low)), [True, False, True])
