"""Write docs/benchmarks.md, its figures, and the measured parts of README.md and docs/theory/atlas.md from the result files.

    python -m benchmarks.page

Every number, and every choice of words that depends on one, comes from the CSV files. A missing file gives the line
"Not measured".
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks import figures
from benchmarks.measure import GOAL, PATIENCE, RESULTS, USELESS, is_silent, load, markdown

ROOT = Path(__file__).resolve().parents[1]
PAGE, README, ATLAS_PAGE = ROOT / "docs" / "benchmarks.md", ROOT / "README.md", ROOT / "docs" / "theory" / "atlas.md"
BEGIN = "<!-- Written by `python -m benchmarks.page`; do not edit. -->"
END = "<!-- End of the generated part. -->"
TITLES = {
    "cardan": "Cardan shaft: spectral radius",
    "damping": "Cardan shaft against damping, Omega = 0.1",
    "gradients": "Cardan shaft: gradient of the spectral radius",
    "forced": "Cardan shaft: forced motion",
    "driveline": "Driveline of three joints and six inertias, one core",
    "bicardan": "Stepped shaft: critical speeds",
    "planetary": "Planetary gear: natural frequencies",
    "rattle": "Gear rattle: motion with backlash",
    "attractors": "Gear rattle: attractors, basins, responses",
    "tripod": "Double tripod: motion over 1,000 strobes",
    "chart": "Chart of the cardan shaft, two cores",
    "atlas": "Atlases of charts of the cardan shaft, two cores",
}
_TWO_CORES = ("chart", "atlas")
# Ratio of times up to which two methods count as equally fast.
LEVEL = 1.1


def rungs(folder: Path) -> pd.DataFrame:
    """All settings of all methods; ``own`` marks the package, ``reached`` an error of at most 1e-9 at every point."""
    files = [file.rows for system in TITLES if (file := load(folder, f"precision_{system}"))]
    if not files:
        return pd.DataFrame(columns=["system", "region", "method", "error", "seconds_per_point", "own", "reached"])
    rows = pd.concat(files, ignore_index=True)
    return rows.assign(own=rows.method.str.startswith("package"), reached=(rows.error <= GOAL) & (rows.failed == 0))


class Compared(NamedTuple):
    """A region, the fastest settings of the package and of a rival that reach the error, and rival over package in time.

    The ratio is infinite if no rival reaches the error, 0 if the package does not, NaN if no method does.
    """

    system: str
    region: str
    package: Any
    rival: Any
    ratio: float


def compared(rows: pd.DataFrame) -> list[Compared]:
    """The package and its fastest rival in every region; atlases with and without the start of the command."""
    pairs = []
    for (system, region), part in rows.groupby(["system", "region"], sort=False):
        reached = part[part.reached]
        rival = _fastest(reached[~reached.own])
        if system == "atlas":
            # An atlas is built to a tolerance of 3e-8; its largest error is about 1e-9.
            part = part[part.own & part.method.str.contains("warm|cold")]
            pairs += [(system, f"{row.method[9:]}, {region}", row, rival) for row in part.itertuples()]
        else:
            pairs.append((system, region, _fastest(reached[reached.own]), rival))
    with np.errstate(invalid="ignore"):
        return [Compared(*pair, _time(pair[3]) / _time(pair[2])) for pair in pairs]


def _time(row: Any) -> np.float64:
    """Time per point, infinite without a method that reaches the error."""
    return np.float64(math.inf if row is None else row.seconds_per_point)


def _fastest(rows: pd.DataFrame) -> Any:
    return next(rows.sort_values("seconds_per_point").itertuples(), None)


def write_pages() -> None:
    """Write the page with its figures, and the measured parts of the other two."""
    write_page(RESULTS, PAGE)
    README.write_text(between_marks(README.read_text(), readme_part(RESULTS)))
    ATLAS_PAGE.write_text(between_marks(ATLAS_PAGE.read_text(), atlas_part(RESULTS)))


def write_page(folder: Path, page: Path) -> None:
    """Write ``page`` and its figures from the files in ``folder``."""
    rows = rungs(folder)
    for system, part in rows.groupby("system", sort=False):
        file = load(folder, f"precision_{system}")
        figures.draw_precision(part, file.facts if file else {}, folder / f"precision_{system}.png")
    page.write_text(text_of(folder, page))


def text_of(folder: Path, page: Path) -> str:
    """The page."""
    images = os.path.relpath(folder, page.parent).replace(os.sep, "/") + "/"
    rows = rungs(folder)
    pairs = compared(rows)
    links = ", ".join(f"[{TITLES[system]}]({images}precision_{system}.png)" for system in dict.fromkeys(rows.system))
    parts = [
        "# Error against run time",
        "Speed of the package over that of its fastest rival, at equal error. "
        f"Speeds within {LEVEL - 1:.0%} are level. Regions are compared at an error of at most {GOAL:g}, on one core unless "
        "the title names two. Atlases: `warm` is an atlas and its chart in a running process, without compilation; "
        "`cold command` is `drivetrain run` of the same scene, with its start, compilation and file.",
        answer(pairs) if pairs else not_measured("precision_cardan"),
        "Written by `python -m benchmarks.page` from the files in `benchmarks/results/`, which have every setting of every "
        "method, and the versions of all packages; `drivetrain bench` measures them again.",
        "## The cardan chart",
        _chart(folder, rows),
        "## Regions of every system",
        f"Time per point of the fastest method, and its error. The error of every setting: {links}.",
        markdown("system | region | package | fastest rival | ratio", [
            [p.system, p.region, _timing(p.package), _timing(p.rival), number(p.ratio) if 0 < p.ratio < math.inf else ""]
            for p in pairs
        ]),
        "\n".join(not_measured(f"precision_{system}") for system in TITLES if system not in set(rows.system)),
        "## Silent failures",
        f"A setting fails silently if it reports nothing, and points are lost or the error exceeds {USELESS:g} or "
        f"{PATIENCE:,.0f} times the tolerance that was asked for. This rule holds for all methods; a number of steps or "
        "elements asks for no tolerance.",
        silence(rows),
        "## Commands",
        _file_table(folder, "waiting", {"command": "command", "first_cpu_s": "first", "cpu_s": "later", "aim_s": "aim"}),
        "## An accelerator beside the cores of its machine",
        _file_table(folder, "accelerator", {"scene": "scene", "points": "points", "cores_per_s": "points/s, cores",
                                            "accelerator_per_s": "points/s, accelerator", "times": "ratio"}),
        "## The measurements",
        "`load`: cores used by other programs. More than half a core disturbs a measurement.",
        measurements(folder),
    ]  # fmt: skip
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def answer(pairs: Sequence[Compared]) -> str:
    """The number of regions where the package is faster, level and slower, and its smallest and largest ratio."""
    lines = []
    for system in dict.fromkeys(pair.system for pair in pairs):
        known = sorted((p for p in pairs if p.system == system and not math.isnan(p.ratio)), key=lambda p: p.ratio)
        faster, slower = sum(p.ratio >= LEVEL for p in known), sum(p.ratio <= 1 / LEVEL for p in known)
        ends = [_extreme(known[0]), _extreme(known[-1])] if known else ["none", "none"]
        lines.append([TITLES[system], *map(str, (faster, len(known) - faster - slower, slower)), *ends])
    return markdown("comparison | faster | level | slower | smallest ratio | largest ratio", lines)


def _extreme(pair: Compared) -> str:
    words = {math.inf: "no rival reaches the error", 0.0: "only a rival reaches the error"}
    rival = f", {pair.rival.method}" if pair.rival is not None else ""
    return f"{words.get(pair.ratio) or number(pair.ratio)} ({pair.region}{rival})"


def _timing(row: Any) -> str:
    if row is None:
        return "does not reach the error"
    return f"{row.method.removeprefix('package, ')}: {number(1e6 * row.seconds_per_point)} us ({row.error:.1e})"


def losses(pairs: Sequence[Compared]) -> str:
    """A sentence that counts the regions where a rival is faster."""
    ratios = [pair.ratio for pair in pairs if pair.system not in _TWO_CORES]
    behind = [1 / ratio for ratio in ratios if 0 < ratio <= 1 / LEVEL]
    most = f", up to {number(max(behind))} times" if behind else ""
    return f"Another library is faster in {len(behind)} of {len(ratios)} regions (error {GOAL:g}, one core){most}."


def silence(rows: pd.DataFrame) -> str:
    """The methods that fail silently, the package's first, with the number of their regions."""
    flags = [is_silent(row.setting, row.error, row.failed, row.noticed) for row in rows.itertuples()]
    failed = rows[np.array(flags, bool)].drop_duplicates(["method", "system", "region"]).astype({"own": bool})
    package = [f"{row.method} ({row.system} {row.region})" for row in failed[failed.own].itertuples()]
    rivals = [
        f"{method} ({count})" for method, count in failed[~failed.own].groupby("method", sort=False).size().items()
    ]
    head = (
        f"**The package fails silently**: {'; '.join(package)}."
        if package
        else "No method of the package fails silently."
    )
    return f"{head} Rivals, with the number of their regions: {', '.join(rivals) or 'none'}."


