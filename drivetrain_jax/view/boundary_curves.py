"""Draw stability boundaries as curves and tips of tongues as named points, in charts of an atlas."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from drivetrain_jax.view.resonance_lines import label_text
from drivetrain_jax.view.style import FLAG_COLOURS, FRAME_GREY, PREDICTION

_MARK = {"marker": "o", "markersize": 3.0, "markerfacecolor": "white", "markeredgewidth": 0.7, "linestyle": "none"}
_FONT = 7.5
# Width and height of a name in points.
_SIZE = np.array([15.0, 9.0])
# Positions of a name relative to the tip of a tongue that opens upwards, in points, and its alignment.
_SIDES = {
    (0, -1): ("center", "top"),
    (1, 0): ("left", "center"),
    (-1, 0): ("right", "center"),
    (0, 1): ("center", "bottom"),
}


def draw_curves(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
    """Draw the traced boundaries, if there are any; returns their legend handle."""
    if not traced(dataset, horizontal, vertical):
        return []
    x, y = (dataset[f"boundary_{name}"] for name in (horizontal, vertical))
    style = {"color": FRAME_GREY, "linewidth": 0.6, "label": "boundary", "scalex": False, "scaley": False}
    return [*axes.plot(x, y, **style)]


def traced(dataset: xr.Dataset, horizontal: str, vertical: str) -> bool:
    """True if ``dataset`` has boundaries over these two axes."""
    return (
        all(f"boundary_{name}" in dataset.coords for name in (horizontal, vertical)) and dataset.sizes["boundary"] > 0
    )


def draw_tips(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
    """Draw the tips of tongues and the boxes that may contain further ones, if stored; returns legend entries."""
    entries: list[Artist] = []
    colour = FLAG_COLOURS["undecided"]
    proved = dataset["tip_proved"].values.astype(bool) if "tip_proved" in dataset.coords else np.empty(0, bool)
    for chosen, label in ((proved, "tip"), (~proved, "tip, by estimate")):
        if chosen.any():
            x, y = (dataset[f"tip_{name}"].values[chosen] for name in (horizontal, vertical))
            style = _MARK if label == "tip" else {**_MARK, "marker": "D", "markerfacecolor": colour}
            keep: dict[str, Any] = {"scalex": False, "scaley": False}
            entries += axes.plot(x, y, color=PREDICTION, label=label, zorder=4, **style, **keep)
    if f"undecided_{horizontal}" not in dataset.coords:
        return entries
    x, y = (dataset[f"undecided_{name}"].values for name in (horizontal, vertical))
    corners: Any = np.stack([x[:, [0, 1, 1, 0]], y[:, [0, 0, 1, 1]]], axis=-1)
    # With outlines: most boxes are smaller than a pixel.
    boxes = PolyCollection(corners, facecolor=colour, edgecolor=colour, linewidth=1.5, zorder=3)
    axes.add_collection(boxes, autolim=False)
    return [*entries, Patch(facecolor=colour, label="narrow unstable ranges may lie here")]


def name_tips(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> None:
    """Write the names of tips outside of the tongues, or next to the tips; omit names that overlap, repeat or leave the
    panel."""
    x, y = (dataset[f"tip_{name}"].values for name in (horizontal, vertical))
    # Without this variable all tongues open upwards.
    opens = dataset["tip_opens"].values if "tip_opens" in dataset.coords else np.ones(len(x))
    tips, names = np.stack([x, y], axis=-1), dataset["tip"].values.astype(str)
    scale = 72 / axes.figure.dpi
    low, high = axes.bbox.min * scale + _SIZE / 2, axes.bbox.max * scale - _SIZE / 2  # pyright: ignore[reportOperatorIssue]
    taken: list[np.ndarray] = []
    named: list[tuple[str, np.ndarray]] = []
    for name, tip, up in zip(names, tips, opens, strict=True):
        mark = axes.transData.transform(tip) * scale
        # Unproved tips may lie within their errors of each other.
        if any(name == other and (np.abs(mark - at) < _SIZE / 2).all() for other, at in named):
            continue
        sides = [(across, rise if up else -rise) for across, rise in _SIDES]
        middles = {side: mark + np.array(side) * (0.7, 1.0) * _SIZE for side in sides}
        inside = {side: at for side, at in middles.items() if ((at >= low) & (at <= high)).all()}
        free = (s for s, at in inside.items() if all((np.abs(at - other) >= _SIZE).any() for other in taken))
        side = next(free, None)
        if side is None:
            continue
        taken.append(middles[side])
        named.append((name, mark))
        aligned, level = _SIDES[side]
        axes.annotate(
            label_text(name),
            tip,
            xytext=3.5 * np.array(side),  # pyright: ignore[reportArgumentType]
            textcoords="offset points",
            ha=aligned,
            va=level,
            size=_FONT,
            color=PREDICTION,
            path_effects=[withStroke(linewidth=2, foreground="white")],
        )
