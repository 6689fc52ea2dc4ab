"""Statements about a result in words: shares and ranges of its verdicts, extremes and their places, errors. Without jax.

The statements follow from the labels of the dataset alone, so they serve any analysis, also one of another package.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax.resonances.orders import FREQUENCIES, in_hertz, operating_range, stored_orders
from drivetrain_jax.view.style import scene_key, units_of, written_units

# A result of so few points is also shown as a table of all its values.
FEW_POINTS, _FEW_VALUES = 12, 240
# Largest number of intervals and of labels that a statement lists.
_MOST = 8
# Results that judge the numerics or number something, so that their extremes say nothing.
_PLAIN = ("_error", "_residual", "_number", "_certified")


def statements(dataset: xr.Dataset, ranges: bool = True) -> list[str]:
    """Sentences about ``dataset``, verdicts first; without ``ranges`` only the shares of verdicts."""
    coded = [v for v in _coded(dataset) if v.name != "outcome"]
    said = [sentence for variable in coded for sentence in _about_codes(dataset, variable, ranges)]
    said += [sentence for variable in _numbers(dataset) for sentence in _about_numbers(dataset, variable)]
    return [*said, *_about_orders(dataset), *_about_outcome(dataset), *_about_errors(dataset)]


def axes_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of the swept parameters: name, meaning, first value, last value, unit, and number of values."""
    axes = [dataset[d] for d in dataset["outcome"].dims if d in dataset.coords]
    columns = [c for c in dataset.coords.values() if c.dims == ("point",) and c.name != "point"]
    return [
        (scene_key(c), c.attrs.get("long_name", ""), *map(_digits, c.values[[0, -1]]), units_of(c), str(c.size))
        for c in (columns or axes)
        if c.size and c.dtype.kind in "fiu"
    ]


def fixed_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of the physical data and of the fixed parameters: name, meaning, value, unit."""
    attrs = dataset.attrs
    fixed = json.loads(attrs.get("physical_data", "{}")) | json.loads(attrs.get("fixed_parameters", "{}"))
    return [
        (name, entry.get("long_name", ""), _digits(entry["value"]), written_units(entry.get("units", "1")))
        for name, entry in fixed.items()
    ]


def values_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of all values of a result of few points: variable, place, value, unit. Empty for a larger result."""
    rows = []
    if dataset["outcome"].size > FEW_POINTS:
        return rows
    for variable in dataset.data_vars.values():
        if variable.size > _FEW_VALUES or variable.dtype.kind not in "fiub" or variable.name == "outcome":
            continue
        meanings = _meanings(variable)
        for place in np.ndindex(variable.shape):
            value = variable.values[place]
            shown = meanings.get(int(value), "") if meanings else _digits(value)
            rows.append((str(variable.name), _place(dataset, variable, place), shown, units_of(variable)))
    return rows if len(rows) <= _FEW_VALUES else []


def _coded(dataset: xr.Dataset) -> list[xr.DataArray]:
    return [v for v in dataset.data_vars.values() if "flag_meanings" in v.attrs]


def _numbers(dataset: xr.Dataset) -> list[xr.DataArray]:
    return [
        v
        for v in dataset.data_vars.values()
        if v.dtype.kind == "f" and not str(v.name).endswith(_PLAIN) and set(dataset["outcome"].dims) <= set(v.dims)
    ]


def _meanings(variable: xr.DataArray) -> dict[int, str]:
    words = str(variable.attrs.get("flag_meanings", "")).split()
    return dict(zip(np.atleast_1d(variable.attrs.get("flag_values", [])).tolist(), words, strict=False))


def _about_codes(dataset: xr.Dataset, variable: xr.DataArray, ranges: bool) -> Iterator[str]:
    """The share of every meaning, and the ranges of the speed or of the only axis that have it."""
    meanings = _meanings(variable)
    name = str(variable.attrs.get("long_name", variable.name))
    if variable.size == 1:
        yield f"{_capital(name)}: {meanings.get(int(variable.values.item()), 'unknown')}."
        return
    shares = {word: float(np.mean(variable.values == code)) for code, word in meanings.items()}
    yield f"{_capital(name)}: " + ", ".join(f"{word} {_share(share)}" for word, share in shares.items() if share) + "."
    axis = _main_axis(dataset, variable) if ranges else None
    if shares.get("undecided"):
        yield "Undecided points lie closer to the limit than their error bound: compute them again with a smaller rtol."
    if axis is None:
        return
    others = [dim for dim in variable.dims if dim != axis.name]
    for code, word in meanings.items():
        everywhere = (variable == code).all(others) if others else variable == code
        if 0 < shares[word] < 1 and bool(everywhere.any()):
            names = " and ".join(scene_key(dataset[dim]) if dim in dataset.coords else str(dim) for dim in others)
            where = f"for all values of {names} " if others else ""
            yield f"{_capital(word)} {where}at {_ranges(axis, everywhere.values)}."


def _main_axis(dataset: xr.Dataset, variable: xr.DataArray) -> xr.DataArray | None:
    """The axis of the speed, or the only axis."""
    speed = json.loads(dataset.attrs.get("roles", "{}")).get("speed")
    axes = [dataset[d] for d in variable.dims if d in dataset.coords and dataset[d].dtype.kind == "f"]
    along = {str(c.dims[0]) for n, c in dataset.coords.items() if n == speed and c.ndim == 1}
    return next((a for a in axes if a.name in along or scene_key(a) == speed), axes[0] if len(axes) == 1 else None)


