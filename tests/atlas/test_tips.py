"""Tips of tongues: exclusion, polish and names, compared with independent root finding on direct solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.atlas import tips as naming
from drivetrain_jax.atlas.boundaries import boundaries
from drivetrain_jax.atlas.criteria import Criteria, growth, invariants
from drivetrain_jax.atlas.exclusion import critical_points
from drivetrain_jax.atlas.patches import on_line, patches_of, roots
from drivetrain_jax.atlas.tips import find_tips
from drivetrain_jax.resonances import natural_frequencies
from drivetrain_jax.runs.atlas_answers import radius_gradient
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, monodromy, propagators
from tests.oracles.cardan_reference import monodromy as reference_monodromy

# beta and Omega of the tips by root finding on direct solves (`direct_tip` below, at rtol 1e-14). For C-1, where two
# multipliers nearly coincide, the values have 30 digits (tests.oracles.cardan_precise_reference).
TIPS = {
    "S11": (0.0237682936, 0.0706222355),
    "S21": (0.1063331213, 1.4159881603),
    "C+2": (0.3732837620, 0.3717671198),
    "H21": (0.5366555070, 0.7086554714),
    "C+1": (0.6055301525, 0.7447624308),
    "C+3": (0.7984822953, 0.2497460274),
    "C+4": (0.8983636305, 0.1884010878),
    "H22": (0.9955772900, 0.3607839606),
    "S22": (1.0051840092, 0.4810633702),
    "C-1": (1.1217996954, 0.6699469751),
    "C+5": (1.1344698234, 0.1550015530),
    "C+6": (1.1691118751, 0.1301021787),
}
KINDS = {"S": "-1", "H": "+1", "C": "pair"}


@pytest.fixture(scope="module")
def atlas():
    """The rectangle of the twelve tips."""
    return cardan_atlas({"beta": (0.0, 1.2), "Omega": (0.06, 2.0)}, 1e-11).atlas


@pytest.fixture(scope="module")
def tips(atlas):
    return find_tips(atlas, CARDAN)


@pytest.fixture(scope="module")
def curves(atlas):
    return boundaries(atlas, CARDAN)


def rate(beta, omega, **others):
    """ln of the spectral radius by direct solves."""
    z = monodromy(propagators({**BASE, **others, "beta": beta, "Omega": omega}, 1e-14))
    return np.log(np.abs(np.linalg.eigvals(z)).max(axis=1))


def direct_tip(beta, omega, shift=1e-5, narrowed=4, **others):
    """The tip near (beta, omega), where the largest rate over Omega is 0, by parabolas through direct solves."""
    start, beta = beta, beta * (1 + shift)

    def peak(beta, omega):
        width = 2e-5 * omega
        for _ in range(narrowed):
            x = omega + width * np.linspace(-1, 1, 9)
            omega, width = x[np.argmax(rate(beta, x, **others))], width / 4
        x = np.linspace(-2, 2, 9)
        fit = np.polyfit(x, rate(beta, omega + width * x, **others), 4)
        stationary = np.roots(np.polyder(fit))
        top = stationary[np.argmin(np.abs(stationary))].real
        return omega + width * top, np.polyval(fit, top)

    before = start * (1 - shift)
    omega, y0 = peak(before, omega)
    for _ in range(4):
        omega, y1 = peak(beta, omega)
        before, beta, y0 = beta, beta - y1 * (beta - before) / (y1 - y0), y1
        if abs(beta - before) < 1e-12:
            break
    return beta, omega


@pytest.mark.full
def test_all_twelve_tips_and_no_other(tips):
    assert tips.undecided == ()
    assert [tip.name for tip in tips.tips] == list(TIPS)
    for tip in tips.tips:
        beta, omega = TIPS[tip.name]
        assert tip.point["beta"] == pytest.approx(beta, abs=1e-8)
        assert tip.point["Omega"] == pytest.approx(omega, abs=1e-8)
        assert tip.multiplier == KINDS[tip.name[0]] and tip.opens


def test_errors_of_tips_lie_within_their_bounds(tips):
    for tip in tips.tips:
        beta, omega = TIPS[tip.name]
        # The references have ten digits.
        assert abs(tip.point["beta"] - beta) <= tip.error["beta"] + 1e-10
        assert tip.error["beta"] < 1e-5
        assert abs(tip.point["Omega"] - omega) <= tip.error["Omega"] + 1e-10


@pytest.mark.full
@pytest.mark.parametrize("name", ["H22", "C+2"])
def test_tips_against_root_finding_on_direct_solves(tips, name):
    tip = next(tip for tip in tips.tips if tip.name == name)
    beta, omega = direct_tip(tip.point["beta"], tip.point["Omega"])
    assert tip.point["beta"] == pytest.approx(beta, abs=1e-9)
    assert tip.point["Omega"] == pytest.approx(omega, abs=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("name", list(TIPS))
def test_reference_tips(name):
    # Near a double multiplier rates have errors of some 1e-8, so the parabola must be wider than for narrow tongues.
    beta, omega = direct_tip(TIPS[name][0], TIPS[name][1], narrowed=1 if name == "C-1" else 4)
    assert TIPS[name] == (pytest.approx(beta, abs=2e-10), pytest.approx(omega, abs=1e-8))


def test_boundary_functions_are_products_of_multipliers(atlas):
    criteria = Criteria.of(atlas, CARDAN)
    points = atlas.lower + (atlas.upper - atlas.lower) * np.random.default_rng(1).random((200, 2))
    x = atlas.to_coordinates(points)
    plus, minus, pair = criteria.derive(criteria.propagator(x), criteria.log_determinant(x))
    sigma = criteria.eigenvalues(x)
    product = np.prod([1 - sigma[:, i] * sigma[:, j] for i in range(4) for j in range(i)], axis=0).real
    d = np.exp(criteria.log_determinant(x))
    assert np.abs(plus - np.prod(1 - sigma, axis=1).real).max() < 1e-12
    assert np.abs(minus - np.prod(1 + sigma, axis=1).real).max() < 1e-12
    assert np.abs(pair - product / (1 - d) ** 2).max() < 1e-9
    stable = np.abs(sigma).max(axis=1) < 1
    assert 20 < stable.sum() < 180
    assert (stable == ((plus > 0) & (minus > 0) & (pair > 0))).all()


def test_multipliers_are_those_of_the_paper_equations(atlas):
    z = reference_monodromy({**BASE, "beta": 0.9, "Omega": 0.71}, rtol=1e-12, atol=1e-12)
    x = atlas.to_coordinates(np.array([[0.9, 0.71]]))
    criteria = Criteria.of(atlas, CARDAN)
    expected = np.poly(np.linalg.eigvals(z)).real
    found = np.poly(criteria.eigenvalues(x)[0]).real
    assert found == pytest.approx(expected, abs=1e-9)
    rows = monodromy(criteria.propagator(x).T)
    a, b, c = invariants(np.moveaxis(rows, 0, -1))
    assert [-a[0], b[0], -c[0]] == pytest.approx(list(expected[1:4]), abs=1e-9)


def test_derivatives_of_the_growth_rate(atlas):
    criteria = Criteria.of(atlas, CARDAN)
    x = atlas.to_coordinates(np.array([[0.7, 0.72], [1.1, 0.3], [0.4, 1.42]]))
    kinds = ["largest"] * 3
    exact, h = growth(criteria, x, kinds, second=True), 1e-5
    for axis in range(2):
        step = h * np.eye(2)[axis]
        above, below = growth(criteria, x + step, kinds), growth(criteria, x - step, kinds)
        assert (above.rate - below.rate) / (2 * h) == pytest.approx(exact.gradient[:, axis], rel=1e-6, abs=1e-9)
        assert (above.gradient - below.gradient) / (2 * h) == pytest.approx(exact.hessian[:, axis], rel=1e-4, abs=1e-7)


def test_exclusion_finds_a_tip_only_inside_the_rectangle(atlas):
    """The tip is found in a rectangle that contains it, and not in one whose lower rim is above it."""
    from drivetrain_jax.atlas.windows import narrow

    for low, expected in ((0.5, 1), (0.54, 0)):
        part = narrow(atlas, {"beta": (low, 1.0), "Omega": (0.69, 0.73)})
        found = critical_points(patches_of(Criteria.of(part, CARDAN)), 0, 1)
        assert len(found.points) == expected and not len(found.undecided)


def test_a_large_error_leaves_boxes_undecided(atlas):
    """The guarantee must notice that the surrogate is too coarse to exclude a tongue."""
    from drivetrain_jax.atlas.windows import narrow

    part = narrow(atlas, {"beta": (0.05, 0.2), "Omega": (1.38, 1.45)})
    assert [tip.name for tip in find_tips(part, CARDAN).tips] == ["S21"]
    panels = tuple(replace(p, value_error=1e-2) for p in part.panels)
    tips = find_tips(replace(part, panels=panels), CARDAN)
    assert tips.undecided
    beta, omega = TIPS["S21"]
    inside = [
        b for b in tips.undecided if b["beta"][0] <= beta <= b["beta"][1] and b["Omega"][0] <= omega <= b["Omega"][1]
    ]
    assert inside and not tips.tips


def test_a_tip_that_cannot_be_proved_is_listed_as_such(atlas):
    """Newton's method on the multiplier still finds the tip of the surrogate, with a bound of its error."""
    from drivetrain_jax.atlas.windows import narrow

    part = narrow(atlas, {"beta": (0.05, 0.2), "Omega": (1.38, 1.45)})
    panels = tuple(replace(p, value_error=1e-6) for p in part.panels)
    tips = find_tips(replace(part, panels=panels), CARDAN)
    (tip,) = tips.tips
    assert tip.name == "S21" and tip.opens and not tip.proved and tips.undecided
    assert tip.point == pytest.approx(dict(zip(("beta", "Omega"), TIPS["S21"], strict=True)), abs=1e-9)
    assert 1e-5 < tip.error["beta"] < 1e-3 and 1e-8 < tip.error["Omega"] < 1e-5
    (tip,) = find_tips(part, CARDAN).tips
    assert tip.proved


