"""Physical data of a scene or of a question, converted to the parameters of the system; tables of them."""

from __future__ import annotations

import io
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, clipped, shown
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.analysis._base import checked
from drivetrain_jax.runs.axes import Axis, entry_of, placed
from drivetrain_jax.systems import PhysicalData, System
from drivetrain_jax.systems._base import Along

if TYPE_CHECKING:
    import pandas as pd

# The axis of the values of points.
_POINT = "points"


def described(system: type[System]) -> dict[str, Parameter]:
    """The parameters of ``system`` and its physical data by name."""
    data = system.physical.quantities if system.physical else ()
    return {quantity.name: quantity for quantity in (*data, *system.parameters)}


def with_parameters(
    system: type[System], axes: tuple[Axis, ...], zipped: bool, fixed: Mapping[str, Any]
) -> tuple[tuple[Axis, ...], dict[str, Any], dict[str, Any]]:
    """The axes and the fixed values of a scene with parameters of ``system`` in place of physical data; and these data."""
    physical = system.physical
    swept = [axis for axis in axes if physical and entry_of(axis.name)[0] in physical.names]
    if physical is None or not (swept or any(name in physical.names for name in fixed)):
        return axes, dict(fixed), {}
    # All given values, in the units of their parameters or quantities.
    known, described_as = dict(fixed), described(system)
    for axis in axes:
        base, entry = entry_of(axis.name)
        given, wanted = axis.parameter.units, described_as[base].units
        size = 1 if given == wanted else _units.factor(given, wanted)
        value = Along(_POINT if zipped else axis.name, axis.values * size)
        whole = known.get(base)
        if entry is None or (isinstance(whole, tuple) and entry < len(whole)):
            known[base] = placed(whole, entry, value)
        elif axis in swept:
            text = f" = {shown(fixed[base])}" if base in fixed else ": missing"
            allowed = f"{base}[0] to {base}[{len(whole) - 1}]" if isinstance(whole, tuple) else "a list of numbers"
            raise InputError(f"fixed.{base}{text}: {axis.name} varies one entry; expected {allowed}")
    everything = physical.all_converted(known)
    parameters = {name: value for name, value in everything.items() if name not in physical.names}
    constant = {
        name: checked(system.parameter(name), _first(value), "fixed.")
        for name, value in parameters.items()
        if not isinstance(value, Along)
    }
    others = {name: value for name, value in fixed.items() if name not in physical.names}
    data = {name: x for name, x in {**fixed, **everything}.items() if name in physical.names and not _varies(x)}
    return _converted_axes(system, axes, zipped, swept, parameters), others | constant, data


def _varies(value: Any) -> bool:
    return isinstance(value, Along) or (isinstance(value, tuple) and any(map(_varies, value)))


def _converted_axes(
    system: type[System], axes: tuple[Axis, ...], zipped: bool, swept: list[Axis], parameters: Mapping[str, Any]
) -> tuple[Axis, ...]:
    """``axes`` with the parameters that vary in place of the quantities, and those that vary with other parameters."""
    columns: dict[str, list[Axis]] = {}
    for name, value in parameters.items():
        entries = [(i, v) for i, v in enumerate(value)] if isinstance(value, tuple) else [(None, value)]
        for entry, values in entries:
            if isinstance(values, Along):
                key = name if entry is None else f"{name}[{entry}]"
                columns.setdefault(values.axis, []).append(Axis(key, system.parameter(name), entry, values.values))
    own = {axis.name for axis in axes if axis not in swept}
    if double := next((axis.name for follow in columns.values() for axis in follow if axis.name in own), None):
        where, names = "points" if zipped else "axes", " and ".join(axis.name for axis in swept)
        raise InputError(f"{where}.{double}: follows from {names}, given too; expected one of them")
    if zipped:
        plain = [axis for axis in axes if axis not in swept]
        return (*plain, *_joined(columns.get(_POINT, []), swept))
    converted = []
    for axis in axes:
        follow = columns.get(axis.name, [])
        converted += _joined(follow, [axis]) if axis in swept else [replace(axis, also=tuple(follow))]
    return tuple(converted)


