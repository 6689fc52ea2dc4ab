"""Sentences, tables and figures of docs/benchmarks.md, from the result files.

Every number, and every choice of words that depends on one, comes from the CSV files. A missing file gives the line
"Not measured".
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import page_aims, page_precision, ratio_figure
from benchmarks.precision import GOAL, PATIENCE, USELESS
from benchmarks.results_files import (
    LEVEL,
    ResultFile,
    against,
    at_equal_error,
    count,
    load,
    markdown,
    not_measured,
    seconds,
    small,
    times,
    whole,
)
from benchmarks.timing import CHART_RANGE, RESULTS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "benchmarks.md"
NAMES = (
    "throughput", "atlas", "critical_speeds", "planetary_throughput", "chaos", "damping", "cold_start", "overhead",
    "accelerator", "random_points", "waiting",
)  # fmt: skip
# Mean number of cores used by other programs from which a measurement counts as disturbed.
_OTHERS = 0.5

Files = dict[str, ResultFile | None]


def write_page(folder: Path = RESULTS, page: Path = PAGE) -> None:
    """Write ``page``, and the figure at its head, from the files in ``folder``."""
    files, precise = {name: load(folder, name) for name in NAMES}, page_precision.load_precision(folder)
    if panels := ratio_figure.ratios(files, precise):
        ratio_figure.draw(panels, folder / f"{ratio_figure.NAME}.png")
    page.write_text(text_of(folder, page))


def text_of(folder: Path, page: Path) -> str:
    """The page."""
    images = os.path.relpath(folder, page.parent).replace(os.sep, "/") + "/"
    files, precise = {name: load(folder, name) for name in NAMES}, page_precision.load_precision(folder)
    parts = [
        "# Error against run time",
        "Speed of the package over that of its fastest rival, at equal error. "
        f"Speeds within {LEVEL - 1:.0%} are level. Regions are compared at an error of at most {GOAL:g} on one core.",
        answer(ratio_figure.ratios(files, precise)),
        f"![Every comparison of the table]({images}{ratio_figure.NAME}.png)",
        "Written by `python -m benchmarks.page` from the files in `benchmarks/results/`, which have every setting of every "
        "method, and the versions of all packages; `drivetrain bench` measures them again. " + machine(files),
        *warnings(files),
        "## The cardan chart",
        _chart_section(files["throughput"]),
        _atlas_sentence(files["atlas"]),
        "## Regions of every system",
        page_precision.regions(precise, images),
        "## Silent failures",
        f"A setting fails silently if it reports nothing, and points are lost or the error exceeds {USELESS:g} or "
        f"{PATIENCE:,.0f} times the tolerance that was asked for. This rule holds for all methods; a number of steps or "
        "elements asks for no tolerance.",
        page_precision.silence(precise),
        random_sentence(files["random_points"]),
        "## Commands",
        "CPU seconds of a process with its start. `first`: without compiled code; later processes find it.",
        whole(files["waiting"], "waiting", {"command": "command", "first_cpu_s": "first", "cpu_s": "later"}, {}),
        _cold_sentence(files["cold_start"]),
        overhead_sentence(files["overhead"]),
        _accelerator_sentence(files["accelerator"]),
        "## Aims of this project",
        page_aims.section(files, precise),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def answer(panels: Mapping[str, Sequence[ratio_figure.Ratio]]) -> str:
    """The number of regions where the package is faster, level and slower, and its smallest and largest ratio."""
    if not panels:
        return not_measured("throughput")
    rows = []
    for title, ratios in panels.items():
        known = [one for one in ratios if not math.isnan(one.ratio)]
        faster = sum(one.ratio >= LEVEL for one in known)
        slower = sum(one.ratio <= 1 / LEVEL for one in known)
        ends = [pick(known, key=lambda one: one.ratio) for pick in (min, max)] if known else []
        counts = (faster, len(known) - faster - slower, slower)
        rows.append([title, *map(str, counts), *(_ratio(one) for one in ends or [None, None])])
    return markdown(["comparison", "faster", "level", "slower", "smallest ratio", "largest ratio"], rows)


def _ratio(one: ratio_figure.Ratio | None) -> str:
    if one is None:
        return "none"
    told = {math.inf: "no rival reaches the error", 0.0: "only a rival reaches the error"}.get(
        one.ratio, times(one.ratio)
    )
    return f"{told} ({', '.join(filter(None, (one.what, one.rival)))})"


def warnings(files: Mapping[str, ResultFile | None]) -> list[str]:
    """A line if the files are of several commits, and one if other programs used the machine."""
    known = {name: file.facts for name, file in files.items() if file}
    commits: dict[str, list[str]] = {}
    for name, facts in known.items():
        commits.setdefault(facts.get("commit", "unknown"), []).append(name)
    loaded = [f"{name} ({load:g})" for name, facts in known.items() if (load := _other_cores(facts)) > _OTHERS]
    told = []
    if len(commits) > 1:
        each = (
            f"{commit} ({', '.join(names) if len(names) < 4 else 'most files'})" for commit, names in commits.items()
        )
        told.append(f"**Several commits**: {', '.join(each)}.")
    if loaded:
        told.append(f"**Other programs used more than {_OTHERS} cores** during: {', '.join(loaded)}.")
    return told


def _other_cores(facts: Mapping[str, str]) -> float:
    number, _, rest = facts.get("load", "").partition(" cores")
    return float(number) if rest else 0.0


def random_sentence(file: ResultFile | None) -> str:
    """Coverage of the bounds at random points."""
    if file is None:
        return not_measured("random_points")
    rows = [row for row in file.rows if row["over_bound"] != "nan"]
    broken = [row["analysis"] for row in rows if float(row["over_bound"]) > 1]
    largest = max(rows, key=lambda row: float(row["over_bound"]))
    total = sum(int(row["compared"]) for row in rows)
    held = f"**broken** in {', '.join(broken)}" if broken else f"no bound is broken at {total:,} compared random points"
    most = f"{times(float(largest['over_bound']))} of its bound ({largest['analysis']})"
    return f"Bounds: {held}; the largest error is {most}."


def _chart_section(file: ResultFile | None) -> str:
    if file is None:
        return not_measured("throughput")
    best = list(at_equal_error(file).values())
    rows = []
    for row in file.rows:
        chosen = any(row is one for one in best)
        cells = [row["method"], f"{int(row['cells']):,}", count(row["cells_per_s"]), row["slowest_over_fastest"]]
        cells += [small(row["max_error"])]
        rows.append([f"**{cell}**" if chosen else cell for cell in cells])
    head = ["method", "cells that it computed", "cells/s", "slowest over fastest run", "largest error"]
    ranges = ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in CHART_RANGE.items())
    text = (
        f"Spectral radius for {ranges}; {'; '.join(file.notes)}. Slow methods computed a part of the cells: a coarser grid "
        "(`diffrax`) or random ones (SciPy); their largest error is over these. The chart of the front page begins at "
        "Omega = 0.01 and takes twice as long. Compilation is not included. Bold: the fastest setting of each method with "
        f"an error of at most {GOAL:g}."
    )
    return f"{text}\n\n{markdown(head, rows)}"


def _atlas_sentence(file: ResultFile | None) -> str:
    if file is None:
        return not_measured("atlas")
    told = []
    for name, words in (("warm", "in memory"), ("cold", "as a cold command (import, compilation, file)")):
        rows = [row for row in file.rows if name in row["method"] and row["times_heyoka"]]
        ends = [f"{against(float(row['times_heyoka']), 'heyoka batch')} at {count(row['chart'])} cells" for row in rows]
        told += [f"{words} {' and '.join(dict.fromkeys([ends[0], ends[-1]]))}"] if ends else []
    return f"Atlas of the chart: {'; '.join(told)}. The start of heyoka is not counted." if told else ""


def _cold_sentence(file: ResultFile | None) -> str:
    """Seconds from the import to the result of a small scene."""
    if file is None:
        return not_measured("cold_start")
    words = {"empty": "without compiled code", "filled": "with compiled code of an earlier process"}
    told = [
        f"{seconds(sum(float(row[part]) for part in ('import_s', 'compile_s', 'run_s')))} {words[row['compiled_code']]}"
        for row in file.rows
        if row["compiled_code"] in words
    ]
    return f"A small chart in a new process takes {' and '.join(told)}."


def critical_sentence(file: ResultFile | None) -> str:
    """Rates of the stepped shaft's critical speeds compared with SciPy and ROSS."""
    if file is None:
        return ""
    ours = {row["method"]: row for row in file.rows}
    words = []
    certified, mapped = ours.get("drivetrain_jax certified"), ours.get("drivetrain_jax, the same map")
    if certified:
        rate, ratio = (
            count(certified["shafts_per_s"]),
            against(float(certified["ratio"]), "scanning and Brent in SciPy"),
        )
        words.append(f"{rate} shafts/s with six certified critical speeds each, {ratio}")
    if mapped:
        ross = "ROSS (both planes of bending, with gyroscopic effect)"
        words.append(f"a critical-speed map {against(float(mapped['ratio']), ross)}")
    return f"Stepped shaft: {'; '.join(words)}." if words else ""