def test_inside_an_unstable_region_there_is_no_tip(atlas):
    criteria = Criteria.of(atlas, CARDAN)
    x = atlas.to_coordinates(np.array([[0.2, 1.0], [0.9, 1.45]]))
    rates = growth(criteria, x, ["+1", "+1"], second=True)
    found = naming._describe(criteria, "+1", 1, (x, rates, np.full((2, 2), np.nan)), np.ones(2, bool))
    assert [tip.point["beta"] for tip in found] == pytest.approx([0.2])


def test_a_name_belongs_to_a_resonance_of_the_same_multiplier(atlas):
    foot = atlas.to_coordinates(np.array([0.0, TIPS["S21"][1]]))
    assert naming._name(atlas, CARDAN, "-1", foot) == "S21"
    assert naming._name(atlas, CARDAN, "+1", foot) == ""
    # There is no name far from all resonances, or as near to C+10 as to C-9.
    assert naming._name(atlas, CARDAN, "-1", foot * [1, 1.03]) == ""
    assert naming._name(atlas, CARDAN, "pair", np.array([0.0, 1 / 0.07454])) == ""
    assert naming._name(atlas, CARDAN, "-1", np.array([0.0, np.nan])) == ""


@pytest.mark.full
@pytest.mark.parametrize(
    ("mu", "beta", "omega"), [(3.0, 0.3654, 0.52311), (5.5, 0.7509, 0.66445), (12.0, 0.2913, 0.92914)]
)
def test_tip_over_the_angle_rises_above_that_of_fig_7(mu, beta, omega):
    assert direct_tip(beta, omega, mu=mu) == (pytest.approx(beta, abs=1e-4), pytest.approx(omega, abs=1e-5))


