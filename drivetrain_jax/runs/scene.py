"""A scene: system, analysis, and varying and fixed parameters, checked before anything is compiled."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from drivetrain_jax._errors import InputError, meant, shown
from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.analysis import OUTCOME, Analysis, Request, Solver, analysis_of, get_analysis
from drivetrain_jax.analysis._base import checked, checked_solvers, dimensions_of, make_request
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.axes import MAX_RANGES, Axis, axis_table, axis_values, check_total, entry_of, placed
from drivetrain_jax.runs.physical import described, with_parameters
from drivetrain_jax.systems import System, get_system, register

Value = float | int | str | tuple[float, ...]
Ranges = dict[str, tuple[float, float]]
# Assumed length of a dimension that depends on the system.
_USUAL_SIZE = 4
# Dimensions of the elements of a chain, which the parts of a scene name.
_OF_ELEMENTS = ("shaft", "joint")
# Largest integer below which every one is a float.
_MOST_EXACT = 2.0**53
# Name of the system that stands for a function in the scene of its sweep.
FUNCTION = "function"


@dataclass(frozen=True, eq=False)
class Problem:
    """The results that are computed, and their points.

    ``axes`` vary: as an outer product in this order, or together as a list of points if ``zipped``. ``fixed`` holds the
    other known parameters of the system, defaults included. A worker receives a problem by the names of its system and
    analysis.
    """

    system: type[System]
    analysis: Analysis
    request: Request
    axes: tuple[Axis, ...]
    zipped: bool
    fixed: Mapping[str, Value]

    @cached_property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions of the results besides those of the sweep."""
        return dimensions_of(self.analysis, self.system, self.request, self.fixed)

    @property
    def solvers(self) -> tuple[Solver, ...]:
        """The solvers of the requested method."""
        return checked_solvers(self.analysis, self.system, self.request, self.dimensions)

    @cached_property
    def path_axis(self) -> str | None:
        """Name of the axis that the analysis computes as a whole, if any."""
        return self.analysis.path_axis(self.system, self.request)

    @property
    def result_bytes(self) -> int:
        """Bytes of the results at a point; dimensions of unknown length count as short ones."""
        sizes = {d.name: len(d.values) or _USUAL_SIZE for d in self.dimensions}
        return sum(np.dtype(v.dtype).itemsize * math.prod(sizes[dim] for dim in v.dims) for v in result_variables(self))

    @staticmethod
    def find_analysis(name: str) -> Analysis:
        """The analysis of this name."""
        return get_analysis(name)

    @property
    def is_named(self) -> bool:
        """True if the names of system and analysis determine both; False for a function that a user sweeps."""
        try:
            system = get_system(self.system.name)
            return system is self.system and self.find_analysis(self.analysis.name).for_system(system) == self.analysis
        except InputError:
            return False

    def __reduce__(self) -> tuple[Any, ...]:
        system = self.system
        names = {"system": (system.__module__, system.__qualname__, system.name), "analysis": self.analysis.name}
        return _restored, (type(self), {f.name: getattr(self, f.name) for f in fields(self)} | names)


def _restored(kind: type[Problem], values: dict[str, Any]) -> Problem:
    module, qualified, name = values["system"]
    # A worker imports the module of a class that is not installed.
    own = getattr(import_module(module), qualified, None)
    system = get_system(name) if own is None else register(own)
    analysis = kind.find_analysis(values["analysis"]).for_system(system)
    return kind(**values | {"system": system, "analysis": analysis})


