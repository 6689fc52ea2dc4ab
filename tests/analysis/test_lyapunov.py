"""Lyapunov spectra of systems whose exponents are known, and verdicts on motions whose kind is known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import flows
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome, Request
from drivetrain_jax.analysis.lyapunov import section_measures
from drivetrain_jax.analysis.lyapunov.analysis import Verdict, analyse
from drivetrain_jax.analysis.lyapunov.orbit import may_be_chaotic
from drivetrain_jax.analysis.lyapunov.variational import needed_steps
from drivetrain_jax.invariants import check
from drivetrain_jax.systems import Flow, get_system
from tests.oracles import tripod_reference as oracle
from tests.sizes import but_full

OUTPUTS = ("lyapunov_spectrum", "lyapunov_standard_error", "sum_rule_residual", "verdict", "chaos_k01")
LANES = 32
LITERATURE = {
    "lorenz": (0.9056, 0.0, -14.5723),
    "roessler": (0.0714, 0.0, -5.3943),
    "ueda": (0.1034, -0.1534),
    "two_wells": (0.1572, -0.4072),
    "pendulum": (0.1400, -0.1900),
}

# Largest standard errors of the means, to keep the comparison sharp.
LARGEST_ERROR = {"lorenz": 1.5e-3, "roessler": 1.5e-3, "ueda": 2e-3, "two_wells": 2e-3, "pendulum": 2e-3}


def broken(dataset) -> list[str]:
    return [str(finding) for finding in check(dataset) if finding.broken]


def request(outputs: tuple[str, ...], max_time: float, steps: int, target: float = 0.0) -> Request:
    return Request(outputs, "benettin", {"standard_error": target, "max_time": max_time, "steps": steps})


def results(flow: Flow, *options) -> dict:
    """Results of ``flow`` for the arguments ``options`` of ``request``."""
    return {name: np.asarray(value) for name, value in jax.jit(lambda: analyse(flow, request(*options)))().items()}


@cache
def batch(name: str) -> dict:
    """Results of the flow ``name`` with suitable time and steps per strobe."""
    sizes = {"lorenz": (1024.0, 16), "roessler": (4096.0, 32), "oscillators": (4000.0, 64)}
    return results(getattr(flows, name)(LANES), OUTPUTS, *sizes[name])


def known(name: str) -> dict:
    if name not in flows.OSCILLATORS:
        return batch(name)
    first = LANES * list(flows.OSCILLATORS).index(name)
    return {key: value[..., first : first + LANES] for key, value in batch("oscillators").items()}


@pytest.mark.full
@pytest.mark.parametrize("name", LITERATURE)
def test_literature_values_within_standard_errors(name):
    """Means over independent members agree within three standard errors; literature values are rounded to 4 digits."""
    spectrum = known(name)["lyapunov_spectrum"]
    error = spectrum.std(axis=1, ddof=1) / math.sqrt(spectrum.shape[1])
    np.testing.assert_array_less(np.abs(spectrum.mean(axis=1) - LITERATURE[name]), 3 * error + 1e-4)
    assert error.max() < LARGEST_ERROR[name]


@pytest.mark.full
@pytest.mark.parametrize("name", LITERATURE)
def test_block_error_is_no_smaller_than_the_scatter(name):
    """The error is never much smaller than the scatter, and larger if neighbouring blocks are anticorrelated."""
    scatter = known(name)["lyapunov_spectrum"].std(axis=1, ddof=1)
    assert (np.median(known(name)["lyapunov_standard_error"], axis=1) > 0.6 * scatter).all()


@pytest.mark.full
@pytest.mark.parametrize("name", LITERATURE)
def test_chaos_is_recognised(name):
    """Roessler's attractor turns almost uniformly: within 1024 strobes only the third component shows its chaos."""
    kinds, k01 = known(name)["verdict"], np.median(known(name)["chaos_k01"])
    assert (kinds == Verdict.CHAOTIC).mean() > 0.9
    assert k01 > 0.97


@pytest.mark.full
@pytest.mark.parametrize("name", LITERATURE)
def test_exponents_add_up_to_the_mean_divergence(name):
    assert np.abs(known(name)["sum_rule_residual"]).max() < 1e-6


