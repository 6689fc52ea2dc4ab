"""The HTML page of a report. Figures are SVG within the page; it needs neither network nor scripts."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.figure import drawn, in_physical_data
from drivetrain_jax.report.statements import amplitudes, statements
from drivetrain_jax.report.tables import Table, axes_table, fixed_table, values_tables
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import open_result
from drivetrain_jax.view.units import in_given_units, in_units, listed, with_prefixes, written_units

# Cells each way of the chart of an atlas, whose figure is a vector image, and cells of an atlas of one parameter: ranges of
# instability are narrow.
_CELLS, _LINE_CELLS = 300, 3000
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
    values: list[Table]
    figure: str
    provenance: list[tuple[str, str]]
    scene: str
    units: set[str]
    compared: bool


def report(
    results: Sequence[str | Path],
    title: str | None = None,
    units: str | Sequence[str] | None = None,
    amplitude: Any = None,
) -> str:
    """The HTML text of a report about these result files.

    Args:
        results: paths of results, atlases among them, each checked against its checksums.
        title: heading of the page; default: the title of the only result, or ``Drivetrain report``.
        units: units of sentences, tables and figures, ``"rpm,deg"`` or a list (default: those of the scenes).
        amplitude: limit of the forced amplitude (``"2 deg"``), with which answers compare the forced motion.

    Returns: one page of HTML, complete in itself.

    Raises: :class:`~drivetrain_jax.InputError` for a file that is damaged or no result, for a unit or a limit that suits
    none of the results, and without jinja2.
    """
    asked = [] if units is None else listed(units)
    try:
        import jinja2
    except ImportError:
        raise InputError("report: needs the package jinja2; pip install 'drivetrain_jax[report]'") from None
    sections = [_section(Path(result), number, asked, amplitude) for number, result in enumerate(results)]
    _check_used(sections, asked, amplitude)
    heading = title or (sections[0].title if len(sections) == 1 else "Drivetrain report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("drivetrain_jax.report").joinpath("report.html.j2").read_text("utf-8"))
    return template.render(title=heading, sections=sections)


def _check_used(sections: Iterable[Section], asked: Iterable[str], amplitude: Any) -> None:
    """Raise :class:`InputError` for units and a limit that no section shows."""
    found = sorted({written_units(u) for section in sections for u in section.units if u not in ("1", "")})
    for unit in asked:
        if written_units(unit) not in found:
            shown = f"units of {', '.join(found)}" if found else "none, all values are dimensionless"
            raise InputError(f"units = {unit!r}: nothing in the report measures that; allowed are {shown}")
    if amplitude is not None and not any(section.compared for section in sections):
        raise InputError(
            f"amplitude = {amplitude!r}: no result has a forced motion to compare; allowed with an atlas over the speed, a "
            "result of floquet of a system with a forced response, or a result of forced that contains amplitude"
        )


def _section(path: Path, number: int, asked: list[str], amplitude: Any) -> Section:
    checksums.refuse_damaged(path)
    dataset = open_result(path)
    analysis = dataset.attrs.get("analysis")
    if analysis is None:
        raise InputError(f"file = {str(path)!r}: has no attribute 'analysis'; allowed is a result of drivetrain_jax")
    answers, compared, convert = [], False, partial(_in_units, asked)
    if analysis == "atlas":
        # Local import: it loads jax, which other results do not need.
        from drivetrain_jax.report.computed import atlas_answers

        answers, chart, compared = atlas_answers(path, (_LINE_CELLS, _CELLS), convert, amplitude)
    else:
        chart = dataset.load()
    limit = moved = None
    if amplitude is not None and (analysis == "floquet" or amplitudes(chart)):
        # Local import: it loads jax.
        from drivetrain_jax.report.computed import forced_motion, limit_of

        limit = limit_of(chart, amplitude)
        moved = forced_motion(chart) if limit and analysis == "floquet" else None
    attrs, handy = dataset.attrs, with_prefixes(convert(chart))
    axes, fixed = axes_table(handy), fixed_table(handy)
    return Section(
        title=str(attrs.get("title") or path.name),
        file=path.name,
        statements=[
            *answers,
            *statements(handy, not answers, limit, None if moved is None else with_prefixes(convert(moved))),
        ],
        axes=axes,
        fixed=fixed,
        values=values_tables(handy),
        figure=_svg(chart, number, asked),
        provenance=[(name, str(attrs[name])) for name in _PROVENANCE if name in attrs],
        scene=str(attrs.get("scene", "")).strip(),
        units={str(v.attrs.get("units", "1")) for v in handy.variables.values()} | {row[-1] for row in fixed},
        compared=compared or limit is not None,
    )


def _in_units(asked: list[str], dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` in the units ``asked`` for, else in those in which its scene gives its axes."""
    return in_units(in_given_units(in_physical_data(dataset, asked) if asked else dataset), asked)


def _svg(source: xr.Dataset, number: int, asked: list[str]) -> str:
    """The figure as an SVG element; empty for an analysis that has none."""
    try:
        figure = drawn([source], asked, check=False)
    except InputError:
        return ""
    image = io.StringIO()
    # The salt makes names within the figure equal in every run, and different from those of other figures of the page.
    with mpl.rc_context({"svg.hashsalt": f"figure {number}"}):
        figure.savefig(image, format="svg", metadata={"Date": None})
    text = image.getvalue()
    # Names such as `axes_1` are those of every figure, and a page may have each only once.
    return re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>figure{number}-", text[text.index("<svg") :])
