"""Stability charts show the stored results."""

from __future__ import annotations

import json

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import to_hex

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.style import FAILED_COLOUR, FLAG_COLOURS
from tests.sizes import full_after
from tests.view import results
from tests.view.results import legend, meshes, panels, texts


def test_chart_draws_every_cell_in_its_state():
    dataset = results.chart()
    figure = plot(dataset)
    drawn = meshes(figure)[0].get_array()
    beta, omega = dataset.beta.values, dataset.Omega.values
    expected = results.unstable(beta[:, None], omega[None]).sum()
    assert drawn.shape == (21, 41)
    assert [(drawn == code).sum() for code in range(4)] == [21 * 41 - expected - 3, expected, 2, 1]
    colours = [to_hex(colour, keep_alpha=True) for colour in meshes(figure)[0].to_rgba(np.arange(4.0))]
    assert colours[0] == FLAG_COLOURS["stable"] and colours[3] == f"{FAILED_COLOUR}ff"
    assert {"A tongue", r"$\zeta$ = 0.001, $\gamma$ = 100", "speed ($\\Omega$)", "joint angle ($\\beta$) [rad]"} <= set(
        texts(figure)
    )


@pytest.mark.parametrize("order", full_after(1, [("beta", "nu"), ("nu", "beta")]))
def test_the_system_says_which_parameter_is_its_speed(order):
    plain = results.chart().drop_vars(("resonance", "resonance_Omega"))
    renamed = plain.rename(Omega="nu").assign_attrs(roles=json.dumps({"speed": "nu"}))
    drawn = meshes(plot(renamed.transpose(*order, ...)))[0].get_array()
    np.testing.assert_array_equal(drawn, meshes(plot(plain))[0].get_array())
    points = renamed.stack(point=order).reset_index("point")
    offsets = panels(plot(points))[0].collections[0].get_offsets()
    assert offsets[:, 0].max() == 1.5 and offsets[:, 1].max() == 1.0


def test_a_figure_over_one_axis_begins_with_its_ranges():
    """The smallest angle has two undecided cells, the next one a failed cell."""

    def above(beta):
        return plot(results.chart().isel(beta=beta)).axes[0].get_title(loc="left")

    speeds = results.chart().Omega.values
    inside = speeds[results.unstable(0.5, speeds)]
    assert above(10) == f"Unstable at Omega = {inside[0]:.6g} to {inside[-1]:.6g}."
    assert above(0) == "Undecided at Omega = 0.5 to 0.525."
    assert above(2) == "Stable at every point." and above(1) == "Failed at Omega = 0.5."
    # An atlas knows its ranges, which may be narrower than a cell.
    narrow = xr.Variable(("unstable_range", "end"), [[0.7001, 0.7002]])
    figure = plot(results.chart().isel(beta=2).assign_coords(unstable_Omega=narrow))
    assert figure.axes[0].get_title(loc="left") == "Unstable at Omega = 0.7001 to 0.7002."
    assert "unstable" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_growth_map_shows_the_logarithm_and_masks_failed_cells():
    growth = meshes(plot(results.chart()))[1].get_array()
    assert np.ma.getmaskarray(growth)[1, 0]
    assert np.ma.getmaskarray(growth).sum() == 1
    np.testing.assert_allclose(sorted(set(growth.compressed())), np.log10([0.99, 1.0, 1.25]), atol=1e-15)


def test_a_radius_of_zero_is_the_fastest_decay_and_not_failed():
    chart = results.chart()
    chart["spectral_radius"][2, 3] = 0.0
    mesh = meshes(plot(chart))[1]
    growth = mesh.get_array()
    assert np.ma.getmaskarray(growth).sum() == 1
    assert growth[2, 3] == mesh.norm.vmin


def test_only_stored_variables_get_a_panel():
    assert len(meshes(plot(results.chart().drop_vars("verdict")))) == 1
    assert len(meshes(plot(results.chart()[["verdict", "outcome"]]))) == 1
    with pytest.raises(
        InputError, match="outputs = outcome: nothing to plot; the figure needs verdict or spectral_radius"
    ):
        plot(results.chart()[["outcome"]])


