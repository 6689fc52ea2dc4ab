"""Figures of the analysis ``history``: two components of the state over time, and the phase portrait."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells, regimes
from drivetrain_jax.view.figure_layout import DPI, WIDTH, NotebookFigure, wrap_caption, write_title
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STYLE,
    caption,
    coordinate_text,
    in_brackets,
    state,
    symbol,
    units_of,
)

_LINE: dict[str, Any] = {"color": LINE_COLOURS[0], "linewidth": 0.6, "markersize": 3.5}
_MOST_ROWS = 8
_CAPTION_LINES = 2
# Largest number of turns of the 3-D curve, to keep it legible.
_MOST_TURNS = 24


def plot(dataset: xr.Dataset) -> Figure:
    """Displacement and rate over time, phase portrait, and for a single history the 3-D curve of both over time.

    Displacement and rate are the first two components of the state. One history has four panels. One axis or ``[points]``
    has a row of three panels for each of up to eight values. A history without values has empty panels with a note. Raises
    :class:`InputError` for more axes or values, and unless both components are stored.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        cells.require(dataset, *_components(dataset))
        names = cells.sweep_axes(dataset)
        if not names:
            return _single(dataset)
        if len(names) == 1 and dataset.sizes[names[0]] <= _MOST_ROWS:
            return _rows(dataset, names[0])
        raise InputError(
            f"axes = {', '.join(names)}: allowed is one axis of up to {_MOST_ROWS} values for a figure of histories"
        )


def _components(dataset: xr.Dataset) -> list[str]:
    """Names of the first displacement and of its rate; displacements are the first half of the state."""
    names = [str(c["name"]) for c in state(dataset)]
    return [names[0], names[len(names) // 2]] if names else ["displacement", "rate"]


def _single(dataset: xr.Dataset) -> Figure:
    height = 6.4
    figure = _figure(dataset, height)
    boxes = [(x, y, 2.55, 2.0) for y in (3.4, 0.55) for x in (0.75, 4.15)]
    along, rate, portrait = (_add(figure, boxes[k], height) for k in (0, 1, 3))
    _draw(dataset, along, rate, portrait)
    for axes in (along, rate):
        axes.set_xlabel(_label(dataset, "time"))
    space = _add(figure, (0.35, 0.3, 3.1, 2.25), height, projection="3d")
    assert isinstance(space, Axes3D)
    _draw_space(dataset, space)
    for axes, letter in zip((along, rate, space, portrait), "abcd", strict=True):
        _letter(axes, letter)
    return figure


def _rows(dataset: xr.Dataset, varies: str) -> Figure:
    count = dataset.sizes[varies]
    row, top, bottom = 1.85, 0.65, 0.35
    height = top + bottom + count * row
    figure = _figure(dataset, height)
    for k in range(count):
        history = dataset.isel({varies: k})
        y = height - top - (k + 1) * row + 0.3
        boxes = [(x, y, 1.5, row - 0.6) for x in (0.75, 3.0, 5.3)]
        along, rate, portrait = (_add(figure, box, height) for box in boxes)
        _draw(history, along, rate, portrait)
        rate.text(0.5, 1.06, _entry(history, varies), transform=rate.transAxes, ha="center", color=FRAME_GREY)
        for axes in (along, rate, portrait):
            axes.set_xlabel(
                _label(dataset, _components(dataset)[0] if axes is portrait else "time") if k == count - 1 else ""
            )
    return figure


def _line(history: xr.Dataset) -> dict[str, Any]:
    """Line style of a history; a single time has no line."""
    return _LINE | {"marker": "o" if history.sizes["time"] == 1 else ""}


def _draw(history: xr.Dataset, along: Axes, rate: Axes, portrait: Axes) -> None:
    first, second = _components(history)
    x, v = history[first].values, history[second].values
    along.plot(history["time"], x, **_line(history))
    rate.plot(history["time"], v, **_line(history))
    portrait.plot(x, v, **_line(history))
    along.set_ylabel(_label(history, first))
    for axes in (rate, portrait):
        axes.set_ylabel(_label(history, second))
    portrait.set_xlabel(_label(history, first))
    for axes in (along, rate) if history.sizes["time"] > 1 else ():
        axes.set_xlim(history["time"].values[0], history["time"].values[-1])
    regimes.draw_flanks(history, along, portrait=portrait)
    if not np.isfinite(x).any():
        for axes in (along, rate, portrait):
            axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color=FRAME_GREY)


def _draw_space(history: xr.Dataset, space: Axes3D) -> None:
    shown = [*_components(history), "time"]
    curve = np.stack([history[name].values for name in shown])
    turns, envelope = _thinned(curve)
    space.plot(*turns, **_line(history))
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
    space.set_box_aspect((1, 1, 0.8), zoom=0.92)  # pyright: ignore[reportArgumentType]


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


def _figure(dataset: xr.Dataset, height: float) -> Figure:
    figure = NotebookFigure(figsize=(WIDTH, height), dpi=DPI)
    left = 0.35 / WIDTH
    write_title(figure, dataset, 0.35)
    text = wrap_caption(caption(dataset), WIDTH - 0.35 - 0.1, _CAPTION_LINES)
    figure.text(left, 1 - 0.32 / height, text, va="top", size=8, color=FRAME_GREY)
    return figure


def _add(figure: Figure, box: tuple[float, float, float, float], height: float, **options: Any) -> Axes:
    """Axes in the box (left, bottom, width, height) in inches."""
    x, y, w, h = box
    return figure.add_axes((x / WIDTH, y / height, w / WIDTH, h / height), **options)


def _letter(axes: Axes, letter: str) -> None:
    corner = axes.get_position()
    figure = axes.get_figure()
    assert figure is not None
    figure.text(_LETTER_COLUMN[letter], corner.y1 + 0.012, f"({letter})", ha="right", va="bottom", weight="bold")


_LETTER_COLUMN = {"a": 0.06, "c": 0.06, "b": 0.55, "d": 0.55}


def _label(dataset: xr.Dataset, name: str) -> str:
    """``symbol [units]`` of a component or the time."""
    symbols = {c["name"]: c["symbol"] for c in state(dataset)}
    mark = "$t$" if name == "time" else symbols.get(name) or symbol(name)
    return f"{mark}{in_brackets(units_of(dataset[name]))}"


def _entry(history: xr.Dataset, name: str) -> str:
    """The parameters that differ between the rows."""
    if name != "point":
        return coordinate_text(history[name])
    own = [c for name, c in history.coords.items() if c.ndim == 0 and name != "point"]
    return ", ".join(map(coordinate_text, own))
