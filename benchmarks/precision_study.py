"""The common ``main`` of the studies of precision: measure, write the CSV, draw the figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.precision import REPEATS, SPENT, Contender, is_silent, measure, write
from benchmarks.precision_figure import draw
from benchmarks.timing import parser, results_folder

Contenders = Callable[[bool], tuple[Sequence[Contender], Sequence[str]]]


def study(name: str, doc: str, contenders: Contenders, argv: Sequence[str] | None) -> None:
    """Run a study: ``contenders(quick)`` returns the contenders, and the notes for the head of the CSV."""
    options = parser(doc).parse_args(argv)
    folder = results_folder(options)
    given, notes = contenders(options.quick)
    repeats, spent = (3, SPENT / 4) if options.quick else (REPEATS, SPENT)
    rungs = measure(given, repeats, spent)
    about = f"medians of up to {repeats} runs in turns, as many as {spent:g} s allow ('timed'), without compilation"
    write(name, rungs, [about, *notes], folder)
    draw(name, rungs, folder)
    for rung in rungs:
        silent = "SILENT" if is_silent(rung) else ""
        print(f"{rung.region:18} {rung.method:32} {rung.setting:16} {rung.error:.0e} {rung.noticed or silent}")
