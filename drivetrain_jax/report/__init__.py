"""One HTML file about one or more results: the answer first, then figures, error bounds and the scene.

Figures are SVG within the page; it needs neither network nor scripts. Modules that load jax are imported where an answer
needs them.
"""

from __future__ import annotations

import io
import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.figure import drawn, in_physical_data
from drivetrain_jax.report.statements import amplitudes, axes_table, chain, fixed_table, statements, values_tables
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import open_result
from drivetrain_jax.view import charts
from drivetrain_jax.view.style import allowed_units, in_units, listed, unit_of, with_prefixes, written_units

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_file import StoredAtlas

__all__ = ["report"]

# Cells each way of the chart of an atlas, whose figure is a vector image, and cells of an atlas of one parameter: ranges of
# instability are narrow.
_CELLS, _LINE_CELLS = 300, 3000
# Attributes that say where the numbers come from.
_PROVENANCE = (
    *("system", "analysis", "method", "options", "references"),
    *("source", "versions", "machine", "created", "digest"),
)


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
    heading = title or (sections[0]["title"] if len(sections) == 1 else "Drivetrain report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("drivetrain_jax.report").joinpath("report.html.j2").read_text("utf-8"))
    return template.render(title=heading, sections=sections)


def _check_used(sections: Iterable[dict[str, Any]], asked: Iterable[str], amplitude: Any) -> None:
    """Raise :class:`InputError` for units and a limit that no section shows."""
    units = sorted({written_units(unit) for section in sections for unit in section["units"]})
    for unit in asked:
        if written_units(unit) not in units:
            raise InputError(f"units = {unit!r}: nothing in the report measures that; {allowed_units(units)}")
    if amplitude is not None and not any(section["compared"] for section in sections):
        raise InputError(
            f"amplitude = {amplitude!r}: no result has a forced motion to compare; expected an atlas over the speed, a "
            "result of floquet of a system with a forced response, or a result of forced that contains amplitude"
        )


def _section(path: Path, number: int, asked: list[str], amplitude: Any) -> dict[str, Any]:
    """Content of the page about one result, and the ``units`` in it; ``compared``: with the limit of the amplitude."""
    checksums.refuse_damaged(path)
    dataset = open_result(path)
    attrs, analysis, convert = dataset.attrs, dataset.attrs.get("analysis"), partial(_in_units, asked)
    answers, limit, moved = [], None, None
    if analysis == "atlas":
        answers, chart, compared = _atlas_answers(path, convert, amplitude)
    else:
        chart, compared = dataset.load(), False
        if analysis == "floquet" and charts.sweep_axes(chart) == [charts.role(chart, "speed")]:
            from drivetrain_jax.runs.reply import with_unstable_ranges

            chart = with_unstable_ranges(chart)[0] if "verdict" in chart else chart
    if amplitude is not None and (analysis == "floquet" or amplitudes(chart)):
        from drivetrain_jax.runs.reply import Limit
        from drivetrain_jax.systems import get_system

        system = get_system(str(attrs.get("system")))
        if "forced" in system.models and system.displacements is not None:
            limit, compared = Limit.from_text(system, amplitude), True
            moved = with_prefixes(convert(_forced_motion(chart))) if analysis == "floquet" else None
    handy = with_prefixes(convert(chart))
    fixed = fixed_table(handy)
    return {
        "title": str(attrs.get("title") or path.name),
        "file": path.name,
        "statements": [*answers, *statements(handy, not answers, limit, moved)],
        "chain": chain(handy),
        "axes": axes_table(handy),
        "fixed": fixed,
        "values": values_tables(handy),
        "figure": _svg(chart, number, asked),
        "provenance": [(name, str(attrs[name])) for name in _PROVENANCE if name in attrs],
        "scene": str(attrs.get("scene", "")).strip(),
        "units": {str(v.attrs.get("units", "1")) for v in handy.variables.values()} | {row[-1] for row in fixed},
        "compared": compared,
    }


def _in_units(asked: list[str], dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` in the units ``asked`` for, else in those in which its scene gives its axes."""
    return in_units(in_physical_data(dataset, asked), asked)


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


def _atlas_answers(
    path: Path, convert: Callable[[xr.Dataset], xr.Dataset], amplitude: Any
) -> tuple[list[str], xr.Dataset, bool]:
    """Sentences of the design question that needs no further values, the chart of the atlas at ``path``, and a flag.

    ``convert`` puts a chart into the units of the sentences. The flag is true if they compare the forced motion with the
    limit ``amplitude``.
    """
    from drivetrain_jax.runs.atlas_answers import least_damping, speed_windows, widest_angle
    from drivetrain_jax.runs.atlas_chart import chart
    from drivetrain_jax.runs.atlas_file import open_atlas

    atlas = open_atlas(path)
    drawn = chart(path, {}, _CELLS if len(atlas.ranges) > 1 else _LINE_CELLS)
    speed, angle, damping = (atlas.scene.system.roles.get(name) for name in ("speed", "angle", "damping"))
    questions = {
        frozenset({speed}): speed_windows,
        frozenset({speed, damping}): least_damping,
        frozenset({speed, angle}): widest_angle,
    }
    question = questions.get(frozenset(atlas.ranges))
    if question is None:
        return [], drawn, False
    reply = question(atlas, {}, amplitude=amplitude, show=partial(_shown, atlas, convert(drawn)))
    return reply.sentences(), drawn, "forced" in reply.data


def _shown(atlas: StoredAtlas, drawn: xr.Dataset, name: str, value: float) -> tuple[str, float, str]:
    """A value of a parameter in the units of the report, as physical data where the atlas has these."""
    quantity = atlas.shaft.quantity(name, value) if atlas.shaft else None
    name, value, units = quantity or (name, value, atlas.scene.system.parameter(name).units)
    size, units = unit_of(drawn, name, units)
    return name, value * size, units


def _forced_motion(stability: xr.Dataset) -> xr.Dataset:
    """The forced amplitudes at the points of a ``floquet`` result, without a value where it is not stable."""
    from drivetrain_jax.runs.run import run

    scene = tomllib.loads(str(stability.attrs["scene"]))
    forced = run({**scene, "analysis": "forced", "outputs": ["amplitude"], "options": {}})
    multipliers = abs(stability.get("floquet_multiplier", xr.DataArray(0.0)))
    radius = stability.get("spectral_radius", multipliers.max([d for d in multipliers.dims if d == "multiplier"]))
    grows = stability["verdict"] == 1 if "verdict" in stability else radius > 1
    amplitude = forced["amplitude"].where(~grows)
    name = f"{amplitude.attrs['long_name']}, where stable"
    return forced.assign(amplitude=amplitude.assign_attrs(long_name=name))
