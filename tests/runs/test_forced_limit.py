"""Limits of the forced amplitude: along a resonance curve in closed form, at points, and in design answers."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.runs import atlas_answers
from drivetrain_jax.runs.reply import Limit
from tests.atlases import stored_atlas

DATA = {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "c1": 0.3464, "c2": 0.1414, "angle": "12 deg"}
WORDS = [f"{name}={value}" for name, value in DATA.items()]
TWO = Limit.from_text(dt.Cardan, "2 deg")


def test_ranges_within_a_limit_follow_the_resonance_curve():
    """``1e-3/sqrt((1 - r^2)^2 + (2 D r)^2)`` with D = 1e-4: a peak ten times narrower than the samples of 0.5 to 1.5."""
    damping = 1e-4

    def amplitude(r):
        size = 1e-3 / np.hypot(1 - r**2, 2 * damping * r)
        return np.stack([size / 2, size], axis=-1)

    text, found = TWO.along(amplitude, 0.5, 1.5003, np.array([1.0001]), "{:.6g}".format)
    ratio = 1e-3 / TWO.value
    # (1 - r^2)^2 + (2 D r)^2 = ratio^2 as a quadratic equation of r^2.
    half = 1 - 2 * damping**2
    roots = np.sqrt(half + np.array([-1, 1]) * math.sqrt(half**2 - 1 + ratio**2))
    (low, inner), (outer, high) = found["within"]
    assert (low, high) == (0.5, 1.5003) and found["displacement"] == "driven"
    np.testing.assert_allclose([inner, outer], roots, atol=3e-4)
    assert amplitude(np.array([inner, outer])).max() <= TWO.value
    assert found["largest"] > 4.0 and found["where"] == pytest.approx(1.0, abs=2e-4)
    assert "above the limit of 2 deg; within the limit from 0.5 to " in text


@pytest.mark.parametrize("damping", [1e-3, 1e-5, 1e-7])
def test_the_largest_amplitude_is_that_of_a_sharp_peak(damping):
    """The curve has its peak 1/(2 D sqrt(1 - D^2)) up to a million times narrower than the distance of the samples."""
    likely = np.array([1.0001])
    _, found = TWO.along(lambda r: 1 / np.hypot(1 - r**2, 2 * damping * r)[:, None], 0.5, 1.5003, likely, str)
    assert found["largest"] * 2 * damping == pytest.approx(1.0, rel=1e-3)


def test_a_curve_below_the_limit_is_within_it():
    text, found = TWO.along(lambda r: np.full((r.size, 2), 0.01), 1.0, 2.0, np.empty(0), str)
    assert found["within"] == [[1.0, 2.0]] and "within the limit of 2 deg" in text
    assert TWO.along(lambda r: np.full((r.size, 2), 1.0), 1.0, 2.0, np.empty(0), str)[1]["within"] == []


def test_displacements_without_names_have_numbers():
    limit = Limit.from_text(dt.Driveline, "2 deg")
    assert limit.along(lambda r: r[:, None] * [0.1, 0.2], 1.0, 2.0, np.empty(0), str)[1]["displacement"] == "2"
    assert list(limit.at_point(np.array([0.1, 0.2]), 0)[1]["amplitude"]) == ["1", "2"]


@pytest.mark.full
@pytest.mark.parametrize(("limit", "within"), [("2 deg", True), ("1.5 deg", False), (0.03, True)])
def test_a_point_compares_its_forced_motion_with_a_limit(limit, within):
    found = dt.point("cardan", "floquet", **DATA, speed=2000.0, amplitude=limit)
    expected = dt.point("cardan", "forced", **DATA, speed=2000.0, outputs=["amplitude"]).amplitude
    text, data = found.forced
    np.testing.assert_allclose(list(data["amplitude"].values()), expected, rtol=1e-9)
    assert data["within"] is within and ("; within the limit" in text) is within
    assert json.loads(found.to_json())["forced"]["within"] is within


@pytest.mark.full
def test_an_unstable_motion_is_never_within_a_limit(capsys):
    assert main(["point", "cardan", "floquet", *WORDS, "speed=1425", "--amplitude", "80 deg"]) == 0
    assert "driven 2.67463 deg; unstable: the motion grows beyond the limit of 80 deg" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("amplitude", "verdict", "within", "text"),
    [
        (0.01, 0, True, "within the limit of 2 deg"),
        (0.01, 1, False, "unstable: the motion grows beyond the limit of 2 deg"),
        (0.01, 2, None, "within the limit of 2 deg if the motion is stable, which is undecided"),
        (0.05, 2, False, "above the limit of 2 deg"),
        (math.nan, 0, None, "no value"),
    ],
)
def test_what_is_not_known_is_not_within_a_limit(amplitude, verdict, within, text):
    said, data = TWO.at_point(np.array([0.0, amplitude]), verdict)
    assert data["within"] is within and said.endswith(text)
    assert json.loads(json.dumps(data, allow_nan=False)) == data


@pytest.mark.full
def test_limits_that_mean_nothing_are_refused(capsys):
    for words, message in (
        ([*WORDS, "speed=2000", "--amplitude", "2"], 'did you mean "2 deg"?'),
        ([*WORDS, "speed=2000", "--amplitude", "2 kg"], "kg is a unit of another quantity"),
        ([*WORDS, "speed=2000", "--amplitude", "-1 deg"], "expected 0 < amplitude"),
    ):
        assert main(["point", "cardan", "floquet", *words]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(dt.InputError, match="has no forced response"):
        dt.point("planetary", "modes", amplitude="1 deg")


@pytest.mark.full
def test_windows_of_an_atlas_say_where_the_amplitude_is_within_the_limit():
    axes = {"speed": {"start": "1900 rpm", "stop": "2100 rpm"}}
    atlas = stored_atlas({"system": "cardan", "analysis": "atlas", "fixed": DATA, "axes": axes})
    reply = atlas_answers.speed_windows(atlas, {}, amplitude="1.6 deg")
    (found,) = reply.data["forced"]
    assert "above the limit of 1.6 deg; within the limit from" in str(reply)
    for omega in found["within"][0]:
        assert atlas.amplitude({"Omega": np.array([omega])}).max() <= 1.6 * math.pi / 180 * (1 + 1e-6)
    inside = found["within"][0][0] + 1e-3
    assert atlas.amplitude({"Omega": np.array([inside - 2e-3])}).max() > 1.6 * math.pi / 180
