"""The rule of the verdict: every piece of evidence counts."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from drivetrain_jax.analysis.lyapunov.analysis import Evidence, Verdict, judge
from drivetrain_jax.analysis.lyapunov.growth_record import adds_up, same_exponent

CHAOTIC = Evidence(
    spectrum=jnp.array([1.0, -3.0]), error=jnp.array([0.1, 0.1]), coarse=jnp.array(1.0), coarse_error=jnp.array(0.1),
    sum_residual=jnp.array(1e-6), k01=jnp.array(0.99), bounded=jnp.array(True), following=jnp.array(False),
    multiple=jnp.array(0), aperiodic=jnp.array(False), returns=jnp.array(False),
    resolved=jnp.array(True), roomy=jnp.array(True),
)  # fmt: skip
REGULAR = CHAOTIC._replace(spectrum=jnp.array([-1.0, -3.0]), k01=jnp.array(0.0))


def verdict(evidence: Evidence, autonomous: bool = False, **changed: object) -> Verdict:
    changed = {name: jnp.asarray(value) for name, value in changed.items()}
    return Verdict(int(judge(evidence._replace(**changed), autonomous)))


def test_all_evidence_together_is_chaos():
    assert verdict(CHAOTIC) == Verdict.CHAOTIC


@pytest.mark.parametrize(
    "missing",
    [
        {"k01": 0.89},
        {"coarse": 0.29},
        {"sum_residual": 0.01},
        {"error": [0.34, 0.1]},
        {"coarse": float("nan")},
        {"roomy": False},
        {"resolved": False},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_chaos_needs_every_piece_of_evidence(missing):
    assert verdict(CHAOTIC, **missing) == Verdict.UNDECIDED


@pytest.mark.parametrize("changed", [{"following": True}, {"bounded": False}])
def test_growth_is_not_chaos(changed):
    assert verdict(CHAOTIC, **changed) == Verdict.PARAMETRICALLY_UNSTABLE


@pytest.mark.parametrize(
    "changed",
    [
        {"bounded": False, "resolved": False},
        {"bounded": False, "spectrum": [float("nan")] * 2},
        {"bounded": False, "spectrum": [-1.0, -3.0]},
        {"following": True, "resolved": False},
        {"spectrum": [-1.0, -3.0], "k01": 0.0, "multiple": 1, "resolved": False},
        {"spectrum": [-1.0, float("nan")], "k01": 0.0, "multiple": 1},
    ],
)
def test_nothing_is_said_of_what_is_not_resolved(changed):
    """Unresolved motions, exponents of NaN, and motions that a torque drives beyond the bounds are undecided."""
    assert verdict(CHAOTIC, **changed) == Verdict.UNDECIDED


@pytest.mark.parametrize(("error", "residual", "good"), [(1e-3, 2e-3, True), (1e-3, 4e-3, False), (5e-3, 4e-3, True)])
def test_exponents_add_up_to_their_size_or_error(error, residual, good):
    """The residual may be a thousandth of the largest exponent, 3, or the largest standard error."""
    errors = jnp.array([1e-3, error])
    assert bool(adds_up(jnp.array([-1.0, -3.0]), errors, jnp.array(-residual), 1.0)) is good
    assert not adds_up(jnp.array([-1.0, -3.0]), errors, jnp.array(jnp.nan), 1.0)


@pytest.mark.parametrize(
    ("other", "error", "good"), [(1.09, 0.0, True), (1.11, 0.0, False), (1.5, 0.2, True), (1.7, 0.2, False)]
)
def test_two_step_sizes_agree_to_a_tenth_or_three_errors(other, error, good):
    values = (1.0, 0.1 if error else 0.0, other, error)
    assert bool(same_exponent(*map(jnp.asarray, values))) is good


def test_a_motion_that_left_agrees_to_a_tenth():
    """The error of a motion that left the bounds is unknown, so exponents may differ by a tenth."""
    assert [bool(same_exponent(1.0, 0.1, other, jnp.nan)) for other in (1.05, 1.2, jnp.nan)] == [True, False, False]


@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({"multiple": 1}, Verdict.FIXED_POINT),
        ({"multiple": 10}, Verdict.PERIODIC),
        ({"aperiodic": True}, Verdict.QUASI_PERIODIC),
        ({}, Verdict.UNDECIDED),
        ({"multiple": 1, "error": [0.4, 0.4]}, Verdict.UNDECIDED),
    ],
)
def test_kinds_of_attracting_motion(changed, kind):
    assert verdict(REGULAR, **changed) == kind


@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({}, Verdict.QUASI_PERIODIC),
        ({"returns": False}, Verdict.UNDECIDED),
        ({"spectrum": [0.01, 0.02]}, Verdict.UNDECIDED),
        ({"spectrum": [-1.0, -3.0]}, Verdict.UNDECIDED),
        ({"k01": 0.2}, Verdict.UNDECIDED),
        ({"k01": float("nan")}, Verdict.UNDECIDED),
        ({"bounded": False, "spectrum": [-0.01, -3.0]}, Verdict.UNDECIDED),
        ({"spectrum": [1.0, -3.0], "k01": 1.0}, Verdict.CHAOTIC),
    ],
)
def test_a_forced_torus_has_one_zero_exponent_and_returns(changed, kind):
    """The exponents of the section, with errors of 0.1."""
    torus = {"spectrum": [0.01, -3.0], "k01": 0.0, "returns": True}
    assert verdict(REGULAR, **torus | changed) == kind


@pytest.mark.parametrize(
    ("spectrum", "k01", "kind"),
    [
        ([-1.0, -3.0], 0.0, Verdict.FIXED_POINT),
        ([0.0, -3.0], 0.0, Verdict.PERIODIC),
        ([0.0, 0.0], 0.0, Verdict.QUASI_PERIODIC),
        ([0.0, -3.0], 0.5, Verdict.UNDECIDED),
    ],
)
def test_kinds_of_unforced_motion(spectrum, k01, kind):
    assert verdict(REGULAR, autonomous=True, spectrum=spectrum, k01=k01) == kind
