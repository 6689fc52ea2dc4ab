"""docs/benchmarks.md from the result files alone: conclusions first, then tables and figures, then where they come from.

    python -m benchmarks.page      # writes docs/benchmarks.md and the measured parts of README.md and
                                   # docs/theory/atlas.md from benchmarks/results/

No number of the page is typed: every sentence takes its figures, and its wording, from the CSV files. A file that is
missing gives a line that says so.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from benchmarks import page_precision, page_sections
from benchmarks.precision import GOAL
from benchmarks.results_files import (
    ResultFile,
    Row,
    against,
    count,
    load,
    markdown,
    not_measured,
    seconds,
    small,
    times,
)
from benchmarks.timing import RESULTS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "benchmarks.md"
NAMES = (
    "throughput", "precision_cardan", "work_precision_cardan", "atlas", "heyoka", "precision_bicardan", "critical_speeds",
    "precision_planetary", "planetary_throughput", "precision_rattle", "rattle_throughput", "precision_tripod", "chaos",
    "chaos_precision", "damping", "batches", "outputs", "cold_start", "overhead", "scaling", "accelerator",
)  # fmt: skip
# Families of the chart: the label's beginning, and how a sentence names them.
CHART = {
    "drivetrain_jax direct": "`direct`",
    "heyoka batch": "heyoka batch",
    "scipy DOP853 stacked": "SciPy DOP853 on the stacked grid",
    "scipy DOP853": "SciPy DOP853 point by point",
    "scipy RK45": "SciPy RK45 point by point, the paper's method",
    "drivetrain_jax diffrax": "`diffrax`",
}
_FLOWS = {"Lorenz": "Lorenz' system", "tripod": "the double tripod"}

Files = dict[str, ResultFile | None]


def write_page(folder: Path = RESULTS, page: Path = PAGE) -> None:
    """Write ``page`` from the files in ``folder``."""
    page.write_text(text_of(folder, page))


def text_of(folder: Path, page: Path) -> str:
    """The page."""
    images = os.path.relpath(folder, page.parent).replace(os.sep, "/") + "/"
    files = {name: load(folder, name) for name in NAMES}
    precise = page_precision.load_precision(folder)
    parts = [
        "# Error against run time",
        "Written by `python -m benchmarks` (`make bench`, `drivetrain bench`) from the files in "
        "`benchmarks/results/`; nothing here is typed by hand. " + machine(files),
        "## Conclusions",
        "\n".join(f"- {line}" for line in conclusions(files, precise)),
        "## The cardan chart at equal error",
        _chart_section(files["throughput"]),
        "## Work-precision and extremes",
        _METHOD,
        *(page_precision.section(folder, images, system, precise) for system in page_precision.TITLES),
        "### Schemes behind `direct`, fixed steps",
        page_sections.figure(
            files, "work_precision_cardan", images, "Error of the multipliers against evaluations and time"
        ),
        "## The atlas from nothing to a file",
        page_sections.atlas(files["atlas"]),
        "## Scaling and outputs",
        page_sections.figure(
            files, "batches", images, "Points per second against batch width, number of points, cores and planets"
        ),
        *page_sections.scaling(files),
        "## Other peers",
        *page_sections.peers(files, images),
        "## Where the figures come from",
        page_sections.sources(files),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


_METHOD = (
    "Each region is one point of the parameter space, and neighbours of it. `holds`: an error of at most "
    f"{GOAL:g} is reached, and every tolerance kept within a factor of 1,000 or the miss said. `degrades`, `fails`: it is "
    "not, and the user learns of it by what stands in the cell. **SILENT**: wrong by more than 1,000 times the tolerance "
    "asked for (or by a tenth), or lost, and nothing says so. A number of steps promises nothing: of such a method only the "
    "finest setting can be silent, by a tenth. In brackets after `holds`: what the coarser settings say of themselves. `-`: "
    "not tried there, or no answer. Methods whose name starts with `package` are those of this package."
)


def conclusions(files: Files, precise: dict[str, page_precision.Precision]) -> list[str]:
    """The sentences at the head of the page."""
    found = [
        _chart_sentence(files["throughput"]),
        _cold_sentence(files["throughput"], files["atlas"]),
        _atlas_sentence(files["atlas"]),
    ]
    found += page_precision.conclusions(precise)
    found += [
        page_sections.damping_sentence(files["damping"]),
        critical_sentence(files["critical_speeds"]),
        planetary_sentence(files["planetary_throughput"]),
        rattle_sentence(files["rattle_throughput"]),
        chaos_sentence(files["chaos"]),
        _outputs_sentence(files["outputs"]),
        overhead_sentence(files["overhead"]),
        _accelerator_sentence(files["accelerator"]),
    ]
    return [sentence for sentence in found if sentence]


def family(row: Row) -> str:
    """The family of a row of throughput.csv; the longest beginning counts."""
    return max((name for name in CHART if row["method"].startswith(name)), key=len, default="")


def at_equal_error(file: ResultFile) -> dict[str, Row]:
    """The fastest setting with an error of at most 1e-9 of each family, in the order of ``CHART``."""
    best: dict[str, Row] = {}
    for name in CHART:
        rows = [r for r in file.rows if family(r) == name and "without" not in r["method"]]
        good = [row for row in rows if float(row["max_error"]) <= GOAL]
        if good:
            best[name] = max(good, key=lambda row: float(row["cells_per_s"]))
    return best


def _rate(row: Row) -> float:
    return float(row["cells_per_s"])


def _chart_sentence(file: ResultFile | None) -> str:
    best = at_equal_error(file) if file else {}
    own = best.get("drivetrain_jax direct")
    if own is None:
        return ""
    rivals = [
        f"{against(_rate(own) / _rate(row), CHART[name])} ({count(_rate(row))}, error {small(row['max_error'])})"
        for name, row in best.items()
        if not name.startswith("drivetrain_jax")
    ]
    told = f"{count(_rate(own))} cells/s (largest error {small(own['max_error'])}, with a bound for every cell)"
    return (
        f"The chart of the cardan shaft at a largest error of {GOAL:g}: `direct` computes {told}; {', '.join(rivals)}."
    )


def _cold_sentence(file: ResultFile | None, atlas: ResultFile | None) -> str:
    notes = [note for note in (file.notes if file else ()) if note.startswith("fresh process")]
    told = [f"of {count(file.rows[0]['cells'])} cells, {notes[0]}"] if file and notes else []
    command = next((row for row in (atlas.rows if atlas else ()) if "cold" in row["method"]), None)
    if command:
        spent = float(command["cells_computed"]) / float(command["cells_per_s"])
        told.append(f"of {count(command['chart'])} cells as an atlas, from the command to the file: {seconds(spent)}")
    return f"From nothing to a first chart: {'; '.join(told)}." if told else ""


def _atlas_sentence(file: ResultFile | None) -> str:
    if file is None:
        return ""
    told = []
    for name, words in (("warm", "in memory"), ("cold", "as a cold command, with import, compilation and file")):
        rows = [row for row in file.rows if name in row["method"] and row["times_heyoka"]]
        ends = [f"{against(float(row['times_heyoka']), 'heyoka batch')} at {count(row['chart'])} cells" for row in rows]
        told += [f"{words} {' and '.join(dict.fromkeys([ends[0], ends[-1]]))}"] if ends else []
    return f"The chart as an atlas is {'; '.join(told)} (what heyoka needs to start is not counted)." if told else ""


def critical_sentence(file: ResultFile | None) -> str:
    """What the stepped shaft's critical speeds cost beside SciPy and ROSS."""
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
        words.append(f"six certified critical speeds of {rate} shafts/s, {ratio}")
    if mapped:
        ross = "ROSS (which computes both planes of bending with the gyroscopic effect)"
        words.append(f"a critical-speed map {against(float(mapped['ratio']), ross)}")
    return f"Stepped shaft: {'; '.join(words)}." if words else ""