def measurements(folder: Path) -> str:
    """Date, commit, machine and load of every file."""
    facts = {path.stem: file.facts for path in sorted(folder.glob("*.csv")) if (file := load(folder, path.stem))}
    names = ("date", "commit", "machine", "load")
    return markdown(("file", *names), [
        [stem, *(one.get(name, "").removesuffix(" cores by other programs") for name in names)]
        for stem, one in facts.items()
    ])  # fmt: skip


def _file_table(folder: Path, name: str, columns: dict[str, str]) -> str:
    """Columns of a file by their names on the page, under its notes."""
    file = load(folder, name)
    if file is None:
        return not_measured(name)
    rows = file.rows[list(columns)].itertuples(index=False)
    table = markdown(list(columns.values()), [[x if isinstance(x, str) else number(x) for x in row] for row in rows])
    return "\n\n".join([*file.notes, table])


_CHART_HEAD = ("method", "cells that it computed", "cells/s", "largest error")


def _chart_row(row: Any, mark: str = "") -> list[str]:
    error = "none" if math.isnan(row.error) else f"{row.error:.1e}"
    cells = (f"{row.method}, {row.setting}", f"{row.points:,}", number(1 / row.seconds_per_point), error)
    return [f"{mark}{cell}{mark}" for cell in cells]


