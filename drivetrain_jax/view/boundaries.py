"""Stability boundaries as curves and the tips of tongues as named points, where a chart comes from an atlas."""

from __future__ import annotations

import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from drivetrain_jax.view.resonances import label_text
from drivetrain_jax.view.style import FRAME_GREY, PREDICTION

_MARK = {"marker": "o", "markersize": 3.0, "markerfacecolor": "white", "markeredgewidth": 0.7, "linestyle": "none"}
_FONT = 7.5


def draw(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
    """Draw what ``dataset`` has of both (``boundary_NAME``, ``tip_NAME``); handles for the legend."""
    handles: list[Artist] = []
    keep = {"scalex": False, "scaley": False}
    if dataset.sizes.get("boundary"):
        x, y = (dataset[f"boundary_{name}"] for name in (horizontal, vertical))
        handles += axes.plot(x, y, color=FRAME_GREY, linewidth=0.6, label="boundary of stability", **keep)
    if dataset.sizes.get("tip"):
        x, y = (dataset[f"tip_{name}"].values for name in (horizontal, vertical))
        handles += axes.plot(x, y, color=PREDICTION, label="tip of a tongue", zorder=4, **_MARK, **keep)
        for name, across, up in zip(dataset["tip"].values.astype(str), x, y, strict=True):
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
    return handles