@dataclass(frozen=True, eq=False)
class Scene(Problem):
    """A checked scene; ``text`` is the scene in TOML, ``data`` its physical data that do not vary, ``parts`` the names of
    the elements of a chain."""

    title: str
    text: str
    data: Mapping[str, Any] = field(default_factory=dict)
    parts: tuple[str, ...] = ()

    @cached_property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions of the results besides those of the sweep; those of the elements have the names of the parts."""
        labels, own = tuple(f"{i} {name}".rstrip() for i, name in enumerate(self.parts, 1)), super().dimensions
        if not labels or self.system.state_axis is None:
            return own
        known = dict.fromkeys(_OF_ELEMENTS, labels) | {d.name: d.of_components(labels) for d in own if d.components}
        return tuple(replace(d, values=known.get(d.name, d.values)) for d in own)


def result_variables(problem: Problem) -> tuple[Variable, ...]:
    """The requested results, then the outcome."""
    return (*(problem.analysis.variable(name) for name in problem.request.outputs), OUTCOME)


def atlas_ranges(scene: Scene) -> Ranges:
    """Lowest and highest value of every parameter that varies, those with the fewest values first."""
    parts = [part for axis in scene.axes for part in axis.together]
    lengths = {part.name: len(part.values) for part in parts}
    varying = [part for part in parts if part.values.min() < part.values.max()]
    return {
        part.name: (float(part.values.min()), float(part.values.max()))
        for part in sorted(varying, key=lambda part: lengths[part.name])
    }


class _SceneTable(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of a scene file."""

    system: str
    analysis: str
    title: str = ""
    parts: list[str] = []
    outputs: list[str] | None = None
    axes: dict[str, Any] = {}
    points: dict[str, Any] = {}
    fixed: dict[str, Any] = {}
    options: dict[str, Any] = {}


def is_of_function(text: object) -> bool:
    """True if a scene of a swept function has this ``text``, a digest that does not restore the function."""
    return str(text).startswith(f'system = "{FUNCTION}"\n')