def test_legend_counts_what_must_not_be_overlooked():
    assert legend(plot(results.chart()))[:4] == ["stable (586)", "unstable (272)", "undecided (2)", "failed (1)"]
    clean = results.grid(np.eye(2, 3, dtype=int), "beta", "Omega")
    clean = results.with_axes(clean, beta=np.arange(2.0), Omega=np.arange(1.0, 4))
    assert legend(plot(clean)) == ["stable (4)", "unstable (2)"]


def test_predicted_lines_exclude_difference_combinations():
    axes = panels(plot(results.chart()))[0]
    assert sorted(line.get_xdata()[0] for line in axes.lines) == [0.7, 1.0, 1.02]
    assert [text.get_text() for text in axes.texts] == ["$H_{21}$", "$S_{21}$", "$C^{+}_{1}$"]


def test_predictions_over_both_axes_are_curves_with_end_labels():
    mu, omega = np.linspace(1, 4, 7), np.linspace(0.5, 2.0, 16)
    dataset = results.with_axes(results.grid(np.zeros((7, 16), int), "mu", "Omega"), mu=mu, Omega=omega)
    dataset = results.with_resonances(dataset, S21=1.2 * np.sqrt(mu), H21=0.6 * np.sqrt(mu))
    axes = panels(plot(dataset))[0]
    low, _ = axes.lines
    np.testing.assert_array_equal(low.get_ydata(), mu)
    np.testing.assert_allclose(low.get_xdata(), 1.2 * np.sqrt(mu))
    assert axes.get_xlim() == pytest.approx((0.45, 2.05))
    assert axes.get_ylim() == pytest.approx((0.75, 4.25))
    sides = {text.get_text(): text.get_ha() for text in axes.texts}
    assert sides == {"$H_{21}$": "center", "$S_{21}$": "left"}


def test_one_axis_gives_radius_error_band_limit_and_verdict():
    omega = np.linspace(0.5, 1.5, 101)
    code = results.unstable(0.5, omega).astype(int)
    dataset = results.with_axes(results.grid(code, "Omega"), Omega=omega)
    axes = panels(plot(dataset))[0]
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), dataset.spectral_radius - 1)
    assert list(axes.lines[1].get_ydata()) == [0, 0]
    (band,) = (
        artist for artist in axes.collections if isinstance(artist, PolyCollection) and not isinstance(artist, QuadMesh)
    )
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((-0.011, 0.251))
    (strip,) = (artist for artist in axes.collections if isinstance(artist, QuadMesh))
    assert (strip.get_array() == 1).sum() == code.sum()


def test_four_axes_give_nine_slices():
    mu, alpha = np.array([0.5, 1, 2, 4, 8]), np.linspace(0, 20, 5)
    beta, omega = np.linspace(0, 1, 12), np.linspace(0.5, 1.5, 40)
    code = np.zeros((12, 40, 5, 5), int)
    code[..., 2, 4] = 1
    dataset = results.grid(code, "beta", "Omega", "mu", "alpha")
    dataset = results.with_axes(dataset, beta=beta, Omega=omega, mu=mu, alpha=alpha)
    dataset = results.with_resonances(dataset, S21=np.sqrt(mu))
    figure = plot(dataset)
    titles = [axes.get_title() for axes in panels(figure)]
    assert titles == [rf"$\mu$ = {m}, $\alpha$ = {a}" for a in (0, 10, 20) for m in (0.5, 2, 8)]
    assert [int((mesh.get_array() == 1).sum()) for mesh in meshes(figure)] == [0] * 7 + [480, 0]
    labelled = [[line.get_xdata()[0] for line in axes.lines] for axes in panels(figure)]
    assert labelled == [pytest.approx([np.sqrt(m)]) if 0.5 <= np.sqrt(m) <= 1.5 else [] for m in (0.5, 2, 8)] * 3


