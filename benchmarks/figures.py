"""Figures of docs/benchmarks.md: seconds against error by region."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.measure import GOAL

# Okabe and Ito's colours from dark to light, each with its own marker and dash, so that lines differ without colours.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">", "h", "*", "p", "d", "8")
DASHES = ("-", "--", "-.", ":")
LOWEST, HIGHEST, COLUMNS = 1e-16, 1e1, 4


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
