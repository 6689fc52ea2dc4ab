"""Figures of the analysis ``steady_state``: regimes and amplitudes over parameters, basins, and a single motion."""

from __future__ import annotations

import itertools

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import cells, regimes
from drivetrain_jax.view.figure_layout import WIDTH, Margins, Panels
from drivetrain_jax.view.growth import scale_around_limit
from drivetrain_jax.view.style import (
    ATTRACTOR_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    STATE_COLOURS,
    STYLE,
    axis_label,
    units_of,
    variable_label,
)

_HEIGHT, _PORTRAIT = 2.45, 3.1
# Relative difference of amplitudes below which attractors are the same.
_SAME = 1e-5


def plot(dataset: xr.Dataset) -> Figure:
    """The figure of a ``steady_state`` result, by its axes.

    - none: time history and phase portrait of the motion (needs ``u_history`` and ``v_history``);
    - one: extremes, period multiple, growth, impact velocity and contact fraction of both flanks along the axis, over bands
      of the regimes;
    - the initial state: basins of the attractors with the share of each;
    - any other two: the regime and the largest displacement, with a predicted threshold.

    Axes of one value count as fixed. Raises :class:`InputError` for other axes, and if variables are missing.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if not names:
            return _motion(dataset)
        if len(names) == 1 and names != ["point"]:
            return _curves(dataset, names[0])
        initial = [cells.role(dataset, role) for role in ("initial_displacement", "initial_rate")]
        if set(names) == set(initial):
            return _basins(dataset, *initial)
        if len(names) == 2:
            return _maps(dataset, names)
        raise InputError(f"axes = {', '.join(names)}: allowed are at most two axes for a figure of steady states")


def _maps(dataset: xr.Dataset, names: list[str]) -> Figure:
    horizontal = cells.speed_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    shown = cells.require_any(dataset, "regime", "u_max")
    panels = Panels(len(shown), height=_HEIGHT, margins=Margins(right=1.15))
    handles: list[Artist] = []
    for (axes,), name in zip(panels.axes, shown, strict=True):
        if name == "regime":
            regimes.draw(axes, dataset, dataset[name], horizontal, vertical)
            handles += regimes.legend(dataset)
        else:
            cmap = matplotlib.colormaps["cividis_r"].with_extremes(bad=STATE_COLOURS[cells.FAILED])
            field = dataset[name].where(dataset["outcome"] < FIRST_FAILURE)
            mesh = cells.draw_cells(axes, field, horizontal, vertical, cmap=cmap, norm=PowerNorm(0.5))
            panels.colorbar(axes, mesh, variable_label(dataset[name]))
        handles += regimes.draw_threshold(axes, dataset, horizontal, vertical)[: 1 if axes is panels.axes[-1][0] else 0]
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    extremes = cells.require_any(dataset, "u_max", "u_min")
    scalars = [key for key in ("period_multiple", "spectral_radius", "lyapunov_exponent") if key in dataset]
    by_flank = [key for key in ("impact_velocity", "contact_fraction") if key in dataset]
    panels = Panels(1 + len(scalars) + len(by_flank), height=1.75, margins=Margins(right=0.3, left=1.0), share_y=False)
    first, *stack = [row[0] for row in panels.axes]
    known = dataset["outcome"] < FIRST_FAILURE
    handles = _extremes(first, dataset, name, extremes)
    panels.label_row(first, f"extremes of the displacement [{units_of(dataset[extremes[0]])}]")
    for axes, key in zip(stack, [*scalars, *by_flank], strict=True):
        label, values = variable_label(dataset[key]), dataset[key].where(known)
        if key in by_flank:
            entries = _flanks(axes, dataset[name], values)
            handles += entries if key == by_flank[0] else []
        else:
            if key == "spectral_radius":
                label, values = f"{label} minus 1", values - 1
                scale_around_limit(axes, values)
            _dots(axes, dataset[name], values, LINE_COLOURS[0], "")
        panels.label_row(axes, label)
        if key == "period_multiple":
            axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        if key in ("spectral_radius", "lyapunov_exponent"):
            axes.axhline(0, color=FRAME_GREY, linewidth=0.8, linestyle=(0, (2, 2)))
    handles += regimes.draw_bands(dataset, name, first, *stack)
    cells.fit_axis(first, "x", dataset[name].values)
    handles += cells.draw_failures(first, dataset, name)
    panels.label_axes(axis_label(dataset[name]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _extremes(axes: Axes, dataset: xr.Dataset, name: str, extremes: list[str]) -> list[Artist]:
    """Draw the extremes, with a separate colour for non-periodic motions, and both flanks."""
    handles: list[Artist] = []
    other = regimes.COLOURS[regimes.NON_PERIODIC]
    known = dataset["outcome"] < FIRST_FAILURE
    wandering = known & (dataset["period_multiple"] == 0) if "period_multiple" in dataset else known & False
    for key, colour in zip(extremes, LINE_COLOURS, strict=False):
        label = dataset[key].attrs.get("long_name", key)
        handles += _dots(axes, dataset[name], dataset[key].where(known & ~wandering), colour, label)
        _dots(axes, dataset[name], dataset[key].where(wandering), other, "")
    if bool(wandering.any()):
        style = {"linestyle": "", "marker": "o", "markersize": 3, "color": other}
        handles.append(Line2D([], [], label="non-periodic", **style))
    return [*handles, *regimes.draw_flanks(dataset, axes)]


def _flanks(axes: Axes, x: xr.DataArray, y: xr.DataArray) -> list[Line2D]:
    """Draw the values of both flanks."""
    handles = []
    for colour, flank in zip(LINE_COLOURS, y["flank"].values, strict=False):
        handles += _dots(axes, x, y.sel(flank=flank), colour, f"{flank} flank")
    return handles


def _dots(axes: Axes, x: xr.DataArray, y: xr.DataArray, colour: str, label: str) -> list[Line2D]:
    return axes.plot(x, y, linestyle="", marker="o", markersize=1.8, color=colour, label=label)


def _basins(dataset: xr.Dataset, horizontal: str, vertical: str) -> Figure:
    cells.require(dataset, "u_max", "period_multiple")
    codes, names = _attractors(dataset)
    panels = Panels(height=4.2, margins=Margins(right=2.3))
    axes = panels.axes[0][0]
    colours = ListedColormap([*ATTRACTOR_COLOURS[: len(names)], STATE_COLOURS[cells.FAILED]])
    cells.draw_cells(axes, codes, horizontal, vertical, cmap=colours, vmin=-0.5, vmax=len(names) + 0.5)
    share = [float((codes == k).mean()) for k in range(len(names) + 1)]
    handles = [
        Patch(facecolor=colour, edgecolor=FRAME_GREY, linewidth=0.6, label=f"{label}: {part:.1%}")
        for colour, label, part in zip(colours.colors, [*names, "other or failed"], share, strict=True)  # pyright: ignore[reportArgumentType]
        if part > 0
    ]
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _attractors(dataset: xr.Dataset) -> tuple[xr.DataArray, list[str]]:
    """The attractors by falling share: the number of each point's attractor, and its properties."""
    known = (dataset["outcome"] < FIRST_FAILURE).values
    multiple, high = dataset["period_multiple"].values, dataset["u_max"].values
    units = units_of(dataset["u_max"])
    # All non-periodic motions count as one attractor.
    level = np.where(multiple > 0, np.log(np.abs(np.where(known, high, 1.0)) + 1e-300) / _SAME, 0.0)
    keys = [(int(m), round(float(x))) for m, x in zip(multiple[known], level[known], strict=True)]
    merged = _merge(keys)
    kinds, counts = np.unique(merged, return_counts=True)
    kinds = kinds[np.argsort(-counts)][: len(ATTRACTOR_COLOURS)]
    codes = np.full(known.shape, len(kinds))
    flat = np.full(len(merged), len(kinds))
    names = []
    for number, kind in enumerate(kinds):
        flat[merged == kind] = number
        first = int(np.flatnonzero(merged == kind)[0])
        m = keys[first][0]
        size = high[known][first]
        names.append(f"period {m}, largest u {size:.4g} {units}".rstrip() if m else "non-periodic")
    codes[known] = flat
    return dataset["outcome"].copy(data=codes), names


