"""Figures of Lyapunov spectra and Poincare sections, from synthetic results."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex, to_rgb

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import plot
from drivetrain_jax.view.style import FAILED_COLOUR, FLAG_COLOURS
from tests.view.results import legend

KINDS = "fixed_point periodic quasi_periodic parametrically_unstable chaotic undecided"


def lyapunov(**sizes: int) -> xr.Dataset:
    """Exponents over the axes ``sizes``, with a chaotic point and a point without values."""
    axes = tuple(sizes)
    shape = tuple(sizes.values())
    spectrum = np.stack([np.full(shape, -1.0), np.full(shape, -2.0)], axis=-1)
    verdict = np.full(shape, 2, np.int8)
    if shape:
        spectrum.reshape(-1, 2)[0] = 3.0
        spectrum.reshape(-1, 2)[-1] = np.nan
        verdict.reshape(-1)[0] = 4
    dataset = xr.Dataset(
        {
            "lyapunov_spectrum": ((*axes, "exponent"), spectrum, {"units": "1/s", "long_name": "Lyapunov exponent"}),
            "lyapunov_standard_error": ((*axes, "exponent"), np.full((*shape, 2), 0.1)),
            "verdict": (axes, verdict, {"flag_meanings": KINDS}),
            "outcome": (axes, np.zeros(shape, np.int8)),
        },
        coords={name: (name, np.linspace(1.0, 2.0, size)) for name, size in sizes.items()},
        attrs={"analysis": "lyapunov", "title": "made up"},
    )
    history = np.stack([np.linspace(0, -1, 64), np.linspace(0, -2, 64)], axis=-1)
    return dataset if shape else dataset.assign(
        lyapunov_history=(("segment", "exponent"), history), segment=("segment", np.arange(1, 65))
    )  # fmt: skip


def test_a_constant_sum_is_a_number_in_the_legend():
    dataset = lyapunov(zeta=8)
    spectrum = dataset["lyapunov_spectrum"]
    dataset["lyapunov_spectrum"] = spectrum.copy(data=np.broadcast_to([1.0, -4.0], spectrum.shape))
    assert "sum -3 throughout" in legend(plot(dataset))


def test_curves_with_bands_and_verdicts():
    figure = plot(lyapunov(zeta=8))
    assert legend(figure) == [
        *("exponent 0", "three standard errors", "exponent 1", "sum", "limit of stability"),
        *("quasi periodic (7)", "chaotic (1)"),
    ]
    lines = figure.axes[0].get_lines()
    np.testing.assert_array_equal(lines[0].get_ydata()[:2], [3.0, -1.0])


def test_maps_with_a_column_for_each_value_of_a_third_axis():
    figure = plot(lyapunov(excitation_frequency=6, zeta=5, chi_n=3))
    assert legend(figure) == ["quasi periodic (89)", "chaotic (1)"]
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    assert len(panels) == 6
    # Growth and decay have colours of their own.
    (mesh,) = panels[-1].collections
    assert mesh.norm(0.0) == pytest.approx(0.5) and (mesh.norm.vmin, mesh.norm.vmax) == (-10.0, 10.0)


@pytest.mark.parametrize("sizes", [{"zeta": 8}, {"zeta": 8, "chi_n": 1}, {"zeta": 4, "chi_n": 2}])
def test_a_point_without_a_value_has_no_kind(sizes):
    dataset = lyapunov(**sizes)
    dataset["outcome"].values.reshape(-1)[-1] = 4
    dataset["verdict"].values.reshape(-1)[-1] = 5
    figure = plot(dataset)
    assert set(legend(figure)) >= {"quasi periodic (6)", "chaotic (1)", "failed (1)"}
    drawn = [mesh for axes in figure.axes for mesh in axes.collections if isinstance(mesh, QuadMesh)]
    colours = [to_hex(colour) for mesh in drawn for colour in mesh.to_rgba(mesh.get_array()).reshape(-1, 4)]
    # The bands behind lines are pale.
    pale = {to_hex(0.65 + 0.35 * np.array(to_rgb(colour))) for colour in (FAILED_COLOUR,)} | {FAILED_COLOUR}
    assert pale & set(colours) and FLAG_COLOURS["undecided"] not in colours


def test_convergence_of_one_point():
    figure = plot(lyapunov())
    assert legend(figure) == ["exponent 0", "three standard errors", "exponent 1", "limit of stability"]


def test_outputs_without_a_figure_are_named():
    needed = "nothing to plot; the figure needs"
    with pytest.raises(InputError, match=f"^outputs = outcome: {needed} verdict or lyapunov_spectrum$"):
        plot(lyapunov(a=5, b=5)[["outcome"]])
    with pytest.raises(InputError, match=f"^outputs = verdict, outcome: {needed} lyapunov_spectrum or paper_estimator"):
        plot(lyapunov(a=5)[["verdict", "outcome"]])


def section(count: int, spread: float) -> xr.Dataset:
    turn = np.linspace(0, 20, count)
    state = [
        {"name": "phi", "units": "rad", "long_name": "twist", "symbol": ""},
        {"name": "v", "units": "rad/s", "long_name": "rate", "symbol": "", "scale": 1e3},
    ]
    points = np.stack([6e-5 + spread * np.cos(turn), spread * np.sin(turn)], axis=-1)
    return xr.Dataset(
        {"section": (("strobe", "state"), points), "outcome": ((), np.int8(0)), "distinct_points": ((), 1)},
        attrs={"analysis": "poincare", "title": "made up", "state": json.dumps(state)},
    )


def test_all_strobes_and_the_first_thousand():
    figure = plot(section(3000, 1e-5))
    counts = [len(axes.collections[0].get_offsets()) for axes in figure.axes]
    assert counts == [3000, 1000]


def test_a_point_is_drawn_as_a_point():
    """Rounding errors do not fill the panel."""
    axes = plot(section(300, 1e-17)).axes[0]
    assert np.ptp(axes.get_xlim()) > 1e-6
    assert np.ptp(axes.get_ylim()) > 1e-5
