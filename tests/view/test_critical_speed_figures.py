"""Figures of critical speeds: scales, bands, and refused results."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.contour import QuadContourSet

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from tests.view.results import texts

MODE = ("mode", [1, 2, 3])


def result(data: dict, coords: dict) -> xr.Dataset:
    attrs = {"analysis": "critical_speeds", "title": "A shaft"}
    described = {
        name: (dims, values, {"units": "N/m", "long_name": f"stiffness {name}"})
        for name, (dims, values) in coords.items()
    }
    return xr.Dataset(data, described | {"mode": MODE}, attrs)


def speeds(values: np.ndarray, dims: tuple[str, ...]) -> tuple:
    return dims, values, {"units": "rpm", "long_name": "critical speed"}


@pytest.fixture
def swept() -> xr.Dataset:
    k = np.geomspace(1e4, 1e10, 25)
    base = np.sqrt(k / (k + 1e7))[:, None] * np.array([8e3, 3e4, 6e4])
    certified = np.ones((25, 3), "int8")
    certified[3, 2] = 0
    data = {
        "critical_speed": speeds(base, ("k_D", "mode")),
        "count_certified": (("k_D", "mode"), certified),
        "outcome": ("k_D", np.zeros(25, "int8")),
    }
    return result(data, {"k_D": ("k_D", k)})


def test_map_is_logarithmic_and_crosses_uncertified_points(swept):
    figure = plot(swept)
    axes = figure.axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    curves = [line for line in axes.get_lines() if len(line.get_xdata()) == 25]
    assert len(curves) == 3
    np.testing.assert_array_equal(curves[1].get_ydata(), swept.critical_speed[:, 1])
    crosses = [line for line in axes.get_lines() if line.get_marker() == "x"]
    assert [list(line.get_xdata()) for line in crosses if len(line.get_xdata())] == [[swept.k_D.values[3] / 1e6]]
    assert "not certified by the count" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize("points", [False, True])
def test_a_rigid_support_has_no_place_on_the_axis_and_is_told(swept, points):
    stiffness = swept.k_D.values.copy()
    stiffness[-1] = np.inf
    rigid = swept.assign_coords(k_D=("k_D", stiffness, swept.k_D.attrs))
    figure = plot(rigid.swap_dims(k_D="point").reset_coords("k_D").set_coords("k_D") if points else rigid)
    curves = [line for line in figure.axes[0].get_lines() if len(line.get_xdata()) == 24]
    np.testing.assert_array_equal(curves[0].get_xdata(), stiffness[:-1] / 1e6)
    assert any("$k_{D}$ = inf left out" in text for text in texts(figure))


@pytest.mark.parametrize(
    ("variable", "low", "drawn"),
    [
        ("critical_speed", 3e3, (3e3, 9e3)),
        ("natural_frequency", 3e3, (50.0, 150.0)),
        ("critical_speed", 0.0, (None, 9e3)),
    ],
)
def test_operating_speeds_are_a_band(swept, variable, low, drawn):
    """The band is in the units of the axis; from standstill, which a logarithmic axis lacks, it begins at the lower edge."""
    options = json.dumps({"operating_min": low, "operating_max": 9e3})
    renamed = swept.rename(critical_speed=variable).assign_attrs(options=options)
    renamed[variable].attrs["units"] = "Hz" if variable == "natural_frequency" else "rpm"
    figure = plot(renamed)
    (band,) = [patch for patch in figure.axes[0].patches if patch.get_label() == "operating speeds"]
    assert band.get_y() + band.get_height() == pytest.approx(drawn[1])
    bottom = figure.axes[0].get_ylim()[0]
    assert band.get_y() == pytest.approx(drawn[0]) if drawn[0] else 0 < band.get_y() <= bottom * 1.5
    assert "operating speeds" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_maps_show_where_a_mode_meets_the_operating_speeds():
    """Critical speeds are k_A + k_D + 10 mode: mode 1 meets both limits, mode 2 the upper limit, mode 3 none."""
    k = np.linspace(1.0, 9.0, 9)
    values = k[:, None, None] + k[:, None] + 10 * np.arange(1, 4)
    data = {
        "critical_speed": speeds(values, ("k_A", "k_D", "mode")),
        "outcome": (("k_A", "k_D"), np.zeros((9, 9), "int8")),
    }
    dataset = result(data, {"k_A": ("k_A", k), "k_D": ("k_D", k)})
    figure = plot(dataset.assign_attrs(options=json.dumps({"operating_min": 17.0, "operating_max": 25.0})))
    found = [
        [lines for lines in axes.collections if isinstance(lines, QuadContourSet) and len(lines.levels) == 1]
        for axes in figure.axes
        if axes.get_label() != "<colorbar>"
    ]
    assert [[float(lines.levels[0]) for lines in each] for each in found] == [[17.0, 25.0], [25.0], []]
    for lines, total in zip((*found[0], *found[1]), (7.0, 15.0, 5.0), strict=True):
        np.testing.assert_allclose(np.concatenate(lines.allsegs[0]).sum(axis=1), total)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["lowest operating speed", "highest operating speed"]
    # The joints bend the shaft twice a turn: at 10 rpm they meet the first mode where it is 20 rpm.
    limits = json.dumps({"operating_min": 0.0, "operating_max": 10.0})
    figure = plot(dataset.assign_attrs(options=limits, system="bicardan"))
    (lines, _) = [each for each in figure.axes[0].collections if isinstance(each, QuadContourSet)]
    np.testing.assert_allclose(np.concatenate(lines.allsegs[0]).sum(axis=1), 10.0)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["highest operating speed, order 2 (joints)"]


def test_a_margin_below_the_required_one_is_marked(swept):
    """Mode 1 misses the margin at its three last points."""
    gap = np.full((25, 3), 0.5)
    gap[-3:, 0] = 0.1
    margins = {
        "separation_margin": (("k_D", "mode"), gap),
        "required_margin": (("k_D", "mode"), np.full((25, 3), 0.26)),
    }
    figure, told = plot(swept.assign(margins)), "less than the required separation margin"
    (marked,) = [
        line for line in figure.axes[0].get_lines() if line.get_linewidth() == 5 and np.isfinite(line.get_ydata()).any()
    ]
    assert np.flatnonzero(np.isfinite(marked.get_ydata())).tolist() == [22, 23, 24]
    assert told in [text.get_text() for text in figure.legends[0].get_texts()]
    both = xr.concat([swept.assign(margins)] * 3, xr.DataArray([1.0, 2.0, 3.0], dims="k_A", name="k_A")).transpose(
        "k_A", ...
    )
    both = both.assign(outcome=(("k_A", "k_D"), np.zeros((3, 25), "int8"))).drop_vars("count_certified")
    figure = plot(both)
    hatched = [c for axes in figure.axes for c in axes.collections if isinstance(c, QuadContourSet) and any(c.hatches)]
    assert told in [text.get_text() for text in figure.legends[0].get_texts()] and len(hatched) == 3


def test_joints_meet_the_modes_at_half_of_their_critical_speeds(swept):
    figure = plot(swept.assign_attrs(system="bicardan"))
    curves = [np.asarray(line.get_ydata()) for line in figure.axes[0].get_lines() if len(line.get_xdata()) == 25]
    assert len(curves) == 6
    for first, second in zip(curves[:3], curves[3:], strict=True):
        np.testing.assert_allclose(2 * second, first, rtol=1e-15)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[:2] == ["order 1", "order 2 (joints)"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["mode 1", "mode 2", "mode 3"]


def test_mode_shapes_are_named(swept):
    x = np.linspace(0, 1, 11)
    data = {
        "mode_shape": (("mode", "x"), np.sin(np.outer([1, 2, 3], np.pi * x))),
        "critical_speed": speeds(np.array([8e3, 3e4, 6e4]), ("mode",)),
        "outcome": ((), np.int8(0)),
    }
    figure = plot(result(data, {}).assign_coords(x=("x", x, {"units": "1", "long_name": "distance"})))
    assert figure.axes[0].get_title(loc="left") == "mode 1: critical speed 8000 rpm"


@pytest.mark.parametrize(("value", "shown"), [(np.nan, "nan"), (0.0, "0")])
def test_results_without_a_positive_value_are_refused(swept, value, shown):
    empty = swept.assign(critical_speed=swept.critical_speed.copy(data=np.full((25, 3), value)))
    line = rf"^critical_speed = {shown}: nothing to plot; expected a result with a positive value$"
    with pytest.raises(InputError, match=line):
        plot(empty)
    with pytest.raises(InputError, match=line):
        plot(empty.isel(k_D=[0, 1]).expand_dims(k_A=[1.0, 2.0]))


@pytest.mark.full
def test_shapes_are_drawn_over_the_shaft_with_its_points():
    fixed = {"length": [0.3, 1.2, 0.5], "EI": [16.0, 256.0, 1.0], "k_A": 5e6, "k_D": np.inf, "k_joint": [0.0, 2e6]}
    fixed |= {"m_joint": [8.0, 0.0], "k_hinge": [1e5, np.inf], "I_D": 0.1}
    data = {
        "mode_shape": (("mode", "x"), np.ones((3, 5))),
        "critical_speed": speeds(np.array([1e3, 2e3, 3e3]), ("mode",)),
    }
    shapes = result(data | {"outcome": ((), np.int8(0))}, {}).assign_coords(x=np.linspace(0, 1, 5))
    shapes.attrs["fixed_parameters"] = json.dumps({name: {"value": value} for name, value in fixed.items()})
    figure = plot(shapes)
    axes = figure.axes[0]
    boxes = [(box.get_x(), box.get_width(), box.get_height()) for box in axes.patches]
    np.testing.assert_allclose(boxes, [(0, 0.3, 0.15), (0.3, 1.2, 0.3), (1.5, 0.5, 0.075)])
    points = {line.get_marker(): list(line.get_xdata()) for line in axes.get_lines()}
    assert points["^"] == [0.0, 1.5, 2.0] and points["s"] == [0.3, 2.0] and points["o"] == [0.3]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["support", "mass", "hinge"]
    assert list(axes.get_lines()[-1].get_xdata()) == [0.0, 0.5, 1.0, 1.5, 2.0]
    # Axes of one value are parts of the shaft, too.
    shorter = plot(shapes.assign_coords({"length[1]": 0.2, "k_A": 0.0})).axes[0]
    assert list(shorter.get_lines()[0].get_xdata()) == [0.5, 1.0]


def test_whirl_over_turns_is_in_hertz_and_its_numbers_stay_inside():
    """Two modes that do not depend on the speed: order 1 crosses one of them near the right end, forward whirl alone."""
    rpm = np.linspace(0.0, 6000.0, 61)
    frequency = 2 * np.pi * np.broadcast_to([20.0, 20.0, 99.0, 99.0], (61, 4))
    senses = {"flag_values": np.int8([0, 1, 2]), "flag_meanings": "backward planar forward"}
    data = {
        "whirl_frequency": (("speed", "mode"), frequency, {"units": "rad/s", "long_name": "whirl frequency"}),
        "whirl_direction": (("speed", "mode"), np.broadcast_to(np.int8([0, 2, 0, 2]), (61, 4)), senses),
        "outcome": ("speed", np.zeros(61, "int8")),
    }
    coords = {"speed": ("speed", rpm, {"units": "rpm", "long_name": "speed"}), "mode": ("mode", [1, 2, 3, 4])}
    attrs = {"system": "bicardan", "analysis": "whirl", "title": "A shaft", "fixed_parameters": "{}"}
    axes = plot(xr.Dataset(data, coords, attrs)).axes[0]
    assert "[Hz]" in axes.get_ylabel() and axes.get_ylim()[1] == pytest.approx(1.05 * 99)
    numbers = {text.get_text(): text for text in axes.texts}
    assert numbers["1200"].get_ha() == "left" and numbers["5940"].get_ha() == "right"
