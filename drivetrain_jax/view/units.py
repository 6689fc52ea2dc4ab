"""Figures in the units of the reader: those asked for or given, and usual prefixes such as 85 MN/m for 8.5e7 N/m."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import shown

# The attribute with the units asked for, and the mark of a converted variable, which takes no further prefix.
ASKED, CONVERTED = "figure_units", "converted"
# Units whose first symbol takes a prefix: N, N/m, N m, N m/rad, N m2, N s/m, Pa.
_PREFIXED = re.compile(r"(N|Pa)(?![A-Za-z])|m$")
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (0.0, ""))
# Displacements in metres: below a centimetre in mm, below a tenth of a millimetre in um.
_SMALL = ((1e-2, 1.0, ""), (1e-4, 1e-3, "m"), (0.0, 1e-6, "u"))
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def written_units(units: str) -> str:
    """A unit of UDUNITS in common notation: ``kg m²`` for ``kg m2``, ``µm`` for ``um``."""
    powers = re.sub(r"(?<=[A-Za-z])-?\d+", lambda power: power[0].translate(SUPERSCRIPTS), units)
    return re.sub(r"\bu(?=m\b)", "\u00b5", powers)


def listed(units: str | Sequence[str]) -> list[str]:
    """The units of ``"rpm,deg"`` or of a list; raises :class:`InputError` for an unknown one, and for two of one kind."""
    listing = units.split(",") if isinstance(units, str) else units
    if not isinstance(listing, (list, tuple)) or not all(isinstance(unit, str) for unit in listing):
        raise InputError(f'units = {shown(units)}: allowed are units such as "rpm,deg", or a list of them')
    found = [unit.strip() for unit in listing]
    for number, unit in enumerate(found):
        try:
            _units.number(f"1 {unit}", unit)
        except _units.UnitError:
            raise InputError(f"units = {unit!r}: not a unit; allowed are units such as rpm, deg or mm") from None
        if twin := next((other for other in found[:number] if size(unit, other)), None):
            raise InputError(f"units = {unit!r}: measures the same as {twin}; allowed is one of them")
    return found


def size(units: str, unit: str) -> float | None:
    """The number of ``unit`` that one of ``units`` is; None if they measure different things."""
    if units in ("1", "") or units == unit:
        return 1.0 if units == unit else None
    try:
        return 1 / _units.factor(unit, units)
    except _units.UnitError:
        return None


def suitable(units: str, asked: Iterable[str]) -> tuple[float, str]:
    """The unit among ``asked`` for a value in ``units``, and its factor; 1 and ``units`` without one."""
    sizes = ((size(units, unit), unit) for unit in asked)
    return next(((each, unit) for each, unit in sizes if each is not None), (1.0, units))


def in_units(dataset: xr.Dataset, asked: Sequence[str]) -> xr.Dataset:
    """``dataset`` with axes, results and state in the units ``asked`` for, the first that fits each."""
    changed = {
        str(name): _changed(variable, *suitable(str(variable.attrs.get("units", "1")), asked))
        for name, variable in dataset.variables.items()
        if variable.dtype.kind in "fc"
    }
    state = [dict(each) for each in json.loads(dataset.attrs.get("state", "[]"))]
    sizes = []
    for component in state:
        factor, component["units"] = suitable(component["units"], asked)
        component["scale"] = component.get("scale", 1.0) * factor / (sizes or [factor])[0]
        sizes.append(factor)
    for name, variable in dataset.variables.items():
        # A point of a section: a displacement and a rate.
        if "units_of_components" in variable.attrs and variable.sizes.get("state") == len(sizes):
            scaled = variable.values * np.array(sizes).reshape([-1 if d == "state" else 1 for d in variable.dims])
            changed[str(name)] = xr.Variable(variable.dims, scaled, variable.attrs)
    attrs = {ASKED: json.dumps(list(asked))} | ({"state": json.dumps(state)} if state else {})
    return _assigned(dataset, changed).assign_attrs(attrs)


def in_given_units(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with each axis, and what belongs to it, in the unit in which its scene gives it."""
    changed = {}
    for axis in dataset.coords.values():
        if axis.dtype.kind != "f" or (unit := given_unit(dataset, str(axis.attrs.get("parameter", axis.name)))) is None:
            continue
        units = str(axis.attrs.get("units", "1"))
        of_axis = re.compile(rf"(?:boundary_|tip_|undecided_|resonance_)?{re.escape(str(axis.name))}(?:_error)?")
        for name, variable in dataset.variables.items():
            if of_axis.fullmatch(str(name)) and variable.attrs.get("units") == units:
                changed[str(name)] = _changed(variable, *suitable(units, [unit]))
    return _assigned(dataset, changed)


