"""Figures of the analysis ``poincare``: all points of the section, and the first ones alone."""

from __future__ import annotations

import textwrap

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, widen
from drivetrain_jax.view.style import LINE_COLOURS, coordinate_text, in_brackets, power_of_ten, state

_FIRST, _MOST_ROWS = 1000, 6
# Letters of a line above a row of panels.
_LETTERS = 110
# Width below which a section is drawn as a point, and least height of a panel, both relative to the size of a component.
_NARROW, _LOW = 1e-9, 1e-3


def plot(dataset: xr.Dataset) -> Figure:
    """The section with all strobes, and with the first 1000 alone if there are more.

    One axis of up to six values gives one row for each value. Raises :class:`InputError` for more axes or values, and
    unless ``section`` is stored.
    """
    charts.require(dataset, "section", some=True)
    names = charts.sweep_axes(dataset)
    if len(names) > 1 or (names and dataset.sizes[names[0]] > _MOST_ROWS):
        raise charts.wrong_axes(dataset, f"one axis of up to {_MOST_ROWS} values")
    parts = [dataset.isel({names[0]: k}) for k in range(dataset.sizes[names[0]])] if names else [dataset]
    columns = 2 if dataset.sizes["strobe"] > _FIRST else 1
    sheet = Sheet(len(parts), columns, height=3.2, sharex="row", sharey="row")
    for row, part in zip(sheet.axes, parts, strict=True):
        _draw_row(row, part, names[0] if names else None)
    described = state(dataset)[:2] or [{"long_name": f"component {i}", "units": "1"} for i in (1, 2)]
    sheet.label(*(f"{c['long_name']} at the strobes{in_brackets(c['units'])}" for c in described))
    return sheet.finish(dataset)


def _draw_row(row: np.ndarray, part: xr.Dataset, name: str | None) -> None:
    points = part["section"].values
    scale = state(part)[1].get("scale", 1.0) if len(state(part)) > 1 else 1.0
    first = np.abs(points[:, 0]).max(initial=0.0, where=np.isfinite(points[:, 0]))
    finite = points[np.isfinite(points).all(axis=1)]
    # Points that are equal up to rounding are one point; the usual ratio of the components is the ``scale``.
    spread = np.ptp(finite, axis=0) if len(finite) else np.full(2, np.inf)
    single = (spread <= _NARROW * first * np.array([1.0, scale])).all()
    for axes, shown in zip(row, (points, points[:_FIRST]), strict=False):
        size = 14.0 if single else 0.6 if len(shown) > 2 * _FIRST else 1.5
        axes.scatter(shown[:, 0], shown[:, 1], s=size, color=LINE_COLOURS[0], linewidths=0, rasterized=True)
        axes.set_title(f"{len(shown)} strobes", loc="left", size=7.5)
    notes = [coordinate_text(part[name])] if name else []
    if "torus_residual" in part:
        distance = power_of_ten(f"{np.max(part['torus_residual'].values):.1e}")
        notes.append(f"distance from a smooth curve {distance} of the largest value")
    if "distinct_points" in part and part["distinct_points"].item():
        notes.append(f"distinct points: {part['distinct_points'].item()}")
    notes.append(row[0].get_title("left"))
    row[0].set_title(textwrap.fill("; ".join(notes), _LETTERS // len(row)), loc="left", size=7.5)
    # Rounding errors do not fill the panel.
    widen(row[0], "x", 0.1 * (spread[0] <= _NARROW * first))
    widen(row[0], "y", 0.1 * single, 2 * _LOW * scale * first)
