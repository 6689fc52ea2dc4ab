"""Figures of the analysis ``parameters``: constants over one parameter as curves, or as a table."""

from __future__ import annotations

import re

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, shown_title
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS, caption, power_of_ten, units_of

_MOST_CURVES = 8
# Least range of a vertical axis relative to its values.
_LEAST_RANGE = 0.01
# Line spacing of the table in inches.
_ROW = 0.24


def plot(dataset: xr.Dataset) -> Figure:
    """One panel for every stored constant over the one axis of ``dataset``; without axes a table of the values.

    A constant with a dimension of its own (natural frequencies by mode) has one curve or one line for each entry. Raises
    :class:`InputError` for more axes, for ``[points]``, for more than eight panels, and without constants.
    """
    names = charts.sweep_axes(dataset)
    shown = [str(name) for name in dataset.data_vars if name != "outcome"]
    if not shown:
        raise InputError("outputs = outcome: nothing to plot; the figure needs a constant")
    if not names:
        return _table(dataset, shown)
    if len(names) > 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis, or none, for a figure of parameters")
    if len(shown) > _MOST_CURVES:
        raise InputError(f"outputs: {len(shown)} constants; allowed are up to {_MOST_CURVES} for curves")
    sheet = charts.stack(dataset, names[0], [[key] for key in shown], colours=LINE_COLOURS[:1])
    for axes in sheet.axes[:, 0]:
        _widen(axes)
    return sheet.finish(dataset)


def _widen(axes: Axes) -> None:
    """Widen the vertical axis to 1 % of the values at least, so that a change of 0.03 % does not look like a cliff."""
    low, high = axes.get_ylim()
    missing = _LEAST_RANGE * max(abs(low), abs(high)) - (high - low)
    if missing > 0:
        axes.set_ylim(low - missing / 2, high + missing / 2)


def _table(dataset: xr.Dataset, shown: list[str]) -> Figure:
    lines = [line for name in shown for line in _lines(dataset[name])]
    sheet = Sheet(height=_ROW * len(lines))
    axes = sheet.axes[0, 0]
    axes.axis("off")
    axes.set(xlim=(0, 1), ylim=(len(lines) - 0.5, -0.5))
    for k, (label, number, unit) in enumerate(lines):
        axes.text(0, k, label, va="center")
        axes.text(0.72, k, power_of_ten(number), va="center", ha="right")
        axes.text(0.74, k, unit, va="center", color=FRAME_GREY)
    return sheet.finish(dataset)


def table(dataset: xr.Dataset, separator: str = "") -> str:
    """The table of a single point as text: aligned under title and parameters, or ``name,value,units`` with a separator.

    Raises :class:`InputError` for a result over an axis.
    """
    dataset = charts.prepare(dataset)
    shown = [str(name) for name in dataset.data_vars if name != "outcome"]
    if charts.sweep_axes(dataset) or not shown:
        raise charts.wrong_axes(dataset, "none for a table; a figure ends in .png, .pdf, .svg")
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
    label, units = str(variable.attrs.get("long_name", variable.name)), units_of(variable)
    units = "" if units == "1" else units
    if not variable.dims:
        return [(label, f"{variable.item():{digits}}", units)]
    (own,) = variable.dims
    entries = variable[own].values if own in variable.coords else np.arange(variable.size)
    return [
        (f"{label}, {own} {entry}", f"{value:{digits}}", units)
        for entry, value in zip(entries, variable.values, strict=True)
    ]