def given_unit(dataset: xr.Dataset, name: str) -> str | None:
    """The unit of the first text that the scene of ``dataset`` gives for ``name``; None without one."""
    scene = tomllib.loads(str(dataset.attrs.get("scene", "")))
    for table in ("axes", "points", "fixed"):
        entry = scene.get(table, {}).get(name)
        entries = entry.values() if isinstance(entry, dict) else [entry]
        flat = (x for each in entries for x in (each if isinstance(each, list) else [each]))
        found = next((_units.split(x) for x in flat if isinstance(x, str)), None)
        if found and found[1]:
            return found[1]
    return None


def unit_of(dataset: xr.Dataset, name: str, units: str) -> tuple[float, str]:
    """The unit in which figures show the fixed parameter ``name``, stored in ``units``, and its factor."""
    factor, unit = suitable(units, json.loads(dataset.attrs.get(ASKED, "[]")))
    given = given_unit(dataset, name) if unit == units else None
    return suitable(units, [given]) if given else (factor, unit)


def value_in(variable: xr.DataArray, units: str) -> Any:
    """The values of ``variable`` in ``units``, whatever its figure shows."""
    return variable.values * suitable(str(variable.attrs.get("units", units)), [units])[0]


def check_measured(dataset: xr.Dataset, asked: Iterable[str]) -> None:
    """Raise :class:`InputError` for a unit ``asked`` for that measures no parameter and no result of ``dataset``."""
    units = [str(variable.attrs.get("units", "1")) for variable in dataset.variables.values()]
    units += [component["units"] for component in json.loads(dataset.attrs.get("state", "[]"))]
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}")).values()
    units += [str(entry.get("units", "1")) for entry in fixed if isinstance(entry, dict)]
    shown = [written_units(unit) for unit in dict.fromkeys(units) if unit not in ("1", "")]
    for unit in asked:
        if all(size(known, unit) is None for known in units):
            kinds = f"units of {', '.join(shown)}" if shown else "none, all axes are dimensionless"
            raise InputError(
                f"units = {unit!r}: nothing in the result measures that; allowed are {kinds} "
                "(a dimensionless speed needs physical data in the scene)"
            )


def _changed(variable: xr.Variable, factor: float, unit: str) -> xr.Variable:
    if unit == variable.attrs.get("units", "1"):
        return variable
    attrs = {**variable.attrs, "units": unit, CONVERTED: 1}
    return xr.Variable(variable.dims, variable.values * factor, attrs)


def _assigned(dataset: xr.Dataset, changed: dict[str, xr.Variable]) -> xr.Dataset:
    coords = {name: variable for name, variable in changed.items() if name in dataset.coords}
    return dataset.assign({n: v for n, v in changed.items() if n not in coords}).assign_coords(coords)


def prefixed(values: Any, units: str) -> tuple[float, str]:
    """The divisor of ``values`` for a unit with a suitable prefix, and this unit.

    The prefix suits the median of the moduli without zeros and infinity, because the ends of an axis may lie decades apart.
    """
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size) & (size > 0)]
    if not (_PREFIXED.match(units) and size.size):
        return 1.0, units
    middle = np.median(size)
    if units == "m":
        return next((factor, prefix + units) for least, factor, prefix in _SMALL if middle >= least)
    return next((factor or 1.0, prefix + units) for factor, prefix in _PREFIXES if middle >= factor)


def with_prefixes(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with its axes and results in units with suitable prefixes."""
    found: dict[Hashable, tuple[float, str]] = {}
    changed = {}
    for name, variable in sorted(dataset.variables.items(), key=lambda item: len(str(item[0]))):
        units = str(variable.attrs.get("units", ""))
        # A scalar coordinate belongs to the fixed parameters, whose captions choose prefixes themselves.
        wanted = variable.dtype.kind == "f" and CONVERTED not in variable.attrs and _PREFIXED.match(units)
        if not wanted or not (variable.ndim or name in dataset.data_vars):
            continue
        # One prefix for results of the same unit, which may share an axis, and for NAME, `boundary_NAME`, `tip_NAME_error`.
        axes = [axis for axis, (_, known) in found.items() if f"_{axis}" in str(name) and known.endswith(units)]
        key = units if name in dataset.data_vars else (axes or [name])[-1]
        factor, written = found.setdefault(key, prefixed(variable.values, units))
        changed[name] = (variable.dims, variable.values / factor, {**variable.attrs, "units": written})
    coords = {name: values for name, values in changed.items() if name in dataset.coords}
    return dataset.assign({n: v for n, v in changed.items() if n not in coords}).assign_coords(coords)
