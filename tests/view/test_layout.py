"""Positions of labels, powers of ten and legends of a figure."""

from __future__ import annotations

import json

import matplotlib
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax.view import cells, plot
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import STYLE
from tests.view import results


def drawn(panels: Panels) -> Panels:
    FigureCanvasAgg(panels.figure).draw()
    return panels


@pytest.mark.parametrize("top", [8e-4, 0.012, 0.03, 3.0, 9000.0, 2e5])
@pytest.mark.parametrize("whole", [True, False])
def test_the_label_is_clear_of_the_numbers(top, whole):
    with matplotlib.rc_context(STYLE):
        panels = Panels(2, height=1.5)
        for (axes,) in panels.axes:
            axes.set_ylim(-top, top)
        panels.label_axes("horizontal", "vertical") if whole else panels.label_row(panels.axes[0][0], "vertical")
        drawn(panels)
    (label,) = (text.get_window_extent() for text in panels.figure.texts if text.get_text() == "vertical")
    numbers = [text for text in panels.axes[0][0].get_yticklabels() if abs(text.get_position()[1]) <= top]
    assert 0 <= label.x0 and label.x1 < min(text.get_window_extent().x0 for text in numbers) - 0.04 * panels.figure.dpi


@pytest.mark.parametrize("columns", [1, 2])
def test_wide_numbers_leave_room_for_a_label_of_two_lines(columns):
    """With numbers such as 0.99975 the panels become narrower, but keep their right end and their gaps."""
    with matplotlib.rc_context(STYLE):
        panels, before = (Panels(1, columns, height=1.5) for _ in range(2))
        panels.axes[0][0].set_ylim(0.99905, 1.00005)
        panels.label_axes("horizontal", "the largest modulus of all of the multipliers of the shaft [1]")
        drawn(panels)
        numbers = [text.get_window_extent().x0 for text in panels.axes[0][0].get_yticklabels() if text.get_text()]
    label = next(text for text in panels.figure.texts if "modulus" in text.get_text())
    assert "\n" in label.get_text() and 0 <= label.get_window_extent().x0
    assert label.get_window_extent().x1 < min(numbers)
    ends = [[axes.get_position().x1 for axes in each.axes[0]] for each in (panels, before)]
    assert ends[0][-1] == pytest.approx(ends[1][-1], abs=1e-12)
    assert panels.axes[0][0].get_position().x0 > before.axes[0][0].get_position().x0
    widths = [axes.get_position().width for axes in panels.axes[0]]
    assert widths == pytest.approx([widths[0]] * columns)


def test_small_and_large_numbers_have_a_power_of_ten_at_the_axis():
    with matplotlib.rc_context(STYLE):
        panels = Panels(2, height=1.5, share_y=False)
        for (axes,), top in zip(panels.axes, (8e-4, 0.03), strict=True):
            axes.set_ylim(0, top)
        drawn(panels)
    offsets = [axes.yaxis.get_offset_text().get_text() for (axes,) in panels.axes]
    assert r"\times" in offsets[0] and "10^{\N{MINUS SIGN}4}" in offsets[0] and offsets[1] == ""


def test_the_power_of_ten_of_columns_stands_at_the_right_end():
    with matplotlib.rc_context(STYLE):
        panels = Panels(1, 2, height=1.5)
        panels.axes[0][0].set_xlim(0, 2e6)
        panels.label_axes("a label that reaches into both of the columns [rad/s]")
        drawn(panels)
    left, right = (axes.xaxis.get_offset_text() for axes in panels.axes[0])
    assert not left.get_visible() and right.get_visible() and "10^{6}" in right.get_text()
    assert not right.get_window_extent().overlaps(panels.figure.texts[0].get_window_extent())


@pytest.mark.parametrize(("count", "rows"), [(2, 1), (8, 2), (16, 3)])
def test_a_legend_has_the_rows_that_it_needs(count, rows):
    with matplotlib.rc_context(STYLE):
        panels = Panels(height=1.5, margins=Margins(bottom=1.2))
        panels.legend([Line2D([], [], label=f"motion {number}") for number in range(count)])
        drawn(panels)
    (legend,) = panels.figure.legends
    heights = {round(text.get_window_extent().y0) for text in legend.get_texts()}
    assert len(heights) == rows and legend.get_window_extent().x1 <= panels.figure.bbox.x1


@pytest.mark.parametrize("count", [1, 6, 12, 20])
def test_a_legend_of_many_rows_stays_below_the_label_of_the_axis(count):
    with matplotlib.rc_context(STYLE):
        panels = Panels(2, height=1.5)
        panels.label_axes("frequency of the drive [rad/s]", "displacement [m]")
        height = panels.axes[0][0].get_tightbbox().height
        panels.legend([Line2D([], [], label="largest displacement") for _ in range(count)])
        drawn(panels)
    label = next(text for text in panels.figure.texts if text.get_text().startswith("frequency"))
    box = panels.figure.legends[0].get_window_extent()
    assert 0 < box.y0 < box.y1 < label.get_window_extent().y0
    assert panels.axes[0][0].get_tightbbox().height == pytest.approx(height, abs=0.1)


def test_labels_of_rows_move_with_the_panels():
    """The last row needs space for three lines; the label of the first row stays next to its numbers."""
    with matplotlib.rc_context(STYLE):
        panels = Panels(2, height=1.2)
        panels.label_row(panels.axes[0][0], "u [m]")
        panels.label_row(
            panels.axes[1][0], "largest Lyapunov exponent over the last three quarters of the periods [1/s]"
        )
        drawn(panels)
    first, numbers = panels.figure.texts[0].get_window_extent(), panels.axes[0][0].yaxis.get_tightbbox()
    assert 0 < numbers.x0 - first.x1 < 0.3 * panels.figure.dpi


def test_a_long_caption_stays_clear_of_the_labels_of_the_resonances():
    fixed = {f"x_{k}": {"value": 123.456 + k, "units": "kg"} for k in range(9)}
    figure = plot(results.chart().assign_attrs(fixed_parameters=json.dumps(fixed)))
    (caption,) = (text for text in figure.texts if "kg" in text.get_text())
    assert caption.get_text().count("\n") == 1
    top = max(label.get_window_extent().y1 for label in figure.axes[0].texts)
    assert caption.get_window_extent().y0 > top
    assert figure.axes[0].get_position().height * figure.get_figheight() == pytest.approx(2.45)


def test_a_million_on_a_logarithmic_axis_is_a_power_of_ten():
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(1e-2, 1e6))
    cells.plain_decades(axes, "x")
    axes.figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert "$\\mathdefault{10^{6}}$" in labels and not any("e+" in label for label in labels)