def _joined(columns: list[Axis], quantities: list[Axis]) -> list[Axis]:
    """One axis of all ``columns``, which follow from the quantities ``quantities``."""
    for axis in columns:
        for extreme in (axis.values.min(), axis.values.max()):
            checked(replace(axis.parameter, name=axis.name, listed=False), float(extreme), "axes.")
    if quantities and not columns:
        raise InputError(f"axes.{quantities[0].name}: no parameter follows from it in this scene; leave it out")
    return [replace(columns[0], given=tuple(quantities), also=tuple(columns[1:]))] if columns else []


def _first(value: Any) -> Any:
    """A list without the entries that vary: the first value stands for them."""
    if isinstance(value, tuple):
        return [_first(entry) for entry in value]
    return float(value.values[0]) if isinstance(value, Along) else value


@dataclass(frozen=True)
class GivenData:
    """Physical ``data`` of a question; with them its answer is in physical units, too."""

    physical: PhysicalData
    data: Mapping[str, Any]

    def quantity(self, parameter: str, value: float) -> tuple[str, float, str] | None:
        """Name, value and unit of the quantity behind a value of ``parameter``, None without one."""
        behind = self.back(parameter)
        return None if behind is None else (behind[0].name, float(behind[1](value)), behind[0].units)

    def back(self, parameter: str) -> tuple[Parameter, Callable[[Any], Any]] | None:
        """The quantity behind ``parameter`` and the function that gives its values, None without one."""
        return self.physical.back(parameter, self.data)

    def parameter_of(self, name: str) -> str:
        """The parameter that ``name`` stands for: itself, or the only one that follows from it."""
        follow = [rule.parameter for rule in self.physical.conversions if name in rule.needs]
        return follow[0] if len(follow) == 1 else name


def in_parameters(
    system: type[System], given: Mapping[str, Any], known: Mapping[str, Any]
) -> tuple[GivenData | None, dict[str, Any]]:
    """The values of a question, numbers, ranges (pairs) or arrays, as parameters; and its physical data, None without any.

    ``known`` are physical data of the scene, which the question need not repeat.
    """
    allowed, physical = described(system), system.physical
    written = any(isinstance(end, str) for v in given.values() for end in (v if isinstance(v, tuple) else (v,)))
    names = physical.names if physical else ()
    values = {n: _numbers(allowed[n], v, n in names) if n in allowed else v for n, v in given.items()}
    if physical is None or not (written or known or any(name in names for name in given)):
        return None, values
    replaced = {rule.parameter: rule.needs[0] for rule in physical.conversions if rule.parameter in values}
    # The atlas compares a value that repeats what follows from its own data.
    repeated = {parameter for parameter, name in replaced.items() if name in known.keys() - values}
    data = {**known, **values}
    pool = {n: Along(n, np.array(v)) if isinstance(v, tuple) else v for n, v in data.items() if n not in repeated}
    parameters = {n: v for n, v in physical.converted(pool).items() if n not in names and n not in repeated}
    converted = {n: tuple(v.values.tolist()) if isinstance(v, Along) else v for n, v in parameters.items()}
    return GivenData(physical, data), {n: v for n, v in values.items() if n not in names} | converted


def _numbers(parameter: Parameter, value: Any, physical: bool) -> Any:
    """``value`` with numbers for texts. The range of physical data is checked; that of parameters is the atlas's."""
    if isinstance(value, tuple):
        return tuple(_numbers(parameter, end, physical) for end in value)
    if isinstance(value, list) and any(isinstance(entry, str) for entry in value):
        return np.array([checked(parameter, entry, "") for entry in value])
    if isinstance(value, str) or (physical and isinstance(value, (int, float))):
        return checked(parameter, value, "")
    if not physical:
        return value
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{parameter.name} = {shown(value)}: expected numbers, {parameter.allowed}") from None
    for extreme in (numbers.min(), numbers.max()) if numbers.size else ():
        checked(parameter, float(extreme), "")
    return value if hasattr(value, "ndim") else numbers


