"""Cells end halfway between their values on any axis; numbers, titles and captions of a figure."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts, plot, sheet
from drivetrain_jax.view.style import axis_label, caption, symbol, value_text, variable_label
from tests.view import results
from tests.view.results import meshes, panels


@pytest.mark.parametrize(
    ("values", "logarithmic"),
    [
        (np.geomspace(0.01, 2, 50), True),
        (np.linspace(0.01, 2, 50), False),
        ([0.25, 0.5, 1, 5, 20], False),
        ([1, 2], False),
    ],
)
def test_logarithmic_axes_are_recognised(values, logarithmic):
    assert sheet.is_logarithmic(np.asarray(values, float)) is logarithmic


def test_drawn_cells_have_these_edges_and_this_scale():
    omega = np.geomspace(0.01, 1, 5)
    dataset = results.grid(np.zeros((3, 5), int), "beta", "Omega")
    figure = plot(results.with_axes(dataset, beta=np.array([0.0, 0.5, 1.0]), Omega=omega))
    corners = meshes(figure)[0].get_coordinates()
    np.testing.assert_allclose(corners[0, :, 0], 10 ** np.linspace(-2.25, 0.25, 6))
    np.testing.assert_allclose(corners[:, 0, 1], [-0.25, 0.25, 0.75, 1.25])
    axes = panels(figure)[0]
    assert axes.get_xscale() == "log"
    assert axes.get_yscale() == "linear"
    assert axes.get_xlim() == pytest.approx((10**-2.25, 10**0.25))


def test_values_given_out_of_order_are_sorted():
    code = np.array([[0, 1, 0], [0, 0, 0]])
    dataset = results.with_axes(
        results.grid(code, "beta", "Omega"), beta=np.array([0.2, 0.1]), Omega=np.array([3.0, 2.0, 1.0])
    )
    np.testing.assert_array_equal(meshes(plot(dataset))[0].get_array(), [[0, 0, 0], [0, 1, 0]])


def test_cells_still_to_be_computed_are_not_failed():
    codes = np.array([[0, 1, 3], [3, 0, 1]])
    chart = results.with_axes(results.grid(codes, "beta", "Omega"), beta=np.arange(2.0), Omega=np.arange(3.0))
    chart["outcome"] = chart["outcome"].assign_attrs(flag_values=np.arange(7), flag_meanings="a b c d e f pending")
    chart["outcome"][1, 0] = 6
    chart = charts.prepare(chart)
    assert [patch.get_label() for patch in charts.flag_entries(charts.valid(chart, "verdict"))] == [
        *("stable (2)", "unstable (2)", "failed (1)", "pending (1)")
    ]
    np.testing.assert_array_equal(charts.valid(chart, "verdict"), [[0, 1, 3], [4, 0, 1]])
    over = charts.draw_cells(axes := Figure().add_subplot(), chart["spectral_radius"], "Omega", "beta")
    assert axes.collections[1] is not over
    covered = np.ma.filled(axes.collections[1].get_array(), np.nan)
    np.testing.assert_array_equal(covered, [[np.nan] * 3, [0, np.nan, np.nan]])


def test_a_strip_shows_what_is_still_to_be_computed():
    line = results.with_axes(results.grid(np.array([0, 1, 0]), "Omega"), Omega=np.arange(3.0))
    line["outcome"] = line["outcome"].assign_attrs(flag_values=np.arange(7), flag_meanings="a b c d e f pending")
    line["outcome"][1] = 6
    (strip,) = meshes(plot(line))
    np.testing.assert_array_equal(strip.get_array(), [[0, 4, 0]])


@pytest.mark.parametrize(
    ("title", "text"),
    [
        ("Fig. 3: joint angle and speed", "Joint angle and speed"),
        ("Table 3, Figs 4 and 5: four planets", "Four planets"),
        ("Frequency response, Figs 2 and 3", "Frequency response"),
        ("Paper 2012, section 4: the shaft", "The shaft"),
        ("Input element: stability", "Input element: stability"),
    ],
)
def test_a_title_needs_no_paper(title, text):
    assert sheet.shown_title(xr.Dataset(attrs={"title": title})) == text


@pytest.mark.parametrize("text", [r"Cost $\foo$ of a gear", r"From $5 to $6_{", r"A \$ and $\beta$ " + "W" * 300])
def test_a_title_is_text_and_no_formula(text):
    figure = sheet.Sheet(height=2.0).finish(xr.Dataset(attrs={"title": text}))
    figure.draw_without_rendering()
    assert figure.get_suptitle()[:20] == text[:20]


def test_caption_gives_parameters_instead_of_the_point_number():
    dataset = xr.Dataset(coords={"point": 0, "omega": ((), 0.86, {"units": "rad/s"})})
    assert caption(dataset) == "$\\omega$ = 0.86 rad/s"


@pytest.mark.parametrize(
    ("value", "units", "text"),
    [
        (8.5e7, "N/m", "$k_{A}$ = 85 MN/m"),
        (999.0, "N/m", "$k_{A}$ = 999 N/m"),
        (-2550.0, "N m", "$k_{A}$ = -2.55 kN m"),
        (2.1e11, "Pa", "$k_{A}$ = 210 GPa"),
        ([64155.0, 22155.0, 8337.0], "N m2", "$k_{A}$ = [64.155, 22.155, 8.337] kN m²"),
        ([0.0, 2e6, "varies"], "N/m", "$k_{A}$ = [0, 2, varies] MN/m"),
        ("inf", "N/m", "$k_{A}$ = inf N/m"),
        (0.0, "N/m", "$k_{A}$ = 0 N/m"),
        (12.0, "MN/m", "$k_{A}$ = 12 MN/m"),
        (5e-5, "m", "$k_{A}$ = 50 µm"),
        (0.3, "m", "$k_{A}$ = 0.3 m"),
        (4800.0, "Np", "$k_{A}$ = 4800 Np"),
        (4800.0, "rpm", "$k_{A}$ = 4800 rpm"),
    ],
)
def test_forces_have_the_prefix_that_people_write(value, units, text):
    assert value_text("k_A", value, units) == text


@pytest.mark.parametrize(
    ("name", "text"),
    [("rate", "rate"), ("k_sp", "$k_{sp}$"), ("J1", "$J_{1}$"), ("theta1", r"$\theta_{1}$"), ("u_10", "$u_{10}$")],
)
def test_a_word_is_no_symbol_with_an_index(name, text):
    assert symbol(name) == text


def test_axes_and_results_have_prefixes_together_with_their_numbers():
    about = {"units": "N/m", "long_name": "stiffness"}
    coords = {"k_A": ("k_A", [3e9, 1e7, 1e8], about), "k_B": ("k_B", [85e6], about)}
    coords |= {f"boundary_{name}": ("boundary", [2e3, np.nan], about) for name in ("k_A", "k_C")}
    torque = ("k_A", "k_B"), np.array([[0.0], [2e3], [np.nan]]), {"units": "N m", "long_name": "torque"}
    data = {"torque": torque, "outcome": (("k_A", "k_B"), np.zeros((3, 1), "int8"))}
    shown = charts.prepare(xr.Dataset(data, coords))
    assert shown["k_A"].values.tolist() == [10.0, 100.0, 3000.0] and shown.indexes["k_A"].tolist() == [10, 100, 3000]
    assert shown["boundary_k_A"].values[0] == 2e-3 and shown["boundary_k_C"].values[0] == 2.0
    assert axis_label(shown["k_A"]) == "stiffness ($k_{A}$) [MN/m]"
    np.testing.assert_array_equal(shown["torque"], [2.0, np.nan, 0.0])
    assert variable_label(shown["torque"]) == "torque [kN m]"
    assert caption(shown) == "$k_{B}$ = 85 MN/m"


def test_a_million_on_a_logarithmic_axis_is_a_power_of_ten():
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(1e-2, 1e6))
    sheet.plain_decades(axes, "x")
    axes.figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert "$\\mathdefault{10^{6}}$" in labels and not any("e+" in label for label in labels)


def test_numbers_along_axes_are_plain_text():
    """The parser of formulas would take half of the time of a figure."""
    figure = plot(results.chart())
    figure.draw_without_rendering()
    labels = [label.get_text() for axes in figure.axes for label in (*axes.get_xticklabels(), *axes.get_yticklabels())]
    assert not [label for label in labels if "$" in label] and any(label.startswith("\u221210") for label in labels)
    formulas = [r"$\mathdefault{-10^{-3}}$", r"$\mathdefault{2\times10^{4}}$", r"$\beta$", "0.5"]
    assert sheet.plain_labels(list, formulas) == ["\u221210\u207b\u00b3", "2\u00d710\u2074", r"$\beta$", "0.5"]


def test_lines_of_two_variables_share_colours_and_the_entries_of_the_legend():
    shape, about = ("speed", "shaft"), {"units": "N m"}
    known = {"long_name": "largest torque, linear system"} | about
    dataset = xr.Dataset(
        {
            "torque": (shape, [[1.0, 2.0], [3.0, 4.0]], known),
            "orbit_torque": (shape, [[1.5, 2.5], [3.5, 4.5]], known | {"long_name": "largest torque, nonlinear orbit"}),
            "outcome": ("speed", [0, 0]),
        },
        {"speed": [1.0, 2.0], "shaft": ["1 front", "2 rear"]},
        {"analysis": "forced"},
    )
    figure = charts.chart(dataset, [["torque", "orbit_torque"]])
    assert results.legend(figure) == ["linear system", "shaft 1 front", "shaft 2 rear", "nonlinear orbit"]
    styles = [(line.get_color(), line.get_linestyle()) for line in panels(figure)[0].get_lines()]
    assert [styles[0][0], styles[1][0]] == [styles[2][0], styles[3][0]] and styles[0][1] != styles[2][1]
