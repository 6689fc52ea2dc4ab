"""Predicted resonances over a chart: thin lines or curves, labelled at the edge."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from drivetrain_jax.view.style import PREDICTION

_DASHES = {"solid": "-", "dashed": (0, (5, 2)), "dashdot": (0, (5, 1.5, 1, 1.5))}
# In points: type size of the labels, space per label along the edges, leader, and largest shift from the line.
_FONT = 7.5
_SPACING_ACROSS = 14.5
_SPACING_UP = 9.5
_LEADER = 9.0
_MAX_SHIFT = 24.0


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
        dashes = _DASHES.get(family.get("line", ""), "-")
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


def draw(axes: Axes, lines: list[Prediction], below: bool = False) -> list[Line2D]:
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


def label(axes: Axes, lines: list[Prediction]) -> None:
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
