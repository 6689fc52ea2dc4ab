"""Generate the measured part of docs/theory/atlas.md from atlas_attack.csv; `python -m benchmarks.page` writes it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from benchmarks.atlas_attack import CASES, KINDS, NAME, Case
from benchmarks.results_files import Row, between_marks, load, markdown, not_measured, small
from benchmarks.timing import RESULTS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "theory" / "atlas.md"
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
_UNKNOWN = "not measured"


def written(text: str, folder: Path = RESULTS) -> str:
    """``text`` with its measured part replaced from the files in ``folder``."""
    return between_marks(text, section(folder))


def write_page() -> None:
    """Rewrite the measured part of the page."""
    PAGE.write_text(written(PAGE.read_text()))


def section(folder: Path = RESULTS) -> str:
    """The text between the two marks."""
    file = load(folder, NAME)
    if file is None:
        return not_measured(NAME)
    rows = {row["case"]: row for row in file.rows}
    sizes, errors = (
        markdown(["chart", *head], [[label(case), *_cells(rows.get(case.name), cells, len(head))] for case in CASES])
        for head, cells in ((_SIZES, _size_cells), (_ERRORS, _error_cells))
    )
    return "\n\n".join([sizes, _explanation(file.rows), errors, f"Machine: {file.facts['machine']}."])


def label(case: Case) -> str:
    """Ranges of a case and its differences from the base case, in symbols."""
    ranges = [
        rf"{_SYMBOLS[name]} \in [{_number(low)}, {_number(high)}]" if low else rf"{_SYMBOLS[name]} \le {_number(high)}"
        for name, (low, high) in case.ranges.items()
    ]
    return ", ".join(f"${x}$" for x in [*ranges, *(f"{_SYMBOLS[n]} = {_number(v)}" for n, v in case.change.items())])


def _number(value: float) -> str:
    digits, _, power = f"{value:g}".partition("e")
    if not power:
        return digits
    return (rf"{digits}\cdot" if digits != "1" else "") + f"10^{{{int(power)}}}"


def _cells(row: Row | None, cells: Callable[[Row], list[str]], width: int) -> list[str]:
    return cells(row) if row else [_UNKNOWN] * width


def _size_cells(row: Row) -> list[str]:
    panels = ", ".join(panel.replace("x", " x ") for panel in row["panels"].split())
    size, solves = f"{float(row['bytes']) / 1e6:.2g} MB", f"{int(row['solves']):,}"
    return [f"${_number(float(row['tolerance']))}$", panels, solves, size, small(row["z_error"])]


def _error_cells(row: Row) -> list[str]:
    parts = [f"{max(float(row[f'{kind}_{by}']) for by in ('direct', 'precise')):.2g}" for kind in KINDS]
    sums = [str(int(row[f"{what}_direct"]) + int(row[f"{what}_precise"])) for what in ("violations", "wrong")]
    return [small(row["rho_error"]), *parts, f"{int(row['undecided']):,} of {int(row['of']):,}", *sums]


def _explanation(rows: Sequence[Row]) -> str:
    cells, few = (_several({int(row[name]) for row in rows}) for name in ("cells", "worst"))
    return (
        f"{cells} cells of each kind are compared with direct solves, {few} with 30 digits. Error of $\\rho$: 99.9 % "
        "quantile over the random cells. Random, nearest, widest: largest ratio of error to bound. The rounding of "
        "direct solves is subtracted from the error."
    )


def _several(values: Collection[int]) -> str:
    return " or ".join(f"{value:,}" for value in sorted(values))
