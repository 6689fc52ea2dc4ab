"""Results as tables of text, with units in the header."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.accessor import in_words
from drivetrain_jax.store.consolidate import open_result
from drivetrain_jax.store.files import move_into_place
from drivetrain_jax.view.style import scene_key

# Rows that are in memory at a time.
_ROWS = 100_000
# Longest dimension of an analysis whose entries are columns; those of a longer one, such as time, are rows.
_MOST_COLUMNS = 32


def write_csv(source: Path, out: Path) -> int:
    """Write the result ``source`` as the table ``out`` and return its number of rows.

    A row is a point, or a sample of a point (time, position along a shaft). Columns are swept parameters, physical data
    along them, and results; entries of a short dimension have columns of their own (``critical_speed_1``). Units are in the
    header, ``Omega [rad/s]``; codes are words.

    Raises: :class:`~drivetrain_jax.InputError` for an atlas, which is a function, and if ``out`` cannot be written.
    """
    dataset = open_result(source)
    if dataset.attrs.get("analysis") == "atlas" or "outcome" not in dataset:
        raise InputError(
            f"file = {str(source)!r}: holds no values on a grid; allowed is a chart of it, saved as a file"
        )
    temporary = out.with_name(f"{out.name}.tmp")
    try:
        with open(temporary, "w", encoding="utf-8", newline="") as file:
            for number, block in enumerate(_blocks(dataset)):
                block.to_csv(file, index=False, header=number == 0)
        move_into_place(temporary, out)
    except OSError as error:
        raise InputError(f"out = {str(out)!r}: {error.strerror}; allowed is a file that can be written") from None
    finally:
        temporary.unlink(missing_ok=True)
    return int(np.prod([dataset.sizes[dim] for dim in _row_dims(dataset)], dtype=int))


def _row_dims(dataset: xr.Dataset) -> tuple[Hashable, ...]:
    sweep = dataset["outcome"].dims
    return (*sweep, *(dim for dim, size in dataset.sizes.items() if dim not in sweep and size > _MOST_COLUMNS))


def _blocks(dataset: xr.Dataset) -> Iterator[Any]:
    """Tables of consecutive points."""
    # Local import: it takes a third of a second.
    import pandas as pd

    shape = tuple(dataset.sizes[dim] for dim in _row_dims(dataset))
    columns, count = dict(_columns(dataset)), int(np.prod(shape, dtype=int))
    for start in range(0, max(count, 1), _ROWS):
        rows = np.arange(start, min(start + _ROWS, count))
        place = np.unravel_index(rows, shape) if shape else ()
        yield pd.DataFrame({name: np.atleast_1d(values[place]) for name, values in columns.items()})


def _columns(dataset: xr.Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """Header and values, with the shape of all rows, of every column."""
    sweep = _row_dims(dataset)
    along = [c for c in dataset.coords.values() if c.ndim and set(c.dims) <= set(sweep)]
    for variable in (*along, *dataset.data_vars.values()):
        words = in_words(variable.variable) if "flag_meanings" in variable.attrs else variable.variable
        own = [dim for dim in words.dims if dim not in sweep]
        values = words.set_dims({dim: dataset.sizes[dim] for dim in (*sweep, *own)}).transpose(*sweep, *own).values
        name = scene_key(variable) if variable.name in dataset.coords else str(variable.name)
        units = f" [{u}]" if (u := str(variable.attrs.get("units", "1"))) not in ("1", "") else ""
        for entry in np.ndindex(values.shape[len(sweep) :]):
            labels = [
                str(dataset[dim].values[k]) if dim in dataset.coords else str(k + 1)
                for dim, k in zip(own, entry, strict=True)
            ]
            column, header = values[(..., *entry)], "_".join((name, *labels))
            if column.dtype.kind == "c":
                yield f"{header}_real{units}", np.real(column)
                yield f"{header}_imag{units}", np.imag(column)
            else:
                yield header + units, column