# The column of a table with the names of its rows, and the entry of a scene that holds them.
_NAMES, PARTS = "part", "parts"
# Lines in front of a CSV table that begin with # and hold no separator, and empty ones.
_COMMENT = re.compile(r"\A(?:(?:#[^,;\t\n]*| *)\n)+")
# Cells of spreadsheets may have several lines, or only blanks.
_HEADER = re.compile(r"\s*(\S.*?|)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*", re.DOTALL)


def read_table(path: Path) -> dict[str, Any]:
    """The parameters in the CSV, XLSX or TOML ``path``: a value or a list by name, ``"60 mm"`` with the unit of the header.

    The first row holds ``name [unit]`` or ``name (unit)``; empty cells below a column are left out, and so are columns
    without a name. The column ``part`` names the rows: these are the ``parts`` of the scene. TOML has a table ``[[part]]``
    with a ``name`` for each row. Raises :class:`InputError` for a file that is no such table.
    """
    rows = _rows(path).dropna(how="all")
    columns: dict[str, Any] = {}
    if len(rows) < 2:
        raise _wrong_table(path, "no values", "a row of names and rows of values")
    for header, *cells in (rows[number].tolist() for number in rows):
        name, unit = _HEADER.fullmatch(header).groups() if isinstance(header, str) else ("", "")  # pyright: ignore[reportOptionalMemberAccess]
        if name == _NAMES:
            columns[PARTS] = [cell.strip() if isinstance(cell, str) else "" for cell in cells]
        if name in ("", _NAMES):
            continue
        values = [_value(path, name, cell.strip(), unit) for cell in cells if isinstance(cell, str)]
        if name in columns:
            raise _wrong_table(path, f"two columns {name}", "one")
        if not values or not all(isinstance(cell, str) for cell in cells[: len(values)]):
            where = "has an empty cell between values" if values else "is empty"
            raise _wrong_table(path, f"column {name} {where}", "a value in every row, or in the first")
        columns[name] = values if len(values) > 1 else values[0]
    return columns


def _wrong_table(path: Path, what: str, allowed: str) -> InputError:
    return InputError(f"data = {str(path)!r}: {what}; expected {allowed}")


def _value(path: Path, name: str, text: str, unit: str | None) -> Any:
    """A cell as a number, with a unit as text; a word stays a word."""
    measured = bool(unit) and unit != "1"
    try:
        return f"{float(text)!r} {unit}" if measured else float(text)
    except ValueError:
        if measured:
            raise _wrong_table(path, f"{name} = {text!r}", f"a number in {unit}, with a decimal point") from None
        return text


def _rows(path: Path) -> pd.DataFrame:
    """The cells of a table as texts, NaN for an empty one."""
    import pandas as pd  # Local import: it takes a third of a second

    kind = path.suffix.lower()
    how: dict[str, Any] = {"header": None, "dtype": str, "keep_default_na": False, "na_values": [""]}
    try:
        if kind == ".xlsx":
            return pd.read_excel(path, **how)
        if kind == ".toml":
            parts = pd.DataFrame(tomllib.loads(path.read_text("utf-8-sig"))[_NAMES]).rename(columns={"name": _NAMES})
            return pd.DataFrame([parts.columns, *parts.to_numpy()]).map(lambda x: x if pd.isna(x) else str(x))
        if kind == ".csv":
            # Spreadsheets write a byte order mark, and semicolons where the comma is a decimal mark. A line such as
            # `# shaft.csv` in front is a comment.
            text = _COMMENT.sub("", path.read_text("utf-8-sig"))
            first = text.partition("\n")[0]
            return pd.read_csv(io.StringIO(text), sep=max(",;\t", key=first.count), **how)
    except ImportError:
        raise InputError("data: .xlsx needs the package openpyxl; pip install 'drivetrain_jax[tables]'") from None
    # Readers raise exceptions of zip files, XML and their own for a damaged file.
    except Exception as error:
        kinds = {".csv": "CSV in UTF-8 with a value a column, numbers with a decimal point", ".xlsx": "a workbook"}
        kinds[".toml"] = f"tables [[{_NAMES}]] with the same keys"
        raise _wrong_table(path, clipped(getattr(error, "strerror", None) or str(error)), kinds[kind]) from None
    raise _wrong_table(path, "not a table", "a file that ends in .csv, .xlsx or .toml")
