"""Interference (Campbell) diagram: natural frequencies over the speed of a shaft, crossed by the lines of its orders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax.resonances import FREQUENCIES, Orders, in_hertz, operating_range
from drivetrain_jax.view.charts import require_values
from drivetrain_jax.view.sheet import Sheet, plain_decades, write_names
from drivetrain_jax.view.style import LINE_COLOURS

# Ratio of the frequencies above which the axes are logarithmic.
_WIDE = 8.0
_DASHES = ("solid", "dashed", "dotted", "dashdot")
# Space beyond the outermost crossings (on logarithmic axes), and beyond the operating range, relative to them.
_SPACE, _LOG_SPACE, _BEYOND = 1.12, 1.5, 1.4
# Most modes of which all orders have numbers.
_FEW = 8


def draw(dataset: xr.Dataset, orders: Orders, colours: Sequence[str], kinds: Mapping[str, str]) -> Figure:
    """The diagram of one point: ``colours`` of its modes, and the ``kinds`` of colours for the legend.

    Crossings have their speeds as numbers, of many modes only those with the first order. With an operating range only its
    surroundings are shown. Raises :class:`InputError` without a positive frequency.
    """
    stored = dataset[next(name for name in FREQUENCIES if name in dataset)]
    require_values(stored, positive=True)
    frequency = in_hertz(stored.values, stored.attrs["units"])
    speeds = orders.speeds(frequency)
    operating = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    shown = np.flatnonzero(np.isfinite(speeds[:, 0]))
    sheet = Sheet(height=4.2)
    axes = sheet.axes[0, 0]
    low, high = _limits(axes, frequency[shown], speeds[shown], operating, orders)
    for mode in shown.tolist():
        axes.axhline(frequency[mode], color=colours[mode], linewidth=0.9)
    sheet.add(*(Line2D([], [], color=colour, label=kind) for kind, colour in kinds.items()))
    ends, heights = np.array([low or 1e-9, high]), frequency[shown]
    for k, ((label, times), dashes) in enumerate(zip(orders.per_turn.items(), _DASHES, strict=False)):
        style = {"color": "black", "linewidth": 0.9, "linestyle": dashes, "label": f"{label} ({times:g}/turn)"}
        sheet.add(*axes.plot(ends, times * ends / 60, **style))
        met = np.stack([speeds[shown, k], heights], axis=-1)
        axes.plot(*met.T, "o", markersize=3.5, color="black", markerfacecolor="white")
        if k == 0 or operating or shown.size <= _FEW:
            sheet.later(lambda met=met: write_names(axes, met, [f"{x:.0f}" for x in met[:, 0]], (4, -4)))
    names = [str(mode) for mode in dataset["mode"].values[shown]]
    sheet.later(lambda: write_names(axes, np.stack([np.full(shown.size, high), heights], axis=-1), names))
    if operating:
        sheet.add(axes.axvspan(*operating, color=LINE_COLOURS[1], alpha=0.2, zorder=0, label="operating speeds"))
    sheet.label(f"speed of the {orders.shaft} [rpm]", "natural frequency [Hz] (number of the mode at the right)")
    return sheet.finish(dataset)


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
        plain_decades(axes, direction)
    return low, high
