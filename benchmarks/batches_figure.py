"""The figure of benchmarks.batches: rates by width, points, cores and planets; cost of outputs; parts of a cold start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.precision_figure import COLOURS, MARKERS
from benchmarks.timing import provenance

Rows = Sequence[Mapping[str, Any]]
_PARTS = {"import_s": "import", "compile_s": "compilation", "run_s": "computation", "write_s": "file"}


def draw(batches: Rows, outputs: Rows, cold: Rows, folder: Path) -> None:
    """``<folder>/batches.png``."""
    figure = Figure(figsize=(13, 8), dpi=120, layout="constrained")
    above, below = figure.subfigures(2, 1)
    labels = {"width": "points of a batch", "points": "points of a run", "cores": "cores", "planets": "planets"}
    for ax, (by, label) in zip(above.subplots(1, 4), labels.items(), strict=True):
        _rates(ax, [row for row in batches if row["by"] == by], by, label)
    left, right = below.subplots(1, 2)
    _outputs(left, outputs)
    _cold(right, cold)
    facts = provenance()
    figure.supxlabel(f"{facts['machine']}; {facts['versions']}; {facts['date']}", fontsize=6.5, color="0.4")
    figure.savefig(folder / "batches.png")


def _rates(ax: Any, rows: Rows, by: str, label: str) -> None:
    for i, system in enumerate(dict.fromkeys(row["system"] for row in rows)):
        mine = [row for row in rows if row["system"] == system]
        known = [row for row in mine if row["how"] != "extrapolated"]
        style = {"color": COLOURS[i], "marker": MARKERS[i]}
        ax.plot([row["number"] for row in known], [row["points_per_s"] for row in known], label=system, **style)
        for row in mine:
            if row["how"] == "extrapolated":
                ax.plot(row["number"], row["points_per_s"], mfc="white", ls="none", label="extrapolated", **style)
    ax.set(xlabel=label, ylabel="points per second")
    if by in ("width", "points"):
        ax.set(xscale="log", yscale="log")
    else:
        # The axis starts at 0, so that twice the rate is twice as high.
        ax.set_ylim(0, 1.08 * max((row["points_per_s"] for row in rows), default=1))
        ax.set_xticks(sorted({row["number"] for row in rows}))
    ax.grid(alpha=0.25)
    if rows:
        ax.legend(frameon=False, fontsize=8)


def _outputs(ax: Any, rows: Rows) -> None:
    names = [f"{row['system']}: {row['outputs']}" for row in rows]
    ax.barh(names[::-1], [row["times_the_first"] for row in rows][::-1], color=COLOURS[1], height=0.6)
    ax.axvline(1.0, color="0.4", lw=0.8)
    ax.set_xlabel("time per point over that of the system's first set")
    ax.tick_params(axis="y", labelsize=7)


def _cold(ax: Any, rows: Rows) -> None:
    names = [row["compiled_code"] for row in rows]
    left = [0.0] * len(rows)
    for i, (part, label) in enumerate(_PARTS.items()):
        widths = [row[part] for row in rows]
        ax.barh(names, widths, left=left, label=label, color=COLOURS[i + 1], height=0.5)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    ax.invert_yaxis()
    ax.set(xlabel="seconds", ylabel="kept compiled code")
    ax.legend(frameon=False, fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
