import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.motions import followed
from drivetrain_jax.view.style import FLAG_COLOURS
from tests.view.results import legend

FIXED = json.dumps({"b": {"value": 0.17, "units": "m", "long_name": "half the backlash"}})
ROLES = json.dumps({"speed": "omega", "initial_displacement": "u0", "initial_rate": "v0", "half_play": "b"})


def result(axes, **variables):
    dims = tuple(axes)
    shape = tuple(len(values) for values in axes.values())
    data = {"outcome": (dims, np.zeros(shape, np.int8))}
    flags = {"regime": {"flag_meanings": "no_separation single_sided double_sided non_periodic"}}
    data |= {name: (dims, np.asarray(values), flags.get(name, {})) for name, values in variables.items()}
    coords = {
        name: (name, np.asarray(values, float), {"units": "1", "long_name": name}) for name, values in axes.items()
    }
    attrs = {"analysis": "steady_state", "title": "a title", "fixed_parameters": FIXED, "roles": ROLES}
    return xr.Dataset(data, coords, attrs)


def test_a_map_shows_regimes_and_the_threshold():
    regime = np.array([[0, 1, 2], [1, 2, 3]])
    dataset = result({"omega": [0.5, 1.0], "B1": [0.1, 0.2, 0.3]}, regime=regime, u_max=regime + 0.5)
    dataset["outcome"][0, 1] = 2
    dataset = dataset.assign_coords(
        resonance=("resonance", ["no separation ends"]), resonance_B1=(("omega", "resonance"), [[0.15], [0.25]])
    )
    figure = plot(dataset)
    shown = legend(figure)
    assert {"no separation (1)", "double sided (2)", "non periodic (1)", "failed (1)", "no separation ends"} <= set(
        shown
    )
    (line,) = [line for line in figure.axes[0].lines if line.get_label() == "no separation ends"]
    np.testing.assert_allclose(line.get_ydata(), [0.15, 0.25])


def test_an_attractor_keeps_its_colour_where_a_larger_one_ends():
    """Results are in order of size, so the smaller attractor is the second and later the first; chaos has no size."""
    nan = np.nan
    size = np.array([[0.5, 0.3, nan], [0.55, 0.29, nan], [0.28, nan, nan], [nan, 0.27, nan]])
    share = np.array([[0.6, 0.4, nan], [0.5, 0.5, nan], [0.9, 0.1, nan], [0.2, 0.8, nan]])
    branch = followed(size, np.isfinite(share), np.isfinite(size))
    assert branch.tolist() == [[0, 1, -1], [0, 1, -1], [1, 2, -1], [2, 1, -1]]


@pytest.mark.parametrize(
    ("size", "multiple", "branch"),
    [
        ([1.0, np.nan, 1.0], [1, 0, 1], [0, -1, 0]),
        ([1.0, 1.0, 1.0], [1, 4, 1], [0, 1, 0]),
        ([1.0, 1.2, 1.55, 2.0], [1, 1, 1, 1], [0, 0, 0, 0]),
        ([1.0, 1.0, 1.55], [1, 1, 1], [0, 0, 1]),
        ([0.0, 0.0, 1.0], [1, 1, 1], [0, 0, 1]),
        ([1.0, 1.2, 1.5, 1.8, 1.6], [1, 1, 1, 1, 1], [0, 0, 0, 0, 0]),
    ],
)
def test_a_branch_keeps_its_period_and_goes_on_after_a_gap(size, multiple, branch):
    size = np.array(size)[:, None]
    found = followed(size, np.isfinite(size), np.array(multiple)[:, None])
    assert found[:, 0].tolist() == branch


def basin(multiple):
    """Four values of omega with one attractor each, all of the same size."""
    size = np.full((4, 1), 0.5)
    dataset = result({"omega": [1.0, 2.0, 3.0, 4.0]}).assign_attrs(analysis="basins")
    dataset["attractor_u_max"] = (("omega", "attractor"), size, {"units": "m"})
    dataset["basin_fraction"] = (("omega", "attractor"), np.ones((4, 1)))
    dataset["attractor_multiple"] = (("omega", "attractor"), np.array(multiple)[:, None])
    return dataset


def test_basins_show_the_share_of_every_attractor():
    high = np.array([[0.5, 0.5, 0.7], [0.5, 0.7 * (1 + 1e-7), 0.5]])
    axes = {"u0": [-1.0, 1.0], "v0": [-1.0, 0.0, 1.0]}
    dataset = result(axes, u_max=high, period_multiple=np.ones((2, 3), int))
    dataset["u_max"].attrs["units"] = "m"
    figure = plot(dataset)
    assert legend(figure) == ["period 1, largest u 0.5 m: 66.7% (4)", "period 1, largest u 0.7 m: 33.3% (2)"]


def test_curves_show_both_flanks_and_bands_of_the_regimes():
    """Impact velocity and contact fraction have both flanks; every value of the axis is a band in its regime's colour."""
    omega, by_flank = [0.5, 1.0, 1.5], np.array([[1.0, np.nan], [2.0, 0.5], [3.0, 0.7]])
    dataset = result({"omega": omega}, u_max=[1.0, 2.0, 3.0], regime=[1, 2, 0])
    for name in ("impact_velocity", "contact_fraction"):
        dataset[name] = ("omega", "flank"), by_flank, {"units": "1", "long_name": name}
    dataset = dataset.assign_coords(flank=["drive", "back"])
    figure = plot(dataset)
    regimes = ["no separation (1)", "single sided (1)", "double sided (1)"]
    assert legend(figure) == ["drive flank", "back flank", "flanks", *regimes]
    extremes, *others = figure.axes
    assert sorted(line.get_ydata()[0] for line in extremes.lines if line.get_label() == "flanks") == [-0.17, 0.17]
    for axes in others:
        np.testing.assert_array_equal([line.get_ydata() for line in axes.lines], by_flank.T)
    for axes in figure.axes:
        (bands,) = axes.collections
        np.testing.assert_array_equal(bands.get_coordinates()[0, :, 0], [0.25, 0.75, 1.25, 1.75])
        pale = [0.65 + 0.35 * np.array(to_rgb(FLAG_COLOURS[flag])) for flag in ("single_sided", "double_sided")]
        np.testing.assert_allclose(bands.to_rgba([1.0, 2.0])[:, :3], pale)


def test_a_single_value_of_the_axis_is_said_to_be_one():
    with pytest.raises(InputError, match=r"axes = omega \(one value\): expected one axis of several values"):
        plot(basin([1, 1, 1, 1]).isel(omega=[0]))


def test_a_motion_shows_history_and_phase_portrait():
    part = np.arange(16) / 16
    dataset = result({"omega": [0.5]}).assign_coords(sample=("sample", part))
    dataset["u_history"] = (("omega", "sample"), np.sin(2 * np.pi * part)[None])
    dataset["v_history"] = (("omega", "sample"), np.cos(2 * np.pi * part)[None])
    figure = plot(dataset)
    # The phase portrait is a closed curve.
    portrait = figure.axes[2].lines[0]
    assert portrait.get_xdata()[0] == portrait.get_xdata()[-1] and legend(figure) == [
        "flanks",
        "start of a drive period",
    ]
