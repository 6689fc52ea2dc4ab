"""Figures and tables of constants."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.style import caption
from tests.view.results import texts

BETA = np.linspace(0, 0.15, 16)


def constants(*axes: str) -> xr.Dataset:
    shape = (BETA.size,) * len(axes)
    along = np.broadcast_to(9636 - 100 * BETA**2, shape) if axes else np.array(9633.726700903984)
    data = {
        "natural_angular_frequency": (axes, along, {"units": "rad/s", "long_name": "natural angular frequency"}),
        "midshaft_frequency": (
            (*axes, "mode"),
            np.broadcast_to([1669.0, 3338.0], (*shape, 2)),
            {"units": "Hz", "long_name": "frequency of the midshaft"},
        ),
        "outcome": (axes, np.zeros(shape, "int8")),
    }
    coords = {name: (name, BETA, {"units": "rad", "long_name": "joint angle"}) for name in axes}
    return xr.Dataset(data, coords | {"mode": [1, 2]}, {"analysis": "parameters", "title": "Constants"})


def test_constants_over_one_axis_are_curves():
    dataset = constants("beta")
    frequency, midshaft = plot(dataset).axes
    np.testing.assert_array_equal(frequency.lines[0].get_ydata(), dataset.natural_angular_frequency)
    assert [set(line.get_ydata()) for line in midshaft.lines] == [{1669.0}, {3338.0}]


def test_constants_without_an_axis_are_a_table():
    shown = texts(plot(constants()))
    row = shown.index("natural angular frequency")
    assert shown[row : row + 3] == ["natural angular frequency", "9633.73", "rad/s"]
    assert "frequency of the midshaft, mode 2" in shown
    assert "3338" in shown


def test_caption_leaves_defaults_out():
    """The caption shows only parameters that the scene fixes."""
    fixed = '{"beta": {"value": 0.1, "units": "rad"}, "rho": {"value": 7850.0, "units": "kg/m3"}}'
    dataset = xr.Dataset(attrs={"fixed_parameters": fixed, "scene": "[fixed]\nbeta = 0.1\n"})
    assert caption(dataset) == r"$\beta$ = 0.1 rad"
    assert caption(dataset.assign_attrs(scene="[fixed]\nbeta = 0.1\nrho = 7850.0\n")).endswith("7850 kg/m³")


def test_no_constant_at_all_is_an_input_error():
    with pytest.raises(InputError, match=r"^outputs = outcome: nothing to plot; the figure needs a result$"):
        plot(constants("beta")[["outcome"]])
