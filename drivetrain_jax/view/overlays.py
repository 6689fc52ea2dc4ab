"""Lines over charts: predicted resonances, labelled at the edges; boundaries, named tips and undecided boxes of an atlas."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from drivetrain_jax.view.style import FLAG_COLOURS, FRAME_GREY, PREDICTION

_FAMILY_DASHES = {"solid": "-", "dashed": (0, (5, 2)), "dashdot": (0, (5, 1.5, 1, 1.5))}
# In points: type size of the labels, space per label along the edges, leader, and largest shift from the line.
_FONT = 7.5
_SPACING_ACROSS = 14.5
_SPACING_UP = 9.5
_LEADER = 9.0
_MAX_SHIFT = 24.0
_MARK = {"marker": "o", "markersize": 3.0, "markerfacecolor": "white", "markeredgewidth": 0.7, "linestyle": "none"}
# Width and height of the name of a tip in points.
_NAME = np.array([15.0, 9.0])
# Positions of a name relative to the tip of a tongue that opens upwards, in points, and its alignment.
_SIDES = {
    (0, -1): ("center", "top"),
    (1, 0): ("left", "center"),
    (-1, 0): ("right", "center"),
    (0, 1): ("center", "bottom"),
}


@dataclass(frozen=True)
class Prediction:
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


def predictions(
    dataset: xr.Dataset, horizontal: str, vertical: str | None = None, forced: bool = False
) -> list[Prediction]:
    """Predicted lines over ``horizontal``, with ``forced`` only of families that the forcing excites; [] without any."""
    name = f"resonance_{horizontal}"
    if name not in dataset.coords:
        return []
    lines = []
    families = json.loads(dataset.attrs.get("resonance_families", "{}"))
    for index, label in enumerate(dataset["resonance"].values.astype(str)):
        family = _family(label, families)
        if not family.get("drawn", True) or (forced and not family.get("forced")):
            continue
        values = dataset[name].isel(resonance=index)
        y = dataset[vertical].values if vertical is not None and vertical in values.dims else None
        dashes = _FAMILY_DASHES.get(family.get("line", ""), "-")
        lines.append(Prediction(label, np.atleast_1d(values.values), y, family["name"], dashes))
    return lines


def _family(label: str, families: Mapping[str, Any]) -> Mapping[str, Any]:
    """The declared family of ``label`` with the longest matching prefix, else a family named by the first letter."""
    prefixes = [prefix for prefix in families if label.startswith(prefix)]
    return families[max(prefixes, key=len)] if prefixes else {"name": label[:1]}


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
    """Label lines at the upper or right edge of ``axes``, without overlaps.

    Lines of low order take precedence. A label that would move far from its line is left out.
    """
    scale = 72 / axes.figure.dpi
    for edge, spacing, side in ((_top_exit, _SPACING_ACROSS, 0), (_right_exit, _SPACING_UP, 1)):
        found = [(line, edge(axes, line)) for line in sorted(lines, key=lambda line: line.order)]
        ends = [(line, point) for line, point in found if point is not None]
        along = [axes.transData.transform(point)[side] * scale for _, point in ends]
        box = axes.bbox
        limits = (box.xmin, box.xmax) if side == 0 else (box.ymin, box.ymax)
        # Labels may extend beyond the corners by one width.
        span = (limits[0] * scale - spacing, limits[1] * scale + spacing)
        kept, positions = _place(along, spacing, span)
        for index, position in zip(kept, positions, strict=True):
            line, end = ends[index]
            _write(axes, line.label, end, side, position - along[index])


def _place(wanted: list[float], spacing: float, span: tuple[float, float]) -> tuple[list[int], np.ndarray]:
    """Rising indices of the labels that fit, and the nearest positions for them at least ``spacing`` apart."""
    from scipy.optimize import isotonic_regression  # loading takes longer than drawing most figures

    kept: list[int] = []
    positions = np.empty(0)
    for index in range(len(wanted)):
        trial = sorted([*kept, index], key=lambda i: wanted[i])
        target = np.array([wanted[i] for i in trial])
        offsets = spacing * np.arange(len(trial))
        # Nearest positions p with p[i+1] - p[i] >= spacing: isotonic regression of p[i] - i * spacing.
        spread = np.clip(isotonic_regression(target - offsets).x, span[0], span[1] - offsets[-1]) + offsets
        if np.abs(spread - target).max() <= _MAX_SHIFT:
            kept, positions = trial, spread
    return kept, positions


def _top_exit(axes: Axes, line: Prediction) -> tuple[float, float] | None:
    """Intersection of the line with the upper edge, in data coordinates."""
    left, right = axes.get_xlim()
    return (float(line.x[-1]), axes.get_ylim()[1]) if left <= line.x[-1] <= right else None


def _right_exit(axes: Axes, line: Prediction) -> tuple[float, float] | None:
    """Intersection of a curve with the right edge, in data coordinates."""
    right = axes.get_xlim()[1]
    crossing = np.flatnonzero((line.x[:-1] <= right) & (line.x[1:] > right))
    if not crossing.size or line.y is None:
        return None
    i = int(crossing[-1])
    return right, float(np.interp(right, line.x[i : i + 2], line.y[i : i + 2]))


def _write(axes: Axes, text: str, end: tuple[float, float], side: int, shift: float) -> None:
    """Write text beyond the edge, ``shift`` points along it, joined to ``end`` (data) by a thin leader."""
    axes.annotate(
        label_text(text),
        end,
        xytext=(shift, _LEADER) if side == 0 else (_LEADER, shift),
        textcoords="offset points",
        ha="center" if side == 0 else "left",
        va="bottom" if side == 0 else "center",
        size=_FONT,
        color=PREDICTION,
        annotation_clip=False,
        arrowprops={
            "arrowstyle": "-",
            "linewidth": 0.5,
            "color": PREDICTION,
            "relpos": (0.5, 0.0) if side == 0 else (0.0, 0.5),
            "shrinkA": 1,
            "shrinkB": 0,
        },
    )


def draw_boundaries(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Artist]:
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
    low, high = axes.bbox.min * scale + _NAME / 2, axes.bbox.max * scale - _NAME / 2  # pyright: ignore[reportOperatorIssue]
    taken: list[np.ndarray] = []
    named: list[tuple[str, np.ndarray]] = []
    for name, tip, up in zip(names, tips, opens, strict=True):
        mark = axes.transData.transform(tip) * scale
        # Unproved tips may lie within their errors of each other.
        if any(name == other and (np.abs(mark - at) < _NAME / 2).all() for other, at in named):
            continue
        sides = [(across, rise if up else -rise) for across, rise in _SIDES]
        middles = {side: mark + np.array(side) * (0.7, 1.0) * _NAME for side in sides}
        inside = {side: at for side, at in middles.items() if ((at >= low) & (at <= high)).all()}
        free = (s for s, at in inside.items() if all((np.abs(at - other) >= _NAME).any() for other in taken))
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
