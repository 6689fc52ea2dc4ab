"""Write docs/benchmarks.md, its figures, and the measured parts of README.md and docs/theory/atlas.md from the result files.

    python -m benchmarks.page

Every number, and every choice of words that depends on one, comes from the CSV files. A missing file gives the line
"Not measured".
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from benchmarks import figures
from benchmarks.atlas_attack import CASES
from benchmarks.measure import GOAL, PATIENCE, RESULTS, USELESS, Results, is_silent, load

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
# Mean number of cores used by other programs from which a measurement counts as disturbed.
_OTHERS = 0.5


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
    return [Compared(*pair, _ratio(*pair[2:])) for pair in pairs]


def _fastest(rows: pd.DataFrame) -> Any:
    return next(rows.sort_values("seconds_per_point").itertuples(), None)


def _ratio(package: Any, rival: Any) -> float:
    if package is None or rival is None:
        return math.nan if package is rival else math.inf if rival is None else 0.0
    return rival.seconds_per_point / package.seconds_per_point


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
    if len(rows):
        figures.draw_ratios(compared(rows), TITLES, folder / "ratios.png")
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
        "the title names two.",
        answer(pairs) if pairs else not_measured("precision_cardan"),
        f"![Every comparison of the table]({images}ratios.png)",
        "Written by `python -m benchmarks.page` from the files in `benchmarks/results/`, which have every setting of every "
        "method, and the versions of all packages; `drivetrain bench` measures them again. " + machines(folder),
        *warnings(folder),
        "## The cardan chart",
        _chart(folder, rows),
        "## Regions of every system",
        f"Time per point of the fastest method, and its error. The error of every setting: {links}.",
        markdown(("system", "region", "package", "fastest rival", "ratio"), [
            [p.system, p.region, _timing(p.package), _timing(p.rival), times(p.ratio) if 0 < p.ratio < math.inf else ""]
            for p in pairs
        ]),
        "\n".join(not_measured(f"precision_{system}") for system in TITLES if system not in set(rows.system)),
        "## Silent failures",
        f"A setting fails silently if it reports nothing, and points are lost or the error exceeds {USELESS:g} or "
        f"{PATIENCE:,.0f} times the tolerance that was asked for. This rule holds for all methods; a number of steps or "
        "elements asks for no tolerance.",
        silence(rows),
        "## Commands",
        "CPU seconds of a process with its start. `first`: without compiled code; later processes find it; `aim`: wanted.",
        _waiting(load(folder, "waiting")),
        _accelerator(load(folder, "accelerator")),
    ]  # fmt: skip
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def answer(pairs: Sequence[Compared]) -> str:
    """The number of regions where the package is faster, level and slower, and its smallest and largest ratio."""
    lines = []
    for system in dict.fromkeys(pair.system for pair in pairs):
        known = sorted(
            (p for p in pairs if p.system == system and not math.isnan(p.ratio)), key=lambda pair: pair.ratio
        )
        faster, slower = sum(p.ratio >= LEVEL for p in known), sum(p.ratio <= 1 / LEVEL for p in known)
        ends = [_extreme(known[0]), _extreme(known[-1])] if known else ["none", "none"]
        lines.append([TITLES[system], *map(str, (faster, len(known) - faster - slower, slower)), *ends])
    return markdown(("comparison", "faster", "level", "slower", "smallest ratio", "largest ratio"), lines)


def _extreme(pair: Compared) -> str:
    words = {math.inf: "no rival reaches the error", 0.0: "only a rival reaches the error"}
    rival = f", {pair.rival.method}" if pair.rival is not None else ""
    return f"{words.get(pair.ratio) or times(pair.ratio)} ({pair.region}{rival})"


def _timing(row: Any) -> str:
    if row is None:
        return "does not reach the error"
    return f"{row.method.removeprefix('package, ')}: {seconds(row.seconds_per_point)} ({small(row.error)})"


def losses(pairs: Sequence[Compared]) -> str:
    """A sentence that counts the regions where a rival is faster."""
    ratios = [pair.ratio for pair in pairs if pair.system not in _TWO_CORES]
    behind = [1 / ratio for ratio in ratios if 0 < ratio <= 1 / LEVEL]
    where = f"{len(behind)} of {len(ratios)} regions (error {GOAL:g}, one core)"
    return (
        f"Another library is faster in {where}, up to {times(max(behind))} times."
        if behind
        else f"No other library is faster in any of {where}."
    )


def silence(rows: pd.DataFrame) -> str:
    """The methods that fail silently, the package's first, with the number of their regions."""
    flags = [is_silent(row.setting, row.error, row.failed, row.noticed) for row in rows.itertuples()]
    failed = rows[pd.Series(flags, rows.index, bool)].groupby(["own", "method"], sort=False)[["system", "region"]]
    regions = {key: list(dict.fromkeys(map(" ".join, part.values.tolist()))) for key, part in failed}
    package = [f"{method} ({', '.join(places)})" for (own, method), places in regions.items() if own]
    rivals = [f"{method} ({len(places)})" for (own, method), places in regions.items() if not own]
    head = (
        f"**The package fails silently**: {'; '.join(package)}."
        if package
        else "No method of the package fails silently."
    )
    return f"{head} Rivals, with the number of their regions: {', '.join(rivals) or 'none'}."


