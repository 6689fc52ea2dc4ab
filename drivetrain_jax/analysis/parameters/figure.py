"""Figures of the analysis ``parameters``: constants over one parameter as curves, or as a table."""

from __future__ import annotations

import re
import textwrap

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import cells
from drivetrain_jax.view.figure_layout import DPI, WIDTH, Margins, NotebookFigure, Panels, shown_title, write_title
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STYLE,
    axis_label,
    caption,
    power_of_ten,
    units_of,
    variable_label,
)

_HEIGHT, _MOST_CURVES = 1.8, 8
# Least range of a vertical axis relative to its values.
_LEAST_RANGE = 0.01
# Line spacing of the table, line spacing of the caption (inches), and letters per line of the caption.
_ROW, _CAPTION, _LETTERS = 0.24, 0.15, 105


def plot(dataset: xr.Dataset) -> Figure:
    """One panel for every stored constant over the one axis of ``dataset``; without axes a table of the values.

    A constant with a dimension of its own (natural frequencies by mode) has one curve or one line for each entry. Axes of
    one value count as fixed. Raises :class:`InputError` for more axes, for ``[points]``, for more than eight panels, and
    without constants.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        shown = [str(name) for name in dataset.data_vars if name != "outcome"]
        if not shown:
            raise InputError("outputs = outcome: nothing to plot; the figure needs a constant")
        if not names:
            return _table(dataset, shown)
        if len(names) > 1 or names == ["point"]:
            raise InputError(f"axes = {', '.join(names)}: allowed is one axis, or none, for a figure of parameters")
        if len(shown) > _MOST_CURVES:
            raise InputError(f"outputs: {len(shown)} constants; allowed are up to {_MOST_CURVES} for curves")
        return _curves(dataset, names[0], shown)


def _curves(dataset: xr.Dataset, name: str, shown: list[str]) -> Figure:
    panels = Panels(len(shown), height=_HEIGHT, margins=Margins(left=1.05, right=0.3, bottom=0.6), share_y=False)
    for (axes,), key in zip(panels.axes, shown, strict=True):
        variable = dataset[key].where(dataset["outcome"] < FIRST_FAILURE).transpose(name, ...)
        axes.plot(dataset[name], variable.values.reshape(dataset.sizes[name], -1), color=LINE_COLOURS[0])
        axes.margins(x=0)
        _widen(axes)
        # Few ticks have few digits, and the label has a fixed position.
        axes.locator_params(axis="y", nbins=4)
        panels.label_row(axes, variable_label(variable))
    panels.label_axes(axis_label(dataset[name]))
    panels.titles(dataset)
    return panels.figure


def _widen(axes: Axes) -> None:
    """Widen the vertical axis to 1 % of the values at least, so that a change of 0.03 % does not look like a cliff."""
    low, high = axes.get_ylim()
    missing = _LEAST_RANGE * max(abs(low), abs(high)) - (high - low)
    if missing > 0:
        axes.set_ylim(low - missing / 2, high + missing / 2)


def _table(dataset: xr.Dataset, shown: list[str]) -> Figure:
    lines = [line for name in shown for line in _lines(dataset[name])]
    # Break only between parameters.
    entries = ", ".join(entry.replace(" ", "\u00a0") for entry in caption(dataset).split(", "))
    head = textwrap.wrap(entries, _LETTERS, break_long_words=False)
    top = 0.55 + _CAPTION * len(head)
    height = top + 0.1 + _ROW * len(lines)
    figure = NotebookFigure(figsize=(WIDTH, height), dpi=DPI)
    left, value, units = 0.35 / WIDTH, 0.72, 0.74
    write_title(figure, dataset, 0.35)
    figure.text(left, 1 - 0.32 / height, "\n".join(head), va="top", size=8, color=FRAME_GREY)
    for k, (label, number, unit) in enumerate(lines):
        y = 1 - (top + _ROW * k) / height
        figure.text(left, y, label, va="center")
        figure.text(value, y, power_of_ten(number), va="center", ha="right")
        figure.text(units, y, unit, va="center", color=FRAME_GREY)
    return figure


def table(dataset: xr.Dataset, separator: str = "") -> str:
    """The table of a single point as text: aligned under title and parameters, or ``name,value,units`` with a separator.

    Raises :class:`InputError` for a result over an axis.
    """
    dataset = cells.prepare(dataset)
    shown = [str(name) for name in dataset.data_vars if name != "outcome"]
    if cells.sweep_axes(dataset) or not shown:
        raise InputError(f"axes = {cells.described_axes(dataset)}: no table; allowed is a figure (.png, .pdf, .svg)")
    if separator:
        rows = [("name", "value", "units"), *(row for name in shown for row in _lines(dataset[name], ".17g"))]
        return "".join(f"{separator.join(_quoted(cell, separator) for cell in row)}\n" for row in rows)
    lines = [line for name in shown for line in _lines(dataset[name])]
    widths = [max(len(line[k]) for line in lines) for k in (0, 1)]
    head = [shown_title(dataset), re.sub(r"[$\\{}]|mathrm", "", caption(dataset)), ""]
    return "\n".join([*head, *(f"{n:<{widths[0]}}  {v:>{widths[1]}}  {u}".rstrip() for n, v, u in lines), ""])


def _quoted(cell: str, separator: str) -> str:
    return f'"{cell}"' if separator in cell else cell


def _lines(variable: xr.DataArray, digits: str = ".6g") -> list[tuple[str, str, str]]:
    """Name, value and unit of a constant, one line for each entry of its own dimension."""
    label = str(variable.attrs.get("long_name", variable.name))
    units = units_of(variable)
    units = "" if units == "1" else units
    if not variable.dims:
        return [(label, f"{variable.item():{digits}}", units)]
    (own,) = variable.dims
    entries = variable[own].values if own in variable.coords else np.arange(variable.size)
    return [
        (f"{label}, {own} {entry}", f"{value:{digits}}", units)
        for entry, value in zip(entries, variable.values, strict=True)
    ]
