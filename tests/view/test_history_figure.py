"""Figures of histories."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.motions import thinned
from drivetrain_jax.view.style import axis_label, value_text, written_units
from tests.view.results import texts

TIMES = np.linspace(0, 0.01, 101)


def history(**axes: list[float]) -> xr.Dataset:
    """A damped oscillation of 1e-4 rad at 1 kHz, the same at every point."""
    shape = tuple(len(values) for values in axes.values())
    angle = 2e3 * np.pi * TIMES
    phi = np.broadcast_to(1e-4 * np.exp(-100 * TIMES) * np.cos(angle), (*shape, TIMES.size)).copy()
    dims = (*axes, "time")
    data = {
        "phi": (dims, phi, {"units": "rad", "long_name": "twist"}),
        "velocity": (dims, 5e3 * phi, {"units": "rad/s", "long_name": "rate of twist"}),
        "outcome": (tuple(axes), np.zeros(shape, "int8")),
    }
    coords = {name: (name, values, {"units": "1", "long_name": name}) for name, values in axes.items()}
    coords["time"] = ("time", TIMES, {"units": "s", "long_name": "time"})
    state = [
        {"name": "phi", "units": "rad", "long_name": "twist", "symbol": ""},
        {"name": "velocity", "units": "rad/s", "long_name": "rate of twist", "symbol": "$v$"},
    ]
    fixed = json.dumps({"beta": {"value": 0.1, "units": "1"}})
    attrs = {"analysis": "history", "title": "A twist", "fixed_parameters": fixed, "state": json.dumps(state)}
    return xr.Dataset(data, coords, attrs)


def test_one_history_in_four_panels():
    dataset = history()
    figure = plot(dataset)
    twist, rate, portrait, space = figure.axes
    assert space.name == "3d"
    np.testing.assert_array_equal(twist.lines[0].get_ydata(), dataset.phi)
    np.testing.assert_array_equal(rate.lines[0].get_ydata(), dataset.velocity)
    np.testing.assert_array_equal(portrait.lines[0].get_xdata(), dataset.phi)
    np.testing.assert_array_equal(portrait.lines[0].get_ydata(), dataset.velocity)
    along = space.lines[0].get_data_3d()
    for found, expected in zip(along, (dataset.phi, dataset.velocity, TIMES), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert {"A twist", r"$\beta$ = 0.1", "(a)", "(b)", "(c)", "(d)"} <= set(texts(figure))
    assert (twist.get_ylabel(), rate.get_ylabel()) == (r"$\phi$ [rad]", "$v$ [rad/s]")


def test_an_axis_is_a_row_of_panels_for_each_value():
    figure = plot(history(zeta=[0.01, 0.02]))
    assert len(figure.axes) == 6
    labels = [title for axes in figure.axes if (title := axes.get_title())]
    assert labels == [r"$\zeta$ = 0.01", r"$\zeta$ = 0.02"]
    assert [bool(axes.get_xlabel()) for axes in figure.axes] == [False] * 3 + [True] * 3


def test_history_without_values_says_so():
    dataset = history(zeta=[0.01, 0.02])
    for name in ("phi", "velocity"):
        dataset[name][1] = np.nan
    figure = plot(dataset)
    shown = [[text.get_text() for text in axes.texts] for axes in figure.axes]
    assert ["no values" in panel for panel in shown] == [False] * 3 + [True] * 3


def test_nothing_to_plot_is_an_input_error():
    with pytest.raises(InputError, match="velocity missing; the figure needs phi and velocity"):
        plot(history().drop_vars("velocity"))
    with pytest.raises(InputError, match="axes = zeta: expected one axis of up to 8 values"):
        plot(history(zeta=np.linspace(0, 1, 9).tolist()))
    with pytest.raises(InputError, match="axes = zeta, beta: expected one axis"):
        plot(history(zeta=[0.1, 0.2], beta=[0.1, 0.2]))


@pytest.mark.parametrize(
    ("units", "text"),
    [
        ("1", "1"),
        ("m2", "m²"),
        ("kg m2", "kg m²"),
        ("N/m^3", "N/m³"),
        ("kg/m3", "kg/m³"),
        ("N m/rad", "N m/rad"),
        ("1/s", "1/s"),
        ("s-1", "s⁻¹"),
        ("kN", "kN"),
        ("rad/s2", "rad/s²"),
        ("m10", "m¹⁰"),
    ],
)
def test_units_as_people_write_them(units, text):
    assert written_units(units) == text
    assert value_text("a", 1.5, units) == ("$a$ = 1.5" if units == "1" else f"$a$ = 1.5 {text}")
    assert axis_label(xr.DataArray(0.0, name="a", attrs={"units": units, "long_name": "b"})) == (
        "b ($a$)" if units == "1" else f"b ($a$) [{text}]"
    )


def test_many_turns_are_thinned():
    """The curve in space shows all of 10 turns, but only 40 of 300 turns."""
    assert len(plot(history()).axes[-1].lines) == 1
    time = np.linspace(0, 1, 30_001)
    decay, angle = np.exp(-2 * time), 600 * np.pi * time
    curve = np.stack([decay * np.cos(angle), -600 * np.pi * decay * np.sin(angle), time])
    turns = thinned(curve)
    shown = np.isfinite(turns[0])
    assert 0.12 < shown.mean() < 0.15 and (turns[:, shown] == curve[:, shown]).all()
    assert shown[0] and shown[-1]
