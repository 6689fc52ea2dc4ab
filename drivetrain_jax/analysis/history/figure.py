"""Figures of the analysis ``history``: two components of the state over time, and the phase portrait."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS, coordinate_text, in_brackets, state, symbol, units_of

_LINE: dict[str, Any] = {"color": LINE_COLOURS[0], "linewidth": 0.6, "markersize": 3.5}
_MOST_ROWS = 8
# Largest number of turns of the 3-D curve, to keep it legible.
_MOST_TURNS = 24


def plot(dataset: xr.Dataset) -> Figure:
    """Displacement and rate over time, phase portrait, and for a single history the 3-D curve of both over time.

    Displacement and rate are the first two components of the state. One history has four panels. One axis or ``[points]``
    has a row of three panels for each of up to eight values. A history without values has empty panels with a note. Raises
    :class:`InputError` for more axes or values, and unless both components are stored.
    """
    charts.require(dataset, *_components(dataset))
    names = charts.sweep_axes(dataset)
    # Of a state with an axis of its own, the last entry: the free end of a driveline.
    dataset = dataset.isel({d: -1 for d in dataset[_components(dataset)[0]].dims if d not in (*names, "time")})
    if not names:
        return _single(dataset)
    if len(names) > 1 or dataset.sizes[names[0]] > _MOST_ROWS:
        raise charts.wrong_axes(dataset, f"one axis of up to {_MOST_ROWS} values for a figure of histories")
    parts = [dataset.isel({names[0]: k}) for k in range(dataset.sizes[names[0]])]
    sheet = Sheet(len(parts), 3, height=1.7, sharex="col", sharey=False)
    for row, history in zip(sheet.axes, parts, strict=True):
        _draw(history, *row)
        own = {name: c for name, c in history.coords.items() if not c.ndim and name != "point"}
        varies = [names[0]] if names[0] in own else own
        row[1].set_title(", ".join(coordinate_text(own[name]) for name in varies), color=FRAME_GREY, size=8)
        for axes in row if history is not parts[-1] else ():
            axes.set_xlabel("")
    return sheet.finish(dataset)


def _components(dataset: xr.Dataset) -> list[str]:
    """Names of the first displacement and of its rate; displacements are the first half of the state."""
    names = [str(c["name"]) for c in state(dataset)]
    return [names[0], names[len(names) // 2]] if names else ["displacement", "rate"]


def _single(dataset: xr.Dataset) -> Figure:
    sheet = Sheet(2, 2, height=2.75, sharex=False, sharey=False)
    along, rate, flat, portrait = sheet.axes.flat
    _draw(dataset, along, rate, portrait)
    space = sheet.figure.add_subplot(flat.get_subplotspec(), projection="3d")
    flat.remove()
    assert isinstance(space, Axes3D)
    _draw_space(dataset, space)
    for axes, letter in zip((along, rate, space, portrait), "abcd", strict=True):
        axes.set_title(f"({letter})", loc="left", weight="bold", size=8)
    return sheet.finish(dataset)


def _draw(history: xr.Dataset, along: Axes, rate: Axes, portrait: Axes) -> None:
    first, second = _components(history)
    x, v, time = history[first].values, history[second].values, history["time"].values
    # A single time has no line.
    style: dict[str, Any] = _LINE | {"marker": "o" if time.size == 1 else ""}
    for axes, places, values, names in (
        (along, time, x, ("time", first)),
        (rate, time, v, ("time", second)),
        (portrait, x, v, (first, second)),
    ):
        axes.plot(places, values, **style)
        axes.set(xlabel=_label(history, names[0]), ylabel=_label(history, names[1]))
        if axes is not portrait and time.size > 1:
            axes.set_xlim(time[0], time[-1])
        if not np.isfinite(x).any():
            axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color=FRAME_GREY)
    charts.draw_flanks(history, along, portrait=portrait)


def _draw_space(history: xr.Dataset, space: Axes3D) -> None:
    shown = [*_components(history), "time"]
    curve = np.stack([history[name].values for name in shown])
    turns, envelope = _thinned(curve)
    style: dict[str, Any] = _LINE | {"marker": "o" if curve.shape[1] == 1 else ""}
    space.plot(*turns, **style)
    for extremes in envelope:
        space.plot(*extremes, color=FRAME_GREY, linewidth=0.8)
    space.set(**{f"{axis}label": _label(history, name) for axis, name in zip("xyz", shown, strict=True)})
    space.tick_params(labelsize=6.5, pad=-2)
    axis: Any
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.labelpad = -3
        axis.label.set_size(7.5)
        axis.pane.set_facecolor("white")
    space.locator_params(nbins=4)
    space.view_init(elev=22, azim=-58)
    space.set_box_aspect((1, 1, 0.8), zoom=1.05)  # pyright: ignore[reportArgumentType]


def _thinned(curve: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The curve (3, T) of displacement, rate and time, thinned to ``_MOST_TURNS`` turns with NaN between them, and the lines
    through its extremes.

    A curve of few turns is unchanged and has no such lines.
    """
    rises = curve[1] > 0
    maxima, minima = (np.flatnonzero((rises[:-1] == up) & (rises[1:] != up)) for up in (True, False))
    if len(maxima) <= 2 * _MOST_TURNS:
        return curve, []
    turn = np.searchsorted(maxima, np.arange(curve.shape[1]))
    kept = np.unique(np.linspace(0, len(maxima), _MOST_TURNS).astype(int))
    at_rest = curve * np.array([[1], [0], [1]])
    return np.where(np.isin(turn, kept), curve, np.nan), [at_rest[:, maxima], at_rest[:, minima]]


def _label(dataset: xr.Dataset, name: str) -> str:
    """``symbol [units]`` of a component or the time."""
    symbols = {c["name"]: c["symbol"] for c in state(dataset)}
    mark = "$t$" if name == "time" else symbols.get(name) or symbol(name)
    return f"{mark}{in_brackets(units_of(dataset[name]))}"
