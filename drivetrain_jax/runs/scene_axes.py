"""The varying parameters and physical data of a scene, as axes or points, checked before their values are computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._machine import physical_memory
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._wording import clipped, meant, shown
from drivetrain_jax.analysis import Analysis
from drivetrain_jax.analysis.request import checked
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.axes import (
    MAX_POINTS,
    MAX_RANGES,
    Axis,
    AxisTable,
    WrittenAxis,
    check_count,
    entry_of,
    in_units,
    spread,
)
from drivetrain_jax.runs.physical import described
from drivetrain_jax.systems import System

# Bytes per value of an axis while it is created and checked.
_BYTES = 32


def axes_of(
    axes: Mapping[str, Any], points: Mapping[str, Any], system: type[System], analysis: Analysis
) -> tuple[tuple[Axis, ...], bool]:
    """The varying parameters; their values are counted before they are computed."""
    if axes and points:
        raise InputError("points: given together with axes; allowed is one of the two")
    if analysis.continuous:
        _check_ranges(axes, points, analysis)
    for where, name in [("axes", n) for n in axes] + [("points", n) for n in points]:
        parameter, _ = _swept_parameter(system, where, name)
        if analysis.continuous and parameter.integer:
            raise InputError(
                f"axes.{name}: an integer; allowed for {analysis.name} are parameters with a continuous range"
            )
    if points:
        return _points(points, system), True
    specs = {name: _axis_table(system, name, value) for name, value in axes.items()}
    counts = {name: check_count(name, spec, analysis.continuous) for name, (spec, _) in specs.items()}
    total = math.prod(counts.values())
    if total > MAX_POINTS:
        raise InputError(f"axes: {clipped(str(total))} points; allowed is up to {MAX_POINTS}")
    most, present = max(counts.values(), default=0), physical_memory()
    if most * _BYTES > present:
        name = max(counts, key=lambda name: counts[name])
        raise InputError(f"axes.{name}.num = {most}: allowed with this memory is up to {int(present / _BYTES)}")
    return tuple(_axis(system, name, *spec) for name, spec in specs.items()), False


def _check_ranges(axes: Mapping[str, Any], points: Mapping[str, Any], analysis: Analysis) -> None:
    if points:
        raise InputError(f"points: {analysis.name} needs ranges; allowed are axes with start and stop")
    if not 1 <= len(axes) <= MAX_RANGES:
        raise InputError(f"axes: {len(axes)} are given; {analysis.name} allows 1 to {MAX_RANGES}")


def _axis_table(system: type[System], name: str, given: Any) -> tuple[AxisTable, Parameter]:
    """The keys of an axis with numbers for texts, and the range of a value in their unit."""
    if isinstance(given, list):
        given = {"values": given}
    if not isinstance(given, Mapping):
        allowed = "allowed is a table { start, stop, num } or { values }, or a row of values"
        raise InputError(f"axes.{name} = {shown(given)}: {allowed}")
    if isinstance(num := given.get("num"), float) and num.is_integer():
        # Options and parameters also accept 1e3 for 1000.
        given = {**given, "num": int(num)}
    parameter, _ = _swept_parameter(system, "axes", name)
    spec = toml.converted(given, WrittenAxis, f"axes.{name}.")
    return in_units(spec, _scalar(parameter, name), keep=_is_physical(system, name))


def _is_physical(system: type[System], name: str) -> bool:
    return system.physical is not None and entry_of(name)[0] in system.physical.names


def _axis(system: type[System], name: str, spec: AxisTable, scalar: Parameter) -> Axis:
    _, entry = _swept_parameter(system, "axes", name)
    for value in spec.values if spec.values is not None else (spec.start, spec.stop):
        checked(scalar, value, "axes.")
    values = spread(spec, f"axes.{name}")
    if scalar.integer:
        for value in values:
            checked(scalar, float(value), "axes.")
    return Axis(
        name, replace(scalar, name=entry_of(name)[0]), entry, values.astype(np.int64) if scalar.integer else values
    )


def _points(points: Mapping[str, Any], system: type[System]) -> tuple[Axis, ...]:
    """Columns of parameter values of equal length."""
    for name, values in points.items():
        if not isinstance(values, list):
            raise InputError(f"points.{name} = {shown(values)}: allowed is a list of numbers")
    lengths = {name: len(values) for name, values in points.items()}
    if len(set(lengths.values())) > 1 or not all(lengths.values()):
        listed = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise InputError(f"points: {listed}; allowed are lists of one length, at least 1")
    columns = []
    for name, values in points.items():
        parameter, entry = _swept_parameter(system, "points", name)
        scalar = _scalar(parameter, name)
        for value in values:
            checked(scalar, value, "points.")
        spec, scalar = in_units(WrittenAxis(values=values), scalar, keep=_is_physical(system, name))
        numbers = np.array(spec.values, np.int64 if parameter.integer else float)
        columns.append(Axis(name, replace(scalar, name=parameter.name), entry, numbers))
    return tuple(columns)


def _scalar(parameter: Parameter, name: str) -> Parameter:
    """The range of one number of ``parameter``, under the name of its axis."""
    return replace(parameter, name=name, listed=False, broadcast=False)


def _swept_parameter(system: type[System], where: str, name: str) -> tuple[Parameter, int | None]:
    """The parameter of the axis ``name``, and the position of a list entry."""
    base, entry = entry_of(name)
    parameter = described(system).get(base)
    if parameter is None:
        raise InputError(f"{where}.{name}: {unknown_parameter(system, base)}")
    if parameter.choices or parameter.text:
        raise InputError(f"{where}.{name}: a word cannot vary; allowed is to fix it: {parameter.allowed}")
    if not parameter.is_number and entry is None:
        raise InputError(
            f'{where}.{name}: a list cannot vary as a whole; allowed is one entry, for example "{name}[0]"'
        )
    if entry is not None and not parameter.listed:
        raise InputError(f"{where}.{name}: {base} is not a list; allowed is {base}")
    return parameter, entry


def unknown_parameter(system: type[System], name: str) -> str:
    """The message for an unknown parameter ``name``, with the allowed names."""
    data = system.physical.names if system.physical else ()
    own = [p.name for p in system.parameters]
    guess = meant(name, described(system).values())
    listed = f"; allowed is {', '.join(own)}" + (f", or physical data: {', '.join(data)}" if data else "")
    return f"unknown parameter{guess}{listed}"
