"""Work-precision figures: one panel per region and one line per method, seconds per point against error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from benchmarks.precision import GOAL, Rung
from benchmarks.timing import RESULTS, provenance

matplotlib.use("Agg")

# Okabe and Ito's colours from dark to light, each with its own marker and dash, so that lines differ without colours.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">", "h", "*", "p", "d", "8")
DASHES = ("-", "--", "-.", ":")
LOWEST, HIGHEST = 1e-16, 1e1
COLUMNS = 4


def draw(name: str, rungs: Sequence[Rung], folder: Path = RESULTS) -> None:
    """Write ``<folder>/<name>.png``; settings with failed points are hollow, and at the right edge without an error."""
    import matplotlib.pyplot as plt

    regions = list(dict.fromkeys(rung.region for rung in rungs))
    methods = list(dict.fromkeys(rung.method for rung in rungs))
    columns = min(COLUMNS, len(regions))
    rows = math.ceil(len(regions) / columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.3 * columns, 2.9 * rows + 1.1), sharex=True, sharey=True, squeeze=False,
        layout="constrained", dpi=120,
    )  # fmt: skip
    for ax, region in zip(axes.flat, regions, strict=False):
        for number, method in enumerate(methods):
            _line(ax, number, method, [r for r in rungs if (r.region, r.method) == (region, method)])
        _dress(ax, region)
    for ax in axes.flat[len(regions) :]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel("time per point / s")
    for column in range(columns):
        lowest = (len(regions) - 1 - column) // columns
        axes[lowest, column].set_xlabel("largest relative error")
        axes[lowest, column].tick_params(labelbottom=True)
    _legend(figure, methods)
    figure.savefig(folder / f"{name}.png")
    plt.close(figure)


def _line(ax: Any, number: int, method: str, mine: Sequence[Rung]) -> None:
    style = style_of(number)
    error = np.array([HIGHEST if math.isnan(r.error) else min(max(r.error, LOWEST), HIGHEST) for r in mine])
    seconds = np.array([rung.seconds_per_point for rung in mine])
    failed = np.array([rung.failed > 0 or math.isnan(rung.error) for rung in mine], dtype=bool)
    ax.plot(error, seconds, label=method, **style)
    ax.plot(error[failed], seconds[failed], ls="none", marker=style["marker"], ms=7, mfc="white", mec=style["color"])


def style_of(number: int) -> dict[str, Any]:
    """Colour, marker and dash of line number ``number``."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "marker": MARKERS[number % len(MARKERS)],
        "ls": DASHES[(2 * (number // len(COLOURS)) + number) % len(DASHES)],
        "ms": 4.5,
        "lw": 1.1,
    }


def _dress(ax: Any, region: str) -> None:
    ax.set(xscale="log", yscale="log", xlim=(LOWEST / 3, 3 * HIGHEST))
    ax.set_title(region, fontsize=10)
    ax.axvline(GOAL, color="0.6", lw=0.8, zorder=0)
    ax.axvspan(HIGHEST / 3, 3 * HIGHEST, color="0.93", zorder=0)
    ax.grid(alpha=0.25)
    ax.set_xticks([10.0**k for k in range(-16, 1, 4)])


def _legend(figure: Any, methods: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=method, **style_of(i)) for i, method in enumerate(methods)]
    hollow = Line2D([], [], ls="none", marker="o", ms=7, mfc="white", mec="black", label="points failed")
    facts = provenance()
    about = f"{facts['machine']}; {facts['versions']}; {facts['date']}"
    figure.legend(
        handles=[*handles, hollow], loc="outside lower center", ncols=5, frameon=False, fontsize=8.5,
        title=about, title_fontsize=6.5,
    )  # fmt: skip
