"""Tables of a report: parameters and values in the units of the reader. Without jax."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from drivetrain_jax.view.style import in_brackets, scene_key, units_of, written_units
from drivetrain_jax.view.units import unit_of

# A result of so few points is also shown as a table of all its values.
FEW_POINTS, _FEW_VALUES = 12, 240


def axes_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of the swept parameters: name, meaning, first value, last value, unit, and number of values."""
    axes = [dataset[d] for d in dataset["outcome"].dims if d in dataset.coords]
    columns = [c for c in dataset.coords.values() if c.dims == ("point",) and c.name != "point"]
    return [
        (scene_key(c), c.attrs.get("long_name", ""), *map(digits, c.values[[0, -1]]), units_of(c), str(c.size))
        for c in (columns or axes)
        if c.size and c.dtype.kind in "fiu"
    ]


def fixed_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of the physical data and of the fixed parameters: name, meaning, value, unit (asked for, else as given)."""
    attrs, rows = dataset.attrs, []
    fixed = json.loads(attrs.get("physical_data", "{}")) | json.loads(attrs.get("fixed_parameters", "{}"))
    for name, entry in fixed.items():
        factor, units = unit_of(dataset, name, entry.get("units", "1"))
        rows.append((name, entry.get("long_name", ""), digits(_times(entry["value"], factor)), written_units(units)))
    return rows


class Table(NamedTuple):
    """A table with its ``head``."""

    head: list[str]
    rows: list[list[str]]


def values_tables(dataset: xr.Dataset) -> list[Table]:
    """All values of a result of few points: a table for the results of the same dimensions, a column each."""
    shown = [
        v
        for v in dataset.data_vars.values()
        if v.size <= _FEW_VALUES and v.dtype.kind in "fiub" and v.name != "outcome"
    ]
    if dataset["outcome"].size > FEW_POINTS or sum(v.size for v in shown) > _FEW_VALUES:
        return []
    alike: dict[tuple[Any, ...], list[xr.DataArray]] = {}
    for variable in shown:
        alike.setdefault(variable.dims, []).append(variable)
    return [_values_table(dataset, variables) for variables in alike.values()]


def _values_table(dataset: xr.Dataset, variables: list[xr.DataArray]) -> Table:
    """A row for each place, with its coordinates and the value of every variable."""
    first, units = variables[0], [units_of(v) for v in variables]
    places = [coordinates(dataset, first, place) for place in np.ndindex(first.shape)]
    head = [f"{name}{in_brackets(unit)}" for name, _, unit in places[0]] if places else []
    head += [f"{str(v.name).replace('_', ' ')}{in_brackets(unit)}" for v, unit in zip(variables, units, strict=True)]
    columns = [[value_text(v, value) for value in v.values.reshape(-1)] for v in variables]
    rows = [[value for _, value, _ in place] + [c[k] for c in columns] for k, place in enumerate(places)]
    return Table(head, rows)


def value_text(variable: xr.DataArray, value: Any) -> str:
    """A value as text: the meaning of a code."""
    meanings = flag_words(variable)
    return meanings.get(int(value), "").replace("_", " ") if meanings else digits(value)


def coordinates(dataset: xr.Dataset, variable: xr.DataArray, place: tuple[Any, ...]) -> list[tuple[str, str, str]]:
    """Name, value and unit of every coordinate at one place of ``variable``."""
    found = []
    for dim, k in zip(variable.dims, place, strict=True):
        columns = [c for c in dataset.coords.values() if c.dims == (dim,) and dim == "point" and c.name != "point"]
        for axis in columns or ([dataset[dim]] if dim in dataset.coords else []):
            value = axis.values[k]
            text = str(value) if axis.dtype.kind in "UO" else digits(value)
            found.append(
                (
                    scene_key(axis).replace("_", " ") if axis.dtype.kind in "UO" else scene_key(axis),
                    text,
                    units_of(axis),
                )
            )
    return found


def flag_words(variable: xr.DataArray) -> dict[int, str]:
    """The meanings of the codes of ``variable``; empty for numbers."""
    words = str(variable.attrs.get("flag_meanings", "")).split()
    return dict(zip(np.atleast_1d(variable.attrs.get("flag_values", [])).tolist(), words, strict=False))


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (list, tuple)):
        return [_times(entry, factor) for entry in value]
    return value * factor if factor != 1.0 and isinstance(value, (int, float)) else value


def digits(value: Any) -> str:
    """A number, or each of a list, in six digits."""
    if isinstance(value, (list, tuple)):
        return ", ".join(map(digits, value))
    if isinstance(value, (float, np.floating)) and np.isnan(value):
        return "no value"
    return f"{value:.6g}" if isinstance(value, (int, float, np.number)) else str(value)
