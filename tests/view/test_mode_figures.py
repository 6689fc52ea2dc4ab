"""Figures of modes: curves, shapes, colours, and refused results."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex

from drivetrain_jax import InputError
from drivetrain_jax.systems.planetary import coordinate_names
from drivetrain_jax.view import plot
from drivetrain_jax.view.frequencies import displacements, type_colours
from tests.view.results import texts

TYPES = ("rigid", "rotational", "translational", "planet", "coupled")
FIXED = {"planet_angle": {"value": [0.0, 2.0, 4.0], "units": "rad", "long_name": "angle"}}


ROLES = json.dumps({"planets": "planet_angle"})


def result(points: int, **variables) -> xr.Dataset:
    attrs = {"analysis": "modes", "title": "Modes", "fixed_parameters": json.dumps(FIXED), "roles": ROLES}
    flags = {"flag_values": np.arange(5, dtype="int8"), "flag_meanings": " ".join(TYPES), "units": "1"}
    data = {"outcome": (("k_p",), np.zeros(points, "int8"), {"units": "1"})}
    for name, values in variables.items():
        dims = ("k_p", "mode", "dof")[: np.ndim(values)]
        data[name] = (dims, values, flags if name == "mode_type" else {"units": "Hz", "long_name": name})
    axis = ("k_p", np.arange(1.0, points + 1), {"units": "N/m", "long_name": "stiffness"})
    return xr.Dataset(data, coords={"k_p": axis}, attrs=attrs)


def crossing() -> xr.Dataset:
    """A rotational and a translational branch that cross, and a rigid mode."""
    x = np.arange(6.0)
    rising, falling = 100 + 10 * x, 140 - 10 * x
    frequency = np.stack([0 * x, np.minimum(rising, falling), np.maximum(rising, falling)], axis=1)
    first = rising <= falling
    kinds = np.stack([0 * x, np.where(first, 1, 2), np.where(first, 2, 1)], axis=1).astype("int8")
    branch = np.stack([0 * x + 1, np.where(first, 2, 3), np.where(first, 3, 2)], axis=1).astype("int32")
    return result(6, natural_frequency=frequency, mode_type=kinds, branch=branch)


def test_points_without_a_value_are_bands():
    dataset = crossing()
    dataset["outcome"][2] = 2
    dataset["natural_frequency"][2] = np.nan
    figure = plot(dataset)
    assert "failed (1)" in [text.get_text() for box in figure.legends for text in box.get_texts()]


def test_branches_keep_colour_and_direction_through_a_crossing():
    axes, of = plot(crossing()).axes[0], type_colours(crossing())
    curves = axes.collections
    colours = [{to_hex(colour) for colour in curve.get_colors()} for curve in curves]
    assert colours == [{of["rotational"]}, {of["translational"]}]
    slopes = [np.diff(np.array(curve.get_segments())[:, :, 1], axis=1) for curve in curves]
    np.testing.assert_allclose(slopes[0], 10)
    np.testing.assert_allclose(slopes[1], -10)


def test_without_branches_curves_follow_the_order_of_frequencies():
    axes, of = plot(crossing().drop_vars("branch")).axes[0], type_colours(crossing())
    below, above = (np.array(curve.get_segments())[:, :, 1] for curve in axes.collections)
    assert (below <= above).all() and below.max() == 120
    colours = [{to_hex(colour) for colour in curve.get_colors()} for curve in axes.collections]
    assert colours == [{of["rotational"], of["translational"]}] * 2


def test_a_coupled_branch_has_the_colour_of_its_dominant_family():
    found = crossing()
    family = {"flag_values": np.arange(4, dtype="int8"), "flag_meanings": "rotational translational planet none"}
    found["dominant_family"] = found["mode_type"].dims, np.maximum(found["mode_type"].values - 1, 0), family
    found["mode_type"] = found["mode_type"].where(found["mode_type"] == 0, 4).astype("int8")
    figure, of = plot(found), type_colours(found)
    colours = [{to_hex(colour) for colour in curve.get_colors()} for curve in figure.axes[0].collections]
    assert colours == [{of["rotational"]}, {of["translational"]}]
    assert any("dominant family" in text for text in texts(figure))


def test_a_split_of_three_hertz_is_drawn_in_hertz():
    x = np.arange(6.0)
    frequency = np.stack([0 * x, 1000 + x, 1003 + x, 5000 + 100 * x, 5000 + 100 * x], axis=1)
    upper, lower = plot(result(6, natural_frequency=frequency)).axes
    np.testing.assert_allclose(lower.lines[0].get_ydata(), 3.0)
    # A double frequency that never splits, and far neighbours, have no line.
    assert [line.get_label() for line in lower.lines] == ["modes 2 and 3"]
    assert "distance" in lower.get_ylabel() and upper.get_ylabel() == "natural_frequency [Hz]"


def shapes(planets: int = 3) -> xr.Dataset:
    size = 9 + 3 * planets
    frequency = np.array([[0.0, 5.0, 5.0, *range(10, 10 + size - 3)]], float)
    kinds = np.full((1, size), 2, "int8")
    found = result(1, natural_frequency=frequency, mode_type=kinds, mode_shape=np.eye(size)[None])
    return found.assign_coords(dof=list(coordinate_names(planets)))


def test_one_gear_for_every_frequency():
    figure = plot(shapes())
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles[:3] == ["0.0 Hz, translational", "5.0 Hz ×2, translational", "10.0 Hz, translational"]
    assert len(titles) == 16
    assert any("1 higher frequencies not drawn" in text for text in texts(figure))


@pytest.mark.parametrize(
    ("name", "attrs"), [("planet_angle_1", {"parameter": "planet_angle[1]"}), ("planet_angle[1]", {})]
)
def test_the_caption_says_which_angle_varies(name, attrs):
    """The caption is right for current files, and for older files, whose dimensions have the names of scenes."""
    swept = crossing().rename(k_p=name)
    swept[name].attrs.update(attrs)
    shown = texts(plot(swept))
    assert "planet angle = [0, varies, 4] rad" in shown and any("planet angle[1]" in text for text in shown)


def test_without_translations_the_carrier_carries_the_planets():
    central, planets = displacements({"u_c": 1.0, "u_r": 0.0, "u_s": -2.0, "u_1": 0.5, "u_2": 0.0}, 2)
    np.testing.assert_allclose(central, 0.14 * np.array([[0, 0, 1], [0, 0, 0], [0, 0, -2]]))
    np.testing.assert_allclose(planets, 0.14 * np.array([[0, 1, 0.5], [0, 1, 0]]))


@pytest.mark.parametrize(
    ("dataset", "named"),
    [
        (shapes().drop_vars("mode_shape"), "mode_shape"),
        (crossing().drop_vars("natural_frequency"), "natural_frequency"),
        (shapes().assign_attrs(fixed_parameters="{}"), "planet_angle"),
        (
            result(2, natural_frequency=np.full((2, 3), np.nan)),
            "^natural_frequency = nan: nothing to plot; expected a result with a positive value$",
        ),
        (result(2, natural_frequency=np.zeros((2, 3))), "^natural_frequency = 0: nothing to plot"),
    ],
)
def test_refusals(dataset, named):
    with pytest.raises(InputError, match=named):
        plot(dataset)
