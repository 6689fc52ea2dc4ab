"""Figures in the units of the reader: those asked for or given, and usual prefixes such as 85 MN/m for 8.5e7 N/m."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, shown

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
    fitting = ((factor, unit) for unit in asked if (factor := size(units, unit)) is not None)
    return next(fitting, (1.0, units))


def in_units(dataset: xr.Dataset, asked: Sequence[str] = ()) -> xr.Dataset:
    """``dataset`` with axes, results and state in the units ``asked`` for, the first that fits each; other axes, and what
    belongs to them, in the unit in which the scene gives them."""
    dataset, changed = dataset.assign_attrs({ASKED: json.dumps(list(asked))}), {}
    for name, variable in dataset.variables.items():
        units = str(variable.attrs.get("units", "1"))
        axis = dataset.coords.get(re.sub(r"^(?:boundary|tip|undecided|resonance)_|_error$", "", str(name)))
        about = {} if axis is None else {"parameter": axis.name, "units": "1", **axis.attrs}
        factor, unit = unit_of(dataset, str(about["parameter"]) if about.get("units") == units else "", units)
        if unit != units and variable.dtype.kind in "fc":
            attrs = {**variable.attrs, "units": unit, CONVERTED: 1}
            changed[name] = variable.dims, variable.values * factor, attrs
    components, sizes = json.loads(dataset.attrs.get("state", "[]")), []
    for component in components:
        factor, component["units"] = suitable(component["units"], asked)
        component["scale"] = component.get("scale", 1.0) * factor / (sizes or [factor])[0]
        sizes.append(factor)
    for name, variable in dataset.variables.items():
        # A point of a section: a displacement and a rate.
        if "units_of_components" in variable.attrs and variable.sizes.get("state") == len(sizes):
            scaled = variable.values * np.array(sizes).reshape([-1 if d == "state" else 1 for d in variable.dims])
            changed[name] = variable.dims, scaled, variable.attrs
    return _assigned(dataset, changed).assign_attrs({"state": json.dumps(components)} if components else {})


def unit_of(dataset: xr.Dataset, name: str, units: str) -> tuple[float, str]:
    """The unit in which figures show the parameter ``name``, stored in ``units``: the one asked for, else that of the first
    text that the scene gives for it; and the factor of the values."""
    scene = scene_of(dataset)
    entries = [scene.get(table, {}).get(name) for table in ("axes", "points", "fixed")]
    entries = [part for entry in entries for part in (entry.values() if isinstance(entry, dict) else [entry])]
    texts = [x for part in entries for x in (part if isinstance(part, list) else [part]) if isinstance(x, str)]
    given = [written[1] for text in texts[:1] if (written := _units.split(text)) and written[1]]
    return suitable(units, [*json.loads(dataset.attrs.get(ASKED, "[]")), *given])


def scene_of(dataset: xr.Dataset) -> dict[str, Any]:
    """The tables of the scene of ``dataset``; empty without one."""
    return _parsed(str(dataset.attrs.get("scene", "")))


_parsed = lru_cache(maxsize=8)(tomllib.loads)


def value_in(variable: xr.DataArray, units: str) -> Any:
    """The values of ``variable`` in ``units``, whatever its figure shows."""
    return variable.values * suitable(str(variable.attrs.get("units", units)), [units])[0]


def check_measured(dataset: xr.Dataset, asked: Iterable[str]) -> None:
    """Raise :class:`InputError` for a unit ``asked`` for that measures no parameter and no result of ``dataset``."""
    components = json.loads(dataset.attrs.get("state", "[]"))
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}")).values()
    described = [v.attrs for v in dataset.variables.values()] + components + [x for x in fixed if isinstance(x, dict)]
    units = dict.fromkeys(str(about.get("units", "1")) for about in described)
    remedy = " (a dimensionless speed needs physical data in the scene)"
    for unit in asked:
        if all(size(known, unit) is None for known in units):
            raise InputError(f"units = {unit!r}: nothing in the result measures that; {allowed_units(units)}{remedy}")


def allowed_units(units: Iterable[str]) -> str:
    """``allowed are ...`` with these units."""
    shown = [written_units(unit) for unit in units if unit not in ("1", "")]
    return f"allowed are units of {', '.join(shown)}" if shown else "allowed are none, all values are dimensionless"


def _assigned(dataset: xr.Dataset, changed: Mapping[Hashable, Any]) -> xr.Dataset:
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
    return _assigned(dataset, changed)
