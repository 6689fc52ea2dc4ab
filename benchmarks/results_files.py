"""Read result files, and format their numbers and tables as Markdown."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.precision import GOAL

Row = Mapping[str, str]
# Ratio of times up to which two methods count as equally fast.
LEVEL = 1.1
# Marks around the generated part of a page.
BEGIN = "<!-- Written by `python -m benchmarks.page`; do not edit. -->"
END = "<!-- End of the generated part. -->"
# Families of the chart: prefix of the label -> name in a sentence.
CHART = {
    "drivetrain_jax direct": "`direct`",
    "heyoka batch": "heyoka batch",
    "scipy DOP853 stacked, half period": "SciPy DOP853 on the stacked grid over half a period",
    "scipy DOP853 stacked": "SciPy DOP853 on the stacked grid",
    "scipy DOP853": "SciPy DOP853 point by point",
    "scipy RK45": "SciPy RK45 point by point, the paper's method",
    "drivetrain_jax diffrax": "`diffrax`",
}
_PROVENANCE = ("date", "commit", "machine", "load", "versions", "accelerator")


@dataclass(frozen=True)
class ResultFile:
    """A CSV file of results: ``facts`` (date, commit, machine, load, versions), ``notes`` from its head, ``rows``."""

    name: str
    facts: Mapping[str, str]
    notes: Sequence[str]
    rows: Sequence[Row]


def load(folder: Path, name: str) -> ResultFile | None:
    """``<folder>/<name>.csv``, or None if it has not been measured."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        return None
    lines = path.read_text().splitlines()
    head = [line[2:] for line in lines if line.startswith("# ")]
    pairs = [line.partition(": ") for line in head]
    facts = {key: value for key, _, value in pairs if key in _PROVENANCE}
    notes = [line for line, (key, _, _) in zip(head, pairs, strict=True) if key not in _PROVENANCE]
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    return ResultFile(name, facts, notes, rows)


def family(row: Row) -> str:
    """The family of a row of throughput.csv: the longest matching prefix in ``CHART``."""
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


def count(value: str | float) -> str:
    """A count or rate with three significant digits and separated thousands."""
    number = float(value)
    if number >= 100:
        return f"{float(f'{number:.3g}'):,.0f}"
    return f"{number:.3g}"


def plain(text: str) -> str:
    """A cell of a table: ``8,192`` for 8192, ``1,110`` for 1.11e+03, empty for NaN, other text unchanged."""
    if text.isdecimal():
        return f"{int(text):,}"
    try:
        number = float(text)
    except ValueError:
        return text
    if math.isnan(number):
        return ""
    return count(number) if abs(number) >= 1000 else text


def small(value: str | float) -> str:
    """An error with two significant digits, ``2.4e-10``."""
    number = float(value)
    if math.isnan(number):
        return "none"
    return "0" if number == 0 else f"{number:.1e}"


def seconds(value: str | float) -> str:
    """A time in s, ms, us or ns."""
    number = float(value)
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if number >= scale or unit == "ns":
            return f"{count(number / scale)} {unit}"
    raise AssertionError


def times(ratio: float) -> str:
    """A ratio with two significant digits (three above 100): ``1.7``, ``860``."""
    return f"{float(f'{ratio:.2g}'):g}" if ratio < 100 else f"{float(f'{ratio:.3g}'):,.0f}"


def is_level(ratio: float) -> bool:
    """True if two speeds count as equal, because another run may reverse their order."""
    return 1 / LEVEL < ratio < LEVEL


def against(ratio: float, rival: str) -> str:
    """A comparison of speeds in words."""
    if is_level(ratio):
        return f"level with {rival}"
    return f"{times(ratio)} times as fast as {rival}" if ratio > 1 else f"{times(1 / ratio)} times slower than {rival}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def whole(file: ResultFile | None, name: str, columns: Mapping[str, str], formats: Mapping[str, object]) -> str:
    """A table of all rows of a file: ``columns`` map names to headings, ``formats`` map names to format functions."""
    if file is None:
        return not_measured(name)
    as_is = dict.fromkeys(columns, plain) | dict(formats)
    rows = [[_cell(row.get(column, ""), as_is[column]) for column in columns] for row in file.rows]
    return markdown(list(columns.values()), rows)


def between_marks(text: str, section: str, begin: str = BEGIN, end: str = END) -> str:
    """``text`` with ``section`` between its marks."""
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n\n{section}\n\n{end}{after}"


def not_measured(name: str) -> str:
    """The line in place of a table whose file is missing."""
    return f"Not measured: `{name}.csv` is missing."


def _cell(text: str, form: object) -> str:
    return form(text) if text and callable(form) else text