def _best_of_chart(chart: pd.DataFrame) -> list[Any]:
    """The fastest setting of each method with an error of at most 1e-9, else the most accurate one; fastest first."""
    best = []
    for _, part in chart[chart.error.notna()].groupby("method", sort=False):
        best.append(_fastest(part[part.reached]) or next(part.sort_values("error").itertuples()))
    return sorted(best, key=lambda row: row.seconds_per_point)


def _chart(folder: Path, rows: pd.DataFrame) -> str:
    chart, file = rows[rows.system == "chart"], load(folder, "precision_chart")
    if file is None:
        return not_measured("precision_chart")
    best = {row.Index for row in _best_of_chart(chart)}
    text = (
        f"Spectral radius for beta from 0 to 1.5, Omega from 0.1 to 2; chart of 30,000 cells; {'; '.join(file.notes)}. "
        "Slow methods computed a part of the cells: a coarser grid (`diffrax`) or random ones (SciPy); their largest error "
        "is over these. The chart of Fig. 3 begins at Omega = 0.01 and takes twice as long. Compilation is not "
        f"included. Bold: the fastest setting of each method with an error of at most {GOAL:g}."
    )
    return f"{text}\n\n{markdown(_CHART_HEAD, [_chart_row(row, '**' * (row.Index in best)) for row in chart.itertuples()])}"


def readme_part(folder: Path) -> str:
    """The measured part of README.md."""
    rows, file = rungs(folder), load(folder, "precision_chart")
    if file is None:
        return not_measured("precision_chart")
    pairs = compared(rows)
    shown = [row for row in _best_of_chart(rows[rows.system == "chart"]) if row.method in LABELS]
    table = [[LABELS[row.method] + f", {row.setting}", *_chart_row(row)[1:]] for row in shown]
    head = (
        "Spectral radius, Omega from 0.1 on, chart of 30,000 cells, 2 cores, without compilation. Each method is shown at "
        f"its fastest setting with an error of at most {GOAL:g}, or at its most accurate setting if it never gets there. "
        f"`direct` and `diffrax` give an error bound for every cell. Machine: {file.facts['machine']}."
    )
    lines = "\n".join(f"- {line}" for line in (*_highlights(rows, pairs), losses(pairs)))
    return f"{head}\n\n{markdown(_CHART_HEAD, table)}\n\n{lines}"


LABELS = {
    "package, direct": "**`direct`**",
    "heyoka batch": "heyoka (compiled Taylor integrator)",
    "scipy DOP853 stacked, half period": "SciPy DOP853, whole grid as one state, half a period",
    "scipy RK45": "SciPy RK45, point by point (the paper's method)",
    "package, diffrax": "`diffrax` under vmap",
}


