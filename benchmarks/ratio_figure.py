"""The figure at the head of docs/benchmarks.md: speed of the package over that of the best rival, by comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

from benchmarks import page_precision
from benchmarks.results_files import CHART, LEVEL, ResultFile, at_equal_error, times

matplotlib.use("Agg")

NAME = "ratios"
FASTER, SLOWER, EQUAL, ALONE = "#0072b2", "#d55e00", "#999999", "#a6cbe3"
# Length of a bar without a finite ratio: only one side reaches the error.
_ENDS = (1e-2, 1e4)

Files = Mapping[str, ResultFile | None]


class Ratio(NamedTuple):
    """A comparison, its best rival, and the speed of the package over that of the rival."""

    what: str
    rival: str
    ratio: float


def ratios(files: Files, precise: Mapping[str, page_precision.Precision]) -> dict[str, list[Ratio]]:
    """All comparisons by panel."""
    found = {
        page_precision.TITLES[system]: [Ratio(*one) for one in page_precision.compared(precision)]
        for system, precision in precise.items()
    }
    found["Charts and atlases of the cardan shaft, two cores"] = _charts(files)
    found["Cardan shaft against damping, Omega = 0.1"] = _damping(files["damping"])
    found["Batches on two cores"] = [*_shafts(files["critical_speeds"]), *_gears(files["planetary_throughput"]),
                                     *_spectra(files["chaos"])]  # fmt: skip
    return {title: rows for title, rows in found.items() if rows}


def _charts(files: Files) -> list[Ratio]:
    rows = []
    chart = at_equal_error(files["throughput"]) if files["throughput"] else {}
    own = chart.pop("drivetrain_jax direct", None)
    rivals = {name: float(row["cells_per_s"]) for name, row in chart.items() if not name.startswith("drivetrain_jax")}
    if own and rivals:
        best = max(rivals, key=lambda name: rivals[name])
        rows.append(Ratio("chart, 30,000 cells", CHART[best], float(own["cells_per_s"]) / rivals[best]))
    for row in files["atlas"].rows if files["atlas"] else ():
        kind = next((kind for kind in ("warm", "cold") if kind in row["method"]), None)
        if kind and row["times_heyoka"]:
            rows.append(
                Ratio(f"atlas {kind}, {float(row['chart']):,.0f} cells", "heyoka batch", float(row["times_heyoka"]))
            )
    return rows


def _damping(file: ResultFile | None) -> list[Ratio]:
    spent: dict[str, dict[str, float]] = {}
    for row in file.rows if file else ():
        spent.setdefault(row["zeta"], {})[row["method"].partition(",")[0]] = float(row["us_per_point"])
    return [
        Ratio(f"zeta = {float(zeta):g}", "heyoka batch", us["heyoka batch"] / us["package"])
        for zeta, us in spent.items()
    ]


def _shafts(file: ResultFile | None) -> list[Ratio]:
    names = {
        "drivetrain_jax certified": ("critical speeds", "SciPy, Brent"),
        "drivetrain_jax, the same map": ("map", "ROSS"),
    }
    return [
        Ratio(*names[row["method"]], float(row["ratio"]))
        for row in (file.rows if file else ())
        if row["method"] in names
    ]


def _gears(file: ResultFile | None) -> list[Ratio]:
    found = []
    rows = file.rows if file else ()
    for planets in dict.fromkeys(row["planets"] for row in rows):
        rates = {row["method"]: float(row["gears_per_s"]) for row in rows if row["planets"] == planets}
        own = rates["package"]
        rates = {method: rate for method, rate in rates.items() if not method.startswith("package")}
        best = max(rates, key=lambda method: rates[method])
        found.append(Ratio(f"{planets} planets", best, own / rates[best]))
    return found


def _spectra(file: ResultFile | None) -> list[Ratio]:
    found = []
    rows = file.rows if file else ()
    for case in dict.fromkeys(row["case"] for row in rows):
        rates = {row["method"]: float(row["per_s"]) for row in rows if row["case"] == case}
        own = rates.pop("drivetrain_jax", None)
        if own and rates:
            best = max(rates, key=lambda method: rates[method])
            found.append(Ratio(f"Lyapunov spectra, {case.partition(' at ')[0]}", best, own / rates[best]))
    return found


def draw(panels: Mapping[str, Sequence[Ratio]], path: Path) -> None:
    """Write the figure: a panel for each group, a bar for each comparison, losses in another colour."""
    import matplotlib.pyplot as plt

    heights = [len(rows) + 1.6 for rows in panels.values()]
    columns = _balanced(heights)
    figure = plt.figure(figsize=(12.5, 0.235 * max(sum(heights[i] for i in column) for column in columns)), dpi=110,
                        layout="constrained")  # fmt: skip
    grid = figure.add_gridspec(1, len(columns))
    titles = list(panels)
    for place, column in enumerate(columns):
        inner = grid[place].subgridspec(len(column), 1, height_ratios=[heights[i] for i in column])
        for row, number in enumerate(column):
            _panel(figure.add_subplot(inner[row]), titles[number], panels[titles[number]])
    figure.savefig(path)
    plt.close(figure)


def _balanced(heights: Sequence[float]) -> list[list[int]]:
    """Two columns of panels, in order, of nearly equal heights."""
    cut = min(range(1, len(heights) + 1), key=lambda k: abs(sum(heights[:k]) - sum(heights[k:])))
    return [column for column in (list(range(cut)), list(range(cut, len(heights)))) if column]


def _panel(ax: Any, title: str, rows: Sequence[Ratio]) -> None:
    low, high = _ENDS
    for place, row in enumerate(rows):
        if math.isnan(row.ratio):
            ax.text(1.0, place, " no method reaches the error", va="center", fontsize=7)
            continue
        width = min(max(row.ratio, low), high)
        colour = (
            ALONE
            if math.isinf(row.ratio)
            else FASTER
            if row.ratio >= LEVEL
            else SLOWER
            if row.ratio <= 1 / LEVEL
            else EQUAL
        )
        ax.barh(place, width - 1, left=1.0, color=colour, height=0.72)
        known = math.isfinite(row.ratio) and row.ratio > 0
        words = (
            f"{times(row.ratio)}  {row.rival}"
            if known
            else "alone at this error"
            if row.ratio
            else f"{row.rival} alone"
        )
        ax.text(max(width, 1.0), place, f" {words}", va="center", fontsize=7)
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set(xscale="log", xlim=(low, 3e6), ylim=(len(rows) - 0.4, -0.6))
    ax.set_yticks(range(len(rows)), [row.what for row in rows], fontsize=7.5)
    ax.set_xticks([1e-2, 1e-1, 1, 10, 100, 1e3, 1e4])
    ax.tick_params(axis="x", labelsize=7)
    ax.set_title(title, fontsize=8.5, loc="left")
    ax.grid(axis="x", alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