def test_roots_on_a_line_are_all_sign_changes(atlas):
    criteria = Criteria.of(atlas, CARDAN)
    value = float(atlas.to_coordinates(np.array([1.0, 1.0]))[0])
    omega = 1 / np.linspace(1 / 2.0, 1 / 0.06, 40_001)
    x = atlas.to_coordinates(np.stack([np.ones_like(omega), omega], axis=-1))
    signs = criteria.derive(criteria.propagator(x), criteria.log_determinant(x)) > 0
    for k, patches in enumerate(patches_of(criteria)):
        found = roots(on_line(patches, 0, value))
        changes = np.flatnonzero(signs[k, 1:] != signs[k, :-1])
        assert len(found.x) == len(changes) and not len(found.undecided)
        assert np.all((found.x >= x[changes, 1]) & (found.x <= x[changes + 1, 1]))


@pytest.mark.full
def test_boundary_curves_are_boundaries(atlas, curves):
    criteria = Criteria.of(atlas, CARDAN)
    lowest = []
    for curve in curves:
        points = np.stack([curve.points["beta"], curve.points["Omega"]], axis=-1)
        x = atlas.to_coordinates(points[curve.limiting])
        assert np.abs(criteria.spectral_radius(x) - 1).max() < 1e-8
        lowest.append(points[:, 0].min())
        # The curve is connected: no step is longer than a fiftieth of the rectangle.
        step = np.diff(atlas.to_coordinates(points), axis=0) / np.ptp(
            atlas.to_coordinates([atlas.lower, atlas.upper]), axis=0
        )
        assert np.abs(step).max() < 0.02
    # Every tongue has one curve, through its tip, and there are no other curves.
    assert sorted(lowest) == pytest.approx(sorted(beta for beta, _ in TIPS.values()), abs=1e-6)