def test_a_range_without_a_boundary_shows_how_far_it_is_from_one():
    """Decay alone, on a scale from its least to its largest, with the axis of three values across."""
    dataset = results.grid(np.zeros((11, 8, 3), int), "speed", "zeta", "chi")
    axes = {
        "speed": np.linspace(2950, 3200, 11),
        "zeta": np.linspace(0.0016, 0.03, 8),
        "chi": np.array([0.1, 0.2, 0.3]),
    }
    dataset = results.with_axes(dataset, **axes)
    dataset["spectral_radius"] = dataset.spectral_radius - dataset.zeta
    figure = plot(dataset)
    assert [axes.get_title() for axes in panels(figure)[:3]] == [rf"$\chi$ = {value}" for value in (0.1, 0.2, 0.3)]
    assert figure.legends[0].get_title().get_text().endswith("stable\xa0at\xa0every\xa0point")
    (mesh, *_), decay = meshes(figure), np.log10(0.99 - dataset.zeta.values)
    np.testing.assert_allclose(mesh.get_array(), np.tile(decay, (11, 1)), rtol=1e-12)
    assert (mesh.norm.vmin, mesh.norm.vmax) == pytest.approx((decay.min(), decay.max()))


def test_nine_slices_without_a_boundary_show_growth():
    values = np.linspace(1.0, 2.0, 5)
    names = ("beta", "Omega", "mu", "alpha")
    dataset = results.with_axes(results.grid(np.zeros((5,) * 4, int), *names), **dict.fromkeys(names, values))
    dataset["spectral_radius"] = dataset.spectral_radius - 0.1 * dataset.beta
    drawn = [mesh.get_array() for mesh in meshes(plot(dataset))]
    assert len(drawn) == 9
    np.testing.assert_allclose(drawn[0][:, 0], np.log10(0.99 - 0.1 * values), rtol=1e-12)


def test_points_are_drawn_by_verdict():
    code = np.array([0, 1, 1, 2, 3, 0])
    dataset = results.grid(code, "point").assign_coords(
        beta=("point", np.arange(6.0), {"units": "rad", "long_name": "joint angle"}),
        Omega=("point", np.arange(1.0, 7), {"units": "1", "long_name": "speed"}),
        mu=("point", np.ones(6)),
    )
    figure = plot(dataset)
    (dots,) = panels(figure)[0].collections
    assert dots.get_offsets().tolist() == [[k + 1, k] for k in range(6)] and dots.get_array().tolist() == [*code]
    assert legend(figure) == ["stable (2)", "unstable (2)", "undecided (1)", "failed (1)"]


def test_points_along_one_parameter_are_a_curve():
    dataset = results.grid(np.array([0, 1, 0]), "point").assign_coords(
        Omega=("point", [3.0, 1.0, 2.0], {"units": "1", "long_name": "speed"}), beta=("point", [0.3, 0.3, 0.3])
    )
    line = panels(plot(dataset))[0].lines[0]
    assert list(line.get_xdata()) == [1, 2, 3]
    np.testing.assert_allclose(line.get_ydata(), [0.25, -0.01, -0.01])


def test_single_point_shows_its_multipliers():
    values = np.array([-1.1, 0.8 + 0.5j, 0.8 - 0.5j, -0.9])
    point = xr.Dataset(
        {"floquet_multiplier": ("multiplier", values), "outcome": ((), np.int8(0))}, attrs={"analysis": "floquet"}
    )
    circle, dots = panels(plot(point))[0].lines
    np.testing.assert_allclose(np.hypot(circle.get_xdata(), circle.get_ydata()), 1)
    np.testing.assert_array_equal(dots.get_xdata() + 1j * dots.get_ydata(), values)
    radius = xr.Dataset({"spectral_radius": 1.1, "outcome": np.int8(0)}, attrs={"analysis": "floquet"})
    assert {"spectral_radius", "1.1"} <= set(texts(plot(radius)))


def test_global_matplotlib_state_is_untouched():
    before = dict(matplotlib.rcParams)
    plot(results.chart())
    assert dict(matplotlib.rcParams) == before


def test_a_point_without_multipliers_is_refused():
    point = results.chart().isel(beta=0, Omega=0)
    point["floquet_multiplier"] = ("multiplier", np.full(4, np.nan + 0j))
    with pytest.raises(InputError, match="floquet_multiplier = nan: nothing to plot"):
        plot(point)
