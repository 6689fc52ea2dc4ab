"""Figures of frequency response: solid, dashed and dotted lines, and refused results."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import QuadMesh

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.style import FLAG_COLOURS

REGIMES = "no_separation single_sided double_sided non_periodic"
OMEGA = np.linspace(0.5, 1.5, 41)


def variable(dims, values, units="m", **attrs):
    return dims, np.asarray(values), {"units": units, "long_name": "displacement", **attrs}


def line(method: str = "multiple_scales", branches: bool = True) -> xr.Dataset:
    """A hardening line: the sweep up jumps down at 1.2, the sweep down jumps up at 0.8, and a saddle lies in between."""
    up = np.where(OMEGA < 1.2, OMEGA, 0.2)
    down = np.where(OMEGA < 0.8, OMEGA, 0.2)
    both = np.stack([up, down], axis=1)
    dims = ("omega", "sweep_direction")
    data = {
        "u_max": variable(dims, both),
        "u_min": variable(dims, -both),
        "phase": variable(dims, both, "rad"),
        "stability": variable(dims, np.zeros(both.shape, "int8"), "1"),
        "outcome": variable(("omega",), np.zeros(len(OMEGA), "int8"), "1"),
    }
    if branches:
        between = (OMEGA >= 0.8) & (OMEGA < 1.2)
        saddle = np.where(between, 0.25 + 2.25 * (OMEGA - 0.8), np.nan)
        number = np.stack([np.where(between, 0.2, up), saddle, np.where(between, up, np.nan)], axis=1)
        stability = np.stack([0 * OMEGA, np.where(between, 1, 2), np.where(between, 0, 2)], axis=1).astype("int8")
        own = ("omega", "branch")
        data |= {
            "branch_u_max": variable(own, number),
            "branch_u_min": variable(own, -number),
            "branch_stability": variable(own, stability, "1"),
        }
    attrs = {"analysis": "frequency_response", "title": "A line", "method": method}
    attrs |= {"fixed_parameters": "{}", "options": json.dumps({"harmonics": 7}), "roles": '{"speed": "omega"}'}
    dataset = xr.Dataset(data, attrs=attrs).assign_coords(sweep_direction=["up", "down"])
    return dataset.assign_coords(omega=("omega", OMEGA, {"units": "rad/s", "long_name": "frequency of the drive"}))


def lines_of(axes, style: str) -> list:
    kinds = {"-": "-", ":": ":"}
    if style in kinds:
        return [item for item in axes.lines if item.get_linestyle() == kinds[style]]
    return [item for item in axes.lines if item.get_linestyle() == "--"]


def with_fixed(dataset: xr.Dataset, **values: float) -> xr.Dataset:
    fixed = {name: {"value": value, "units": "1"} for name, value in values.items()}
    return dataset.assign_attrs(fixed_parameters=json.dumps(fixed))


def test_results_in_one_figure_differ_only_by_method():
    """The heading shows the parameters once, and each legend entry a different method."""
    first = with_fixed(line(), B1=0.03)
    plot(first, with_fixed(line("exact"), B1=0.03))
    with pytest.raises(InputError, match=r"B1 = 0\.02: expected the value of the first result, 0\.03"):
        plot(first, with_fixed(line("exact"), B1=0.02))
    with pytest.raises(InputError, match=r"B1 = 0\.02: expected .* 0\.03"):
        plot(first, line("exact").assign_coords(B1=0.02))
    with pytest.raises(InputError, match="'multiple scales' is given twice"):
        plot(first, first)


def test_jumps_are_dotted_and_not_bridged():
    axes = plot(line()).axes[0]
    drawn = [np.array(item.get_data()) for item in lines_of(axes, ":")]
    steps = np.concatenate([np.stack([data[0, :-1], *np.diff(data)]) for data in drawn], axis=1)
    steps = steps[:, np.isfinite(steps).all(axis=0)]
    assert np.sort(steps[0]).round(2).tolist() == [0.78, 1.18] and (np.abs(steps[2]) > 0.5).all()
    for item in lines_of(axes, "-"):
        y = item.get_ydata()
        assert np.nanmax(np.abs(np.diff(y)), initial=0.0) < 0.1


def test_frequencies_without_a_motion_are_marked():
    dataset = line()
    dataset["u_max"][3, 1] = np.nan
    dataset["u_max"][5] = np.nan
    figure = plot(dataset)
    (marks,) = [each for each in figure.axes[0].lines if each.get_marker() == "x"]
    np.testing.assert_array_equal(marks.get_xdata(), dataset["omega"].values[[3, 5]])
    assert "no motion found (2)" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_saddles_are_dashed_and_reach_the_branches_they_meet():
    dashed = [item for item in lines_of(plot(line()).axes[0], "--") if np.isfinite(item.get_ydata()).any()]
    (saddle,) = dashed
    y = saddle.get_ydata()[np.isfinite(saddle.get_ydata())]
    # One more point at either end, on the branch that meets the saddles.
    assert len(y) == ((OMEGA >= 0.8) & (OMEGA < 1.2)).sum() + 2
    assert y[0] == pytest.approx(0.2)
    assert y[-1] == pytest.approx(OMEGA[OMEGA < 1.2][-1])


def test_several_methods_share_the_axes():
    exact = line("exact", branches=False)
    figure = plot(line(), line("describing_function"), line("harmonic_balance"), exact)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "harmonic balance, 7 harmonics" in texts
    assert {"multiple scales", "describing function", "exact, up", "exact, down", "unstable"} <= set(texts)
    assert len({item.get_color() for item in figure.axes[0].lines}) >= 4


def test_map_of_two_axes():
    single = line(branches=False)
    pair = xr.concat([single, single], dim="B1", data_vars="all").assign_coords(
        B1=("B1", [0.1, 0.2], {"units": "m/s2", "long_name": "amplitude of the drive"})
    )
    pair["outcome"] = (("B1", "omega"), np.zeros((2, len(OMEGA)), "int8"))
    flags = {"flag_meanings": REGIMES, "long_name": "regime"}
    pair["regime"] = xr.zeros_like(pair["u_max"], dtype="int8").assign_attrs(flags)
    figure = plot(pair)
    assert [axes.get_title() for axes in figure.axes[:2]] == ["up sweep direction", "down sweep direction"]
    assert "no separation (164)" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(InputError, match="needs u_max and u_min"):
        plot(line().drop_vars("u_min"))
    with pytest.raises(InputError, match="expected omega"):
        plot(line().rename(omega="beta"))
    with pytest.raises(InputError, match=r"axes = omega \(one value\): expected omega of several values"):
        plot(line().isel(omega=[3]))
    with pytest.raises(InputError, match="several results"):
        plot(xr.Dataset(attrs={"analysis": "floquet"}), line())
    with pytest.raises(InputError, match="expected the analysis of the first result"):
        plot(line(), xr.Dataset(attrs={"analysis": "floquet"}))


def test_motions_that_are_not_periodic_are_dots_and_not_unstable():
    """The exact sweeps flag them as unstable, because they have no stability of their own."""
    dataset = line("exact", branches=False)
    wandering = np.stack([(OMEGA > 0.6) & (OMEGA < 0.7), np.zeros(len(OMEGA), bool)], axis=1)
    dims = ("omega", "sweep_direction")
    dataset["regime"] = variable(dims, np.where(wandering, 3, 1).astype("int8"), "1", flag_meanings=REGIMES)
    dataset["stability"] = variable(dims, wandering.astype("int8"), "1")
    figure = plot(dataset)
    axes = figure.axes[0]
    assert all(np.isnan(item.get_ydata()).all() for item in lines_of(axes, "--"))
    amber = FLAG_COLOURS["non_periodic"]
    dots = [item for item in axes.lines if item.get_color() == amber]
    drawn = np.concatenate([item.get_ydata() for item in dots])
    np.testing.assert_allclose(np.sort(drawn[np.isfinite(drawn)]), OMEGA[wandering[:, 0]])
    assert {"not periodic", "single sided (79)"} <= {text.get_text() for text in figure.legends[0].get_texts()}


def test_regimes_of_both_sweeps_are_strips_and_half_the_backlash_a_line():
    dataset = with_fixed(line("exact"), b=0.3)
    codes = np.stack([np.where(OMEGA < 1.2, 2, 1), np.where(OMEGA < 0.8, 2, 1)], axis=1).astype("int8")
    dataset["regime"] = variable(("omega", "sweep_direction"), codes, "1", flag_meanings=REGIMES)
    axes = plot(dataset.assign_attrs(roles='{"speed": "omega", "half_play": "b"}')).axes[0]
    strips = [each.get_array().ravel().tolist() for each in axes.collections if isinstance(each, QuadMesh)]
    assert strips == [codes[:, 1].tolist(), codes[:, 0].tolist()]
    assert [item.get_ydata()[0] for item in axes.lines if item.get_label() == "half the backlash"] == [0.3]


def test_folds_stand_at_their_speed_along_an_axis_of_physical_data():
    """Two excitations a turn: folds at 0.8 and 1.2 rad/s are those of 0.4 and 0.6 rad/s of the shaft; 9 rad/s is outside."""
    about = {"units": "rpm", "long_name": "speed"}
    swept = line().rename(omega="speed").assign_coords(speed=("speed", OMEGA / 2 * 30 / np.pi, about))
    swept = swept.assign_coords(omega=("speed", OMEGA, {"units": "rad/s"})).assign_attrs(roles='{"speed": "speed"}')
    folds = np.tile([0.8, 1.2, 9.0, np.nan], (len(OMEGA), 1))
    figure = plot(swept.assign(fold_frequency=variable(("speed", "fold"), folds, "rad/s")))
    drawn = [item.get_xdata()[0] for item in figure.axes[0].lines if item.get_label() == "fold"]
    np.testing.assert_allclose(drawn, np.array([0.4, 0.6]) * 30 / np.pi, rtol=1e-12)
    outside = swept.assign(fold_frequency=variable(("speed", "fold"), folds[:, 2:], "rad/s"))
    assert "fold" not in [text.get_text() for text in plot(outside).legends[0].get_texts()]
