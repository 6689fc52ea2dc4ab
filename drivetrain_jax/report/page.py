"""The HTML page of a report. Figures are SVG within the page; it needs neither network nor scripts."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.figure import plot
from drivetrain_jax.report.statements import axes_table, fixed_table, statements, values_table
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import open_result
from drivetrain_jax.view.prefixes import with_prefixes

# Cells each way of the chart of an atlas: its figure is a vector image.
_CELLS = 300
# Attributes that say where the numbers come from.
_PROVENANCE = (
    *("system", "analysis", "method", "options", "references"),
    *("source", "versions", "machine", "created", "digest"),
)


class Section(NamedTuple):
    """Content of the page about one result."""

    title: str
    file: str
    statements: list[str]
    axes: list[tuple[str, ...]]
    fixed: list[tuple[str, ...]]
    values: list[tuple[str, ...]]
    figure: str
    provenance: list[tuple[str, str]]
    scene: str


def report(results: Sequence[str | Path], title: str | None = None) -> str:
    """The HTML text of a report about these result files.

    Args:
        results: paths of results, atlases among them, each checked against its checksums.
        title: heading of the page; default: the title of the only result, or ``Drivetrain report``.

    Returns: one page of HTML, complete in itself.

    Raises: :class:`~drivetrain_jax.InputError` for a file that is damaged or no result, and without jinja2.
    """
    try:
        import jinja2
    except ImportError:
        raise InputError("report: needs the package jinja2; pip install 'drivetrain_jax[report]'") from None
    sections = [_section(Path(result), number) for number, result in enumerate(results)]
    heading = title or (sections[0].title if len(sections) == 1 else "Drivetrain report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("drivetrain_jax.report").joinpath("report.html.j2").read_text("utf-8"))
    return template.render(title=heading, sections=sections)


def _section(path: Path, number: int) -> Section:
    checksums.refuse_damaged(path)
    dataset = open_result(path)
    analysis = dataset.attrs.get("analysis")
    if analysis is None:
        raise InputError(f"file = {str(path)!r}: has no attribute 'analysis'; allowed is a result of drivetrain_jax")
    answers = []
    if analysis == "atlas":
        # Local import: it loads jax, which other results do not need.
        from drivetrain_jax.report.atlas_section import atlas_answers

        answers, chart = atlas_answers(path, _CELLS)
    else:
        chart = dataset.load()
    attrs, handy = dataset.attrs, with_prefixes(chart)
    return Section(
        title=str(attrs.get("title") or path.name),
        file=path.name,
        statements=[*answers, *statements(handy, ranges=not answers)],
        axes=axes_table(handy),
        fixed=fixed_table(dataset),
        values=values_table(handy),
        figure=_svg(path if analysis == "atlas" else chart, number),
        provenance=[(name, str(attrs[name])) for name in _PROVENANCE if name in attrs],
        scene=str(attrs.get("scene", "")).strip(),
    )


def _svg(source: Path | xr.Dataset, number: int) -> str:
    """The figure as an SVG element; empty for an analysis that has none."""
    options: dict[str, Any] = {"cells": _CELLS} if isinstance(source, Path) else {}
    try:
        figure = plot(source, **options)
    except InputError:
        return ""
    image = io.StringIO()
    # The salt makes names within the figure equal in every run, and different from those of other figures of the page.
    with mpl.rc_context({"svg.hashsalt": f"figure {number}"}):
        figure.savefig(image, format="svg", metadata={"Date": None})
    text = image.getvalue()
    # Names such as `axes_1` are those of every figure, and a page may have each only once.
    return re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>figure{number}-", text[text.index("<svg") :])