def _merge(keys: list[tuple[int, int]]) -> np.ndarray:
    """Numbers of classes of ``(multiple, level)`` whose levels form chains of neighbours."""
    order = sorted(range(len(keys)), key=keys.__getitem__)
    numbers = np.zeros(len(keys), int)
    current = 0
    for before, here in itertools.pairwise(order):
        near = keys[before][0] == keys[here][0] and keys[here][1] - keys[before][1] <= 1
        current += not near
        numbers[here] = current
    return numbers


def _motion(dataset: xr.Dataset) -> Figure:
    cells.require(dataset, "u_history", "v_history")
    cells.require_values(dataset["u_history"])
    u, v, part = dataset["u_history"], dataset["v_history"], dataset["sample"]
    height = 2.6
    panels = Panels(height=height, margins=Margins(left=0.85, right=_PORTRAIT + 0.3))
    history = panels.axes[0][0]
    box = history.get_position()
    portrait = panels.figure.add_axes((1 - (_PORTRAIT - 0.7) / WIDTH, box.y0, (_PORTRAIT - 0.85) / WIDTH, box.height))
    handles = history.plot(part, u, color=LINE_COLOURS[0], label="displacement")
    portrait.plot(np.append(u, u[0]), np.append(v, v[0]), color=LINE_COLOURS[0])
    portrait.plot(u[0], v[0], "o", markersize=4, color=LINE_COLOURS[1])
    handles.append(
        Line2D([], [], linestyle="", marker="o", markersize=4, color=LINE_COLOURS[1], label="start of a drive period")
    )
    history.plot(part[0], u[0], "o", markersize=4, color=LINE_COLOURS[1])
    handles += regimes.draw_flanks(dataset, history, portrait=portrait)
    history.set_xlim(0, 1)
    panels.label_axes("part of the motion's period", variable_label(u))
    # At the left, clear of a power of ten at the right end.
    portrait.set_xlabel(variable_label(u), loc="left")
    portrait.set_ylabel(variable_label(v))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure
