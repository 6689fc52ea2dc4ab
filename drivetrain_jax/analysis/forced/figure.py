"""Figures of the analysis ``forced``: amplitudes of the displacements, and stability of the nonlinear periodic orbit."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells
from drivetrain_jax.view import resonance_lines as resonances
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.growth import draw_growth, scale_around_limit
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STATE_COLOURS,
    STYLE,
    axis_label,
    in_brackets,
    units_of,
    variable_label,
)

_AMPLITUDES = {"amplitude": ("-", "linear"), "orbit_amplitude": ((0, (4, 1.5)), "nonlinear orbit")}
_SCALARS = ("orbit_spectral_radius", "condition")
_HEIGHT = 2.1


def plot(dataset: xr.Dataset) -> Figure:
    """Amplitudes of the displacements, and the orbit's spectral radius minus 1 and the condition if stored.

    Over one axis as curves (solid: linear response, dashed: nonlinear orbit), over two axes as maps. Failed points are
    crosses at the foot of the curves, or coloured cells of the maps. Axes of one value count as fixed. Raises
    :class:`InputError` for another number of axes, and if none of these variables is stored.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        shown = cells.require_any(dataset, *_AMPLITUDES, *_SCALARS)
        names = cells.sweep_axes(dataset)
        if len(names) == 1 and names != ["point"]:
            return _curves(dataset, names[0])
        if len(names) == 2:
            return _maps(dataset, names, shown)
        raise InputError(
            f"axes = {cells.described_axes(dataset)}: allowed are one or two axes of several values for a figure of "
            "forced response"
        )


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    amplitudes = [key for key in _AMPLITUDES if key in dataset]
    scalars = [key for key in _SCALARS if key in dataset]
    rows = bool(amplitudes) + len(scalars)
    panels = Panels(rows, height=_HEIGHT, margins=Margins(right=0.3, left=1.0), share_y=False)
    stack = [row[0] for row in panels.axes]
    handles: list[Artist] = []
    if amplitudes:
        handles += _draw_amplitudes(stack[0], dataset, name, amplitudes)
    for axes, key in zip(stack[rows - len(scalars) :], scalars, strict=True):
        if key == "condition":
            axes.plot(dataset[name], dataset[key], color=LINE_COLOURS[0])
            panels.label_row(axes, variable_label(dataset[key]))
            _set_decades(axes, dataset[key])
        else:
            scale_around_limit(axes, dataset[key] - 1)
            axes.plot(dataset[name], dataset[key] - 1, color=LINE_COLOURS[0])
            panels.label_row(axes, f"{variable_label(dataset[key])} minus 1")
            handles.append(
                axes.axhline(0, color=FRAME_GREY, linewidth=0.8, linestyle=(0, (2, 2)), label="limit of stability")
            )
    if amplitudes:
        own = next(dim for dim in dataset[amplitudes[0]].dims if dim != name)
        both = f"amplitude of the {own}s{in_brackets(units_of(dataset[amplitudes[0]]))}"
        panels.label_row(stack[0], both if len(amplitudes) > 1 else variable_label(dataset[amplitudes[0]]))
    cells.fit_axis(stack[0], "x", dataset[name].values)
    lines = resonances.predictions(dataset, name, forced=True)
    handles += cells.draw_failures(stack[0], dataset, name)
    for axes in stack:
        predicted = resonances.draw(axes, lines)
    panels.label_axes(axis_label(dataset[name]))
    resonances.label(stack[0], lines)
    panels.titles(dataset)
    panels.legend([*handles, *predicted])
    return panels.figure


def _draw_amplitudes(axes: Axes, dataset: xr.Dataset, name: str, keys: list[str]) -> list[Line2D]:
    handles = []
    for key in keys:
        style, meaning = _AMPLITUDES[key]
        (own,) = (dim for dim in dataset[key].dims if dim != name)
        for index, colour in zip(range(dataset.sizes[own]), LINE_COLOURS, strict=False):
            curve = dataset[key].isel({own: index})
            label = f"{_entry(curve, own, index)}, {meaning}"  # pyright: ignore[reportArgumentType]
            handles += axes.plot(dataset[name], curve, color=colour, linestyle=style, label=label)
    _set_decades(axes, *(dataset[key] for key in keys))
    return handles


def _set_decades(axes: Axes, *shown: xr.DataArray) -> None:
    """Set a logarithmic scale if there are positive values; it cannot show zeros (straight joints) and failed points."""
    if any((np.isfinite(each.values) & (each.values > 0)).any() for each in shown):
        axes.set_yscale("log")
        cells.plain_decades(axes, "y")


def _maps(dataset: xr.Dataset, names: list[str], shown: list[str]) -> Figure:
    horizontal = cells.horizontal_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    fields = [field for key in shown for field in _split(dataset[key], names)]
    panels = Panels(len(fields), height=_HEIGHT, margins=Margins(right=1.15))
    for (axes,), field in zip(panels.axes, fields, strict=True):
        if field.name == "orbit_spectral_radius":
            mesh, label, bar = draw_growth(axes, dataset, field, horizontal, vertical)
            panels.colorbar(axes, mesh, label, **bar)
        else:
            mesh = _draw_decades(axes, field, horizontal, vertical)
            panels.colorbar(axes, mesh, variable_label(field))
    lines = resonances.predictions(dataset, horizontal, vertical, forced=True)
    handles = resonances.draw(panels.axes[0][0], lines)
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    resonances.label(panels.axes[0][0], lines)
    panels.titles(dataset)
    panels.legend([*handles, *cells.failure_legend(dataset)])
    return panels.figure


def _draw_decades(axes: Axes, field: xr.DataArray, horizontal: str, vertical: str) -> QuadMesh:
    """Draw positive values on a logarithmic colour scale, darker for larger; an amplitude of 0 is lightest."""
    values = field.values[np.isfinite(field.values) & (field.values > 0)]
    low, high = (values.min(), values.max()) if values.size else (0.1, 1.0)
    cmap = matplotlib.colormaps["cividis_r"].with_extremes(bad=STATE_COLOURS[cells.FAILED])
    field = field.where(field.isnull() | (field > low), low)
    return cells.draw_cells(axes, field, horizontal, vertical, cmap=cmap, norm=LogNorm(low, high))


def _split(variable: xr.DataArray, names: list[str]) -> list[xr.DataArray]:
    """One variable over the axes for each entry of the variable's own dimension; the long name names the entry."""
    own = [dim for dim in variable.dims if dim not in names]
    if not own:
        return [variable]
    parts = [variable.isel({own[0]: index}) for index in range(variable.sizes[own[0]])]
    return [
        part.assign_attrs(long_name=f"{part.attrs.get('long_name', part.name)}, {_entry(part, own[0], index)}")  # pyright: ignore[reportArgumentType]
        for index, part in enumerate(parts)
    ]


def _entry(part: xr.DataArray, dimension: str, index: int) -> str:
    """``driving shaft`` for a named entry of a dimension, ``shaft 1`` for a numbered one."""
    entry = part[dimension].item() if dimension in part.coords else index
    return f"{entry} {dimension}" if isinstance(entry, str) else f"{dimension} {entry}"
