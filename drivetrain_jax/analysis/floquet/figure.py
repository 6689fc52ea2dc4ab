"""Stability charts of the analysis ``floquet``."""

from __future__ import annotations

import math
from itertools import chain
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import boundary_curves as boundaries
from drivetrain_jax.view import cells
from drivetrain_jax.view import resonance_lines as resonances
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.growth import draw_growth, draw_limit, growth_of, scale_around_limit
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STATE_COLOURS,
    STATE_NAMES,
    STATES,
    STYLE,
    axis_label,
    coordinate_text,
    variable_label,
)

_PANEL = 2.45
_SMALL_PANEL = 1.35
# Largest number of values of an axis across a figure of small panels.
_FEW = 4


def plot(dataset: xr.Dataset) -> Figure:
    """The chart of a ``floquet`` result, by number of swept axes.

    - none: the multipliers in the complex plane;
    - one: the rate of growth, or the distance of the spectral radius from 1, with its error band;
    - two: regions of the verdict and a map of the growth (per second, turn or period), both with the limit of stability;
    - more: regions of the verdict for the first, middle and last value of two further axes;
    - ``[points]``: the points coloured by their verdict.

    Axes of one value count as fixed. Raises :class:`InputError` if needed variables are not stored.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if names == ["point"]:
            return _points(dataset)
        if not names:
            return _multipliers(dataset)
        if len(names) == 1:
            return _curve(dataset, names[0])
        return _chart(dataset, names) if len(names) == 2 else _small_multiples(dataset, names)


def _chart(dataset: xr.Dataset, names: list[str]) -> Figure:
    horizontal = cells.horizontal_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    shown = cells.require_any(dataset, "verdict", "spectral_radius")
    panels = Panels(len(shown), height=_PANEL, margins=Margins(right=1.15))
    handles: list[Artist] = []
    for (axes,), name in zip(panels.axes, shown, strict=True):
        if name == "verdict":
            cells.draw_states(axes, dataset, horizontal, vertical)
            handles += cells.state_legend(dataset)
            handles += boundaries.draw(axes, dataset, horizontal, vertical)
            _draw_limit(axes, dataset, horizontal, vertical)
        else:
            mesh, label, bar = draw_growth(axes, dataset, _radius(dataset), horizontal, vertical)
            panels.colorbar(axes, mesh, label, **bar)
            boundaries.draw_curves(axes, dataset, horizontal, vertical)
    # Only over the upper panel, so that narrow tongues stay visible in the map below.
    lines = resonances.predictions(dataset, horizontal, vertical)
    handles += resonances.draw(panels.axes[0][0], lines, below="verdict" in shown)
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    resonances.label(panels.axes[0][0], lines)
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _radius(dataset: xr.Dataset) -> xr.DataArray:
    return dataset["spectral_radius"].where(dataset["outcome"] < FIRST_FAILURE)


def _draw_limit(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> None:
    """Draw the limit of stability over the cells of the verdict, as over those of the growth."""
    if "spectral_radius" in dataset:
        draw_limit(axes, dataset, _radius(dataset), horizontal, vertical)


def _curve(dataset: xr.Dataset, name: str, marker: str = "") -> Figure:
    cells.require_any(dataset, "spectral_radius")
    panels = Panels(height=3.0, margins=Margins(right=0.3))
    axes = panels.axes[0][0]
    x, radius = dataset[name].values, dataset["spectral_radius"]
    growth = growth_of(dataset)
    known = growth.label.endswith("[1/s]")
    excess, label = (growth.of(radius), growth.label) if known else (radius - 1, f"{variable_label(radius)} minus 1")
    entry = "rate of growth" if known else "spectral radius"
    handles = axes.plot(x, excess, color=LINE_COLOURS[0], marker=marker, markersize=3, label=entry, zorder=3)
    if "spectral_radius_error" in dataset:
        # The derivative of the logarithm is 1 near the limit of stability.
        error = dataset["spectral_radius_error"] * (growth.factor if known else 1.0)
        band = axes.fill_between(
            x, excess - error, excess + error, color=LINE_COLOURS[0], alpha=0.3, linewidth=0, label="error band"
        )
        handles.append(band)  # pyright: ignore[reportArgumentType]
    handles.append(axes.axhline(0, color=FRAME_GREY, linewidth=0.8, linestyle=(0, (2, 2)), label="limit of stability"))
    scale_around_limit(axes, excess)
    cells.fit_axis(axes, "x", x)
    if "verdict" in dataset:
        _draw_strip(axes, dataset, name)
        handles += cells.state_legend(dataset)
    lines = resonances.predictions(dataset, name)
    resonances.draw(axes, lines)
    panels.label_axes(axis_label(dataset[name]), label)
    resonances.label(axes, lines)
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _draw_strip(axes: Axes, dataset: xr.Dataset, name: str) -> None:
    """Draw the verdict as a strip along the foot of the panel."""
    scale = axes.yaxis.get_transform()
    low, high = scale.transform(axes.get_ylim())
    axes.set_ylim(*scale.inverted().transform([low - 0.06 * (high - low), high]))
    cells.draw_strip(axes, cells.states(dataset), name, (0, 0.035), cmap=STATES, vmin=-0.5, vmax=3.5)
    axes.plot([0, 1], [0.035, 0.035], transform=axes.transAxes, color=FRAME_GREY, linewidth=0.5)


def _notes(stable: bool, shown: int, count: int) -> str:
    left_out = [f"{shown} of {count} charts shown"] if shown < count else []
    return "; ".join([*(["stable everywhere"] if stable else []), *left_out])


def _small_multiples(dataset: xr.Dataset, names: list[str]) -> Figure:
    cells.require_any(dataset, "verdict")
    # Axes of few values run across the figure, if two other axes remain.
    long = [name for name in names if dataset.sizes[name] > _FEW]
    horizontal = cells.horizontal_axis(dataset, long if len(long) > 1 else names)
    vertical = max((name for name in names if name != horizontal), key=lambda name: dataset.sizes[name])
    sliced = [name for name in names if name not in (horizontal, vertical)]
    # Only the first row has labels of the resonances, so an axis that changes their positions runs across.
    dependent = dataset.coords.get(f"resonance_{horizontal}", xr.DataArray(0)).dims
    sliced.sort(key=lambda name: name not in dependent)
    count = math.prod(dataset.sizes[name] for name in sliced)
    dataset = dataset.isel({name: dataset.sizes[name] // 2 for name in sliced[2:]})
    across, down = sliced[0], (*sliced[1:2], None)[0]
    slices = [
        [dataset.isel({across: column} | ({down: row} if down else {})) for column in _spread(dataset, across)]
        for row in (_spread(dataset, down) if down else [0])
    ]
    # If all is stable there is no boundary to draw: show the spectral radius instead.
    plain = _is_stable(dataset) and not boundaries.traced(dataset, horizontal, vertical)
    margins = Margins(right=1.05 if plain else 0.25, top=1.12, between_rows=0.32, between_columns=0.16)
    panels = Panels(len(slices), len(slices[0]), height=_SMALL_PANEL if len(slices) > 1 else _PANEL, margins=margins)
    predicted: list[Line2D] = []
    limit: list[Artist] = []
    labels: list[tuple[Axes, list[resonances.Prediction]]] = []
    for panel, axes in zip(chain(*slices), chain(*panels.axes), strict=True):
        if plain:
            _draw_radius(panels, axes, panel, dataset, (horizontal, vertical))
        else:
            cells.draw_states(axes, panel, horizontal, vertical)
            limit = boundaries.draw_curves(axes, panel, horizontal, vertical)
            _draw_limit(axes, panel, horizontal, vertical)
        lines = resonances.predictions(panel, horizontal, vertical)
        predicted = max(predicted, resonances.draw(axes, lines, below=not plain), key=len)
        first_row = axes in panels.axes[0]
        if first_row:
            labels.append((axes, [line for line in lines if line.order == 1]))
        axes.set_title(_slice_text(panel, across, down), pad=24 if first_row and lines else 4)
    if not cells.is_logarithmic(dataset[horizontal].values):
        panels.axes[0][0].set_xticks(_clear_ticks(panels.axes[0][0]))
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    for axes, lines in labels:
        resonances.label(axes, lines)
    panels.titles(dataset, _notes(plain, len(slices) * len(slices[0]), count))
    panels.legend(predicted if plain else [*cells.state_legend(dataset), *limit, *predicted])
    return panels.figure


def _is_stable(dataset: xr.Dataset) -> bool:
    """True if all cells are stable and have a spectral radius."""
    return "spectral_radius" in dataset and bool((cells.states(dataset) == cells.STABLE).all())


def _clear_ticks(axes: Axes) -> list[float]:
    """Set few ticks, none at the right end, to keep it clear of the next panel."""
    low, high = axes.get_xlim()
    return [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high - 0.08 * (high - low)]


def _draw_radius(panels: Panels, axes: Axes, panel: xr.Dataset, whole: xr.Dataset, names: tuple[str, str]) -> None:
    """Draw spectral radii below 1 on the scale of the whole result, with a colour bar at the end of the row."""
    radius = whole["spectral_radius"]
    limits = {"vmin": float(radius.min()), "vmax": float(radius.max())}
    mesh = cells.draw_cells(axes, panel["spectral_radius"], *names, cmap="cividis", **limits)
    if any(axes is row[-1] for row in panels.axes):
        panels.colorbar(axes, mesh, variable_label(radius))


def _slice_text(panel: xr.Dataset, *names: str | None) -> str:
    return ", ".join(coordinate_text(panel[name]) for name in names if name)


def _spread(dataset: xr.Dataset, name: str) -> list[int]:
    """First, middle and last index of an axis."""
    return sorted({0, dataset.sizes[name] // 2, dataset.sizes[name] - 1})


_MARKERS = ({"marker": "o", "facecolors": "none"}, {"marker": "o"}, {"marker": "D"}, {"marker": "x"})


def _points(dataset: xr.Dataset) -> Figure:
    varying = [
        str(name)
        for name, values in dataset.coords.items()
        if values.dims == ("point",) and name != "point" and np.unique(values).size > 1
    ]
    if not varying:
        raise InputError("points: all points are the same, there is nothing to plot; give points that differ")
    if len(varying) == 1:
        return _curve(dataset.swap_dims(point=varying[0]).sortby(varying[0]), varying[0], marker="o")
    cells.require_any(dataset, "verdict")
    horizontal = cells.speed_axis(dataset, varying)
    vertical = next(name for name in varying if name != horizontal)
    panels = Panels(height=3.4, margins=Margins(right=0.3))
    axes = panels.axes[0][0]
    code = cells.states(dataset).values
    handles = []
    for state, marker in enumerate(_MARKERS):
        chosen = dataset.isel(point=code == state)
        if chosen.sizes["point"]:
            colour: dict[str, Any] = (
                {"edgecolors": FRAME_GREY} if state == cells.STABLE else {"color": STATE_COLOURS[state]}
            )
            label = f"{STATE_NAMES[state]} ({chosen.sizes['point']})"
            handles.append(axes.scatter(chosen[horizontal], chosen[vertical], s=22, label=label, **marker, **colour))
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _multipliers(dataset: xr.Dataset) -> Figure:
    cells.require_any(dataset, "floquet_multiplier")
    cells.require_values(dataset["floquet_multiplier"])
    panels = Panels(height=4.0, margins=Margins(left=1.5, right=1.5))
    axes = panels.axes[0][0]
    angle = np.linspace(0, 2 * np.pi, 361)
    circle = axes.plot(np.cos(angle), np.sin(angle), color=FRAME_GREY, linewidth=0.8, label="unit circle")
    values = dataset["floquet_multiplier"].values
    dots = axes.plot(values.real, values.imag, "o", color=LINE_COLOURS[0], markersize=5, label="Floquet multipliers")  # pyright: ignore[reportAttributeAccessIssue]
    axes.set_aspect("equal", adjustable="datalim")
    panels.label_axes("real part of the multiplier", "imaginary part")
    panels.titles(dataset)
    panels.legend([*dots, *circle])
    return panels.figure
