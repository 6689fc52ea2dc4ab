"""Stability boundaries as curves and the tips of tongues as named points, where a chart comes from an atlas."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from drivetrain_jax.view.resonances import label_text
from drivetrain_jax.view.style import FRAME_GREY, PREDICTION, STATE_COLOURS

_MARK = {"marker": "o", "markersize": 3.0, "markerfacecolor": "white", "markeredgewidth": 0.7, "linestyle": "none"}
_FONT = 7.5
# Width and height that a name takes, in points.
_ROOM = (15.0, 9.0)


def draw(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
    """Draw what ``dataset`` has of both (``boundary_NAME``, ``tip_NAME``, ``undecided_NAME``); handles for the legend."""
    handles: list[Artist] = []
    keep = {"scalex": False, "scaley": False}
    if dataset.sizes.get("boundary"):
        x, y = (dataset[f"boundary_{name}"] for name in (horizontal, vertical))
        handles += axes.plot(x, y, color=FRAME_GREY, linewidth=0.6, label="boundary", **keep)
    boxes = _draw_undecided(axes, dataset, horizontal, vertical)
    proved = dataset["tip_proved"].values.astype(bool) if "tip_proved" in dataset.coords else np.empty(0, bool)
    for chosen, label in ((proved, "tip"), (~proved, "not proved")):
        if chosen.any():
            x, y = (dataset[f"tip_{name}"].values[chosen] for name in (horizontal, vertical))
            style = _MARK if label == "tip" else {**_MARK, "marker": "D", "markerfacecolor": STATE_COLOURS[2]}
            handles += axes.plot(x, y, color=PREDICTION, label=label, zorder=4, **style, **keep)
    if proved.size:
        _name(
            axes, dataset["tip"].values.astype(str), *(dataset[f"tip_{name}"].values for name in (horizontal, vertical))
        )
    # The mark of a tip that is not proved explains the boxes too.
    return handles if proved.size and not proved.all() else handles + boxes


def _draw_undecided(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
    """The boxes that may hide further tips: most are smaller than a pixel, hence outlined."""
    if f"undecided_{horizontal}" not in dataset.coords:
        return []
    x, y = (dataset[f"undecided_{name}"].values for name in (horizontal, vertical))
    corners = np.stack([x[:, [0, 1, 1, 0]], y[:, [0, 0, 1, 1]]], axis=-1)
    colour = STATE_COLOURS[2]
    boxes = PolyCollection(corners, facecolor=colour, edgecolor=colour, linewidth=1.5, zorder=3)
    axes.add_collection(boxes, autolim=False)
    return [Patch(facecolor=colour, label="may hide tips")]


def _name(axes: Axes, names: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Names below the tips, apart from those that would cover an earlier one."""
    places = axes.transData.transform(np.stack([x, y], axis=-1)) * 72 / axes.figure.dpi
    for i, (name, across, up) in enumerate(zip(names, x, y, strict=True)):
        if (np.abs(places[:i] - places[i]) < _ROOM).all(axis=1).any():
            continue
        axes.annotate(
            label_text(name),
            (across, up),
            xytext=(0, -3.5),
            textcoords="offset points",
            ha="center",
            va="top",
            size=_FONT,
            color=PREDICTION,
            path_effects=[withStroke(linewidth=2, foreground="white")],
        )