def _ranges(axis: xr.DataArray, holds: np.ndarray) -> str:
    """The runs of sampled values of ``axis`` at which ``holds`` is true."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], holds.astype(np.int8), [0]))))
    runs = [(axis.values[a], axis.values[b - 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    shown = [_digits(a) if a == b else f"{_digits(a)} to {_digits(b)}" for a, b in runs[:_MOST]]
    more = f" and {len(runs) - _MOST} more ranges" if len(runs) > _MOST else ""
    return f"{scene_key(axis)} = {', '.join(shown)}{more}{_unit(axis)}"


def _about_numbers(dataset: xr.Dataset, variable: xr.DataArray) -> Iterator[str]:
    """Smallest and largest value with their places; by label if the analysis adds a short dimension."""
    own = [dim for dim in variable.dims if dim not in dataset["outcome"].dims]
    if len(own) > 1 or (own and variable.sizes[own[0]] > _MOST):
        return
    if dataset["outcome"].size == 1:
        values = ", ".join(map(_digits, np.atleast_1d(variable.values).ravel()))
        yield f"{_capital(variable.attrs.get('long_name', variable.name))}: {values}{_unit(variable)}."
        return
    for k in range(variable.sizes[own[0]] if own else 1):
        part = variable.isel({own[0]: k}) if own else variable
        if not np.isfinite(part.values).any():
            continue
        finite = np.ma.masked_invalid(part.values)
        label = f", {str(own[0]).replace('_', ' ')} {_label(variable, own[0], k)}" if own else ""
        low, high = (np.unravel_index(int(f()), part.shape) for f in (finite.argmin, finite.argmax))
        name = _capital(str(variable.attrs.get("long_name", variable.name)))
        if part.values[low] == part.values[high]:
            yield f"{name}{label}: {_digits(part.values[low])}{_unit(variable)} throughout."
            continue
        ends = (
            f"{_digits(part.values[p])}{_unit(variable)} at {_place(dataset, part, p)}" for p in map(tuple, (low, high))
        )
        yield f"{name}{label}: from {' to '.join(ends)}."


def _about_outcome(dataset: xr.Dataset) -> Iterator[str]:
    outcome = dataset["outcome"]
    counts = {word: int((outcome.values == code).sum()) for code, word in _meanings(outcome).items() if code}
    wrong = ", ".join(f"{word.replace('_', ' ')} {count:,}" for word, count in counts.items() if count)
    points = f"{outcome.size:,} point{'s' if outcome.size != 1 else ''}"
    yield f"{points} computed, with these remarks: {wrong}." if wrong else f"{points} computed, all successfully."


def _about_errors(dataset: xr.Dataset) -> Iterator[str]:
    for name, variable in dataset.data_vars.items():
        if str(name).endswith("_error") and variable.dtype.kind == "f" and np.isfinite(variable.values).any():
            middle, largest = np.nanmedian(variable.values), np.nanmax(variable.values)
            name = _capital(variable.attrs.get("long_name", name))
            yield f"{name}: median {middle:.2g}, at most {largest:.2g}{_unit(variable)}."


def _about_orders(dataset: xr.Dataset) -> Iterator[str]:
    """Speeds at which orders of the excitation meet the modes of a single point, within the operating range if given."""
    name = next((name for name in FREQUENCIES if name in dataset), None)
    orders = stored_orders(dataset.attrs)
    if name is None or orders is None or dataset["outcome"].size != 1:
        return
    speeds = orders.speeds(in_hertz(dataset[name].values.reshape(-1), dataset[name].attrs["units"]))
    operating = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    if operating:
        low, high = operating
        for sentence in orders.within(speeds, low, high):
            yield f"From {low:g} to {high:g} rpm of the {orders.shaft}: {sentence}."
        return
    for order, column in zip(orders.per_turn, speeds.T, strict=True):
        met = [f"{speed:.6g}" for speed in column[np.isfinite(column)]]
        more = f" and {len(met) - _MOST} more speeds" if len(met) > _MOST else ""
        yield f"{_capital(order)} meets modes at {', '.join(met[:_MOST])}{more} rpm of the {orders.shaft}."


def _place(dataset: xr.Dataset, variable: xr.DataArray, place: tuple[Any, ...]) -> str:
    """``name = value unit`` for every swept parameter at one place of ``variable``."""
    texts = []
    for dim, k in zip(variable.dims, place, strict=True):
        columns = [c for c in dataset.coords.values() if c.dims == (dim,) and dim == "point" and c.name != "point"]
        for axis in columns or ([dataset[dim]] if dim in dataset.coords else []):
            value = axis.values[k]
            texts.append(f"{scene_key(axis)} = {value if axis.dtype.kind in 'UO' else _digits(value)}{_unit(axis)}")
    return ", ".join(texts)


def _label(variable: xr.DataArray, dim: Any, k: int) -> str:
    return str(variable[dim].values[k]) if dim in variable.coords else str(k + 1)


def _capital(text: object) -> str:
    return str(text)[:1].upper() + str(text)[1:]


def _unit(variable: xr.DataArray) -> str:
    units = units_of(variable)
    return "" if units in ("1", "") else f" {units}"


def _share(share: float) -> str:
    """A share in percent; a small one is never shown as 0, a large one never as 100."""
    return f"{100 * share:.3g} %" if share in (0, 1) else f"{min(max(100 * share, 0.001), 99.999):.5g} %"


def _digits(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_digits, value))
    if isinstance(value, (float, np.floating)) and np.isnan(value):
        return "no value"
    return f"{value:.6g}" if isinstance(value, (int, float, np.number)) else str(value)