def warnings(folder: Path) -> list[str]:
    """A line if the files are of several commits, and one if other programs used the machine."""
    facts = {path.stem: file.facts for path in sorted(folder.glob("*.csv")) if (file := load(folder, path.stem))}
    commits: dict[str, list[str]] = {}
    for name in sorted(facts.keys() - {"atlas_attack"}):
        commits.setdefault(facts[name].get("commit", "unknown"), []).append(name)
    lines, most = [], max(commits.values(), key=len, default=[])
    if len(commits) > 1:
        which = (
            f"{commit} ({'most files' if names is most else ', '.join(sorted(names))})"
            for commit, names in sorted(commits.items())
        )
        lines.append(f"**Several commits**: {', '.join(which)}.")
    loads = {
        name: float(words[0]) for name, one in facts.items() if (words := one.get("load", "").partition(" cores"))[1]
    }
    if busy := [f"{name} ({load:g})" for name, load in loads.items() if load > _OTHERS]:
        lines.append(f"**Other programs used more than {_OTHERS} cores** during: {', '.join(busy)}.")
    return lines


def machines(folder: Path) -> str:
    """A sentence that names the machines of all files."""
    files = (load(folder, path.stem) for path in folder.glob("*.csv") if path.stem != "atlas_attack")
    names = sorted({file.facts["machine"] for file in files if file})
    return (
        f"{'Machines' if len(names) > 1 else 'Machine'}: {'; '.join(names)}." if names else "Nothing has been measured."
    )


_CHART_HEAD = ("method", "cells that it computed", "cells/s", "largest error")


def _chart_row(row: Any, mark: str = "") -> list[str]:
    cells = (f"{row.method}, {row.setting}", f"{row.points:,}", count(1 / row.seconds_per_point), small(row.error))
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
        "is over these. The chart of the front page begins at Omega = 0.01 and takes twice as long. Compilation is not "
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
    return "\n\n".join(
        [
            head,
            markdown(_CHART_HEAD, table),
            "\n".join(f"- {line}" for line in (*_highlights(rows, pairs), losses(pairs))),
        ]
    )


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
        rate = count(1 / pair.package.seconds_per_point)
        speed = against(pair.ratio, f"the best other method ({pair.rival.method})")
        lines.append(f"Stepped shaft: {rate} shafts/s on one core with six certified critical speeds each, {speed}.")
    rates = 1 / rows[rows.system == "atlas"].groupby("method").seconds_per_point.min()
    words = {"package, evaluation": "grid cells", "package, points": "scattered points"}
    speeds = [f"up to {count(rates[method])} {what} per second" for method, what in words.items() if method in rates]
    charts = [f"{pair.region}: {against(pair.ratio, pair.rival.method)}" for pair in pairs if pair.system == "atlas"]
    if speeds:
        lines.append(f"Evaluation of an atlas, with bounds and verdicts: {'; '.join(speeds)}.")
        lines.append(f"Atlas of the chart: {charts[0]}; {charts[-1]} (the start of heyoka is not counted).")
    return lines


def _waiting(file: Results | None) -> str:
    if file is None:
        return not_measured("waiting")
    lines = [
        [row.command, f"{row.first_cpu_s:g}", f"{row.cpu_s:g}", f"{row.aim_s:g}" if row.aim_s != "" else ""]
        for row in file.rows.itertuples()
    ]
    return markdown(("command", "first", "later", "aim"), lines)


def _accelerator(file: Results | None) -> str:
    if file is None:
        return "No GPU was available: all figures are from the processors named above."
    rates = (
        f"{row.scene} {count(row.accelerator_per_s)} points/s, {against(row.times, 'the cores')}"
        for row in file.rows.itertuples()
    )
    device, cores = file.notes[0].partition(";")[0], file.facts["machine"].rpartition(", ")[2]
    text = f"On an accelerator ({device}), compared with the {cores} of its machine: {'; '.join(rates)}."
    return " ".join([text, *file.notes[1:]])


