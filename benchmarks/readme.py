"""Generate the measured part of README.md from the result files; `python -m benchmarks.page` writes it."""

from __future__ import annotations

from pathlib import Path

from benchmarks import page_precision, page_text
from benchmarks.precision import GOAL
from benchmarks.results_files import (
    ResultFile,
    Row,
    at_equal_error,
    between_marks,
    count,
    family,
    load,
    markdown,
    not_measured,
    seconds,
    small,
)
from benchmarks.timing import CHART_RANGE, RESULTS

README = Path(__file__).resolve().parents[1] / "README.md"
NAMES = ("throughput", "critical_speeds", "atlas")
LABELS = {
    "drivetrain_jax direct": "**`direct`**",
    "heyoka batch": "heyoka (compiled Taylor integrator)",
    "scipy DOP853 stacked, half period": "SciPy DOP853, whole grid as one state, half a period",
    "scipy RK45": "SciPy RK45, point by point (the paper's method)",
    "drivetrain_jax diffrax": "`diffrax` under vmap",
}


def section(folder: Path = RESULTS) -> str:
    """The text between the two marks."""
    files = {name: load(folder, name) for name in NAMES}
    told = [
        page_text.critical_sentence(files["critical_speeds"]),
        _atlas(files["atlas"]),
        page_precision.losses(page_precision.load_precision(folder)),
    ]
    return "\n\n".join([*_chart(files["throughput"]), "\n".join(f"- {sentence}" for sentence in told if sentence)])


def _chart(file: ResultFile | None) -> list[str]:
    if file is None:
        return [not_measured("throughput")]
    good = at_equal_error(file)
    exact = [_most_exact(file, name) for name in LABELS if name not in good]
    shown = [*(row for name, row in good.items() if name in LABELS), *filter(None, exact)]
    rows = [
        [_label(row), f"{int(row['cells']):,}", count(row["cells_per_s"]), small(row["max_error"])]
        for row in sorted(shown, key=lambda row: -float(row["cells_per_s"]))
    ]
    head = (
        f"Spectral radius, Omega from {CHART_RANGE['Omega'][0]:g} on, {file.notes[0]}, without compilation. Each method is "
        f"shown at its fastest setting with an error of at most {GOAL:g}, or at its most accurate setting if it never gets "
        f"there. `direct` and `diffrax` give an error bound for every cell. {page_text.machine({'throughput': file})}"
    )
    return [head, markdown(["method", "cells that it computed", "cells/s", "largest error"], rows)]


def _label(row: Row) -> str:
    return f"{LABELS[family(row)]}, {row['method'].rpartition(', ')[2]}"


def _most_exact(file: ResultFile, name: str) -> Row | None:
    rows = [row for row in file.rows if family(row) == name]
    return min(rows, key=lambda row: float(row["max_error"]), default=None)


def _atlas(file: ResultFile | None) -> str:
    if file is None:
        return ""
    rates = {kind: [] for kind in ("evaluation", "points")}
    for row in file.rows:
        kind = row["method"].removeprefix("atlas, ")
        if kind in rates:
            rates[kind].append(float(row["cells_per_s"]))
    told = [f"up to {count(max(rates[kind]))} {what} per second" for kind, what in _KINDS.items() if rates[kind]]
    sliced = next((row for row in file.rows if "four parameters" in row["method"]), None)
    if sliced:
        time = seconds(float(sliced["cells_computed"]) / float(sliced["cells_per_s"]))
        told.append(f"a chart of {count(sliced['cells_computed'])} cells from a four-parameter atlas in {time}")
    return f"Evaluation of an atlas, with bounds and verdicts: {'; '.join(told)}."


_KINDS = {"evaluation": "grid cells", "points": "scattered points"}


def written(text: str, folder: Path = RESULTS) -> str:
    """``text`` with its measured part replaced from the files in ``folder``."""
    return between_marks(text, section(folder))


def write_readme() -> None:
    """Rewrite the measured part of README.md."""
    README.write_text(written(README.read_text()))
