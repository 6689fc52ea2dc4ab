"""Tips followed through a third parameter, against all tips that exclusion finds at every value."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas.following import follow_tips
from drivetrain_jax.atlas.tips import find_tips
from drivetrain_jax.atlas.windows import narrow
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, monodromy, propagators


def tips_at(atlas, **values):
    return {(tip.name, round(tip.point["beta"], 6)) for tip in find_tips(atlas.slice(values), CARDAN).tips}


def ends(paths):
    return {
        (path.tip.name, round(float(path.points["beta"][-1]), 6))
        for path in paths
        if np.isfinite(path.points["beta"][-1])
    }


@pytest.fixture(scope="module")
def stiffnesses():
    return cardan_atlas({"beta": (0.0, 1.4), "Omega": (0.45, 1.5), "mu": (1.0, 7.5)}, 1e-11).atlas


@pytest.mark.parametrize(("start", "end"), [(5.5, 6.0), (7.2, 2.2), (3.0, 1.7)])
def test_a_tip_keeps_its_name_however_far_apart_the_values_are(stiffnesses, start, end):
    """From 5.5 to 6 C+2 moves from 0.7509 to 1.1346, and two more appear: where one closes, and another tip at 0.5611."""
    paths = follow_tips(stiffnesses, CARDAN, "mu", [start, end])
    assert {(path.tip.name, round(float(path.points["beta"][0]), 6)) for path in paths} == tips_at(
        stiffnesses, mu=start
    )
    followed = ends(paths)
    assert followed <= tips_at(stiffnesses, mu=end)
    assert sum(bool(path.limiting[-1]) for path in paths) == len(followed) > 0
    if start == 5.5:
        assert dict(followed)["C+2"] == pytest.approx(1.134649, abs=2e-6)


def test_tips_at_small_angles_are_followed(stiffnesses):
    (path,) = (p for p in follow_tips(stiffnesses, CARDAN, "mu", [3.5, 4.0, 5.0]) if p.tip.name == "C+1")
    for mu, beta in zip(path.values, path.points["beta"], strict=True):
        assert dict(tips_at(stiffnesses, mu=mu))["C+1"] == pytest.approx(beta, abs=1e-6) and beta < 0.045


def test_a_tip_within_another_tongue_bounds_nothing():
    """H22 passes through the tongue S23, and comes out on its other side."""
    atlas = cardan_atlas({"beta": (0.8, 1.2), "Omega": (0.35, 0.42), "gamma": (2.2, 6.0)}, 1e-11).atlas
    gamma = np.array([5.5, 3.5, 2.31])
    (path,) = (p for p in follow_tips(atlas, CARDAN, "gamma", gamma) if p.tip.name == "H22")
    sigma = np.linalg.eigvals(monodromy(propagators({**BASE, **path.points, "gamma": gamma}, 1e-13)))
    assert np.abs(sigma - 1).min(axis=1).max() < 1e-9
    assert np.abs(sigma).max(axis=1) - 1 == pytest.approx([0.0, 0.54, 0.0], abs=0.01)
    assert path.limiting.tolist() == [True, False, True]


def test_at_zero_damping_tips_are_those_of_the_theory():
    atlas = cardan_atlas({"beta": (0.0, 1.2), "Omega": (0.3, 2.0), "zeta": (0.0, 0.002)}, 1e-11).atlas
    down = {p.tip.name: p for p in follow_tips(atlas, CARDAN, "zeta", [0.001, 0.0])}
    for tip in find_tips(atlas.slice({"zeta": 0.0}), CARDAN).tips:
        assert down[tip.name].points["beta"][-1] == 0.0
        assert down[tip.name].points["Omega"][-1] == pytest.approx(tip.point["Omega"], rel=1e-12)
    # Without damping it does not exist.
    assert np.isnan(down["C-1"].points["beta"][-1]) and not down["C-1"].limiting[-1]
    up = follow_tips(atlas, CARDAN, "zeta", [0.0, 0.001])
    assert ends(up) == {tip for tip in tips_at(atlas, zeta=0.001) if tip[0] != "C-1"}
    undamped = cardan_atlas({"beta": (0.0, 0.3), "Omega": (1.3, 1.8), "mu": (1.0, 2.0)}, 1e-9, {**BASE, "zeta": 0.0})
    (path,) = follow_tips(undamped.atlas, CARDAN, "mu", [1.0, 2.0])
    assert path.tip.name == "S21" and path.points["Omega"] == pytest.approx([1.415985, 1.735904], abs=1e-6)


def test_where_there_is_no_tip_none_is_followed(stiffnesses):
    between = stiffnesses.slice({"mu": 1.0})
    assert not find_tips(narrow(between, {"beta": (0.2, 0.3), "Omega": (1.0, 1.1)}), CARDAN).tips
    assert follow_tips(narrow(stiffnesses, {"beta": (0.2, 0.3), "Omega": (1.0, 1.1)}), CARDAN, "mu", [1.0, 1.1]) == ()


def test_what_ends_a_tongue_over_the_damping_is_followed():
    atlas = cardan_atlas({"zeta": (1e-4, 0.05), "Omega": (1.3, 1.5), "beta": (0.2, 0.4)}, 1e-11).atlas
    (path,) = follow_tips(atlas, CARDAN, "beta", [0.2, 0.3, 0.4])
    for beta, zeta in zip(path.values, path.points["zeta"], strict=True):
        (tip,) = find_tips(atlas.slice({"beta": beta}), CARDAN, opening=False).tips
        assert zeta == pytest.approx(tip.point["zeta"], rel=1e-9)