_SYMBOLS = {"beta": r"\beta", "Omega": r"\Omega", "mu": r"\mu", "alpha": r"\alpha", "zeta": r"\zeta"}
_SIZES = ("tolerance", "polynomials", "solves", "arrays of the file", "largest relative error of $Z$")
_ERRORS = (
    r"error of $\rho$",
    "random",
    r"nearest $\rho = 1$",
    "widest bound",
    "undecided",
    "broken bounds",
    "wrong verdicts",
)


def atlas_part(folder: Path) -> str:
    """The measured part of docs/theory/atlas.md, from atlas_attack.csv."""
    file = load(folder, "atlas_attack")
    if file is None:
        return not_measured("atlas_attack")
    rows = {row["case"]: row for row in file.rows.to_dict("records")}

    def table(head: Sequence[str], cells: Callable[[Mapping[str, Any]], list[str]]) -> str:
        lines = [
            [chart_label(c), *(cells(rows[c.name]) if c.name in rows else ["not measured"] * len(head))] for c in CASES
        ]
        return markdown(("chart", *head), lines)

    cells, few = (
        " or ".join(f"{n:,}" for n in sorted({int(row[name]) for row in rows.values()})) for name in ("cells", "worst")
    )
    text = (
        f"{cells} cells of each kind are compared with direct solves, {few} with 30 digits. Error of $\\rho$: 99.9 % "
        "quantile over the random cells. Random, nearest, widest: largest ratio of error to bound. The rounding of "
        "direct solves is subtracted from the error."
    )
    return "\n\n".join([table(_SIZES, _sizes), text, table(_ERRORS, _errors), f"Machine: {file.facts['machine']}."])


def chart_label(case: Any) -> str:
    """Ranges of a case and its differences from the base case, in symbols."""
    ranges = [
        rf"{_SYMBOLS[name]} \in [{_number(low)}, {_number(high)}]" if low else rf"{_SYMBOLS[name]} \le {_number(high)}"
        for name, (low, high) in case.ranges.items()
    ]
    return ", ".join(f"${x}$" for x in [*ranges, *(f"{_SYMBOLS[n]} = {_number(v)}" for n, v in case.change.items())])


def _number(value: float) -> str:
    digits, _, power = f"{value:g}".partition("e")
    return ((rf"{digits}\cdot" if digits != "1" else "") + f"10^{{{int(power)}}}") if power else digits


def _sizes(row: Mapping[str, Any]) -> list[str]:
    panels = ", ".join(panel.replace("x", " x ") for panel in row["panels"].split())
    return [
        f"${_number(row['tolerance'])}$",
        panels,
        f"{row['solves']:,}",
        f"{row['bytes'] / 1e6:.2g} MB",
        small(row["z_error"]),
    ]


def _errors(row: Mapping[str, Any]) -> list[str]:
    parts = [
        f"{max(row[f'{kind}_{by}'] for by in ('direct', 'precise')):.2g}" for kind in ("random", "nearest", "widest")
    ]
    sums = [str(row[f"{what}_direct"] + row[f"{what}_precise"]) for what in ("violations", "wrong")]
    return [small(row["rho_error"]), *parts, f"{row['undecided']:,} of {row['of']:,}", *sums]


def count(number: float) -> str:
    """A count or rate with three significant digits and separated thousands."""
    return f"{float(f'{number:.3g}'):,.0f}" if number >= 100 else f"{number:.3g}"


def small(error: float) -> str:
    """An error with two significant digits, ``2.4e-10``."""
    return "none" if math.isnan(error) else "0" if error == 0 else f"{error:.1e}"


def seconds(time: float) -> str:
    """A time in s, ms, us or ns."""
    unit, scale = next((pair for pair in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)) if time >= pair[1]), ("ns", 1e-9))
    return f"{count(time / scale)} {unit}"


def times(ratio: float) -> str:
    """A ratio with two significant digits (three above 100): ``1.7``, ``860``."""
    return f"{float(f'{ratio:.2g}'):g}" if ratio < 100 else f"{float(f'{ratio:.3g}'):,.0f}"


def against(ratio: float, rival: str) -> str:
    """A comparison of speeds in words."""
    if 1 / LEVEL < ratio < LEVEL:
        return f"level with {rival}"
    return f"{times(ratio)} times as fast as {rival}" if ratio > 1 else f"{times(1 / ratio)} times slower than {rival}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *rows])


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