def sampled_shortly(patch, strobes: int) -> None:
    """Take fewer strobes after a run, which cost more than a short run."""
    patch.setattr(section_measures, "SAMPLES", strobes)
    patch.setattr(section_measures, "LONGEST", strobes // 2)


@pytest.fixture(scope="module")
def linear():
    """Results of linear oscillators as a function of damping and stiffness, compiled once."""
    compiled = jax.jit(lambda *p: analyse(flows.linear(*p), request(OUTPUTS, 200.0, 12, 1e-2)))
    with pytest.MonkeyPatch.context() as patch:
        sampled_shortly(patch, 128)
        compiled = compiled.lower(*(np.ones(4),) * 2).compile()
    return lambda *p: {name: np.asarray(value) for name, value in compiled(*map(np.asarray, p)).items()}


@pytest.fixture(scope="module")
def linear_motions(linear):
    """Oscillators with exponents -0.1 and -0.9, with a pair -0.1 +- i, with a slow decay, and with overflowing growth."""
    return linear([1.0, 0.2, 0.01, -0.5], [0.09, 1.01, 1.0, 1.0])


@pytest.mark.full
def test_linear_oscillator_under_constant_torque_stands_still(linear_motions):
    np.testing.assert_allclose(linear_motions["lyapunov_spectrum"][:, 0], [-0.1, -0.9], rtol=1e-6)
    assert linear_motions["verdict"][0] == Verdict.FIXED_POINT


@pytest.mark.full
def test_degenerate_pair_is_still_a_fixed_point(linear_motions):
    """A complex pair has a double exponent, that of its orbit; averages would have two values with the exact sum."""
    ours, error = (linear_motions[name][:, 1] for name in ("lyapunov_spectrum", "lyapunov_standard_error"))
    np.testing.assert_allclose(ours, -0.1, rtol=0, atol=1e-9)
    assert (error < 1e-9).all()
    assert linear_motions["verdict"][1] == Verdict.FIXED_POINT


@pytest.mark.full
def test_what_leaves_all_bounds_is_unstable_and_stops_nobody(linear_motions):
    assert linear_motions["verdict"][3] == Verdict.PARAMETRICALLY_UNSTABLE
    assert np.isnan(linear_motions["lyapunov_standard_error"][:, 3]).all()
    np.testing.assert_allclose(linear_motions["lyapunov_spectrum"][:, 3], 0.25, atol=0.05)
    assert (linear_motions["outcome"] == 0).all()


@pytest.mark.full
def test_what_leaves_at_once_has_no_exponents():
    """Without a value the outcome must not be a success."""
    ours = dt.run(
        {
            "system": "tripod",
            "analysis": "lyapunov",
            "axes": {"chi_n": {"values": [0.01, 0.6]}},
            "fixed": {"element": "input", "beta": 0.157, "zeta": 0.01},
            "options": {"max_time": 0.5},
        }
    )
    assert ours["outcome"].values.tolist() == [Outcome.SUCCESS, Outcome.NOT_FINITE]
    assert np.isnan(ours["lyapunov_spectrum"].values[1]).all() and not broken(ours)


@pytest.mark.full
def test_what_has_no_value_where_it_starts_is_not_left_out():
    """A point whose settling time could not be predicted was once skipped."""
    ours = tripod({"chi_n": [-0.6, 0.0026], "zeta": [0.01, 0.01]}, OUTPUTS[:1], max_time=0.02, standard_error=0.5)
    assert ours.outcome.values[0] == Outcome.NOT_FINITE


def tripod(points: dict, outputs: tuple = OUTPUTS[:4], fixed: dict | None = None, **options):
    """Results of points of the input element, or of other parameters in ``fixed``."""
    scene = {"system": "tripod", "analysis": "lyapunov", "outputs": list(outputs), "points": points, "options": options}
    return dt.run(scene | {"fixed": {"element": "input", "beta": 0.157} | (fixed or {})})


# Excitation frequency [Hz] and damping ratio; the sum of the exponents, a closed form (chi_n is 0.0026), and the outcome.
_UNRESOLVED = (
    (33.0, 0.0016, -30.83, Outcome.TOLERANCE_NOT_MET),  # the steps feed the oscillation until it leaves
    (36.0, 0.0016, -30.83, Outcome.TOLERANCE_NOT_MET),  # they damp it
    (50.0, 0.0016, -30.83, Outcome.TOLERANCE_NOT_MET),
    (100.0, 0.0016, -30.83, Outcome.TOLERANCE_NOT_MET),
    (3066.5, 30.0, -578023.8, Outcome.TOLERANCE_NOT_MET),
    (20.0, 0.0016, -30.83, Outcome.NOT_FINITE),
    (3066.5, 50.0, -963373.0, Outcome.NOT_FINITE),
    (400.0, 0.0016, -30.83, Outcome.SUCCESS),
    (3066.5, 10.0, -192674.586, Outcome.SUCCESS),
)


@pytest.mark.full
def test_too_few_steps_are_told():
    """48 steps are too few for up to 77 periods of the shaft, and for a decay within the first step."""
    points = {"excitation_frequency": [case[0] for case in _UNRESOLVED], "zeta": [case[1] for case in _UNRESOLVED]}
    ours = tripod(points, max_time=1.0, steps=48)
    assert ours.outcome.values.tolist() == [case[3] for case in _UNRESOLVED]
    assert (ours.verdict.values[:-2] == Verdict.UNDECIDED).all()
    # The residual equals the error of the sum, even for motions that left the bounds.
    found = ours.lyapunov_spectrum.values.sum(axis=1) - [case[2] for case in _UNRESOLVED]
    given = ours.outcome.values != Outcome.NOT_FINITE
    np.testing.assert_allclose(ours.sum_rule_residual.values[given], found[given], rtol=1e-3, atol=0.01)
    assert not broken(ours)


# Excitation frequency [Hz] and damping ratio: 48 steps damp or excite the oscillation, or are too few for a fast decay, or a
# strobe shrinks volume by more than rounding allows.
_HARD = ((20.0, 1e-4), (36.0, 0.0016), (120.0, 0.0016), (100.0, 0.3), (30.0, 1.5), (500.0, 3.0), (3066.5, 30.0))


@pytest.fixture(scope="module")
def hard():
    names = ("excitation_frequency", "zeta")
    points = dict(zip(names, map(list, zip(*_HARD, strict=True)), strict=True))
    return points, tripod(points, OUTPUTS[:4], {"chi_n": 0.01}, max_time=0.5)


@pytest.mark.full
def test_steps_follow_the_field(hard):
    """By default the exponents are those of Floquet theory (a pair has a common decay, whose sum is exact)."""
    points, ours = hard
    scene = {"system": "tripod", "analysis": "floquet", "outputs": ["floquet_exponent", "outcome"], "points": points}
    exact = dt.run(scene | {"fixed": {"element": "input", "beta": 0.157, "chi_n": 0.01}})
    assert (exact.outcome == Outcome.SUCCESS).all() and (ours.outcome == Outcome.SUCCESS).all()
    found, expected = ours.lyapunov_spectrum.values, exact.floquet_exponent.values
    # Multipliers far below the largest are not known.
    known = np.isfinite(expected)
    assert known.sum() >= 13
    np.testing.assert_allclose(found.sum(axis=1)[known.all(axis=1)], expected.sum(axis=1)[known.all(axis=1)], rtol=5e-5)
    error = ours.lyapunov_standard_error.values
    assert (np.abs(found - expected) < 3 * error + 5e-5 * np.abs(expected))[known].all()
    assert np.isin(ours.verdict, [Verdict.FIXED_POINT, Verdict.PERIODIC, Verdict.QUASI_PERIODIC]).all()
    assert not broken(ours)


@pytest.mark.full
def test_a_neighbour_that_needs_more_steps_changes_little(hard):
    """A batch marches with the largest number of steps that any member needs."""
    points, ours = hard
    first = {name: values[:3] for name, values in points.items()}
    alone = tripod(first, OUTPUTS[:4], {"chi_n": 0.01}, max_time=0.5)
    difference = np.abs(alone.lyapunov_spectrum.values - ours.lyapunov_spectrum.values[:3])
    assert (difference < 2e-5 * np.abs(alone.lyapunov_spectrum.values)).all()
    assert alone.verdict.values.tolist() == ours.verdict.values[:3].tolist()


@pytest.mark.full
def test_steps_that_are_given_are_taken():
    """A given number of steps is used, even if the field needs more."""
    points = {"excitation_frequency": [3066.5] * 4, "zeta": [0.0016, 0.01, 0.1, 0.5]}
    ours, same, fewer = (tripod(points, OUTPUTS[:3], max_time=0.02, **n) for n in ({}, {"steps": 48}, {"steps": 8}))
    for name in OUTPUTS[:3]:
        np.testing.assert_array_equal(ours[name], same[name])
    assert (ours.lyapunov_spectrum != fewer.lyapunov_spectrum).all()
    with pytest.raises(dt.InputError, match=r"^options\.steps = 0: expected integer 4 <= steps <= 1000000$"):
        tripod(points, steps=0)


@pytest.mark.full
def test_decay_beyond_rounding_within_a_strobe_is_found():
    """The decay within a strobe is e^-63: vectors orthonormalised once per strobe would lose all digits."""
    ours = tripod({"excitation_frequency": [3066.5], "zeta": [10.0]}, OUTPUTS[:4], max_time=0.5, steps=192)
    assert ours.lyapunov_spectrum.values.sum() == pytest.approx(-192674.6, rel=1e-6)
    assert ours.outcome.values.tolist() == [Outcome.SUCCESS]


@pytest.mark.full
def test_more_steps_than_usual_are_taken_only_on_request():
    points = {"excitation_frequency": [0.05, 3066.5], "zeta": [0.01, 0.01]}
    ours = tripod(points, OUTPUTS[:1], max_time=0.01)
    assert ours.outcome.values.tolist() == [Outcome.STEP_LIMIT, Outcome.SUCCESS]
    asked = tripod({name: [values[0]] for name, values in points.items()}, OUTPUTS[:1], max_time=0.01, steps=64)
    assert asked.outcome.values.tolist() == [Outcome.NOT_FINITE]


def test_steps_of_a_flow_are_predicted_from_what_it_tells():
    """Without a known frequency there are 48 steps, otherwise more with more turns per strobe and with weak damping."""

    def steps(fastest: float | None, damping: float, period: float) -> float:
        flow = Flow(lambda _, y: (y[1], -y[0] - damping * y[1]), (1.0, 0.0), period, fastest=fastest)
        return float(needed_steps(flow))

    assert steps(None, 0.01, 1e4) == steps(1.0, 0.01, 1.0) == 48
    assert steps(1.0, 0.01, 200.0) > 150
    assert steps(1.0, 0.01, 400.0) == pytest.approx(2 * steps(1.0, 0.01, 200.0), rel=0.01)
    assert steps(1.0, 1e-6, 200.0) > 2 * steps(1.0, 0.01, 200.0)
    assert steps(1.0, 100.0, 20.0) > 1400
    assert steps(1.0, 0.0, 200.0) < 2000 and steps(math.nan, 0.01, 200.0) == 48


# (26) is an autonomous equation for an angle and its rate. Its largest exponent over 0.3 s is 1.96 by an extrapolation
# method at 1e-12; the fixed steps stir the fast whirl of the start.
PLANAR = {
    "excitation_frequency": 2012.7004798698006, "zeta": 0.00019142247356200389, "chi_n": 0.16866322682805285,
    "phi0": 2.8840525342093706, "M_MS": 610795060.6725879,
}  # fmt: skip


@pytest.mark.full
def test_steps_do_not_make_chaos():
    fixed = {"element": "output", "equation": "26"}
    ours = tripod({name: [value] for name, value in PLANAR.items()}, OUTPUTS, fixed, max_time=0.3)
    # The exponent looks like that of a chaotic motion.
    assert ours.lyapunov_spectrum.values[0, 0] > 1000
    assert abs(ours.sum_rule_residual.values[0]) < 1 and ours.chaos_k01.values[0] > 0.8
    assert ours.verdict.values.tolist() == [Verdict.UNDECIDED]
    assert ours.outcome.values.tolist() == [Outcome.TOLERANCE_NOT_MET]


@pytest.mark.full
def test_steps_that_disagree_are_told_whatever_is_asked_for():
    """The outcome does not depend on the requested outputs, such as the verdict."""
    point = {name: [value] for name, value in PLANAR.items()}
    ours = tripod(point, OUTPUTS[:1], {"element": "output", "equation": "26"}, max_time=0.05)
    assert ours.outcome.values.tolist() == [Outcome.TOLERANCE_NOT_MET]


@pytest.mark.parametrize(
    ("changed", "possible"),
    [
        ({"equation": "29"}, True),
        ({"equation": "25"}, True),
        ({"equation": "25", "chi_AEM": 0.0}, False),
        ({"equation": "29", "chi_AEM": 0.0}, True),
        ({"equation": "29", "chi_AEM": 0.0, "chi_n": 0.0}, False),
        ({"element": "output", "equation": "26"}, False),
        ({"element": "output", "equation": "30"}, True),
    ],
)
def test_chaos_needs_a_third_dimension(changed, possible):
    """A clock on which the field depends counts as a dimension."""
    system = get_system("tripod")
    values = {p.name: p.default for p in system.parameters if p.default is not None}
    values |= {
        "element": "input",
        "beta": 0.157,
        "zeta": 0.0016,
        "chi_n": 0.0026,
        "excitation_frequency": 3e3,
    } | changed
    flow = system.models["lyapunov"].build(values)
    found = jax.jit(lambda *y: may_be_chaotic(flow, y))(jnp.array([0.1, 1.0]), jnp.array([0.2, 0.0]))
    assert found.tolist() == [possible] * 2


def test_room_for_chaos_is_a_matter_of_each_member():
    """Three components may be chaotic; two without forcing, or with a forcing of amplitude 0, may not."""
    state = (jnp.ones(2), jnp.ones(2))
    forced = Flow(lambda angles, y: (y[1], jnp.array([0.0, 1e-9]) * jnp.cos(angles[0])), state, 1.0, turns=(1,))
    assert may_be_chaotic(forced, state).tolist() == [False, True]
    assert not may_be_chaotic(flows.van_der_pol(2), state).any()
    assert may_be_chaotic(flows.lorenz(2), (*state, state[0])).all()


# Damping ratio, excitation frequency [Hz], M_AEM, phi0; the largest exponent by the monodromy matrix in quadruple precision.
_TONGUE_EDGE = (
    (1e-9, 2851.882955753298, 0.0, 1e-3, -9.311e-6),
    (1e-4, 2851.87, 0.0, 1e-3, -0.9311025),
    (1e-4, 2851.87, 0.0, 0.0, -0.9311025),
    (1.6e-3, 2851.88, 2550.0, 0.0, -13.5106671),
)


@pytest.mark.full
@pytest.mark.parametrize("max_time", [0.1, 1.0])
def test_a_double_multiplier_is_no_instability(max_time):
    """At a double multiplier vectors grow in proportion to time, or to time and a decay."""
    names = ("zeta", "excitation_frequency", "M_AEM", "phi0")
    points = dict(zip(names, map(list, zip(*(case[:4] for case in _TONGUE_EDGE), strict=True)), strict=True))
    ours = tripod(points, fixed={"beta": 0.0, "chi_n": 0.3}, max_time=max_time, steps=16)
    off = ours.lyapunov_spectrum.values[:, 0] - [case[4] for case in _TONGUE_EDGE]
    # The references have seven digits.
    assert (np.abs(off) < 2 * ours.lyapunov_standard_error.values[:, 0] + 5e-8).all()
    assert (ours.verdict.values != Verdict.PARAMETRICALLY_UNSTABLE).all()
    assert (ours.outcome == Outcome.SUCCESS).all()


@pytest.mark.full
def test_members_do_not_depend_on_their_neighbours(linear, linear_motions):
    """The slow member runs to the end and the others stop earlier; among equal members its results are the same."""
    alike = linear([0.01] * 4, [1.0] * 4)
    for name in OUTPUTS:
        np.testing.assert_array_equal(alike[name][..., 2], linear_motions[name][..., 2])


@pytest.mark.full
def test_limit_cycle_is_periodic():
    ours = results(flows.van_der_pol(2), OUTPUTS, 400.0, 24)
    assert (ours["verdict"] == Verdict.PERIODIC).all()
    assert np.abs(ours["lyapunov_spectrum"][0]).max() < 1e-3


@pytest.mark.full
def test_a_slow_drift_in_a_plane_is_no_torus():
    """x'' = 0 and x'' = 1e-8 x: the time is too short to distinguish either exponent from zero."""
    stiffness = jnp.array([0.0, 1e-8])
    flow = Flow(lambda _, y: (y[1], stiffness * y[0]), (jnp.ones(2), jnp.zeros(2)), period=1.0)
    ours = results(flow, OUTPUTS, 3000.0, 12)
    assert (ours["outcome"] == Outcome.SUCCESS).all()
    assert ours["verdict"].tolist() == [Verdict.UNDECIDED] * 2


@pytest.mark.full
def test_phases_do_not_supply_exponents():
    """The two-well oscillator with its forcing as a third component has the same two exponents."""

    def field(_, y):
        return y[1], 0.4 * jnp.cos(y[2]) - 0.25 * y[1] - y[0] ** 3 + y[0], 1.0 + 0.0 * y[2]

    flow = Flow(field, (0.1, 0.1, jnp.zeros(1)), 2 * math.pi, phases=(2,))
    ours = results(flow, ("lyapunov_spectrum", "sum_rule_residual"), 200.0, 64)
    assert ours["lyapunov_spectrum"].shape == (2, 1)
    assert ours["lyapunov_spectrum"].sum() == pytest.approx(-0.25, abs=1e-9)


# Excitation frequencies [Hz] and periods in strobes of motions of (29); exponents of the first by SciPy's DOP853 at 2e-13
# about the orbit, and their digits.
_ORBITS = (
    ((3000.0,), (10,), (-15.41392954, -15.41392954), 1e-8),
    ((3066.0, 2965.0), (511, 593), (-13.726990310634, -17.100868773641), 1e-9),
    ((3066.5,), (6133,), (-13.10868374, -17.71917535), 1e-8),
)


@pytest.mark.full
@pytest.mark.parametrize(("frequencies", "periods", "expected", "digits"), _ORBITS)
def test_exponents_of_periodic_motion_are_those_of_its_orbit(frequencies, periods, expected, digits):
    """By default, whatever the period; averages of one second were off by 0.06, and 593 strobes were no period."""
    fixed = {"beta": math.radians(9), "zeta": 0.0016, "chi_n": 0.0026}
    ours = tripod({"excitation_frequency": list(frequencies)}, (*OUTPUTS[:4], "period_multiple"), fixed)
    np.testing.assert_allclose(ours.lyapunov_spectrum.values[0], expected, rtol=0, atol=digits)
    assert (ours.lyapunov_standard_error < 1e-9).all() and not ours.outcome.any()
    assert (ours.verdict == Verdict.PERIODIC).all()
    assert ours.period_multiple.values.tolist() == list(periods)


def by_the_paper(element: str, zeta: float, strobes: int) -> np.ndarray:
    frequency, chi_n = (3066.5, 0.0026) if element == "input" else (2792.0, 0.0027)
    shaft = dt.Tripod(element=element, beta=math.radians(9), zeta=zeta, chi_n=chi_n, excitation_frequency=frequency)
    options = {"max_time": (strobes - 0.5) / frequency, "steps": 24}
    return np.asarray(dt.lyapunov(shaft, outputs=["paper_estimator"], **options).paper_estimator)


class TestPaperEstimator:
    """The paper's estimator equals independent computations of (31)-(36), and is wrong for systems with known exponents."""

    @pytest.mark.full
    @pytest.mark.parametrize(
        ("strobes", "expected"), [(307, (-22587.20, -10361.95, -1311.025)), (154, (-21779.65, -10317.94, -1293.414))]
    )
    def test_its_own_criterion_fails_at_fig_17(self, strobes, expected):
        """Reference: RK4 by an independent author. The largest of all three is negative, so that criterion (37) fails."""
        np.testing.assert_allclose(by_the_paper("input", 0.0016, strobes), expected, rtol=0, atol=5.1e-3)

    @pytest.mark.full
    @pytest.mark.parametrize("element", ["input", "output"])
    def test_it_is_the_rule_by_scipy(self, element):
        equation, frequency, chi_n = ("29", 3066.5, 0.0026) if element == "input" else ("30", 2792.0, 0.0027)
        expected = oracle.paper_estimator(equation, 0.0064, chi_n, frequency, 12)
        np.testing.assert_allclose(by_the_paper(element, 0.0064, 12), expected, rtol=1e-7)

    @pytest.mark.parametrize("interval", [1.0, 0.1])
    def test_it_is_positive_for_a_damped_linear_oscillator(self, interval):
        """The distance is proportional to the motion; the true exponents are -0.1 for any interval."""
        flow = replace(flows.linear([0.2], [1.0], torque=0.0), period=interval)
        ours = results(flow, ("paper_estimator",), 100.0, 12)["paper_estimator"]
        rate, times = math.sqrt(1 - 0.1**2), np.arange(1, round(100 / interval) + 1) * interval
        (x0, v0), cosine, sine = flow.start, np.cos(rate * times), np.sin(rate * times)
        turned = [x0 * cosine + (v0 + 0.1 * x0) / rate * sine, v0 * cosine - (x0 + 0.1 * v0) / rate * sine]
        motion = np.exp(-0.1 * times) * np.stack(turned)
        expected = np.sum(np.log10(abs(motion) / np.linalg.norm(motion[:, -1])), axis=1) / times[-1]
        np.testing.assert_allclose(ours[:, 0], expected, rtol=1e-6)
        assert (expected * interval > 1).all()

    @pytest.mark.full
    def test_it_is_negative_for_a_chaotic_system(self):
        """Means of the first two over 16 starts, -17 and -15 with strobes every 0.05; single starts scatter by 4."""
        flow = flows.lorenz(16)
        short, long = (
            results(replace(flow, period=interval), ("paper_estimator",), 200.0, 12)["paper_estimator"].mean(axis=-1)
            for interval in (0.05, 0.5)
        )
        assert (short[:2] < -10).all()
        assert (abs(short - long)[:2] > 5).all()


@pytest.fixture(scope="module")
def controls():
    """Results of (29) without torque, for chi_n around the parametric threshold."""
    points = {"chi_n": [0.01, 0.025, 0.05]}
    fixed = {"element": "input", "beta": math.radians(9), "zeta": 0.0016, "excitation_frequency": 3066.5, "M_AEM": 0.0}
    scene = {"system": "tripod", "analysis": "lyapunov", "outputs": OUTPUTS[:4], "points": points, "fixed": fixed}
    return dt.run(scene | {"options": {"max_time": 1.0, "steps": 12}})


@pytest.mark.full
def test_runs_that_never_end_are_not_begun():
    fixed = {"element": "input", "beta": 0.1, "zeta": 0.0016}
    scene = {
        "system": "tripod",
        "analysis": "lyapunov",
        "points": {"excitation_frequency": [1e300, 3e3]},
        "fixed": fixed,
    }
    with pytest.raises(
        dt.InputError, match=r"^options\.max_time = 1e\+300: expected 0 < max_time <= 1000000000, in s$"
    ):
        dt.run(scene | {"options": {"max_time": 1e300}})
    ours = dt.run(scene | {"options": {"max_time": 0.01}, "outputs": ["lyapunov_spectrum"]})
    assert ours.outcome.values.tolist() == [Outcome.STEP_LIMIT, Outcome.SUCCESS]
    assert np.isnan(ours.lyapunov_spectrum[0]).all() and np.isfinite(ours.lyapunov_spectrum[1]).all()


@pytest.mark.full
def test_parametric_threshold_is_bracketed(controls):
    """The exponents are those of Floquet theory, by SciPy at 1e-12."""
    np.testing.assert_allclose(
        controls.lyapunov_spectrum.values[:, 0], [-6.54835511, 6.73022516, 28.72424293], rtol=2e-4
    )
    kinds = [Verdict.FIXED_POINT, Verdict.PARAMETRICALLY_UNSTABLE, Verdict.PARAMETRICALLY_UNSTABLE]
    assert controls.verdict.values.tolist() == kinds


@pytest.mark.full
def test_sum_rule_of_the_tripod(controls):
    assert np.abs(controls.sum_rule_residual).max() < 1e-7


# Excitation frequency [Hz], chi_AEM, order of the motor's torque (50 Hz each), M_AEM, phi0; verdict and period in strobes.
_M = 2550.0
FORCED = (
    (3000.0, 0.1, 6.0, _M, 0.0, Verdict.PERIODIC, 10),
    (3066.5, 0.1, 6.133, _M, 0.0, Verdict.PERIODIC, 10),  # its computed exponents are too low by 2 in 15
    (3000.03, 0.1, 6.0, _M, 0.0, Verdict.QUASI_PERIODIC, 0),  # repeats after 100001, nearly after 10
    (2718.281828, 1e-5, 6.0, _M, 0.0, Verdict.QUASI_PERIODIC, 0),  # a torus thinner than the transient
    (2718.281828, 0.0, 6.0, _M, 0.0, Verdict.FIXED_POINT, 1),
    (3000.0, 0.1, 6.0, 0.0, 1e-3, Verdict.FIXED_POINT, 1),  # two negative exponents: it decays to rest
)


@pytest.mark.full
def test_a_slow_drift_along_a_torus_is_no_period():
    """The frequencies determine if the strobes repeat; neither a slow drift nor a transient may count as a period."""
    names = ("excitation_frequency", "chi_AEM", "motor_order", "M_AEM", "phi0")
    points = dict(zip(names, map(list, zip(*(case[:5] for case in FORCED), strict=True)), strict=True))
    fixed = {"element": "input", "beta": math.radians(9), "zeta": 0.0016}
    scene = {"system": "tripod", "analysis": "lyapunov", "outputs": [*OUTPUTS[3:], "period_multiple"], "fixed": fixed}
    ours = dt.run(scene | {"points": points, "options": {"max_time": 0.6, "steps": 12}})
    assert ours.verdict.values.tolist() == [case[5] for case in FORCED]
    assert ours.period_multiple.values.tolist() == [case[6] for case in FORCED]
    # K is 0 only for motions that repeat.
    assert ((ours.chaos_k01 == 0) == (ours.period_multiple > 0)).all()


@pytest.mark.full
def test_bounded_chaos_of_the_tripod():
    """An unphysical control of the theory note: L1 = 1218 +- 12 by an independent computation, K = 0.997."""
    omega = 9633.726700903984
    fixed = {"element": "input", "beta": math.radians(9), "zeta": 0.03, "chi_n": 0.3, "M_AEM": 8.4e4 * 2550.0}
    fixed |= {"chi_AEM": 0.5, "excitation_frequency": omega / math.pi, "motor_order": 0.618 * omega / (100 * math.pi)}
    scene = {"system": "tripod", "analysis": "lyapunov", "outputs": list(OUTPUTS), "fixed": fixed}
    ours = dt.run(scene | {"options": {"max_time": 0.3, "steps": 64}})
    spectrum, error = ours.lyapunov_spectrum.values, ours.lyapunov_standard_error.values
    assert abs(spectrum[0] - 1218) < 3 * math.hypot(error[0], 12)
    assert spectrum.sum() == pytest.approx(-558.382, abs=1.0)
    assert int(ours.verdict) == Verdict.CHAOTIC


# Motions whose kind is known: the flow, the time of the run, the verdict and the period in strobes.
_GOLDEN = (math.sqrt(5) - 1) / 2
KNOWN = {
    "decay to rest": (lambda: flows.damped(), 40.0, Verdict.FIXED_POINT, 1),
    "slow decay to rest": (lambda: flows.damped(damping=0.02), 600.0, Verdict.FIXED_POINT, 1),
    "overdamped decay": (lambda: flows.damped(damping=9.0), 40.0, Verdict.FIXED_POINT, 1),
    "decay with modulated stiffness": (lambda: flows.mathieu(0.1), 200.0, Verdict.FIXED_POINT, 1),
    "parametric instability": (lambda: flows.mathieu(0.3), 200.0, Verdict.PARAMETRICALLY_UNSTABLE, None),
    "rest under a load": (lambda: flows.damped(lambda a: 0.7), 300.0, Verdict.FIXED_POINT, 1),
    "response of the strobe's period": (lambda: flows.damped(lambda a: jnp.cos(a[0])), 300.0, Verdict.FIXED_POINT, 1),
    "small response": (lambda: flows.damped(lambda a: 1e-6 * jnp.cos(a[0])), 400.0, Verdict.FIXED_POINT, 1),
    "response of three periods": (
        lambda: flows.damped(lambda a: jnp.cos(a[1]), turns=(1, 1 / 3)), 300.0, Verdict.PERIODIC, 3,
    ),
    "response of two incommensurate periods": (
        lambda: flows.damped(lambda a: jnp.cos(a[0]) + jnp.cos(a[1]), turns=(1, _GOLDEN)), 300.0, Verdict.QUASI_PERIODIC, 0,
    ),
    "small response of two incommensurate periods": (
        lambda: flows.damped(lambda a: 1e-6 * jnp.cos(a[1]), turns=(1, _GOLDEN)), 400.0, Verdict.QUASI_PERIODIC, 0,
    ),
    "unforced decay": (lambda: flows.damped(turns=()), 300.0, Verdict.FIXED_POINT, None),
    "unforced growth": (lambda: flows.damped(turns=(), damping=-0.1), 300.0, Verdict.PARAMETRICALLY_UNSTABLE, None),
    "centre": (lambda: flows.damped(turns=(), damping=0.0), 300.0, Verdict.UNDECIDED, None),
    "limit cycle": (lambda: flows.stuart_landau(1.0), 100.0, Verdict.PERIODIC, None),
    "torus": (lambda: flows.stuart_landau(1.0, _GOLDEN), 300.0, Verdict.QUASI_PERIODIC, None),
    "forced torus": (lambda: flows.forced_cycle(1.0, 0.3), 300.0, Verdict.QUASI_PERIODIC, 0),
    "locked cycle": (lambda: flows.forced_cycle(3.6, 0.5), 300.0, Verdict.FIXED_POINT, 1),
    "cycle locked to every second period": (lambda: flows.forced_cycle(1.9, 0.5, 0.5), 300.0, Verdict.PERIODIC, 2),
    "chaos": (lambda: flows.lorenz(1), 128.0, Verdict.CHAOTIC, None),
    "decay slower than exponential": (lambda: flows.algebraic(), 300.0, Verdict.UNDECIDED, None),
}  # fmt: skip
_SHORT = ("chaos",)


@pytest.mark.parametrize("name", but_full(KNOWN, *(KNOWN.keys() - set(_SHORT))))
def test_the_kind_of_a_known_motion(name, monkeypatch):
    build, max_time, verdict, multiple = KNOWN[name]
    if name == "chaos":
        sampled_shortly(monkeypatch, 256)
    ours = results(build(), ("verdict", "period_multiple"), max_time, 24)
    assert ours["verdict"].tolist() == [verdict]
    assert multiple is None or ours["period_multiple"].tolist() == [multiple]


@pytest.mark.full
def test_a_tripod_shaft_without_torque_comes_to_rest():
    ours = tripod(
        {"zeta": [1.6e-3, 1e-6]}, fixed={"M_AEM": 0.0, "beta": 0.3, "phi0": 0.5, "velocity0": 1.0}, max_time=10.0
    )
    assert ours.verdict.values.tolist() == [Verdict.FIXED_POINT, Verdict.PARAMETRICALLY_UNSTABLE]
    assert (ours.lyapunov_standard_error < 1e-5).all()


@pytest.mark.full
def test_small_multipliers_of_an_orbit_with_a_long_period():
    """Over 6,133 strobes tangent vectors shrink to exp(-740): of one parametric equation, by SciPy over one strobe."""
    damping = [0.04, 0.08]
    points = {"zeta": damping, "chi_n": [0.02] * 2, "M_AEM": [2550.0] * 2, "excitation_frequency": [3066.5] * 2}
    outputs = ["lyapunov_spectrum", "lyapunov_standard_error"]
    found = dt.run({"system": "tripod", "analysis": "lyapunov", "points": points, "outputs": outputs,
                    "fixed": {"element": "input", "beta": 0.157, "phi0": 0.0}, "options": {"max_time": 0.4}})  # fmt: skip
    np.testing.assert_allclose(found.lyapunov_spectrum[:, 0], [-369.91787, -770.60015], rtol=1e-6)
    assert (found.lyapunov_standard_error[:, 0] < 1e-9).all()