def planetary_sentence(file: ResultFile | None) -> str:
    """Planetary gears beside the faster of NumPy's two methods."""
    if file is None:
        return ""
    told = []
    for planets in dict.fromkeys(row["planets"] for row in file.rows):
        rates = {row["method"]: float(row["gears_per_s"]) for row in file.rows if row["planets"] == planets}
        rival = max(rate for method, rate in rates.items() if method.startswith("numpy"))
        told.append(f"{planets} planets {times(rates['package'] / rival)}")
    off = max(float(row["rigid_Hz"]) for row in file.rows if row["method"].startswith("numpy eigvalsh"))
    rivals = f"singular values, or eigenvalues of the squares, off by up to {small(off)} Hz where a frequency is 0"
    return (
        f"Planetary gears, gears per second over NumPy's faster batched way ({rivals}), all cores: {', '.join(told)}."
    )


def rattle_sentence(file: ResultFile | None) -> str:
    """Periods of gear rattle beside diffrax and SciPy."""
    if file is None:
        return ""
    own = next(row for row in file.rows if row["solver"] == "exact")
    rivals = {row["solver"]: row for row in file.rows if row is not own}
    told = [
        f"{against(float(row['us_per_lane_period']) / float(own['us_per_lane_period']), name)} at its most exact"
        f" ({small(row['error'])})"
        for name, row in rivals.items()
    ]
    return f"Gear rattle: {count(own['per_second'])} periods/s at an error of {small(own['error'])}; {', '.join(told)}."