def overhead_sentence(file: ResultFile | None) -> str:
    """Time that the engine adds to its kernels."""
    if file is None:
        return not_measured("overhead")
    row = file.rows[0]
    return (
        f"From scene to file, {count(row['points'])} points take {100 * float(row['engine_over_kernels']):.1f} % longer "
        f"than the kernels alone. The file has {float(row['bytes_per_point']):.3g} bytes per point. Reopening a finished "
        f"run takes {seconds(row['resume_s'])}."
    )


def _accelerator_sentence(file: ResultFile | None) -> str:
    if file is None:
        return "No GPU was available: all figures are from the processors named above."
    rates = (
        f"{row['scene']} {count(row['accelerator_per_s'])} points/s, {against(float(row['times']), 'the cores')}"
        for row in file.rows
    )
    device, cores = file.notes[0].partition(";")[0], file.facts["machine"].rpartition(", ")[2]
    told = f"On an accelerator ({device}), compared with the {cores} of its machine: {'; '.join(rates)}."
    return " ".join([told, *file.notes[1:]])


def machines(files: Files) -> list[str]:
    """Names of the machines of all files, sorted."""
    return sorted({file.facts["machine"] for file in files.values() if file})


def machine(files: Files) -> str:
    """A sentence that names the machines."""
    found = machines(files)
    return (
        f"{'Machines' if len(found) > 1 else 'Machine'}: {'; '.join(found)}." if found else "Nothing has been measured."
    )
