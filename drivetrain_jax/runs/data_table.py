"""Tables of parameters, as engineers keep them: a column for each parameter, with its unit in the header.

A column of one value is a number, a longer one a list: segments of a shaft, planets of a gear.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import clipped

_HEADER = re.compile(r"\s*(.+?)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*")


def read_table(path: Path) -> dict[str, Any]:
    """The parameters in the CSV or XLSX file ``path``: a value or a list by name, ``"60 mm"`` in the unit of the header.

    The first row holds ``name [unit]`` or ``name (unit)``; empty cells below a column are left out, and so are columns
    without a name. Raises :class:`InputError` for a file that is no such table.
    """
    rows = [row for row in _rows(path) if any(cell not in ("", None) for cell in row)]
    if len(rows) < 2:
        raise InputError(f"data = {str(path)!r}: no values; allowed is a row of names and rows of values")
    if wide := next((row for row in rows[1:] if any(cell not in ("", None) for cell in row[len(rows[0]) :])), None):
        given = clipped(", ".join(map(str, wide)))
        raise InputError(
            f"data = {str(path)!r}: the row {given!r} is longer than that of the names; allowed is a value a column "
            "(numbers with a decimal point)"
        )
    found: dict[str, Any] = {}
    for number, header in enumerate(rows[0]):
        cells = [row[number] if number < len(row) else "" for row in rows[1:]]
        if header in ("", None):
            continue
        name, unit = _HEADER.fullmatch(str(header)).groups()  # pyright: ignore[reportOptionalMemberAccess]
        if name in found:
            raise InputError(f"data = {str(path)!r}: has two columns {name}; allowed is one")
        values = [_value(path, name, cell, unit) for cell in _filled(path, name, cells)]
        found[name] = values if len(values) > 1 else values[0]
    return found


def _filled(path: Path, name: str, cells: list[Any]) -> list[Any]:
    """The cells of a column down to the last value."""
    count = max((i + 1 for i, cell in enumerate(cells) if cell not in ("", None)), default=0)
    if not count or any(cell in ("", None) for cell in cells[:count]):
        where = "is empty" if not count else "has an empty cell between values"
        raise InputError(
            f"data = {str(path)!r}: column {name} {where}; allowed is a value in every row, or in the first"
        )
    return cells[:count]


def _value(path: Path, name: str, cell: Any, unit: str | None) -> Any:
    """A cell as a number, with a unit as text; a word stays a word."""
    text = str(cell).strip()
    try:
        value = float(text)
    except ValueError:
        if unit and unit != "1":
            raise InputError(
                f"data = {str(path)!r}: {name} = {clipped(text)!r}: allowed is a number in {unit}, with a decimal point"
            ) from None
        return text
    return f"{value!r} {unit}" if unit and unit != "1" else value


def _rows(path: Path) -> Iterable[list[Any]]:
    kind = path.suffix.lower()
    if kind not in (".csv", ".xlsx"):
        raise InputError(f"data = {str(path)!r}: allowed is a file that ends in .csv or .xlsx")
    try:
        return _csv_rows(path) if kind == ".csv" else _xlsx_rows(path)
    except OSError as error:
        raise InputError(f"data = {str(path)!r}: {error.strerror or error}; allowed is a table") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"data = {str(path)!r}: {error}; allowed is CSV in UTF-8") from None


def _csv_rows(path: Path) -> list[list[str]]:
    # Spreadsheets write a byte order mark, and semicolons where the comma is a decimal mark.
    text = path.read_text("utf-8-sig")
    first = text.partition("\n")[0]
    separator = max((",", ";", "\t"), key=first.count)
    return list(csv.reader(text.splitlines(), delimiter=separator, strict=True))


def _xlsx_rows(path: Path) -> list[list[Any]]:
    try:
        import openpyxl
    except ImportError:
        raise InputError("data: .xlsx needs the package openpyxl; pip install 'drivetrain_jax[tables]'") from None
    try:
        sheet = openpyxl.load_workbook(path, read_only=True, data_only=True).worksheets[0]
        return [list(row) for row in sheet.iter_rows(values_only=True)]
    except OSError:
        raise
    # openpyxl raises exceptions of zip files, XML and its own for a damaged file.
    except Exception as error:
        raise InputError(f"data = {str(path)!r}: {clipped(str(error))}; allowed is an .xlsx workbook") from None
