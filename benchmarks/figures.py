"""Figures of docs/benchmarks.md: seconds against error by region, and speed of the package over that of its best rival."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.measure import GOAL

# Okabe and Ito's colours from dark to light, each with its own marker and dash, so that lines differ without colours.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">", "h", "*", "p", "d", "8")
DASHES = ("-", "--", "-.", ":")
LOWEST, HIGHEST, COLUMNS = 1e-16, 1e1, 4
FASTER, SLOWER, EQUAL, ALONE = "#0072b2", "#d55e00", "#999999", "#a6cbe3"
# Ratio within which speeds are level, and lengths of bars without a finite ratio: only one side reaches the error.
_LEVEL, _ENDS = 1.1, (1e-2, 1e4)


def draw_precision(rungs: pd.DataFrame, facts: Mapping[str, str], path: Path) -> None:
    """One panel per region, one line per method; settings with failed points are hollow, those without error at the edge."""
    regions, methods = list(dict.fromkeys(rungs.region)), list(dict.fromkeys(rungs.method))
    columns = min(COLUMNS, len(regions))
    rows = math.ceil(len(regions) / columns)
    figure = Figure(figsize=(max(3.3 * columns, 9.0), 2.9 * rows + 1.1), layout="constrained", dpi=120)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax, region in zip(axes.flat, regions, strict=False):
        for number, method in enumerate(methods):
            _line(ax, _style(number), rungs[(rungs.region == region) & (rungs.method == method)])
        ax.set(xscale="log", yscale="log", xlim=(LOWEST / 3, 3 * HIGHEST), xticks=[10.0**k for k in range(-16, 1, 4)])
        ax.set_title(region, fontsize=10)
        ax.axvline(GOAL, color="0.6", lw=0.8, zorder=0)
        ax.axvspan(HIGHEST / 3, 3 * HIGHEST, color="0.93", zorder=0)
        ax.grid(alpha=0.25)
    for ax in axes.flat[len(regions) :]:
        ax.set_visible(False)
    for ax in axes.flat[max(len(regions) - columns, 0) : len(regions)]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("largest relative error")
    figure.supylabel("time per point / s", fontsize=10)
    handles = [Line2D([], [], label=method, **_style(i)) for i, method in enumerate(methods)]
    if (rungs.failed > 0).any() or rungs.error.isna().any():
        handles.append(Line2D([], [], ls="none", marker="o", ms=7, mfc="white", mec="black", label="points failed"))
    about = "; ".join(facts.get(name, "") for name in ("machine", "versions", "date"))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(5, columns + 2), frameon=False, fontsize=8.5,
        title=about, title_fontsize=6.5,
    )  # fmt: skip
    figure.savefig(path)


def _line(ax: Any, style: Mapping[str, Any], rungs: pd.DataFrame) -> None:
    error = rungs.error.fillna(HIGHEST).clip(LOWEST, HIGHEST).to_numpy()
    seconds, failed = rungs.seconds_per_point.to_numpy(), ((rungs.failed > 0) | rungs.error.isna()).to_numpy(bool)
    ax.plot(error, seconds, **style)
    ax.plot(error[failed], seconds[failed], ls="none", marker=style["marker"], ms=7, mfc="white", mec=style["color"])


def _style(number: int) -> dict[str, Any]:
    return {
        "color": COLOURS[number % len(COLOURS)],
        "marker": MARKERS[number % len(MARKERS)],
        "ls": DASHES[(2 * (number // len(COLOURS)) + number) % len(DASHES)],
        "ms": 4.5,
        "lw": 1.1,
    }


def draw_ratios(pairs: Sequence[Any], titles: Mapping[str, str], path: Path) -> None:
    """A panel for each system, a bar for each region, losses in another colour."""
    systems = list(dict.fromkeys(pair.system for pair in pairs))
    panels = [[pair for pair in pairs if pair.system == system] for system in systems]
    heights = [len(panel) + 1.6 for panel in panels]
    # Two columns of panels, in order, of nearly equal heights.
    cut = min(range(1, len(heights) + 1), key=lambda k: abs(sum(heights[:k]) - sum(heights[k:])))
    columns = [part for part in (range(cut), range(cut, len(heights))) if part]
    tallest = max(sum(heights[i] for i in part) for part in columns)
    figure = Figure(figsize=(12.5, 0.235 * tallest), dpi=110, layout="constrained")
    grid = figure.add_gridspec(1, len(columns))
    for place, part in enumerate(columns):
        inner = grid[place].subgridspec(len(part), 1, height_ratios=[heights[i] for i in part])
        for row, number in enumerate(part):
            _panel(figure.add_subplot(inner[row]), titles[systems[number]], panels[number])
    figure.savefig(path)


def _panel(ax: Any, title: str, pairs: Sequence[Any]) -> None:
    low, high = _ENDS
    for place, pair in enumerate(pairs):
        ratio, rival = pair.ratio, pair.rival.method if pair.rival is not None else ""
        width = 1.0 if math.isnan(ratio) else float(np.clip(ratio, low, high))
        faster, slower = ratio >= _LEVEL, ratio <= 1 / _LEVEL
        colour = ALONE if math.isinf(ratio) else FASTER if faster else SLOWER if slower else EQUAL
        ax.barh(place, width - 1, left=1.0, color=colour, height=0.72)
        words = {math.inf: "alone at this error", 0.0: f"{rival} alone"}.get(ratio, f"{ratio:,.3g}  {rival}")
        words = "no method reaches the error" if math.isnan(ratio) else words
        ax.text(max(width, 1.0), place, f" {words}", va="center", fontsize=7)
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set(xscale="log", xlim=(low, 3e6), ylim=(len(pairs) - 0.4, -0.6))
    ax.set_yticks(range(len(pairs)), [pair.region for pair in pairs], fontsize=7.5)
    ax.set_xticks([1e-2, 1e-1, 1, 10, 100, 1e3, 1e4])
    ax.tick_params(axis="x", labelsize=7)
    ax.set_title(title, fontsize=8.5, loc="left")
    ax.grid(axis="x", alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
