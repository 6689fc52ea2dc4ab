"""Tables of the documentation that come from the code: parameters, analyses, scenes, outcomes, file contents, figures.

    python docs/generated.py      # rewrites the tables in docs/, between their marks

A table stands in its page between two comments, ``<!-- generated: NAME [SYSTEM] -->`` and ``<!-- end of generated -->``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import gallery

import drivetrain_jax as dt
from drivetrain_jax._quantities import Parameter, Variable
from drivetrain_jax.analysis import Analysis, Outcome, get_analysis
from drivetrain_jax.systems import System, get_system, system_names
from drivetrain_jax.view.style import symbol

DOCS = Path(__file__).parent
FIGURES = DOCS.parent / "out" / "gallery" / "index.md"
_MARKS = re.compile(r"(<!-- generated: (\S+)(?: (\S+))? -->\n).*?(<!-- end of generated -->)", re.S)

MEANINGS = {
    Outcome.SUCCESS: "the value meets its target",
    Outcome.TOLERANCE_NOT_MET: "the value is stored; its error exceeds the target",
    Outcome.NOT_CONVERGED: "NaN: an iteration did not converge",
    Outcome.STEP_LIMIT: "NaN: the point needs more steps than the limit",
    Outcome.NOT_FINITE: "NaN: overflow, or the model has no value",
    Outcome.LOST: "NaN: the chunk crashed its worker three times; another run tries again",
}
ATTRIBUTES = {
    "Conventions": "version of the CF conventions",
    "title": "title of the scene, or of its system and analysis",
    "system": "name of the system",
    "roles": "parameters that are the speed, the angle, the damping, ... (JSON)",
    "periods_per_turn": "periods of the motion of a system in one turn of its shaft",
    "state": "name, unit, meaning, symbol and scale of every component of the system's state (JSON)",
    "resonance_families": "prefix of the labels, name and line style of the families of predicted resonances (JSON)",
    "analysis": "name of the analysis",
    "method": "method of the scene",
    "options": "options of the scene with defaults (JSON)",
    "source": "this package and its version",
    "history": "time (UTC) and command of the run",
    "references": "paper that the system is taken from",
    "scene": "text of the scene (TOML)",
    "fixed_parameters": "value, unit and meaning of every fixed parameter (JSON)",
    "drivetrain_jax_version": "version of this package",
    "versions": "versions of the numerical packages",
    "machine": "processor, cores, operating system, Python",
    "created": "time at which the file was completed (UTC)",
    "digest": "digest of scene, chunk sizes and numerics; runs of one digest give identical bits",
    "numerics": "digest of `numerics_detail` of the group `provenance`",
    "wall_time_s": "time of the computation in s",
}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; vertical bars in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines) + "\n"


def parameters(system: str) -> str:
    """Symbols, units, ranges and defaults of a system."""
    rows = [_parameter_row(p) for p in get_system(system).parameters]
    text = table(("symbol", "name", "meaning", "unit", "allowed", "default"), rows)
    presets = get_system(system).presets
    listed = [(f"`{name}`", ", ".join(_entry(*item) for item in given.items())) for name, given in presets.items()]
    return text + ("\n" + table(("preset", "values"), listed) if listed else "")


def _entry(name: str, value: Any) -> str:
    return f"`{name} = {list(value) if isinstance(value, tuple) else value}`"


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
    """The default value as text."""
    if parameter.derived:
        return parameter.derived
    if parameter.default is None:
        return "required"
    return value_text(parameter.default) or "none"


def value_text(value: Any) -> str:
    """A word, a number or a list of numbers as text."""
    if isinstance(value, tuple):
        return ", ".join(map(value_text, value))
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def physical(system: str) -> str:
    """The physical data of a system, and the formulas of the parameters that follow from them."""
    data = get_system(system).physical
    rows = [
        (f"`{q.name}`", q.long_name, q.units, f"`{q.allowed}`", "" if q.default is None else value_text(q.default))
        for q in data.quantities
    ]
    formulas = [(f"`{each.parameter}`", f"`{each.formula}`") for each in data.conversions]
    given = table(("physical data", "meaning", "unit", "allowed", "default"), rows)
    return f"{given}\n{table(('parameter', 'follows from the data as'), formulas)}"


def analyses(system: str) -> str:
    """The analyses of a system: results, methods and options of each."""
    served = get_system(system)
    return "\n".join(_analysis(get_analysis(name).for_system(served), served) for name in served.models)


def _analysis(analysis: Analysis, system: System) -> str:
    lacking = analysis.lacks(system)
    offered = [v for v in analysis.variables if v.name not in lacking]
    results = table(("result", "meaning", "unit", "dimensions"), [_variable_row(v, analysis) for v in offered])
    used = {name: options for name, options in analysis.methods.items() if name not in lacking}
    methods = ", ".join(f"`{name}` ({', '.join(options) or 'no options'})" for name, options in used.items())
    heading = f"### `{analysis.name}`\n\n{analysis.title[0].upper()}{analysis.title[1:]}."
    text = f"{heading}\n\n{results}\nMethods (options), the default first: {methods}.\n"
    rows = [_parameter_row(option)[1:] for option in analysis.options]
    return text + ("\n" + table(("option", "meaning", "unit", "allowed", "default"), rows) if rows else "")


def _variable_row(variable: Variable, analysis: Analysis) -> tuple[str, ...]:
    star = "*" if variable.name in analysis.default_outputs else ""
    flags = ": " + ", ".join(f"{code} {flag}" for code, flag in enumerate(variable.flags)) if variable.flags else ""
    return f"`{variable.name}`{star}", variable.long_name + flags, variable.units, ", ".join(variable.dims)


def scenes(system: str) -> str:
    """The scenes of a system with their titles."""
    rows = []
    for path in sorted(gallery.SCENES.glob("*.toml")):
        scene = tomllib.loads(path.read_text())
        if scene["system"] == system:
            rows.append((f"`sweeps/{path.name}`", scene["title"], f"`{scene['analysis']}`"))
    return table(("scene", "title", "analysis"), rows)


def outcomes() -> str:
    """The codes of the variable `outcome`."""
    return table(("code", "name", "meaning"), [(str(int(o)), f"`{o.name.lower()}`", MEANINGS[o]) for o in Outcome])


def file_contents() -> str:
    """Variables and attributes of a result of the analysis ``floquet``."""
    axes = {"beta": {"values": [0.1, 0.3]}, "Omega": {"values": [1.0, 1.4]}}
    fixed = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    result = dt.run({"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": fixed})
    rows = [
        (f"`{name}`", ", ".join(v.dims), str(v.dtype), v.attrs["units"], v.attrs["long_name"])
        for name, v in result.variables.items()
    ]
    variables = table(("variable", "dimensions", "type", "units", "long_name"), rows)
    return f"{variables}\n{table(('attribute', 'meaning'), [(f'`{name}`', ATTRIBUTES[name]) for name in result.attrs])}"


def figures() -> str:
    """The figures of the gallery by system, with the scenes that they come from."""
    rows = [
        (get_system(item.system).title, item.title, ", ".join(f"`{scene.stem}`" for scene in item.scenes))
        for item in gallery.items(gallery.SCENES)
    ]
    return table(("system", "figure", "scenes in `sweeps/`"), rows)


_TABLES = (parameters, physical, analyses, scenes, outcomes, file_contents, figures)
SOURCES = {f.__name__.replace("_", "-"): f for f in _TABLES}


def written(text: str) -> str:
    """``text`` of a page with its generated tables replaced."""

    def replaced(found: re.Match[str]) -> str:
        begin, name, argument, end = found.groups()
        return f"{begin}\n{SOURCES[name](*filter(None, [argument]))}\n{end}"

    return _MARKS.sub(replaced, text)


def pages() -> list[Path]:
    """The pages that have generated tables."""
    return [*(DOCS / "systems" / f"{name}.md" for name in system_names()), DOCS / "file_format.md", DOCS / "gallery.md"]


def adapt_to_site(app: Any, page: str, source: list[str]) -> None:
    """On the site, drop links to folders of the repository and append the figures of `make gallery`."""
    source[0] = re.sub(r"\[([^\]]*)\]\(\.\./[^)#]*/\)", r"\1", source[0])
    if page == "gallery" and FIGURES.exists():
        source[0] += "\n" + FIGURES.read_text().replace("](", "](../out/gallery/")


def setup(app: Any) -> dict[str, bool]:
    """Sphinx extension: adapt every page to the site."""
    app.connect("source-read", adapt_to_site)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    for path in pages():
        path.write_text(written(path.read_text()))
