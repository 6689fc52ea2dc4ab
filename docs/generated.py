"""Directives whose tables come from the code: parameters, analyses, scenes, outcomes, what a file holds, the gallery.

Each writes Markdown and lets the page's parser read it, so that a table in a page cannot differ from the package.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

import drivetrain_jax as dt
from drivetrain_jax._quantities import Parameter, Variable
from drivetrain_jax.analysis import Analysis, Outcome, get_analysis
from drivetrain_jax.runs.toml import entries
from drivetrain_jax.systems import System, get_system
from drivetrain_jax.view.style import symbol

ROOT = Path(__file__).parents[1]
GALLERY = ROOT / "out" / "gallery"

MEANINGS = {
    Outcome.SUCCESS: "the value is there, within the target",
    Outcome.TOLERANCE_NOT_MET: "the value is there with its error, which exceeds the target",
    Outcome.NOT_CONVERGED: "an iteration found nothing; NaN",
    Outcome.STEP_LIMIT: "the point would take more steps than are allowed; NaN",
    Outcome.NOT_FINITE: "overflow, or a model without a value there; NaN",
    Outcome.LOST: "the process that computed it died every time; NaN. Another run tries again",
}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines) + "\n"


def parameters(system: str) -> str:
    """Symbols, units, ranges and defaults of a system."""
    rows = [_parameter_row(p) for p in get_system(system).parameters]
    text = table(("symbol", "name", "meaning", "unit", "allowed", "default"), rows)
    presets = get_system(system).presets
    listed = [(f"`{name}`", ", ".join(f"`{entry}`" for entry in entries(given))) for name, given in presets.items()]
    return text + ("\n" + table(("preset", "values"), listed) if listed else "")


def _parameter_row(parameter: Parameter) -> tuple[str, ...]:
    mark = symbol(parameter.name)
    shown = mark if mark.startswith("$") else ""
    return (
        shown,
        f"`{parameter.name}`",
        parameter.long_name,
        parameter.units,
        f"`{parameter.allowed}`",
        default_text(parameter),
    )


def default_text(parameter: Parameter) -> str:
    """The default as a reader would write it."""
    if parameter.derived:
        return parameter.derived
    if parameter.default is None:
        return "required"
    return value_text(parameter.default) or "none"


def value_text(value: Any) -> str:
    """A word, a number or a list of numbers."""
    if isinstance(value, tuple):
        return ", ".join(map(value_text, value))
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def analyses(system: str) -> str:
    """The analyses of a system: results, methods and options of each."""
    served = get_system(system)
    return "\n".join(_analysis(get_analysis(name), served) for name in served.models)


def _analysis(analysis: Analysis, system: System) -> str:
    lacking = analysis.lacks(system)
    offered = [v for v in analysis.variables if v.name not in lacking]
    results = table(("result", "meaning", "unit", "dimensions"), [_variable_row(v, analysis) for v in offered])
    used = {name: options for name, options in analysis.methods.items() if name not in lacking}
    methods = ", ".join(f"`{name}` ({', '.join(options) or 'no options'})" for name, options in used.items())
    heading = f"### `{analysis.name}`\n\n{analysis.title[0].upper()}{analysis.title[1:]}."
    text = f"{heading}\n\n{results}\nMethods and the options they use, the first by default: {methods}.\n"
    rows = [_parameter_row(option)[1:] for option in analysis.options]
    return text + ("\n" + table(("option", "meaning", "unit", "allowed", "default"), rows) if rows else "")


def _variable_row(variable: Variable, analysis: Analysis) -> tuple[str, ...]:
    star = "*" if variable.name in analysis.default_outputs else ""
    flags = ": " + ", ".join(f"{code} {flag}" for code, flag in enumerate(variable.flags)) if variable.flags else ""
    return f"`{variable.name}`{star}", variable.long_name + flags, variable.units, ", ".join(variable.dims)


def scenes(system: str) -> str:
    """The scenes of a system, each with what it is about."""
    rows = []
    for path in sorted((ROOT / "sweeps").glob("*.toml")):
        scene = tomllib.loads(path.read_text())
        if scene["system"] == system:
            rows.append((f"`sweeps/{path.name}`", scene["title"], f"`{scene['analysis']}`"))
    return table(("scene", "title", "analysis"), rows)


def outcomes() -> str:
    """The codes of the variable `outcome`."""
    return table(("code", "name", "meaning"), [(str(int(o)), f"`{o.name.lower()}`", MEANINGS[o]) for o in Outcome])


def file_contents() -> str:
    """Variables and attributes of a result, read from one."""
    axes = {"beta": {"values": [0.1, 0.3]}, "Omega": {"values": [1.0, 1.4]}}
    fixed = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    result = dt.run({"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": fixed})
    rows = [
        (f"`{name}`", ", ".join(v.dims), str(v.dtype), v.attrs["units"], v.attrs["long_name"])
        for name, v in result.variables.items()
    ]
    attributes = [(f"`{name}`", f"`{_one_line(value)}`") for name, value in result.attrs.items()]
    return (
        table(("variable", "dimensions", "type", "units", "long_name"), rows)
        + "\n"
        + table(("attribute", "here"), attributes)
    )


def _one_line(value: Any) -> str:
    text = " ".join(str(value).split()).replace("`", "'")
    return text if len(text) <= 90 else text[:87] + "..."


def gallery() -> str:
    """The figures that `make gallery` has rendered, or how to get them."""
    page = GALLERY / "index.md"
    if not page.exists():
        return "This copy was built without figures: `make gallery` renders them, `make docs` then includes them.\n"
    return page.read_text().replace("](", "](../out/gallery/")


class Generated(SphinxDirective):
    """Parses what one of the functions above writes in place of the directive."""

    optional_arguments = 1
    sources: ClassVar = {
        f.__name__.replace("_", "-"): f for f in (parameters, analyses, scenes, outcomes, file_contents, gallery)
    }

    def run(self) -> list[nodes.Node]:
        """The nodes of the generated Markdown."""
        return self.parse_text_to_nodes(self.sources[self.name](*self.arguments), allow_section_headings=True)


def unlink_folders(app: Any, page: str, source: list[str]) -> None:
    """Links to folders of the repository are of use there only: on the site their text is left."""
    source[0] = re.sub(r"\[([^\]]*)\]\(\.\./[^)#]*/\)", r"\1", source[0])


def setup(app: Any) -> dict[str, bool]:
    """Registers a directive for every table."""
    app.connect("source-read", unlink_folders)
    for name in Generated.sources:
        app.add_directive(name, Generated)
    return {"parallel_read_safe": True}
