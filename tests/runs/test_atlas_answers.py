"""Questions to an atlas that is loose, undamped, without panels, or has angles of both signs."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection

import drivetrain_jax as dt
from drivetrain_jax.atlas import design, stability
from drivetrain_jax.atlas.boundaries import boundaries
from drivetrain_jax.atlas.evaluation import tiles
from drivetrain_jax.atlas.exclusion import critical_points
from drivetrain_jax.runs import atlas_answers, through_atlas
from drivetrain_jax.runs.atlas_answers import _from_one
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.atlas_file import StoredAtlas
from drivetrain_jax.systems import get_system
from drivetrain_jax.systems.cardan import PHYSICAL
from tests.atlases import atlas_file, stored_atlas
from tests.sizes import full_after

S21 = (0.1063331213, 1.4159881603)
CARDAN = get_system("cardan")


def stored(scene: dict) -> xr.Dataset:
    return dt.open_result(atlas_file(scene))


@cache
def panels(beta: tuple, omega: tuple, rtol: float = 1e-9, zeta: float = 0.001, gamma: float = 100.0) -> xr.Dataset:
    axes = {"beta": beta, "Omega": omega}
    return stored(
        {
            "system": "cardan",
            "analysis": "atlas",
            "axes": {name: {"start": low, "stop": high} for name, (low, high) in axes.items()},
            "fixed": {"zeta": zeta, "alpha": 1.0, "mu": 1.0, "gamma": gamma},
            "options": {"rtol": rtol},
        }
    )


@pytest.mark.full
def test_an_atlas_answers_with_multipliers_as_well():
    axes = {"beta": {"start": 0.2, "stop": 0.4}, "Omega": {"start": 1.3, "stop": 1.5}}
    fixed = {"zeta": 0.01, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    scene = {"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": fixed, "outputs": ["floquet_multiplier"]}
    reply = atlas_answers.query(stored_atlas(scene), {"beta": 0.3, "Omega": 1.416})
    expected = dt.point("cardan", "floquet", beta=0.3, Omega=1.416, outputs="floquet_multiplier", **fixed)
    found = json.loads(reply.to_json())["values"]["floquet_multiplier"]
    multipliers = np.array(found["real"]) + 1j * np.array(found["imag"])
    np.testing.assert_allclose(multipliers, expected.floquet_multiplier, rtol=1e-8)
    assert reply.lines[1].split()[1] == f"{multipliers[0].real:.12g}{multipliers[0].imag:+.12g}j,"


def atlas_of(*given, **more) -> StoredAtlas:
    return dt.open_atlas(panels(*given, **more))


@pytest.mark.parametrize("beta", full_after(1, [(-0.3, 0.1), (-0.3, 0.0), (-0.1, 0.3)]))
@pytest.mark.full
def test_the_widest_angle_has_no_sign(beta):
    answer = atlas_answers.widest_angle(atlas_of(beta, (1.3, 1.5)), {"Omega": (1.35, 1.45)}).data
    assert answer["value"] == pytest.approx(S21[0], abs=1e-8) and answer["check"]["agrees"]


@pytest.mark.full
def test_boundaries_lie_on_both_sides_of_the_angle_0():
    """At a speed next to the tip of S21 the system is stable between the edges at both signs of the angle."""
    atlas, at = atlas_of((-0.2, 0.3), (1.3, 1.5)), {"beta": -0.15, "Omega": 1.42}
    nearest = atlas_answers.query(atlas, at).data["nearest"]["beta"]
    below, above = nearest["below"]["value"], nearest["above"]["value"]
    assert below == pytest.approx(-above, rel=1e-12) and -0.2 < below < -0.15
    beside = [below - 1e-6, below + 1e-6, above - 1e-6, above + 1e-6]
    rho = atlas.direct({"beta": np.array(beside), "Omega": np.full(4, 1.42), **columns(4)})
    assert (rho > 1).tolist() == [True, False, False, True]
    ends = atlas_answers.query(atlas, {"beta": 0.25, "Omega": 1.42}).data["nearest"]["beta"]
    assert ends["below"]["value"] == pytest.approx(above, rel=1e-12) and ends["above"] is None


@pytest.mark.parametrize(("J1", "k1"), full_after(1, [(2e-9, 3.7), (2.0, 1000.0), (1e-170, 1e-170)], several=True))
def test_the_ends_of_an_atlas_may_be_given_in_other_units(J1, k1):
    """Converted ends, or ends copied from a message, differ from the ends of the atlas by a rounding."""
    atlas, critical = atlas_of((0.0, 0.3), (1.3, 1.5)), 2 * np.sqrt(J1) * np.sqrt(k1)
    data = {"J1": J1, "J2": 100 * J1, "k1": k1, "k2": k1, "c1": 0.001 * critical, "c2": 0.001 * critical}
    _, speed_of = PHYSICAL.back("Omega", data)
    ends = float(speed_of(1.3)), float(speed_of(1.5))
    exact = atlas_answers.widest_angle(atlas, {"Omega": (1.3, 1.5)}).data["value"]
    for speed in (ends, tuple(float(f"{end:.10g}") for end in ends)):
        assert atlas_answers.widest_angle(atlas, {**data, "speed": speed}).data["value"] == exact
    near = atlas.check_within("Omega", np.array([1.3 * (1 - 1e-10), 1.4, 1.5 * (1 + 1e-10)]))
    assert near.tolist() == [1.3, 1.4, 1.5]
    with pytest.raises(dt.InputError, match=r"^Omega = 1\.50000015: expected"):
        atlas.check_within("Omega", np.array([1.5 * (1 + 1e-7)]))
    with pytest.raises(dt.InputError, match=r"^speed = .*: expected speed=LOW:HIGH within"):
        atlas_answers.widest_angle(atlas, {**data, "speed": (ends[0] * (1 - 1e-8), ends[1])})


def test_an_answer_in_rpm_says_how_fast_disturbances_grow():
    """A cardan shaft has two periods a turn; without a speed in rpm growth is that of a turn."""
    atlas = atlas_of((0.0, 0.3), (1.3, 1.5))
    data = {"J1": 2.0, "J2": 200.0, "k1": 1000.0, "k2": 1000.0, "c1": 0.0894427191, "c2": 0.0894427191}
    found = atlas_answers.query(atlas, {**data, "angle": 17.0, "speed": 302.3})
    radius, grows = float(found.data["values"]["spectral_radius"]), found.data["growth"]
    assert radius > 1.01
    assert grows["per_turn"] == pytest.approx(radius**2, rel=1e-12)
    assert grows["rate"] == pytest.approx(np.log(radius) * 2 * 302.3 / 60, rel=1e-12)
    assert grows["turns_to_double"] == pytest.approx(np.log(2) / np.log(radius**2), rel=1e-12)
    assert "doubles in" in str(found) and "time_to_halve" not in grows
    without = atlas_answers.query(atlas, {"beta": 0.2967, "Omega": 1.416}).data["growth"]
    assert without.keys() == {"per_turn", "turns_to_double"}


TRUCK = {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "alpha": 0.4082, "angle": 12.0}


def test_answers_begin_with_one_sentence_in_the_units_of_the_question():
    atlas = atlas_of((0.0, 0.3), (1.3, 1.5))
    data = {"J1": 2.0, "J2": 200.0, "k1": 1000.0, "k2": 1000.0, "c1": 0.0894427191, "c2": 0.0894427191}
    windows = atlas_answers.speed_windows(atlas, {**data, "angle": 17.0})
    assert windows.answer == "Unstable at speed = 299.068 to 305.769 rpm (subharmonic S21)."
    assert str(windows).startswith(windows.answer) and windows.sentences()[0] == windows.answer
    assert [each["resonance"] for each in windows.data["unstable"]] == ["subharmonic S21"]
    assert atlas_answers.speed_windows(atlas, {"beta": 0.05}).answer == "Stable at Omega = 1.3 to 1.5."
    without = atlas_answers.speed_windows(atlas, {**data, "angle": 17.0}, margin=0.9)
    assert without.data["windows"] == [] and without.answer == windows.answer
    widest = atlas_answers.widest_angle(atlas, {**data, "speed": (290.0, 320.0)})
    assert widest.answer == "With angle = 6.09241 deg (beta = 0.106333) or less, speed = 290 to 320 rpm is stable."
    whole = atlas_answers.widest_angle(atlas, {})
    assert whole.data == atlas_answers.widest_angle(atlas, {"Omega": (1.3, 1.5)}).data
    least = atlas_answers.least_damping(atlas, data, vary="angle")
    assert least.data["parameter"] == "beta" and str(least).splitlines()[1].startswith(
        "least angle, speed = 277.587 to"
    )
    assert least.data["intervals"][0]["ends"][1]["value"] == whole.data["value"] == pytest.approx(S21[0], abs=1e-8)
    for vary, message in (("speed", "vary = 'speed': is the speed"), ("mu", "file: the atlas does not vary mu; ")):
        with pytest.raises(dt.InputError, match=message):
            atlas_answers.least_damping(atlas, data if vary == "speed" else {}, vary=vary)
    asked = json.loads(atlas_answers.query(atlas, {**data, "angle": 17.0, "speed": 302.3}).to_json())["answer"]
    assert (
        asked.startswith("Unstable; growth ") and " 3.23186 rpm below: speed = 299.068 rpm (Omega = 1.4006, " in asked
    )


@pytest.mark.full
def test_the_damping_of_a_sentence_is_sufficient():
    axes = {"speed": {"start": "2000 rpm", "stop": "4000 rpm"}, "zeta": {"start": 0.0, "stop": 0.01}}
    file = atlas_file({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": TRUCK})
    atlas = dt.open_atlas(file)
    assert atlas_answers.speed_windows(atlas, {"c1": 0.3}).answer == (
        "Unstable at speed = 2270.71 to 2288.98 rpm (sum combination C+1) and 3126.26 to 3142.12 rpm (subharmonic S21); "
        "c1 = 2.53436 N m s/rad (zeta = 0.00365803) or more (the atlas ends at c1 = 6.9282) removes this."
    )
    assert atlas_answers.speed_windows(atlas, {"c1": 2.53436}).answer == "Stable at speed = 2000 to 4000 rpm."
    # A chart along the speed has the same ranges, in its units.
    ranges = chart(file, {"c1": 0.3}, 9).unstable_speed
    said = atlas_answers.speed_windows(atlas, {"c1": 0.3}).data["unstable"]
    np.testing.assert_allclose(ranges, [entry["physical"]["speed"]["value"] for entry in said], rtol=1e-12)
    assert ranges.units == "rpm" and len(ranges)
    least = atlas_answers.least_damping(atlas, {"speed": (2000.0, 4000.0)})
    assert least.answer.startswith(
        "With c1 = 2.53436 N m s/rad (zeta = 0.00365803) or more (the atlas ends at c1 = 6.9282), speed = 2000 to"
    )


@pytest.mark.parametrize(
    ("value", "error", "text"), [(1421.8376, 0, "1421.84"), (1421.8376, 3.0, "1.4e+03"), (0.5, 0.5, "0.5"), (0, 1, "0")]
)
def test_numbers_have_the_digits_that_their_error_allows(value, error, text):
    assert atlas_answers.number(value, error) == text


@pytest.mark.full
@pytest.mark.parametrize("axes", [("Omega", "beta", "mu"), ("mu", "beta", "Omega"), ("beta", "mu", "Omega")])
def test_tiles_lie_along_the_longest_axes_of_a_chart(monkeypatch, axes):
    """A chart may have few values of the last two parameters of its atlas; tiles must not become small by that."""
    ranges = {"beta": (0.2, 0.5), "Omega": (1.3, 1.5), "mu": (1.0, 1.1)}
    table = {name: dict(zip(("start", "stop"), ranges[name], strict=True)) for name in axes}
    fixed = {"zeta": 0.001, "alpha": 1.0, "gamma": 100.0}
    scene = {"system": "cardan", "analysis": "atlas", "axes": table, "fixed": fixed, "options": {"rtol": 1e-8}}
    atlas, cut = stored_atlas(scene), []

    def counted(*given, **more):
        for tile in tiles(*given, **more):
            cut.append(tile)
            yield tile

    monkeypatch.setattr(stability, "tiles", counted)
    lengths = {"beta": 60, "Omega": 70, "mu": 3}
    values = {name: np.linspace(*ranges[name], n) for name, n in lengths.items()}
    found = atlas.grid(**values)
    assert len(cut) <= 2 * lengths["mu"] * len(atlas.stability.atlas.panels)
    for mu in values["mu"]:
        alone, ours = atlas.grid(**{**values, "mu": float(mu)}), found.sel(mu=mu)
        bound = alone.spectral_radius_error + ours.spectral_radius_error
        assert (abs(alone.spectral_radius - ours.spectral_radius) <= bound).all()
        assert (alone.verdict == ours.verdict).all() and (ours.spectral_radius_error < 1e-7).all()


@pytest.mark.parametrize("number", full_after(1, [np.float32, np.float64, np.array]))
def test_numbers_of_numpy_are_accepted(number):
    atlas, speeds = atlas_of((-0.2, 0.3), (1.3, 1.5)), (1.3125, 1.5)
    found = atlas_answers.query(atlas, {"beta": number(0.25), "Omega": number(1.375)}).data
    assert found == atlas_answers.query(atlas, {"beta": 0.25, "Omega": 1.375}).data
    asked = {"Omega": tuple(map(number, speeds))}
    assert atlas_answers.widest_angle(atlas, asked).data == atlas_answers.widest_angle(atlas, {"Omega": speeds}).data


def columns(count: int, zeta: float = 0.001) -> dict[str, np.ndarray]:
    return {name: np.full(count, x) for name, x in {"zeta": zeta, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}.items()}


@pytest.mark.full
def test_a_chart_over_the_angle_0_has_curves_and_tips_on_both_sides():
    source = panels((-0.2, 0.3), (1.3, 1.5))
    drawn = chart(source, {}, 20)
    assert sorted(drawn["tip_beta"].values) == pytest.approx([-S21[0], S21[0]], abs=1e-8)
    assert drawn["tip_Omega"].values == pytest.approx([S21[1]] * 2, abs=1e-8)
    assert (drawn["tip_opens"].values == (drawn["tip_beta"].values > 0)).all()
    beta, omega = (drawn[f"boundary_{name}"].values for name in ("beta", "Omega"))
    beta, omega = beta[np.isfinite(beta)], omega[np.isfinite(beta)]
    assert beta.min() == pytest.approx(-0.2, abs=2e-3) and beta.max() == pytest.approx(0.3, abs=1e-12)
    rho = dt.open_atlas(source)(beta=beta, Omega=omega).spectral_radius.values
    np.testing.assert_allclose(rho, 1.0, rtol=0, atol=1e-7)
    part = chart(source, {"beta": (-0.2, -0.05)}, 20)
    assert part["tip_beta"].values == pytest.approx([-S21[0]], abs=1e-8)
    assert np.nanmax(part["boundary_beta"].values) < -0.1


def test_a_chart_searches_its_tips_once(monkeypatch):
    source, searched = panels((0.0, 0.3), (1.3, 1.5)), []

    def counted(patches, number, horizontal):
        searched.append(number)
        return critical_points(patches, number, horizontal)

    for module in ("tips", "boundaries"):
        monkeypatch.setattr(f"drivetrain_jax.atlas.{module}.critical_points", counted)
    drawn = chart(source, {}, 4)
    assert sorted(searched) == [0, 1, 2]
    curves = boundaries(dt.open_atlas(source).stability.atlas, CARDAN)
    length = sum(len(segment["beta"]) for curve in curves for segment in curve.segments())
    assert np.isfinite(drawn["boundary_beta"]).sum() == length


@pytest.mark.full
def test_every_slice_of_a_chart_has_its_own_curve():
    axes = {"beta": (0.05, 0.3), "alpha": (0.5, 4.0), "Omega": (1.35, 1.48)}
    scene = {"axes": {name: {"start": low, "stop": high} for name, (low, high) in axes.items()}}
    fixed = {"zeta": 0.001, "mu": 1.0, "gamma": 100.0}
    source = stored({"system": "cardan", "analysis": "atlas", "fixed": fixed, **scene})
    drawn = chart(source, {}, 20)
    assert drawn["boundary_beta"].dims == ("alpha", "boundary") and "tip" not in drawn.coords
    for alpha in drawn["alpha"].values:
        beta, omega = (drawn[f"boundary_{name}"].sel(alpha=alpha).dropna("boundary") for name in ("beta", "Omega"))
        rho = dt.open_atlas(source)(beta=beta.values, Omega=omega.values, alpha=alpha).spectral_radius.values
        np.testing.assert_allclose(rho, 1.0, rtol=0, atol=1e-7)
        assert len(beta) > 10
    assert beta.min() == chart(source, {"alpha": 4.0}, 4)["boundary_beta"].min()
    panels = dt.plot(source, cells=20).axes[: drawn.sizes["alpha"]]
    lines = [[line.get_xdata() for line in axes.lines if line.get_label() == "boundary"] for axes in panels]
    np.testing.assert_array_equal(np.array(lines)[:, 0], drawn["boundary_Omega"].values)
    # The edges of the cells are not drawn next to the curve.
    assert not [each for axes in panels for each in axes.collections if isinstance(each, LineCollection)]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_part_without_extent_is_drawn():
    drawn = chart(panels((0.0, 0.3), (1.3, 1.5)), {"Omega": (1.4, 1.4000000000000001), "beta": (0.1, 0.3)}, 4)
    assert (drawn["verdict"].values == 0).all() and drawn["tip"].size == 0


@pytest.mark.full
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_range_of_speeds_without_extent_has_a_widest_angle():
    atlas = dt.open_atlas(panels((0.0, 1.5), (0.1, 2.0)))
    found = atlas_answers.widest_angle(atlas, {"Omega": (1.4, 1.4000000000000004)}).data
    beta, margin = found["value"], found["error"]
    assert margin < 1e-5
    beside = atlas(beta=beta + margin * np.array([-3, -1, 1, 3]), Omega=1.4)
    assert np.sign(beside["spectral_radius"].values - 1).tolist() == [-1, -1, 1, 1]
    # The bound of the radius is wider than that of the angle.
    assert beside["verdict"].values[[0, 3]].tolist() == [0, 1]


@pytest.mark.parametrize(
    ("rtol", "beta"),
    [pytest.param(1e-5, 0.894981, marks=pytest.mark.full), pytest.param(1e-4, 0.871812, marks=pytest.mark.full)],
)
def test_an_undecided_range_that_hides_a_change_ends_a_window(rtol, beta):
    atlas = atlas_of((0.0, 1.3), (0.15, 2.0), rtol=rtol)
    windows = atlas_answers.speed_windows(atlas, {"beta": beta}).data["windows"]
    speeds = np.concatenate([np.linspace(*window["safe"], 41)[1:-1] for window in windows])
    assert len(windows) >= 5 and all(window["check"]["agrees"] for window in windows)
    assert atlas.direct({"beta": np.full(speeds.size, beta), "Omega": speeds, **columns(speeds.size)}).max() < 1


@pytest.mark.full
def test_the_nearest_change_next_to_an_undecided_range():
    atlas = atlas_of((0.0, 1.3), (0.15, 2.0), rtol=1e-5)
    below = atlas_answers.query(atlas, {"beta": 0.894981, "Omega": 0.752}).data["nearest"]["Omega"]["below"]
    exact = atlas_answers.query(atlas_of((0.0, 1.3), (0.15, 2.0)), {"beta": 0.894981, "Omega": 0.752})
    assert abs(below["value"] - exact.data["nearest"]["Omega"]["below"]["value"]) < below["error"] < 1e-3


@pytest.mark.full
def test_no_change_is_stated_with_undecided_ranges_as_exception():
    atlas = atlas_of((0.0, 1.2), (0.3, 2.0), zeta=0.0)
    asked = atlas_answers.AtlasQuery(atlas, {}, None)
    nearest = design.Nearest("Omega", 1.0, None, None, ((0.9, 1.1),))
    assert atlas_answers._reach(asked, nearest) == "none within Omega = 0.3 to 2, except undecided ranges:"
    assert atlas_answers._reach(asked, replace(nearest, undecided=())) == "none within Omega = 0.3 to 2"


@pytest.mark.full
def test_very_little_damping_is_not_zero_damping():
    """Without damping S21 reaches down to the angle 0, with very little damping only down to .0001."""
    atlas = atlas_of((0.0, 1.2), (0.3, 2.0), zeta=0.0)
    point = {"beta": 0.00005, "Omega": 1.4159846397}
    assert atlas_answers.query(atlas, point).data["meanings"]["verdict"] == "unstable"
    with pytest.raises(dt.InputError, match=r"^zeta = 1e-09: the atlas is made for zeta = 0; expected that value$"):
        atlas_answers.query(atlas, {**point, "zeta": 1e-9})


def test_an_answer_without_a_value_states_if_it_is_certain():
    crowded = atlas_of((0.0, 1.2), (0.3, 2.0), zeta=1e-7)
    assert "\n  no beta found; whether there is one is undecided\n" in str(
        atlas_answers.widest_angle(crowded, {"Omega": (1.3, 1.5)})
    )
    none = atlas_answers.widest_angle(atlas_of((0.3, 1.2), (0.3, 2.0)), {"Omega": (1.3, 1.5)})
    assert "\n  no beta of the atlas is sufficient" in str(none) and none.data["certain"]


@pytest.mark.full
def test_stable_intervals_away_from_the_safe_end_are_listed():
    """At beta = .9 a tongue covers all speeds; it closes at 1.144."""
    atlas = atlas_of((0.9, 1.45), (0.5, 0.6), zeta=0.01, gamma=1.0)
    reply = atlas_answers.widest_angle(atlas, {"Omega": (0.5504, 0.5506)})
    assert "\n  unstable at beta = 0.9, the smallest of the atlas\n  stable from beta = 1.14432 (error at" in str(reply)
    assert " to beta = 1.35718 (error at" in str(reply) and "is sufficient" not in str(reply)
    assert "\n  direct solves agree" in str(reply)
    found = json.loads(reply.to_json())
    assert found["value"] is None and found["error"] is None and found["certain"] and found["check"]["agrees"]
    ((low, high),) = (interval["ends"] for interval in found["intervals"])
    assert [low["value"], high["value"]] == pytest.approx([1.1443182976, 1.3571774558], abs=1e-8)
    assert [low["multiplier"], high["multiplier"]] == ["pair", "-1"] and low["kind"] == high["kind"] == "crossing"
    assert 0 < max(low["error"], high["error"]) < 1e-8
    shaft = {"J1": 2.0, "J2": 2.0, "k1": 1000.0, "k2": 1000.0, "c1": 0.894427191, "c2": 0.894427191}
    degrees = atlas_answers.widest_angle(atlas, {**shaft, "Omega": (0.5504, 0.5506)}).data["intervals"][0]["physical"]
    assert degrees["angle"]["value"] == pytest.approx([65.564609, 77.760540], abs=1e-5)


@pytest.mark.full
@pytest.mark.parametrize(
    ("speeds", "kind", "value"), [((1.3, 1.5), "crossing", S21[0]), ((1.415, 1.417), "undecided", 0.1063277628)]
)
def test_an_answer_names_the_kinds_of_its_ends(speeds, kind, value):
    """On a loose atlas the tip of S21 is undecided from .10633 to .10640, in a narrow range of speeds to .11255."""
    reply = atlas_answers.widest_angle(atlas_of((0.0, 1.3), (0.15, 2.0), rtol=1e-5), {"Omega": speeds})
    found = json.loads(reply.to_json())
    start, end = found["intervals"][0]["ends"]
    assert start == {"value": 0.0, "kind": "atlas", "error": None, "multiplier": None} and end["kind"] == kind
    decided = kind == "crossing"
    # The edge of an undecided range moves with the estimated bound of the atlas, which rounding changes.
    near = pytest.approx(value, abs=1e-7 if decided else 1e-6)
    assert found["value"] == end["value"] == near and found["error"] == end["error"]
    assert found["certain"] == decided and found["check"]["agrees"]
    assert (end["multiplier"], found["limit"] is None) == (("-1", False) if decided else (None, True))
    if decided:
        assert abs(value - S21[0]) < found["error"] < 1e-4
    else:
        assert found["error"] is None and value < S21[0] and " (undecided beyond)\n  not certain" in str(reply)


@pytest.mark.full
def test_a_slowly_resolved_boundary_function_is_not_taken_for_rounding():
    """Of this shaft five patches hardly resolve more than three: all speeds were undecided."""
    given = {"J1": 1.2, "J2": 0.35, "k1": 3e4, "k2": 2.5e4, "c1": 2.0, "c2": 0.3, "angle": "15 deg"}
    speed = {"start": "100 rpm", "stop": "4500 rpm"}
    atlas = stored_atlas({"system": "cardan", "analysis": "atlas", "axes": {"speed": speed}, "fixed": given})
    found = atlas_answers.speed_windows(atlas, {}).data
    ends = [end["value"] for window in found["windows"] for end in window["ends"]]
    assert ends[1:-1] == pytest.approx([0.84714, 0.84976, 1.41307, 1.42805, 1.98566, 1.99992], abs=1e-5)
    assert not found["undecided"]


@pytest.mark.full
def test_a_question_may_repeat_what_follows_from_the_data_of_the_atlas():
    """``zeta`` follows from c1, as ``alpha`` does: to replace c1 by it left nothing for ``alpha``."""
    given = {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "c1": 0.3464, "c2": 0.1414, "angle": "12 deg"}
    speed = {"start": "1400 rpm", "stop": "1450 rpm"}
    atlas = stored_atlas({"system": "cardan", "analysis": "atlas", "axes": {"speed": speed}, "fixed": given})
    plain = atlas_answers.query(atlas, {"speed": 1425.0}).data
    for repeated in ({"zeta": 0.0005}, {"zeta": 0.0005, "alpha": 0.4082, "mu": 2 / 3, "gamma": 0.25, "beta": "12 deg"}):
        assert atlas_answers.query(atlas, {"speed": 1425.0, **repeated}).data == plain
    for other, message in (
        ({"zeta": 0.001}, r"^zeta = 0\.001: the atlas is made for zeta = 0\.00049998"),
        ({"mu": 0.5}, r"^mu = 0\.5: the atlas is made for mu = 0\.6666"),
        (
            {"zeta": 0.0005, "c1": 1.0, "c2": 0.4082},
            r"^zeta = 0\.0005: given besides c1, J1, k1; expected one of the two",
        ),
    ):
        with pytest.raises(dt.InputError, match=message):
            atlas_answers.query(atlas, {"speed": 1425.0, **other})


@pytest.mark.full
def test_nothing_found_beside_undecided_ranges_is_not_nothing(monkeypatch):
    atlas = atlas_of((0.0, 1.2), (0.3, 2.0), zeta=0.0)
    for undecided, text in (
        ((), "within the atlas"),
        (((0.5, 0.6),), "found; whether there is one is undecided\n  undec"),
    ):
        monkeypatch.setattr(design, "speed_windows", lambda *_, ends=undecided, **__: design.Windows((), (), ends))
        reply = atlas_answers.speed_windows(atlas, {"beta": 0.1})
        assert f"\n  none {text}" in str(reply)
    assert reply.lines[2] == "  undecided: Omega = 0.5 to 0.6" and reply.answer == "Undecided at Omega = 0.3 to 2."


@pytest.mark.full
def test_windows_name_the_kinds_of_their_ends():
    found = atlas_answers.speed_windows(atlas_of((0.0, 1.3), (0.15, 2.0), rtol=1e-4), {"beta": 0.9254237})
    windows = json.loads(found.to_json())["windows"]
    kinds = [[end["kind"] for end in window["ends"]] for window in windows]
    assert kinds[0] == ["atlas", "crossing"] and kinds[-1] == ["crossing", "atlas"]
    assert any("undecided" in both for both in kinds)
    for window in windows:
        for safe, end, sign in zip(window["safe"], window["ends"], (1, -1), strict=True):
            crossed = end["kind"] == "crossing"
            assert (end["error"] is not None) == (end["multiplier"] is not None) == crossed
            assert safe == pytest.approx(end["value"] + sign * (end["error"] if crossed else 0.0), abs=1e-12)
    assert "largest spectral radius 1 - " in str(found) and "largest spectral radius 1 at" not in str(found)


@pytest.mark.full
def test_answers_without_damping_agree_with_direct_solves():
    atlas = atlas_of((0.0, 1.2), (0.3, 2.0), zeta=0.0)
    assert atlas_answers.widest_angle(atlas, {"Omega": (1.6, 1.9)}).data["check"]["agrees"]
    windows = atlas_answers.speed_windows(atlas, {"beta": 0.5}).data["windows"]
    assert len(windows) >= 5 and all(window["check"]["agrees"] for window in windows)


@pytest.mark.full
def test_without_damping_tips_are_at_the_angle_0():
    source = panels((0.0, 1.2), (0.3, 2.0), zeta=0.0)
    assert {"S21", "H21", "C+1"} <= set(chart(source, {}, 20)["tip"].values)
    both = chart(panels((-0.3, 0.2), (1.3, 1.5), zeta=0.0), {}, 20)
    assert both["tip"].values.tolist() == ["S21"] and both["tip_opens"].values.tolist() == [1]
    assert chart(source, {"beta": (0.9, 1.2)}, 20)["tip"].size == 0


@pytest.mark.full
def test_an_atlas_without_a_panel_answers_by_direct_solves(monkeypatch):
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 10)
    source = panels((0.0, 0.5), (0.001, 0.002), rtol=1e-8)
    atlas = dt.open_atlas(source)
    assert not atlas.stability.atlas.panels
    reply = atlas_answers.query(atlas, {"beta": 0.1, "Omega": 0.0015})
    direct = dt.point(
        "cardan", "floquet", beta=0.1, Omega=0.0015, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0, rtol=1e-8
    )
    assert reply.data["values"]["spectral_radius"] == pytest.approx(direct.spectral_radius, abs=1e-7)
    assert reply.text.splitlines()[-1].startswith("  unknown: the atlas has no panel (")
    assert reply.data["nearest"] == {} and "boundary_beta" not in chart(source, {}, 4).coords
    with pytest.raises(
        dt.InputError, match=r"^file: the atlas has no panel \(.*\); expected one whose solves converged$"
    ):
        atlas_answers.widest_angle(atlas, {"Omega": (0.001, 0.002)})


@pytest.mark.parametrize(
    "point",
    [
        {"beta": 1.2, "Omega": 0.001, "zeta": 1e-4},
        {"beta": 1.569, "Omega": 2.0, "zeta": 0.01},
        {"beta": 1.0, "Omega": 0.1, "zeta": 10.0},
        {"beta": 0.4, "Omega": 1.2, "zeta": 1e-7},
    ],
)
@pytest.mark.full
def test_gradients_at_extremes(point):
    """Gradients equal differences of direct solves, with steps small against the phase and the distance to pi/2."""
    point = {"alpha": 1.0, "mu": 1.0, "gamma": 100.0} | point
    gradient = atlas_answers.radius_gradient(CARDAN, point)
    for name in ("beta", "Omega", "zeta"):
        h = 3e-6 * (np.pi / 2 - point["beta"] if name == "beta" else point[name]) * (30 if name == "zeta" else 1)
        radii = [dt.point("cardan", "floquet", **{**point, name: point[name] + d}, rtol=1e-13) for d in (-h, h)]
        difference = (radii[1].spectral_radius - radii[0].spectral_radius) / (2 * h)
        noise = 4e-13 * radii[0].spectral_radius / h
        assert gradient[name] == pytest.approx(difference, rel=1e-5, abs=noise), name


def test_a_gradient_that_needs_too_many_panels_has_no_value():
    point = {"beta": 1.2, "Omega": 1e-6, "zeta": 1e-4, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    assert atlas_answers.radius_gradient(CARDAN, point) is None


@pytest.mark.full
def test_steps_of_a_gradient_are_found_where_the_system_predicts_none():
    model = CARDAN.models["floquet"]
    other = replace(model, build=lambda values: replace(model.build(values), panels=None))
    system = type("Variant", (CARDAN,), {"models": CARDAN.models | {"floquet": other}})
    point = {"beta": 0.3, "Omega": 0.004, "zeta": 1e-4, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    found, exact = (atlas_answers.radius_gradient(s, point) for s in (system, CARDAN))
    for name, slope in exact.items():
        assert found[name] == pytest.approx(slope, rel=1e-5, abs=1e-9), name


@pytest.mark.parametrize(
    ("radius", "text"), [(1 - 2.04e-10, "1 - 2.0e-10"), (1 + 5e-7, "1 + 5.0e-07"), (0.9, "0.9"), (1.0, "1")]
)
def test_distance_from_one_keeps_its_digits(radius, text):
    assert _from_one(radius) == text


@pytest.mark.parametrize(
    "name", ["lower", "panel_lower", "panel_degrees", "value_error", "coefficients", "kept", "scene"]
)
def test_a_part_of_an_atlas_is_refused(name):
    """Without the bits that mark the kept coefficients, all coefficients would be 0, and every shaft stable."""
    whole = panels((0.2, 0.3), (1.3, 1.5))
    attrs = {key: value for key, value in whole.attrs.items() if key != name}
    part = whole.drop_vars(name, errors="ignore").drop_attrs().assign_attrs(attrs)
    with pytest.raises(dt.InputError, match=f"^dataset: lacks {name}; expected the whole result of a scene"):
        dt.open_atlas(part)


@pytest.mark.parametrize("cut", ["coefficient", "byte"])
def test_an_atlas_that_was_cut_is_refused(cut):
    whole = panels((0.2, 0.3), (1.3, 1.5))
    with pytest.raises(dt.InputError, match=r"^dataset: lacks some of "):
        dt.open_atlas(whole.isel({cut: slice(0, -1)}))