def _highlights(rows: pd.DataFrame, pairs: Sequence[Compared]) -> list[str]:
    lines = []
    for pair in (pair for pair in pairs if (pair.system, pair.region) == ("bicardan", "typical")):
        rate = number(1 / pair.package.seconds_per_point)
        speed = against(pair.ratio, f"the best other method ({pair.rival.method})")
        lines.append(f"Stepped shaft: {rate} shafts/s on one core with six certified critical speeds each, {speed}.")
    rates = 1 / rows[rows.system == "atlas"].groupby("method").seconds_per_point.min()
    words = {"package, evaluation": "grid cells", "package, points": "scattered points"}
    speeds = [f"up to {number(rates[method])} {what} per second" for method, what in words.items() if method in rates]
    atlases = [pair for pair in pairs if pair.system == "atlas"]
    if speeds:
        lines.append(f"Evaluation of an atlas, with bounds and verdicts: {'; '.join(speeds)}.")
        charts = [_chart_of_atlas(pair) for pair in (atlases[0], min(atlases, key=lambda p: p.ratio), atlases[-1])]
        counted = "the first run starts and compiles; the start of heyoka is not counted"
        lines.append(f"Atlas of the chart: {'; '.join(charts)} ({counted}).")
    return lines


_WAYS = {"warm": "in a running process", "cold command": "by a first `drivetrain run`"}


def _chart_of_atlas(pair: Compared) -> str:
    way, cells = pair.region.split(", ", 1)
    return f"{cells} {_WAYS[way]}, {against(pair.ratio, pair.rival.method)}"


def atlas_part(folder: Path) -> str:
    """The measured part of docs/theory/atlas.md, from atlas_attack.csv."""
    file = load(folder, "atlas_attack")
    if file is None:
        return not_measured("atlas_attack")
    rows = file.rows
    charts = [f"beta {r.beta}, Omega {r.Omega}, zeta {r.zeta}, alpha {r.alpha}, mu {r.mu}" for r in rows.itertuples()]
    largest = {
        kind: rows[[f"{kind}_direct", f"{kind}_precise"]].max(axis=1) for kind in ("random", "nearest", "widest")
    }
    sums = {what: rows[f"{what}_direct"] + rows[f"{what}_precise"] for what in ("violations", "wrong")}
    sizes = [
        f"{chart} | {r.tolerance:g} | {r.panels} | {r.solves:,} | {r.bytes / 1e6:.2g} MB | {r.z_error:.1e}"
        for chart, r in zip(charts, rows.itertuples(), strict=True)
    ]
    errors = [
        f"{chart} | {r.rho_error:.1e} | {r.random:.2g} | {r.nearest:.2g} | {r.widest:.2g} | {r.undecided:,} of {r.of:,} | "
        f"{r.violations} | {r.wrong}"
        for chart, r in zip(charts, rows.assign(**largest, **sums).itertuples(), strict=True)
    ]
    cells, few = (" or ".join(f"{n:,}" for n in np.unique(rows[name])) for name in ("cells", "worst"))
    text = (
        f"{cells} cells of each kind are compared with direct solves, {few} with 30 digits. Error of $\\rho$: 99.9 % "
        "quantile over the random cells. Random, nearest, widest: largest ratio of error to bound. The rounding of "
        "direct solves is subtracted from the error."
    )
    first = "chart | tolerance | polynomials | solves | arrays of the file | largest relative error of $Z$"
    second = (
        r"chart | error of $\rho$ | random | nearest $\rho = 1$ | widest | undecided | broken bounds | wrong verdicts"
    )
    machine = f"Machine: {file.facts['machine']}."
    return "\n\n".join([markdown(first, sizes), text, markdown(second, errors), machine])


def number(value: float) -> str:
    """A number with three significant digits and separated thousands."""
    return f"{float(f'{value:.3g}'):,.0f}" if value >= 100 else f"{value:.3g}"


def against(ratio: float, rival: str) -> str:
    """A comparison of speeds in words."""
    if 1 / LEVEL < ratio < LEVEL:
        return f"level with {rival}"
    return (
        f"{number(ratio)} times as fast as {rival}" if ratio > 1 else f"{number(1 / ratio)} times slower than {rival}"
    )


def between_marks(text: str, section: str) -> str:
    """``text`` with ``section`` between its marks."""
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{section}\n\n{END}{rest.partition(END)[2]}"


def not_measured(name: str) -> str:
    """The line in place of a table whose file is missing."""
    return f"Not measured: `{name}.csv` is missing."


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    write_pages()
