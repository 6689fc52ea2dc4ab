"""Interference (Campbell) diagram: natural frequencies over the speed of a shaft, crossed by the lines of its orders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax.resonances import FREQUENCIES, Orders, in_hertz, operating_range
from drivetrain_jax.view import cells
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS

_HEIGHT = 4.2
# Ratio of the frequencies above which the axes are logarithmic.
_WIDE = 8.0
_DASHES = ("solid", "dashed", "dotted", "dashdot")
# Space beyond the outermost crossings (on logarithmic axes), and beyond the operating range, relative to them.
_SPACE, _LOG_SPACE, _BEYOND = 1.12, 1.5, 1.4
# Least vertical distance of two labels, in points. Most modes of which all orders have numbers.
_LINE, _FEW = 7.5, 8


def draw(dataset: xr.Dataset, orders: Orders, colours: Sequence[str], kinds: Mapping[str, str]) -> Figure:
    """The diagram of one point: ``colours`` of its modes, and the ``kinds`` of colours for the legend.

    Crossings have their speeds as numbers, of many modes only those with the first order. With an operating range only its
    surroundings are shown.
    """
    stored = dataset[next(name for name in FREQUENCIES if name in dataset)]
    frequency = in_hertz(stored.values, stored.attrs["units"])
    speeds = orders.speeds(frequency)
    operating = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    shown = np.flatnonzero(np.isfinite(speeds[:, 0]))
    panels = Panels(height=_HEIGHT, margins=Margins(right=0.6, left=0.9, bottom=1.15))
    axes = panels.axes[0][0]
    low, high = _limits(axes, frequency[shown], speeds[shown], operating, orders)
    for mode in shown.tolist():
        axes.axhline(frequency[mode], color=colours[mode], linewidth=0.9)
    handles = [Line2D([], [], color=colour, label=kind) for kind, colour in kinds.items()]
    for k, ((label, times), dashes) in enumerate(zip(orders.per_turn.items(), _DASHES, strict=False)):
        ends = np.array([low or 1e-9, high])
        handles += axes.plot(
            ends, times * ends / 60, color="black", linewidth=0.9, linestyle=dashes, label=f"{label} ({times:g}/turn)"
        )
        met, y = speeds[shown, k], frequency[shown]
        axes.plot(met, y, "o", markersize=3.5, color="black", markerfacecolor="white")
        if k == 0 or operating or shown.size <= _FEW:
            _label(axes, met, y, [f"{x:.0f}" for x in met], (4, -4))
    names = [str(mode) for mode in dataset["mode"].values[shown]]
    _label(axes, np.full(shown.size, high), frequency[shown], names, (3, 0))
    handles += _band(axes, operating)
    panels.label_row(axes, "natural frequency [Hz] (number of the mode at the right)")
    panels.label_axes(f"speed of the {orders.shaft} [rpm]")
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _limits(
    axes: Axes, frequency: np.ndarray, speeds: np.ndarray, operating: tuple[float, float] | None, orders: Orders
) -> tuple[float, float]:
    """Set scales and limits of ``axes``; the lowest and the highest speed."""
    if operating:
        high = _BEYOND * operating[1]
        reached = max(orders.per_turn.values()) * high / 60
        top = np.max(frequency, initial=0.0, where=frequency <= reached) or reached
        axes.set(xlim=(0, high), ylim=(0, _SPACE * top))
        return 0.0, high
    high = _SPACE * np.max(speeds[:, 0])
    if frequency.max() < _WIDE * frequency.min():
        axes.set(xlim=(0, high), ylim=(0, _SPACE * frequency.max()))
        return 0.0, high
    low, high = np.min(speeds) / _SPACE, _LOG_SPACE * np.max(speeds[:, 0])
    axes.set(xscale="log", yscale="log", xlim=(low, high))
    axes.set_ylim(frequency.min() / _SPACE**2, _SPACE * frequency.max())
    for direction in "xy":
        cells.plain_decades(axes, direction)
    return low, high


def _label(axes: Axes, x: np.ndarray, y: np.ndarray, texts: list[str], offset: tuple[float, float]) -> None:
    """Write ``texts`` beside rising points; of close neighbours the first and the last one."""
    groups: list[list[int]] = []
    heights = axes.transData.transform(np.stack([x, y], axis=-1))[:, 1] * 72 / axes.figure.dpi
    for k, height in enumerate(heights):
        if groups and height < heights[groups[-1][0]] + _LINE:
            groups[-1].append(k)
        else:
            groups.append([k])
    style = {"textcoords": "offset points", "va": "center", "size": 6.5, "color": FRAME_GREY, "annotation_clip": True}
    for group in groups:
        ends = dict.fromkeys((texts[group[0]], texts[group[-1]]))
        axes.annotate("\N{EN DASH}".join(ends), (x[group[-1]], y[group].mean()), offset, **style)


def _band(axes: Axes, operating: tuple[float, float] | None) -> list[Artist]:
    if operating is None:
        return []
    return [axes.axvspan(*operating, color=LINE_COLOURS[1], alpha=0.2, zorder=0, label="operating speeds")]
