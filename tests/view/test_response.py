"""Figures of the forced response."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from tests.view import results
from tests.view.results import legend, meshes, panels, texts

OMEGA = np.linspace(0.5, 1.5, 21)


def test_amplitude_of_both_shafts_over_one_axis():
    figure = plot(results.forced(Omega=OMEGA))
    amplitude, orbit = panels(figure)
    first, second = (line for line in amplitude.lines if len(line.get_xdata()) == 21)
    assert set(first.get_ydata()) == {0.1}
    assert set(second.get_ydata()) == {0.2}
    assert amplitude.get_yscale() == "log"
    assert [set(line.get_ydata()) for line in orbit.lines[:2]] == [{1.1 - 1}, {0}]
    assert legend(figure) == ["driving shaft", "driven shaft", "limit of stability", "harmonic $H$"]
    assert {"amplitude [rad]", "spectral radius of the orbit minus 1", "speed ($\\Omega$)"} <= set(texts(figure))


def test_two_axes_give_one_map_a_shaft_and_mark_failures():
    dataset = results.forced(beta=np.linspace(0, 1, 11), Omega=OMEGA)
    dataset.amplitude[0] = 0
    dataset.amplitude[3, 4] = np.nan
    dataset.orbit_spectral_radius[3, 4] = np.nan
    dataset.outcome[3, 4] = 2
    figure = plot(dataset)
    one, two, orbit = (mesh.get_array() for mesh in meshes(figure))
    assert np.ma.getmaskarray(one).sum() == np.ma.getmaskarray(two).sum() == np.ma.getmaskarray(orbit).sum() == 1
    assert one[5, 5] == 0.1
    assert two[5, 5] == 0.2
    assert orbit[5, 5] == pytest.approx(np.log10(1.1))
    assert "failed (1)" in legend(figure)


def test_a_response_of_zero_is_drawn():
    """A straight joint has no forcing and a response of zero, which a logarithmic scale cannot show."""
    dataset = results.forced(Omega=OMEGA)
    dataset.amplitude[:] = 0
    amplitude = panels(plot(dataset))[0]
    assert amplitude.get_yscale() == "linear" and amplitude.get_ylim()[0] < 0 < amplitude.get_ylim()[1]


def test_nothing_to_plot_is_an_input_error():
    with pytest.raises(InputError, match="outputs = outcome: nothing to plot; the figure needs amplitude or"):
        plot(results.forced(Omega=OMEGA)[["outcome"]])


def test_unknown_analysis_is_an_input_error():
    with pytest.raises(InputError, match=r"analysis = 'atlas': is a function; .* its `grid` and `drivetrain plot`"):
        plot(results.forced(Omega=OMEGA).assign_attrs(analysis="atlas"))
    with pytest.raises(
        InputError, match="analysis = 'anything': has no figure; expected one of basins, critical_speeds"
    ):
        plot(results.forced(Omega=OMEGA).drop_vars("outcome").assign_attrs(analysis="anything"))


def test_a_single_point_shows_words_and_powers_of_ten():
    point = results.chart().isel(beta=0, Omega=0)
    shown = texts(plot(point.assign(spectral_radius=point.spectral_radius.copy(data=2e-7))))
    assert {"undecided", "2×10⁻⁷"} <= set(shown)


def test_any_result_has_a_table_lines_or_maps():
    """The results of a function that somebody swept, by the number of axes."""
    own = {"analysis": "somebody's own"}
    shown = texts(plot(results.forced(Omega=OMEGA[:1]).assign_attrs(own)))
    assert {"amplitude, shaft driving", "0.1", "rad", "1.1"} <= set(shown)
    lines = panels(plot(results.forced(Omega=OMEGA).assign_attrs(own)))
    assert lines[0].get_ylabel() == "amplitude [rad]" and len(lines) == 2
    charts = panels(plot(results.forced(Omega=OMEGA, beta=OMEGA, mu=OMEGA[:2]).assign_attrs(own)))
    titles = [axes.get_title() for axes in charts]
    assert titles[:4] == [f"$\\mu$ = {mu:g}, {shaft} shaft" for shaft in ("driving", "driven") for mu in OMEGA[:2]]
