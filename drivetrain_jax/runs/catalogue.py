"""List systems, their parameters and analyses, and scene files as plain text."""

from __future__ import annotations

import tomllib
from pathlib import Path

from drivetrain_jax._errors import InputError, aligned, did_you_mean, written
from drivetrain_jax._quantities import Parameter, Variable
from drivetrain_jax.analysis import analyses_of, analysis_names, broken_analyses, get_analysis
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.toml import entries
from drivetrain_jax.systems import System, get_system, system_names


def overview() -> str:
    """Systems with their analyses, and the scenes found here."""
    lines = ["Systems (drivetrain list SYSTEM describes one)", *aligned([_system_row(name) for name in system_names()])]
    return "\n".join([*lines, *_broken_lines(), *_scene_lines(None)]) + "\n"


def _system_row(name: str) -> tuple[str, str]:
    try:
        system = get_system(name)
    except InputError as error:
        return name, str(error).partition(": ")[2]
    known = analysis_names()
    served = [
        analysis if analysis in known else f"{analysis}: unknown{did_you_mean(analysis, known)}"
        for analysis in analyses_of(system)
    ]
    return name, f"{system.title}; analyses: {', '.join(served)}"


def _broken_lines() -> list[str]:
    """Analyses of installed packages that cannot be used, with the reason."""
    broken = broken_analyses()
    return ["", "Analyses that cannot be used", *aligned([*broken.items()])] if broken else []


def describe(name: str) -> str:
    """Parameters, presets, analyses with results and options, and scenes of one system."""
    system = get_system(name)
    lines = [f"{system.name}: {system.title}", f"  {system.source}", "", "Parameters"]
    lines += aligned([_parameter_row(p) for p in system.parameters])
    if system.physical:
        lines += ["", 'Physical data, which parameters follow from; any number may have a unit: "18 deg", "1500 rpm"']
        lines += aligned([_parameter_row(p, "") for p in system.physical.quantities])
        lines += aligned([(c.parameter, f"= {c.formula}") for c in system.physical.conversions])
    if system.presets:
        lines += ["", "Presets, to copy into a scene"]
        lines += aligned([(preset, ", ".join(entries(values))) for preset, values in system.presets.items()])
    for analysis in analyses_of(system):
        lines += ["", *_analysis_lines(analysis, system)]
    return "\n".join([*lines, *_broken_lines(), *_scene_lines(system)]) + "\n"


def _analysis_lines(name: str, system: type[System]) -> list[str]:
    try:
        analysis = get_analysis(name).for_system(system)
    except InputError as error:
        return [f"Analysis {name}: {str(error).partition(': ')[2]}"]
    lacking = analysis.lacks(system)
    lines = [f"Analysis {name}: {analysis.title}"]
    lines += aligned(
        [_variable_row(v, v.name in analysis.default_outputs) for v in analysis.variables if v.name not in lacking]
    )
    lines += ["  (* default of outputs)", "  Methods and their options, the default first"]
    methods = [
        (method, analysis.method_titles.get(method, ""), ", ".join(used))
        for method, used in analysis.methods.items()
        if method not in lacking
    ]
    lines += ["  " + line for line in aligned(methods)]
    if not analysis.options:
        return lines
    return [*lines, "  Options", *("  " + line for line in aligned([_parameter_row(o) for o in analysis.options]))]


def _parameter_row(parameter: Parameter, required: str = "required") -> tuple[str, ...]:
    standard = "none" if parameter.default in ((), "") else written(parameter.default)
    default = required if parameter.default is None else f"default {standard}"
    default = f"default {parameter.derived}" if parameter.derived else default
    return parameter.name, f"[{parameter.units}]", parameter.long_name, default, parameter.allowed


def _variable_row(variable: Variable, default: bool) -> tuple[str, ...]:
    meaning = variable.long_name + (f": {', '.join(variable.flags)}" if variable.flags else "")
    return f"{variable.name}{'*' if default else ''}", f"[{variable.units}]", meaning, ", ".join(variable.dims)


def _scene_lines(system: type[System] | None) -> list[str]:
    """Scenes that the package brings, by name, and files of another ``sweeps/`` in the working folder."""
    here = Path("sweeps")
    lines = _rows("Scenes (drivetrain run NAME computes one)", toml.FOLDER, "{0.stem}", system)
    if here.is_dir() and not here.samefile(toml.FOLDER):
        lines += _rows("Scenes of this folder", here, "{0}", system)
    return lines


def _rows(heading: str, folder: Path, named: str, system: type[System] | None) -> list[str]:
    rows = []
    for path in sorted(folder.glob("*.toml")):
        try:
            content = tomllib.loads(path.read_text("utf-8"))
        except (OSError, ValueError, RecursionError):
            continue
        if system is None or content.get("system") == system.name:
            rows.append((named.format(path), str(content.get("title", ""))))
    return ["", heading, *aligned(rows)] if rows else []