def test_only_points_on_the_stable_region_are_limiting(chart):
    """The boundary of a tongue continues inside another tongue that overlaps it."""
    criteria, inside = Criteria.of(chart.atlas, CARDAN), 0
    for curve in boundaries(chart.atlas, CARDAN):
        x = chart.atlas.to_coordinates(np.stack([curve.points["beta"], curve.points["Omega"]], axis=-1))
        rho = criteria.spectral_radius(x)
        assert np.abs(rho[curve.limiting] - 1).max(initial=0.0) < 2e-6
        assert (rho[~curve.limiting] > 1).all()
        inside += np.sum(~curve.limiting)
    assert inside > 20


@pytest.mark.full
def test_curves_enclose_the_unstable_region(atlas, curves):
    """Random points are unstable if the path from beta = 0 crosses an odd number of curves."""
    generator = np.random.default_rng(3)
    points = atlas.lower + (atlas.upper - atlas.lower) * generator.random((300, 2))
    radius = np.exp(rate(points[:, 0], points[:, 1]))
    for (beta, omega), rho in zip(points, radius, strict=True):
        crossings = 0
        for curve in curves:
            o, b = curve.points["Omega"], curve.points["beta"]
            k = np.flatnonzero((o[:-1] < omega) != (o[1:] < omega))
            height = b[k] + (omega - o[k]) / (o[k + 1] - o[k]) * (b[k + 1] - b[k])
            crossings += np.count_nonzero(height < beta)
        if abs(rho - 1) > 1e-4:
            assert (rho > 1) == bool(crossings % 2)


def test_undamped_tongues_start_at_the_resonances(undamped):
    tips = find_tips(undamped.atlas, CARDAN)
    omega1, omega2 = natural_frequencies(1.0, 100.0)
    found = {tip.name: tip for tip in tips.tips}
    assert set(found) >= {"S21", "H21", "C+1", "C+2", "S22", "H22"}
    assert not any(name.startswith("C-") for name in found)
    assert found["S21"].point == {"beta": 0.0, "Omega": pytest.approx(omega2)}
    assert found["C+2"].point == {"beta": 0.0, "Omega": pytest.approx((omega1 + omega2) / 4)}


def test_sums_of_near_frequencies_are_predicted_up_to_the_lowest_speed(atlas):
    """The tongue of C+7 grows from (omega1 + omega2)/14 = 0.14375; the orders of single frequencies end at 4."""
    slow = replace(atlas, lower=np.array([0.0, 0.1425]), fixed={**atlas.fixed, "mu": 0.05, "gamma": 0.05})
    predicted = naming._predictions(slow, CARDAN)
    speeds = predicted.values(slow.fixed)
    assert speeds[predicted.labels.index("C+7")] == pytest.approx(natural_frequencies(0.05, 0.05).sum() / 14)


def test_undamped_boundaries_separate_bounded_and_growing_motion(undamped):
    curves = boundaries(undamped.atlas, CARDAN)
    curve = max((c for c in curves if c.multiplier == "-1"), key=lambda c: np.ptp(c.points["beta"]))
    middle = np.argmin(np.abs(curve.points["beta"] - 0.6))
    beta, omega = curve.points["beta"][middle], curve.points["Omega"][middle]
    rates = rate(np.full(2, beta), omega * np.array([1 - 1e-6, 1 + 1e-6]), zeta=0.0)
    assert rates.min() < 1e-9 and rates.max() > 1e-5
    z = monodromy(propagators({**BASE, "zeta": 0.0, "beta": beta, "Omega": omega}, 1e-14))
    assert np.abs(np.linalg.eigvals(z) + 1).min() < 1e-2


@pytest.mark.full
def test_limits_without_damping_allow_for_a_loose_atlas():
    """Multipliers that meet on the unit circle leave it by the root of the atlas's error, in other tongues by more."""
    fixed = {**BASE, "zeta": 0.0, "gamma": 1.0}
    atlas = cardan_atlas({"beta": (0.6, 1.5), "Omega": (0.5, 2.0)}, 1e-3, fixed).atlas
    outside, limiting = [], []
    for curve in boundaries(atlas, CARDAN):
        outside.append(rate(curve.points["beta"], curve.points["Omega"], zeta=0.0, gamma=1.0))
        limiting.append(curve.limiting)
    outside, limiting = np.concatenate(outside), np.concatenate(limiting)
    assert outside[limiting].max() < 5e-3 and outside[~limiting].min() > 3e-2
    assert limiting.sum() > 500 and (~limiting).sum() > 100