def chaos_sentence(file: ResultFile | None) -> str:
    """Lyapunov spectra beside heyoka and SciPy."""
    if file is None:
        return ""
    words = []
    for case in dict.fromkeys(row["case"] for row in file.rows):
        rows = {row["method"]: float(row["per_s"]) for row in file.rows if row["case"] == case}
        own = rows.pop("drivetrain_jax", None)
        if own is not None:
            name, _, error = case.partition(" at error <= ")
            told = " and ".join(against(own / rate, rival) for rival, rate in rows.items())
            words.append(f"{_FLOWS.get(name, name)} with an error of at most {error}: {told}")
    return f"Lyapunov spectra: {'; '.join(words)}." if words else ""


def _outputs_sentence(file: ResultFile | None) -> str:
    told: dict[str, list[str]] = {}
    for row in file.rows if file else ():
        told.setdefault(row["system"], []).append(f"{times(float(row['times_the_first']))} ({row['outputs']})")
    words = "; ".join(f"`{system}` {', '.join(sets)}" for system, sets in told.items())
    return (
        f"What is not asked for is not computed. Time per point over that of the first outputs: {words}."
        if told
        else ""
    )


def overhead_sentence(file: ResultFile | None) -> str:
    """What the engine adds to its kernels."""
    if file is None:
        return ""
    row = file.rows[0]
    return (
        f"From scene to file, {count(row['points'])} points take {100 * float(row['engine_over_kernels']):.1f} % more than "
        f"the bare kernels; {float(row['bytes_per_point']):.3g} bytes a point; a finished run is resumed in "
        f"{seconds(row['resume_s'])}."
    )


def _accelerator_sentence(file: ResultFile | None) -> str:
    if file is None:
        return "There was no GPU machine: every figure of this page is one of a processor named below."
    rates = (
        f"{row['scene']} {count(row['accelerator_per_s'])} points/s, {against(float(row['times']), 'the cores')}"
        for row in file.rows
    )
    device = file.notes[0].partition(";")[0]
    return f"On an accelerator ({device}), beside all cores of its machine: {'; '.join(rates)}."


def _chart_section(file: ResultFile | None) -> str:
    if file is None:
        return not_measured("throughput")
    best = list(at_equal_error(file).values())
    rows = []
    for row in file.rows:
        chosen = any(row is one for one in best)
        cells = [row["method"], count(row["cells_per_s"]), small(row["max_error"]), small(row["median_error"])]
        cells += [times(float(row["times_scipy_RK45"]))]
        rows.append([f"**{cell}**" if chosen else cell for cell in cells])
    head = ["method", "cells/s", "largest error", "median error", "times SciPy RK45"]
    text = f"In bold the fastest setting of each family with a largest error of at most {GOAL:g}."
    return f"{'; '.join(file.notes)}.\n\n{text}\n\n{markdown(head, rows)}"


def machines(files: Files) -> list[str]:
    """Where the files were measured."""
    return sorted({file.facts["machine"] for file in files.values() if file})


def machine(files: Files) -> str:
    """The same as a sentence."""
    found = machines(files)
    return (
        f"{'Machines' if len(found) > 1 else 'Machine'}: {'; '.join(found)}." if found else "Nothing has been measured."
    )


def main() -> None:
    """Write the page, and the measured parts of the README and of docs/theory/atlas.md, from the stored results."""
    from benchmarks import page_atlas
    from benchmarks.readme import write_readme

    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    write_page()
    write_readme()
    page_atlas.write_page()


if __name__ == "__main__":
    main()
