"""Lines over charts: predicted resonances, labelled at the edges; boundaries, named tips and undecided boxes of an atlas."""

from __future__ import annotations

import json
import re
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from drivetrain_jax._rules import BUILT_IN, Declared
from drivetrain_jax.view.sheet import write_names
from drivetrain_jax.view.style import FLAG_COLOURS, FRAME_GREY, PREDICTION

_FAMILY_DASHES = {"solid": "-", "dashed": (0, (5, 2)), "dashdot": (0, (5, 1.5, 1, 1.5))}
_MARK = {"marker": "o", "markersize": 3.0, "markerfacecolor": "white", "markeredgewidth": 0.7, "linestyle": "none"}
# Type size of the name of a tip, its width and height, and its distance from the tip, in points.
_FONT, _NAME, _BESIDE = 7.5, np.array([15.0, 9.0]), 3.5


class Prediction(NamedTuple):
    """One predicted line: values of the horizontal axis, values of the vertical axis unless the line is vertical, and name
    and line style of its family."""

    label: str
    x: np.ndarray
    y: np.ndarray | None
    family: str
    dashes: Any

    @property
    def order(self) -> int:
        """Last digit of the label, or 0."""
        digits = re.findall(r"\d", self.label)
        return int(digits[-1]) if digits else 0


def predictions(dataset: xr.Dataset, horizontal: str, vertical: str | None = None) -> list[Prediction]:
    """Predicted lines over ``horizontal``, those of forced responses only of families that the forcing excites; [] without
    any."""
    name = f"resonance_{horizontal}"
    if name not in dataset.coords:
        return []
    lines, shown = [], BUILT_IN.get(str(dataset.attrs.get("analysis")), Declared()).predicted
    families = json.loads(dataset.attrs.get("resonance_families", "{}"))
    for index, label in enumerate(dataset["resonance"].values.astype(str)):
        # The family with the longest matching prefix, else one named by the first letter.
        prefixes = [prefix for prefix in families if label.startswith(prefix)]
        family = families[max(prefixes, key=len)] if prefixes else {"name": label[:1]}
        if not family.get("drawn", True) or (shown == "forced" and not family.get("forced")):
            continue
        values = dataset[name].isel(resonance=index)
        y = dataset[vertical].values if vertical is not None and vertical in values.dims else None
        dashes = _FAMILY_DASHES.get(family.get("line", ""), "-")
        lines.append(Prediction(label, np.atleast_1d(values.values), y, family["name"], dashes))
    return lines


def label_text(label: str) -> str:
    """``C+1`` as a formula; text other than letters, sign and digits stays unchanged."""
    match = re.fullmatch(r"([A-Za-z]+)([+-]?)(\d+)", label)
    if not match:
        return label
    family, sign, index = match.groups()
    return rf"${family}^{{{sign}}}_{{{index}}}$" if sign else rf"${family}_{{{index}}}$"


def draw_predictions(axes: Axes, lines: list[Prediction], below: bool = False) -> list[Line2D]:
    """Draw the lines that cross ``axes``, keeping its limits; returns one legend handle per family.

    Lines ``below`` the cells leave tongues of one cell visible.
    """
    low, high = axes.get_xlim()
    handles: dict[str, Line2D] = {}
    order: dict[str, Any] = {"zorder": -1} if below else {}
    for line in lines:
        if line.x.max() < low or line.x.min() > high:
            continue
        style = {"color": PREDICTION, "linewidth": 0.7, "linestyle": line.dashes, "alpha": 0.9}
        if line.y is None:
            axes.axvline(line.x[0], **style, **order)
        else:
            axes.plot(line.x, line.y, scalex=False, scaley=False, **style, **order)
        handles.setdefault(line.family, Line2D([], [], **style, label=line.family))
    return list(handles.values())


def label_predictions(axes: Axes, lines: list[Prediction]) -> None:
    """Label lines beyond the upper or right edge of ``axes``; where there is no space for all, lines of low order."""
    (left, right), lines = axes.get_xlim(), sorted(lines, key=lambda line: line.order)
    top = [(line, (line.x[-1], axes.get_ylim()[1])) for line in lines if left <= line.x[-1] <= right]
    side = []
    for line in lines:
        crossing = np.flatnonzero((line.x[:-1] <= right) & (line.x[1:] > right))
        if crossing.size and line.y is not None:
            i = slice(crossing[-1], crossing[-1] + 2)
            side.append((line, (right, np.interp(right, line.x[i], line.y[i]))))
    for ends, above in ((top, True), (side, False)):
        names = [label_text(line.label) for line, _ in ends]
        write_names(axes, [end for _, end in ends], names, above=above, colours=PREDICTION, offset=9.0)


def draw_boundaries(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Line2D]:
    """Draw the traced boundaries, if there are any; returns their legend handle."""
    x, y = (dataset.coords.get(f"boundary_{name}") for name in (horizontal, vertical))
    if x is None or y is None or not x.size:
        return []
    style: dict[str, Any] = {"color": FRAME_GREY, "linewidth": 0.6, "label": "boundary"}
    return axes.plot(x, y, scalex=False, scaley=False, **style)


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
    """Write the names of tips outside of the tongues, or within them; omit names that overlap, repeat or leave the panel."""
    if "tip_proved" not in dataset.coords:
        return
    tips = np.stack([dataset[f"tip_{name}"].values for name in (horizontal, vertical)], axis=-1)
    # Without this variable all tongues open upwards.
    opens = dataset["tip_opens"].values if "tip_opens" in dataset.coords else np.ones(len(tips))
    scale = 72 / axes.figure.dpi
    low, high = axes.bbox.min * scale + _NAME / 2, axes.bbox.max * scale - _NAME / 2  # pyright: ignore[reportOperatorIssue]
    taken: list[np.ndarray] = []
    named: list[tuple[str, np.ndarray]] = []
    for name, tip, up in zip(dataset["tip"].values.astype(str), tips, opens, strict=True):
        mark = axes.transData.transform(tip) * scale
        # Unproved tips may lie within their errors of each other.
        if any(name == other and (np.abs(mark - place) < _NAME / 2).all() for other, place in named):
            continue
        for side in (-1, 1) if up else (1, -1):
            middle = mark + side * np.array([0.0, _NAME[1]])
            free = all((np.abs(middle - other) >= _NAME).any() for other in taken)
            if free and (middle >= low).all() and (middle <= high).all():
                taken.append(middle)
                named.append((name, mark))
                style: dict[str, Any] = {"ha": "center", "va": "bottom" if side > 0 else "top", "color": PREDICTION}
                style |= {"size": _FONT, "path_effects": [withStroke(linewidth=2, foreground="white")]}
                axes.annotate(label_text(name), tip, (0, _BESIDE * side), textcoords="offset points", **style)
                break
