"""Interference (Campbell) diagram: natural frequencies over the speed of a shaft, crossed by the lines of its orders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drivetrain_jax.resonances import FREQUENCIES, Orders, in_hertz, operating_range
from drivetrain_jax.view.charts import require_values
from drivetrain_jax.view.sheet import Sheet, write_names
from drivetrain_jax.view.style import LINE_COLOURS

_DASHES = ("solid", "dashed", "dotted", "dashdot")
# Range of the axes relative to the outermost crossings, and to the highest operating speed.
_SPACE, _BEYOND = 1.12, 1.4
# Numbers stand below the line of the mode, clear of the line of the order.
_NUMBERS: dict[str, Any] = {"va": "top", "path_effects": [withStroke(linewidth=2, foreground="white")]}
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
    high, top = _SPACE * np.nanmax(speeds[:, 0]), frequency.max()
    if operating:
        high = _BEYOND * operating[1]
        reached = max(orders.per_turn.values()) * high / 60
        top = np.max(frequency, initial=0.0, where=frequency <= reached) or reached
    sheet = Sheet(height=4.2)
    axes = sheet.axes[0, 0]
    axes.set(xlim=(0, high), ylim=(0, _SPACE * top))
    shown = np.flatnonzero(np.isfinite(speeds[:, 0]) & (frequency < _SPACE * top))
    axes.hlines(frequency[shown], 0, high, colors=np.array(colours)[shown], linewidth=0.9)
    names = [str(mode) for mode in dataset["mode"].values[shown]]
    ends = np.stack([np.full(shown.size, high), frequency[shown]], axis=-1)
    sheet.later(partial(write_names, axes, ends, names))
    sheet.add(*(Line2D([], [], color=colour, label=kind) for kind, colour in kinds.items()))
    for k, ((label, times), dashes) in enumerate(zip(orders.per_turn.items(), _DASHES, strict=False)):
        style = {"color": "black", "linewidth": 0.9, "linestyle": dashes, "label": f"{label} ({times:g}/turn)"}
        sheet.add(*axes.plot([0, high], [0, times * high / 60], **style))
        met = np.stack([speeds[shown, k], frequency[shown]], axis=-1)
        met = met[met[:, 0] <= high]
        axes.plot(*met.T, "o", markersize=3.5, color="black", markerfacecolor="white")
        if k == 0 or operating or shown.size <= _FEW:
            sheet.later(
                partial(write_names, axes, met, [f"{speed:.0f}" for speed in met[:, 0]], offset=4.0, **_NUMBERS)
            )
    if operating:
        sheet.add(axes.axvspan(*operating, color=LINE_COLOURS[1], alpha=0.2, zorder=0, label="operating speeds"))
    sheet.label(f"speed of the {orders.shaft} [rpm]", "natural frequency [Hz] (number of the mode at the right)")
    return sheet.finish(dataset)
