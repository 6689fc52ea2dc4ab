"""Design questions: answers against direct solves and by hand."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drivetrain_jax import InputError
from drivetrain_jax.atlas import design
from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.design import least_damping, nearest_boundaries, speed_windows, widest_angle
from drivetrain_jax.atlas.panels import Gap
from drivetrain_jax.atlas.windows import Crossing, Interval, Line, _line, narrow, stability_along
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, monodromy, propagators


def direct(columns):
    z = monodromy(propagators(columns, 1e-12))
    return np.abs(np.linalg.eigvals(z)).max(axis=1)


@pytest.fixture(scope="module")
def atlas():
    return cardan_atlas({"beta": (0.0, 1.1), "Omega": (0.3, 2.0)}, 1e-11).atlas


@pytest.fixture(scope="module")
def damped():
    """Speed and damping at beta = 1."""
    fixed = {**BASE, "beta": 1.0}
    return cardan_atlas({"Omega": (0.6, 2.0), "zeta": (0.0, 0.1)}, 1e-11, fixed).atlas


def test_widest_angle_is_that_of_the_lowest_tip(atlas):
    answer = widest_angle(atlas, CARDAN, (1.3, 1.5), {}, direct=direct)
    assert answer.value == pytest.approx(0.1063331213, abs=1e-8)
    assert answer.limit.multiplier == "-1" and answer.limit.point["Omega"] == pytest.approx(1.4159881603, abs=1e-8)
    assert answer.certain and answer.check.agrees and answer.error < 1e-7


def test_widest_angle_at_the_end_of_the_range(atlas):
    """Between tongues the smallest unstable angle is at an end of the range of speeds."""
    answer = widest_angle(atlas, CARDAN, (0.8, 1.3), {}, direct=direct)
    assert answer.limit.point["Omega"] == 1.3 and answer.check.agrees
    beta = np.linspace(0.0, 1.1, 2001)
    unstable = direct({**{k: np.full(2001, v) for k, v in BASE.items()}, "beta": beta, "Omega": np.full(2001, 1.3)}) > 1
    first = beta[np.argmax(unstable)]
    assert first - 1.1 / 2000 <= answer.value <= first


def test_least_damping(damped):
    answer = least_damping(damped, CARDAN, (0.7, 0.8), {}, direct=direct)
    assert answer.certain and answer.check.agrees
    assert [i.stable for i in answer.intervals] == [False, True]
    omega = np.linspace(0.7, 0.8, 2001)

    def largest(zeta):
        fixed = {k: np.full(2001, v) for k, v in {**BASE, "beta": 1.0, "zeta": zeta}.items()}
        return direct({**fixed, "Omega": omega}).max()

    assert largest(answer.value * (1 - 1e-3)) > 1 > largest(answer.value * (1 + 1e-3))


def test_least_damping_is_0_without_a_tongue(damped):
    answer = least_damping(damped, CARDAN, (0.9, 1.1), {}, direct=direct)
    assert answer.value == 0.0 and answer.limit is None and answer.check.agrees


def test_no_least_damping_if_the_largest_is_unstable(damped):
    answer = least_damping(narrow(damped, {"zeta": (0.0, 0.01)}), CARDAN, (1.3, 1.6), {}, direct=direct)
    assert answer.value is None and answer.check is None and answer.certain


def test_an_undecided_safe_end_gives_an_uncertain_answer():
    """With very little damping stability ends near beta = 0, within the errors, although small angles are stable."""
    fixed = {**BASE, "zeta": 1e-7, "gamma": 1.0}
    faint = cardan_atlas({"beta": (0.0, 1.5), "Omega": (0.3, 2.0)}, 1e-11, fixed).atlas
    answer = widest_angle(faint, CARDAN, (1.0, 2.0), {}, direct=direct)
    omega = np.linspace(1.0, 2.0, 2001)
    columns = {k: np.full(2001, v) for k, v in {**fixed, "beta": 0.0012}.items()}
    assert (direct({**columns, "Omega": omega}) < 1).all()
    assert answer.value is None and not answer.certain
    (first, *_), low = answer.undecided, answer.intervals[0]
    assert first[0] == 0.0 and first[1] > 0.0012 and low.lower >= first[1] and not low.stable


def test_a_part_narrower_than_its_errors_is_not_tested(undamped):
    """At beta = 0 no multiplier is unstable; the atlas is undecided where two double roots meet."""
    line = stability_along(undamped.atlas.slice({"beta": 0.0}), CARDAN)
    assert [(i.lower, i.upper, i.stable) for i in line.intervals] == [(0.3, 2.0, True)]
    assert line.undecided and max(b - a for a, b in line.undecided) < 1e-5
    assert all(a[1] < b[0] for a, b in itertools.pairwise(line.undecided))


def candidates(*values, error=1e-10):
    return [Crossing(v, error, "-1", {"beta": v}) for v in values]


@pytest.mark.parametrize(
    ("changes", "undecided", "expected"),
    [
        # Two candidates for one edge: one change at either of them.
        (candidates(0.4, 0.4 + 1e-10), [], [(0.0, 0.4, True), (0.4, 1.0, False)]),
        # The whole range between two candidates is undecided: the change may be at either of them.
        (candidates(0.3, 0.5), [(0.29, 0.51)], [(0.0, 0.29, True), (0.51, 1.0, False)]),
        # The whole range below the candidate, above it, or on both sides is undecided.
        (candidates(0.4), [(0.0, 0.4)], [(0.4, 1.0, False)]),
        (candidates(0.4), [(0.4, 1.0)], [(0.0, 0.4, True)]),
        (candidates(0.4), [(0.0, 1.0)], []),
    ],
)
def test_intervals_between_candidates(changes, undecided, expected):
    """The line is stable below 0.4."""
    line = _line("beta", (0.0, 1.0), changes, undecided, lambda values: values < 0.4)
    assert [(i.lower, i.upper, i.stable) for i in line.intervals] == [
        (pytest.approx(a), pytest.approx(b), stable) for a, b, stable in expected
    ]
    for crossing in line.crossings:
        assert all(abs(c.value - crossing.value) + c.error <= crossing.error for c in changes)


@pytest.mark.parametrize(
    ("undecided", "suspects", "value", "error"),
    [
        # The candidate is at an end of the undecided range: the change may be anywhere in this range.
        ((0.3995, 0.4), [], 0.4, 5e-4),
        ((0.4, 0.4004), [], 0.4, 4e-4),
        # A likely tip is nearer to the stable part.
        ((0.3995, 0.4), [0.3998], 0.3998, 3e-4),
        ((0.3995, 0.4), [0.3, 0.5], 0.4, 5e-4),
        # Too wide a range for an error: it has no crossing.
        ((0.39, 0.4), [0.395], None, None),
    ],
)
def test_error_of_a_change_covers_undecided_ranges(undecided, suspects, value, error):
    given = candidates(0.4), [undecided], lambda values: values < 0.4
    line = _line("beta", (0.0, 1.0), *given, candidates(*suspects, error=0.0))
    below, above = line.intervals
    assert below.stable and not above.stable
    if value is None:
        assert (below.upper, above.lower) == undecided and not line.crossings
    else:
        (crossing,) = line.crossings
        assert (crossing.value, crossing.error) == (value, pytest.approx(error))


# Tips of atlases at rtol 1e-11, accurate to some 1e-11.
H21, S21 = (0.5366555069660, 0.70865547138956), (0.1063331213411, 1.41598816034540)


@pytest.mark.parametrize(
    ("tip", "half", "error"), [(S21, 3e-7, 2e-9), (S21, 3e-6, 1e-7), (H21, 1e-6, 1e-7), (H21, 1e-3, 1e-9)]
)
def test_the_widest_angle_between_the_flanks_of_a_tongue(atlas, tip, half, error):
    """At the ends of so narrow a range of speeds the tongue is no wider than the undecided range at its tip."""
    answer = widest_angle(atlas, CARDAN, (tip[1] - half, tip[1] + half), {}, direct=direct)
    assert abs(answer.value - tip[0]) < 1e-10
    assert 1e-12 < answer.error < error
    assert answer.certain and answer.check.agrees
    assert answer.limit.point["Omega"] == pytest.approx(tip[1], abs=1e-10)


@pytest.mark.parametrize(("beyond", "agrees"), [(0.0, True), (5e-9, False)])
def test_a_check_refutes_an_error_that_is_too_small(atlas, monkeypatch, beyond, agrees):
    value = S21[0] + beyond
    limit = Crossing(value, 1e-9, "-1", {"beta": value, "Omega": S21[1]})
    intervals = (Interval(0.0, value, True, None, limit), Interval(value, 1.1, False, limit, None))
    monkeypatch.setattr(design, "stability_over_range", lambda *_: Line("beta", intervals, ()))
    assert widest_angle(atlas, CARDAN, (1.3, 1.5), {}, direct=direct).check.agrees == agrees


@pytest.mark.full
def test_a_check_follows_the_ridge_of_a_narrow_tongue():
    """With very little damping the error covers an undecided range; at its end the tongue is not at the speed of its tip."""
    fixed = {"zeta": 1.0165e-5, "alpha": 0.13975, "mu": 1.0822, "gamma": 1.09888}
    slender = cardan_atlas({"beta": (0.0, 0.8), "Omega": (0.39, 0.43)}, 1e-10, fixed).atlas
    answer = widest_angle(slender, CARDAN, (0.4, 0.42), {}, direct=direct)
    limit = answer.limit
    assert answer.certain and limit.error > 1e-6 and limit.multiplier == "+1"
    beyond = {"beta": limit.value + limit.error, "Omega": limit.point["Omega"]}
    assert direct({k: np.array([v]) for k, v in {**fixed, **beyond}.items()}) < 1
    assert answer.check.agrees and answer.check.beyond > 1 + 1e-9


@pytest.mark.full
@pytest.mark.parametrize(
    ("ask", "ranges", "fixed", "speeds", "ends", "safe_end"),
    [
        (
            least_damping,
            {"Omega": (1.3, 1.5), "zeta": (0.1, 20.0)},
            {"beta": 1.0, "alpha": 0.2, "mu": 2.0, "gamma": 2.0},
            (1.317, 1.457),
            (0.219182068, 12.482503512),
            20.0,
        ),
        (
            widest_angle,
            {"beta": (0.9, 1.45), "Omega": (0.5, 0.6)},
            {"zeta": 0.01, "gamma": 1.0},
            (0.5504, 0.5506),
            (1.144318298, 1.357177456),
            0.9,
        ),
    ],
)
def test_stable_interval_away_from_an_unstable_safe_end(ask, ranges, fixed, speeds, ends, safe_end):
    answer = ask(cardan_atlas(ranges, 1e-9, {**BASE, **fixed}).atlas, CARDAN, speeds, {}, direct=direct)
    assert answer.value is None and np.isnan(answer.error) and answer.certain and answer.safe_end == safe_end
    (interval,) = answer.stable
    assert (interval.lower, interval.upper) == pytest.approx(ends, abs=1e-8)
    # The bound follows from an estimate, which rounding changes: 1.24e-8 on a processor with AVX2.
    assert max(c.error for c in interval.crossings) < 2e-8
    omega, (low, high) = np.linspace(*speeds, 201), ends

    def largest(value):
        columns = {k: np.full(201, v) for k, v in {**BASE, **fixed, answer.parameter: value}.items()}
        return direct({**columns, "Omega": omega}).max()

    inside, outside = (low * 1.0001, (low + high) / 2, high * 0.9999), (low * 0.9999, high * 1.0001, safe_end)
    assert max(map(largest, inside)) < 1 < min(map(largest, outside))
    # For each end: 101 speeds, the speed of the crossing and the worst one inside, and the last two also beyond.
    assert answer.check.agrees and answer.check.solves == 2 * (103 + 2)
    assert answer.check.inside < 1 < answer.check.beyond


@pytest.mark.parametrize(
    ("ask", "at", "left", "wanted"),
    [
        (partial(least_damping, speeds=(1.3, 1.5)), {}, "beta and Omega", "Omega and zeta"),
        (partial(widest_angle, speeds=(1.3, 1.5)), {"beta": 1.0}, "Omega", "Omega and beta"),
        (speed_windows, {}, "beta and Omega", "Omega"),
    ],
)
def test_an_atlas_over_other_parameters_is_refused(atlas, ask, at, left, wanted):
    with pytest.raises(InputError) as error:
        ask(atlas, CARDAN, at=at)
    assert str(error.value) == f"at = {at}: leaves an atlas over {left}; expected values that leave {wanted}"


def test_speed_windows_with_a_margin(atlas):
    windows = speed_windows(atlas, CARDAN, {"beta": 1.0}, margin=0.01, direct=direct).windows
    assert len(windows) > 1 and all(w.check.agrees for w in windows)
    for window in windows:
        assert window.interval.lower <= window.safe[0] < window.safe[1] <= window.interval.upper
        if window.interval.lower_end:
            assert window.safe[0] == pytest.approx(1.01 * window.interval.lower, rel=1e-6)
        if window.interval.upper_end:
            assert window.safe[1] == pytest.approx(0.99 * window.interval.upper, rel=1e-6)
        assert window.largest < 1
    # Narrow windows vanish with a wide margin.
    assert len(speed_windows(atlas, CARDAN, {"beta": 1.0}, margin=0.1).windows) < len(windows)


def test_a_margin_counts_from_boundaries_beyond_the_range(atlas):
    whole = speed_windows(atlas, CARDAN, {"beta": 1.0})
    low, high = max((w.safe for w in whole.windows[1:]), key=lambda ends: ends[1] / ends[0])
    asked = {"margin": 0.05, "within": (1.01 * low, high)}
    (window,) = speed_windows(atlas, CARDAN, {"beta": 1.0}, **asked).windows
    assert window.safe == pytest.approx((1.05 * low, 0.95 * high), rel=1e-6)
    near = speed_windows(atlas, CARDAN, {"beta": 1.0}, margin=0.05, within=(1.01 * low, 1.02 * low))
    assert near.windows == near.unstable == near.undecided == ()
    inside = speed_windows(atlas, CARDAN, {"beta": 1.0}, within=(0.9 * low, 1.02 * low))
    assert inside.windows[-1].safe[1] == pytest.approx(1.02 * low) and inside.windows[-1].interval.upper_end is None
    assert all(0.9 * low <= i.lower < i.upper <= low for i in inside.unstable)


def test_an_undecided_range_is_no_safe_speed(atlas):
    """A gap is in the middle of the stable speeds from .772 to 1.247, where an interval is usually tested."""
    below, above = narrow(atlas, {"Omega": (0.3, 0.95)}), narrow(atlas, {"Omega": (1.1, 2.0)})
    corners = np.sort(atlas.to_coordinates(np.array([[0.0, 0.95], [1.1, 1.1]])), axis=0)
    cut = replace(atlas, panels=(*below.panels, *above.panels), gaps=(Gap(*corners, "cut out"),))
    found, whole = (speed_windows(a, CARDAN, {"beta": 1.0}, margin=0.01) for a in (cut, atlas))
    assert found.undecided == (pytest.approx((0.95, 1.1)),) and not whole.undecided
    (around,) = (w.safe for w in whole.windows if w.safe[0] < 1.0 < w.safe[1])
    left, right = (w for w in found.windows if around[0] < sum(w.safe) / 2 < around[1])
    assert left.safe == pytest.approx((around[0], 0.95 * 0.99)) and left.interval.upper_end is None
    assert right.safe == pytest.approx((1.1 * 1.01, around[1])) and right.interval.lower_end is None
    assert len(found.windows) == len(whole.windows) + 1 and all(w.largest < 1 for w in found.windows)


def test_windows_cover_the_stable_speeds(atlas):
    line = stability_along(atlas.slice({"beta": 1.0}), CARDAN)
    omega = np.linspace(0.3, 2.0, 1201)
    rho = direct({**{k: np.full(1201, v) for k, v in BASE.items()}, "beta": np.full(1201, 1.0), "Omega": omega})
    ends = np.array([i.upper for i in line.intervals])
    expected = np.array([i.stable for i in line.intervals])[np.searchsorted(ends[:-1], omega)]
    assert (expected == (rho < 1)).all()


def test_nearest_boundaries(atlas):
    found = {n.parameter: n for n in nearest_boundaries(atlas, CARDAN, {"beta": 1.0, "Omega": 0.8})}
    omega = found["Omega"]
    assert omega.below.multiplier == "pair" and omega.below.value == pytest.approx(0.7719697, abs=1e-6)
    assert omega.above.multiplier == "-1" and omega.above.value == pytest.approx(1.2474955, abs=1e-6)
    assert found["beta"].below is None and found["beta"].above is None
    for crossing in (omega.below, omega.above):
        near = crossing.value + np.array([-1e-4, 1e-4])
        rho = direct({**{k: np.full(2, v) for k, v in BASE.items()}, "beta": np.full(2, 1.0), "Omega": near})
        assert (rho[0] - 1) * (rho[1] - 1) < 0


def test_narrow_keeps_the_function(atlas):
    part = narrow(atlas, {"beta": (0.3, 0.9), "Omega": (0.5, 0.6)})
    points = np.array([[0.3, 0.5], [0.61, 0.57], [0.9, 0.6]])
    values = [Criteria.of(a, CARDAN).propagator(a.to_coordinates(points)) for a in (atlas, part)]
    assert np.abs(values[0] - values[1]).max() < 1e-13 * np.abs(values[0]).max()
    with pytest.raises(ValueError, match=r"beta = 0\.3 to 1\.3: expected a range within 0 to 1\.1"):
        narrow(atlas, {"beta": (0.3, 1.3)})
    with pytest.raises(KeyError, match="mu"):
        narrow(atlas, {"mu": (0.3, 1.3)})


@pytest.mark.parametrize(
    ("undecided", "certain"), [((0.5, 0.6), True), ((0.05, 0.06), False), ((0.0999, 0.1), True), ((0.0995, 0.1), False)]
)
def test_undecided_ranges_on_the_safe_side_make_an_answer_uncertain(atlas, monkeypatch, undecided, certain):
    limit = Crossing(0.1, 1e-4, "-1", {"beta": 0.1, "Omega": 1.4})
    intervals = (Interval(0.0, 0.1, True, None, limit), Interval(0.1, 1.1, False, limit, None))
    monkeypatch.setattr(design, "stability_over_range", lambda *_: Line("beta", intervals, (undecided,)))
    answer = widest_angle(atlas, CARDAN, (1.3, 1.5), {})
    assert answer.value == 0.1 and answer.certain == certain