@pytest.mark.full
def test_the_gradient_of_a_tip():
    """At a tip the radius does not vary along the speed, so that ``d beta/d mu = -rho_mu/rho_beta``."""
    atlas = cardan_atlas({"beta": (0.0, 0.7), "Omega": (0.65, 1.5), "mu": (1.0, 1.1)}, 1e-12).atlas
    values = np.linspace(1.0, 1.1, 3)
    found = [{t.name: t.point for t in find_tips(atlas.slice({"mu": mu}), CARDAN).tips} for mu in values]
    assert list(found[0]) == ["S21", "H21", "C+1"]
    slopes = radius_gradient(CARDAN, {**BASE, **found[0]["S21"], "mu": 1.0})
    difference = np.polyfit(values - 1, [tips["S21"]["beta"] for tips in found], 2)[1]
    assert -slopes["mu"] / slopes["beta"] == pytest.approx(difference, rel=2e-2)


@pytest.mark.full
def test_gradients_of_the_radius():
    point = {**BASE, "beta": 0.9, "Omega": 0.71}
    # Without damping all four multipliers lie on the circle, and derivatives of the radius are rounding.
    assert radius_gradient(CARDAN, {**point, "beta": 0.3, "Omega": 1.2, "zeta": 0.0}) is None
    for name, slope in radius_gradient(CARDAN, point).items():
        h = 1e-5 * point[name]
        columns = {**{k: np.full(2, v) for k, v in point.items()}, name: point[name] + np.array([-h, h])}
        values = np.abs(np.linalg.eigvals(monodromy(propagators(columns, 1e-14)))).max(axis=1)
        assert slope == pytest.approx((values[1] - values[0]) / (2 * h), rel=1e-5, abs=1e-9)


@pytest.mark.full
@pytest.mark.parametrize(("inside", "exists"), [(1e-15, False), (1e-10, True)])
def test_gradient_at_multipliers_equal_to_rounding(inside, exists):
    """Near the edge of S21 without damping, known to 30 digits, d rho/d Omega = 0.20180 (Omega - edge)^(-1/2)."""
    edge = 1.4001277838891882126
    point = {**BASE, "zeta": 0.0, "beta": 0.3, "Omega": edge + inside}
    found = radius_gradient(CARDAN, point)
    assert (found is not None) == exists
    if exists:
        assert found["Omega"] == pytest.approx(20180.37290, rel=1e-5)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.full
def test_no_gradient_of_a_radius_below_the_smallest_number():
    point = {**BASE, "zeta": 1.0, "gamma": 1.0, "beta": 0.3, "Omega": 0.001}
    assert radius_gradient(CARDAN, point) is None


def test_with_little_damping_points_in_a_tongue_are_not_limiting():
    """The edge of the tongue of -1 runs through the tongue of a pair, in which multipliers grow by at most 7e-8."""
    fixed = {**BASE, "zeta": 1e-5, "mu": 3.0}
    atlas = cardan_atlas({"beta": (1.0, 1.2), "Omega": (1.45, 1.6)}, 1e-11, fixed).atlas
    (minus,) = (b for b in boundaries(atlas, CARDAN) if b.multiplier == "-1")
    columns = {**{name: np.full(len(minus.limiting), v) for name, v in fixed.items()}, **minus.points}
    rho = np.abs(np.linalg.eigvals(monodromy(propagators(columns, 1e-13)))).max(axis=1)
    inside = rho > 1 + 1e-8
    assert inside.sum() > 30 and rho.max() < 1 + 1e-7 and not minus.limiting[inside].any()
    assert minus.limiting[rho < 1 + 1e-10].all() and (rho < 1 + 1e-10).sum() > 30


@pytest.mark.full
def test_up_to_an_angle_of_86_degrees_there_are_twenty_tips():
    """Six of the eight further ones have names; 0.002 below and above them SciPy gives stable and unstable shafts."""
    found = find_tips(cardan_atlas({"beta": (0.0, 1.5), "Omega": (0.06, 2.0)}, 1e-11).atlas, CARDAN)
    assert len(found.tips) == 20 and not found.undecided and all(tip.proved for tip in found.tips)
    expected = {"C+7": (1.3232, 0.1166), "C+8": (1.3267, 0.1023), "S23": (1.3473, 0.3106), "H24": (1.3996, 0.1996)}
    expected |= {"C-5": (1.4474, 0.1557), "C+12": (1.4484, 0.0724)}
    for tip in (tip for tip in found.tips if tip.name in expected):
        np.testing.assert_allclose((tip.point["beta"], tip.point["Omega"]), expected.pop(tip.name), rtol=0, atol=1e-4)
    assert not expected and [tip.name for tip in found.tips].count("") == 2