def load_scene(source: str | Path | Mapping[str, Any] | Scene, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Read and check a scene: a path, a name of `drivetrain list`, a mapping with the same keys, or a checked scene."""
    if isinstance(source, Scene):
        return source
    if isinstance(source, Mapping) and isinstance(source.get("system"), type):
        source = {**source, "system": register(source["system"]).name}
    tree, text = toml.read(source, overrides)
    if isinstance(names := tree.get("outputs"), str):
        tree = {**tree, "outputs": names.split(",")}
    table = toml.converted(tree, _SceneTable, "")
    system = get_system(table.system)
    analysis = analysis_of(system, table.analysis)
    request = make_request(system, analysis, table.outputs, table.options, {*table.axes, *table.points})
    swept, zipped = axes_of(table.axes, table.points, system, analysis)
    axes, given, data = with_parameters(system, swept, zipped, _given(table, system, swept))
    fixed = _fixed(system, analysis, axes, given, "points" if table.points else "axes")
    title = table.title or f"{system.title}: {analysis.title}"
    scene = Scene(system, analysis, request, axes, zipped, fixed, title, text, data, tuple(table.parts))
    lengths = {len(value) for value in fixed.values() if isinstance(value, tuple)} - {0}
    if table.parts and system.state_axis and len(table.parts) not in lengths:
        raise InputError(f"parts = {shown(table.parts)}: expected one name per element, {max(lengths, default=0)}")
    if several := next((axis for axis in axes if axis.also and analysis.continuous), None):
        names = " and ".join(part.name for part in several.together)
        others = ", ".join(axis.name for axis in several.also)
        allowed = f"expected an atlas over one of them: fix {others} in place of the data behind"
        raise InputError(f"axes.{several.shown.name}: changes {names} together; {allowed}")
    _check_path(scene)
    # The analysis checks that request and parameters match.
    _ = scene.dimensions
    taken = {dim for variable in result_variables(scene) for dim in variable.dims}
    if clash := next((axis for axis in axes if axis.dim in taken), None):
        where = f"{'points' if zipped else 'axes'}.{clash.shown.name}"
        raise InputError(f"{where}: results have a dimension {clash.dim!r}; expected a parameter of another name")
    return scene


def restore_scene(text: object) -> Scene:
    """The scene whose TOML text a result stores. Raises :class:`InputError` if it is not valid now."""
    if is_of_function(text):
        raise InputError(f"system = {FUNCTION!r}: known only to the script that called drivetrain_jax.sweep")
    try:
        return load_scene(tomllib.loads(str(text)))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"scene: not valid TOML: {error}") from None


def _given(table: _SceneTable, system: type[System], axes: tuple[Axis, ...]) -> dict[str, Any]:
    """The checked values of ``[fixed]``, parameters and physical data."""
    known = described(system)
    whole = {axis.name for axis in axes if axis.entry is None}
    for name, value in table.fixed.items():
        if name not in known:
            raise InputError(f"fixed.{name} = {shown(value)}: {unknown_parameter(system, name)}")
        if name in whole:
            where = "points" if table.points else "axes"
            raise InputError(f"fixed.{name} = {shown(value)}: also in [{where}]; expected one of the two")
    names = [name for name in known if name in table.fixed]
    return {name: checked(known[name], table.fixed[name], "fixed.") for name in names}


def _fixed(
    system: type[System], analysis: Analysis, axes: tuple[Axis, ...], given: Mapping[str, Any], where: str
) -> dict[str, Value]:
    """The parameters that do not vary: ``given`` ones, then defaults of those that the analysis uses."""
    whole = {part.name for axis in axes for part in axis.together if part.entry is None}
    fixed: dict[str, Any] = {}
    used, missing = analysis.model(system).parameters, []
    for parameter in system.parameters:
        if parameter.name in given:
            fixed[parameter.name] = given[parameter.name]
        elif parameter.name in used and parameter.name not in whole and not parameter.derived:
            fixed[parameter.name] = parameter.default
            missing += [parameter] if parameter.default is None else []
    if missing:
        others = f" (missing too: {', '.join(p.name for p in missing[1:])})" if missing[1:] else ""
        data = system.physical.source(missing[0].name) if system.physical else ""
        either = f", or physical data: {data}" if data else ""
        raise InputError(f"fixed.{missing[0].name}: missing; expected {missing[0].allowed_in_units}{others}{either}")
    for axis in (part for whole_axis in axes for part in whole_axis.together if part.entry is not None):
        # The list supplies its length and the other entries; an empty one is the default "none".
        name, whole = axis.parameter.name, fixed.get(axis.parameter.name, ())
        if whole == ():
            allowed = f"varies one entry of this list; expected {axis.parameter.allowed}"
            raise InputError(f"fixed.{name}: missing; {axis.name} {allowed}")
        if not isinstance(whole, tuple):
            raise InputError(f"fixed.{name} = {whole}: {axis.name} varies one entry; expected a list of numbers")
        if cast(int, axis.entry) >= len(whole):
            raise InputError(f"{where}.{axis.name}: expected {name}[0] to {name}[{len(whole) - 1}]")
    if check := analysis.model(system).check:
        try:
            for values in _extremes(fixed, axes):
                check(values)
        except ValueError as error:
            raise InputError(f"fixed.{error}") from None
    return fixed


def _extremes(fixed: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[dict[str, Any]]:
    """The values to check against each other: ``fixed`` with the largest value of each number that varies; and with 0 for
    the entries of lists that pass through 0, which may not be allowed."""
    parts = [part for axis in axes for part in axis.together]
    known = {**fixed} | {part.name: part.values.max().item() for part in parts if part.entry is None}
    zeros = dict(known)
    for part in parts:
        if part.entry is not None and not part.values.all():
            zeros[part.parameter.name] = placed(zeros[part.parameter.name], part.entry, 0.0)
    return [known, zeros] if zeros != known else [known]


def _check_path(scene: Scene) -> None:
    """Check that the path is an axis of the scene, or, unless an option names it, a fixed number: a line of one value."""
    name, names = scene.path_axis, [axis.name for axis in scene.axes]
    if name is None:
        return
    for axis in scene.axes:
        if name in (part.name for part in axis.together) and axis.also:
            others = ", ".join(part.name for part in axis.together if part.name != name)
            raise InputError(
                f"axes.{axis.shown.name}: {others} would change along the path {name}; expected {name} alone"
            )
    if name in names and scene.zipped:
        raise InputError(f"points.{name}: {scene.analysis.name} uses it as a path; expected an axis or a fixed value")
    fixed = isinstance(scene.fixed.get(name), (int, float)) and name not in scene.request.options.values()
    if name not in names and not fixed:
        allowed = f"expected one of {', '.join(names)}" if names else "the scene has no axes"
        raise InputError(f"options: {name!r} is not an axis of the scene; {allowed}")


def axes_of(
    axes: Mapping[str, Any], points: Mapping[str, Any], system: type[System], analysis: Analysis
) -> tuple[tuple[Axis, ...], bool]:
    """The varying parameters, and True for lists of points."""
    if axes and points:
        raise InputError("points: given together with axes; expected one of the two")
    if analysis.continuous and points:
        raise InputError(f"points: {analysis.name} needs ranges; expected axes with start and stop")
    if analysis.continuous and not 1 <= len(axes) <= MAX_RANGES:
        raise InputError(f"axes: {len(axes)} are given; {analysis.name} allows 1 to {MAX_RANGES}")
    where = "points" if points else "axes"
    known, varying = described(system), list[Axis]()
    for name, keys in (axes or points).items():
        base, entry = entry_of(name)
        parameter = known.get(base)
        if parameter is None:
            raise InputError(f"{where}.{name}: {unknown_parameter(system, base)}")
        if parameter.choices or parameter.text:
            raise InputError(f"{where}.{name}: a word cannot vary; fix it: {parameter.allowed}")
        if not parameter.is_number and entry is None:
            one = f'expected one entry, for example "{name}[0]"'
            raise InputError(f"{where}.{name}: a list cannot vary as a whole; {one}")
        if entry is not None and not parameter.listed:
            raise InputError(f"{where}.{name}: {base} is not a list; expected {base}")
        if analysis.continuous and (parameter.integer or entry is not None):
            what = "an integer" if parameter.integer else "an entry of a list"
            allowed = f"expected for {analysis.name} a parameter with a continuous range"
            raise InputError(f"axes.{name}: {what}; {allowed}")
        if points and not isinstance(keys, list):
            raise InputError(f"points.{name} = {shown(keys)}: expected a list of numbers")
        # The unit of physical data is that of the scene.
        keep = system.physical is not None and base in system.physical.names
        one_number = replace(parameter, name=name, listed=False, broadcast=False)
        table, scalar = axis_table(one_number, name, keys, where, keep=keep)
        values = table.values if points else axis_values(table, f"axes.{name}", analysis.continuous)
        numbers = np.asarray(values, float)
        for value in numbers if axes and scalar.integer else ():
            checked(scalar, float(value), "axes.")
        if scalar.integer and np.abs(numbers).max(initial=0.0) > _MOST_EXACT:
            raise InputError(f"{where}.{name} = {np.abs(numbers).max():g}: expected integers up to 2^53")
        numbers = numbers.astype(np.int64) if scalar.integer else numbers
        varying.append(Axis(name, replace(scalar, name=base), entry, numbers))
    lengths = {axis.name: len(axis.values) for axis in varying}
    if points and (len(set(lengths.values())) > 1 or not all(lengths.values())):
        listed = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise InputError(f"points: {listed}; expected lists of one length, at least 1")
    if axes:
        check_total(math.prod(lengths.values()))
    return tuple(varying), bool(points)


def unknown_parameter(system: type[System], name: str) -> str:
    """The message for an unknown parameter ``name``, with the allowed names."""
    data = system.physical.names if system.physical else ()
    parameters = [p.name for p in system.parameters]
    guess = meant(name, described(system).values())
    listed = f"; expected {', '.join(parameters)}" + (f", or physical data: {', '.join(data)}" if data else "")
    return f"unknown parameter{guess}{listed}"
