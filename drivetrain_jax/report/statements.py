"""Statements about a result: shares and ranges of its verdicts, extremes and their places, errors; tables. Without jax.

The statements follow from the labels of the dataset alone, so they serve any analysis, also one of another package.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from drivetrain_jax._units import behind
from drivetrain_jax.resonances import FREQUENCIES, operating_range, stored_orders
from drivetrain_jax.view.charts import growth_of, role, valid
from drivetrain_jax.view.style import (
    ASKED,
    MOST_RANGES,
    in_brackets,
    ranges_text,
    scene_key,
    scene_of,
    suitable,
    unit_of,
    units_of,
    unstable_text,
    value_in,
    written_units,
)

if TYPE_CHECKING:
    from drivetrain_jax.runs.reply import Limit

# Results that judge the numerics or number something, so that their extremes say nothing.
_PLAIN = ("_error", "_residual", "_number", "_certified", "_share")
# A result of so few points is also shown as a table of all its values.
FEW_POINTS, _FEW_VALUES = 12, 240


def statements(
    dataset: xr.Dataset, ranges: bool = True, limit: Limit | None = None, moved: xr.Dataset | None = None
) -> list[str]:
    """Sentences about ``dataset``, verdicts first; without ``ranges`` only the shares of verdicts.

    Forced amplitudes in ``moved`` (default: among the results) are compared with ``limit``.
    """
    results = [v for v in dataset.data_vars.values() if v.name != "outcome"]
    exact = [unstable_text(dataset, str(dim)) for dim in dataset["outcome"].dims] if ranges else []
    said = [*(f"{_capital(text)}." for text in exact if text), *_about_orders(dataset)]
    said += [sentence for v in results if "flag_meanings" in v.attrs for sentence in _about_codes(dataset, v, ranges)]
    said += [f"{_capital(dataset.attrs['proof'])}."] if "proof" in dataset.attrs else []
    said += [*_about_growth(dataset), *(_about_limit(dataset if moved is None else moved, limit) if limit else ())]
    said += [sentence for variable in results for sentence in _about_numbers(dataset, variable)]
    return [*said, *_about_outcome(dataset), *_about_errors(dataset)]


def _about_codes(dataset: xr.Dataset, variable: xr.DataArray, ranges: bool) -> Iterator[str]:
    """The share of every meaning, and the ranges of the speed or of the only axis that have it."""
    # Points without a value store the last code.
    meanings, variable = flag_words(variable), valid(dataset, str(variable.name))
    # A remark in brackets explains codes, most of which do not occur.
    name = re.sub(r" \(.*\)$", "", str(variable.attrs.get("long_name", variable.name)))
    if variable.size == 1:
        yield f"{_capital(name)}: {value_text(variable, variable.values.item())}."
        return
    shares = {word.replace("_", " "): float(np.mean(variable.values == code)) for code, word in meanings.items()}
    without = float(np.mean(~np.isin(variable.values, list(meanings))))
    if 1.0 in shares.values() and variable.ndim > dataset["outcome"].ndim:
        # All modes are of one kind.
        return
    parts = ", ".join(f"{word} {_share(s)}" for word, s in (*shares.items(), ("without a value", without)) if s)
    yield f"{_capital(name)} at the points computed: {parts}."
    axis = _main_axis(dataset, variable) if ranges else None
    exact = axis is not None and f"unstable_{axis.name}" in dataset.coords
    # Other verdicts, such as that on a chaotic motion, are undecided for other reasons.
    if shares.get("undecided") and "stable" in shares:
        yield "Undecided points lie closer to the limit than their error bound: compute them again with a smaller rtol."
    if axis is None:
        return
    others = [dim for dim in variable.dims if dim != axis.name]
    for code, word in zip(meanings, shares, strict=True):
        # The first sentence says the exact ranges.
        if exact and word in ("stable", "unstable"):
            continue
        everywhere = (variable == code).all(others) if others else variable == code
        if 0 < shares[word] < 1 and bool(everywhere.any()):
            names = " and ".join(scene_key(dataset[dim]) if dim in dataset.coords else str(dim) for dim in others)
            where = f"for all values of {names} " if others else ""
            yield f"{_capital(word)} {where}at {ranges_text(axis, everywhere.values)}."


def _main_axis(dataset: xr.Dataset, variable: xr.DataArray) -> xr.DataArray | None:
    """The axis of the speed, or the only axis."""
    speed = role(dataset, "speed")
    axes = [dataset[d] for d in variable.dims if d in dataset.coords and dataset[d].dtype.kind == "f"]
    along = {str(c.dims[0]) for n, c in dataset.coords.items() if n == speed and c.ndim == 1}
    return next((a for a in axes if a.name in along or scene_key(a) == speed), axes[0] if len(axes) == 1 else None)


def _about_numbers(dataset: xr.Dataset, variable: xr.DataArray) -> Iterator[str]:
    """Smallest and largest value with their places; by label if the analysis adds a short dimension."""
    if variable.dtype.kind != "f" or str(variable.name).endswith(_PLAIN):
        return
    inner, axes = [dim for dim in variable.dims if dim not in dataset["outcome"].dims], set(dataset["outcome"].dims)
    if len(inner) > 1 or (inner and variable.sizes[inner[0]] > MOST_RANGES) or not axes <= set(variable.dims):
        return
    name = _capital(variable.attrs.get("long_name", variable.name))
    if dataset["outcome"].size == 1:
        yield f"{name}: {', '.join(map(digits, variable.values.ravel()))}{behind(units_of(variable))}."
        return
    for k in range(variable.sizes[inner[0]] if inner else 1):
        part = variable.isel({inner[0]: k}) if inner else variable
        if not np.isfinite(part.values).any():
            continue
        finite = np.ma.masked_invalid(part.values)
        label = f", {str(inner[0]).replace('_', ' ')} {_label(variable, inner[0], k)}" if inner else ""
        places = [np.unravel_index(int(f()), part.shape) for f in (finite.argmin, finite.argmax)]
        low, high = (f"{digits(part.values[place])}{behind(units_of(variable))}" for place in places)
        if finite.min() == finite.max():
            yield f"{name}{label}: {low} throughout."
            continue
        first, last = (_place(dataset, part, place) for place in places)
        yield f"{name}{label}: from {low} at {first} to {high} at {last}."


def _about_growth(dataset: xr.Dataset) -> Iterator[str]:
    """The meaning of the verdict: fastest growth or slowest decay in time and per turn, and time to double or halve."""
    periods = dataset.attrs.get("periods_per_turn", 0)
    radius = dataset.get("spectral_radius")
    if radius is None or not periods or not np.isfinite(radius.values).any():
        return
    growth = growth_of(dataset)
    rates, timed = growth.from_radius(radius).transpose(*radius.dims), growth.label.endswith("[1/s]")
    if "verdict" in dataset:
        # An undecided radius is 1 within its error: it neither grows nor dies out.
        decided = [code for code, word in flag_words(dataset["verdict"]).items() if word != "undecided"]
        rates = rates.where(valid(dataset, "verdict").isin(decided))
    if not np.isfinite(rates.values).any():
        return
    place = np.unravel_index(int(np.ma.masked_invalid(rates.values).argmax()), rates.shape)
    # The factor per turn may underflow, or round to 1, where its logarithm does neither.
    rate, turn = float(rates.values[place]), periods * math.log(float(radius.values[place]) or math.nan)
    if rate == 0 or not math.isfinite(rate):
        return
    factor, turns = math.exp(turn), math.log(2) / abs(turn)
    per_second, seconds = (f"{abs(rate):.4g} 1/s, ", f"{math.log(2) / abs(rate):.4g} s, ") if timed else ("", "")
    where = f" at {text}" if (text := _place(dataset, radius, tuple(map(int, place)))) else ""
    start, most, ends = "Stable means that every small disturbance dies out", "slowest", "halves"
    if rate > 0:
        start, most, ends = "Unstable means that a small disturbance grows", "fastest", "doubles"
    most = f", {most}{where}" if where else ""
    yield f"{start}{most}: {per_second}by a factor {factor:.6g} per turn; it {ends} in {seconds}{turns:.4g} turns."


def _about_limit(dataset: xr.Dataset, limit: Limit) -> Iterator[str]:
    """The largest forced amplitude and its place, compared with the limit; and the speeds within it."""
    for variable in amplitudes(dataset):
        amplitude = np.ma.masked_invalid(value_in(variable, limit.own))
        if not amplitude.count():
            continue
        place = tuple(map(int, np.unravel_index(int(amplitude.argmax()), amplitude.shape)))
        most = f"{limit.written(amplitude[place])} at {_place(dataset, variable, place)}"
        inner = [dim for dim in variable.dims if dim not in dataset["outcome"].dims]
        within = xr.DataArray(np.asarray(amplitude.filled(np.inf)) <= limit.value, dims=variable.dims).all(inner)
        name, allowed = _capital(variable.attrs.get("long_name", variable.name)), limit.written(limit.value)
        if bool(within.all()):
            yield f"{name}: at most {most}, within the limit of {allowed}."
            continue
        axis = _main_axis(dataset, dataset["outcome"])
        inside = within.all([d for d in within.dims if axis is None or d != axis.name])
        kept = "nowhere" if not bool(within.any()) else f"at {_share(float(within.mean()))} of the points"
        kept = f"at {ranges_text(axis, inside.values)}" if axis is not None and bool(inside.any()) else kept
        # A point without a value is not within the limit.
        side = "above" if amplitude[place] > limit.value else "within"
        yield f"{name}: up to {most}, {side} the limit of {allowed}; within it {kept}."


def amplitudes(dataset: xr.Dataset) -> list[xr.DataArray]:
    """The forced amplitudes among the results."""
    variables = [dataset.get(name) for name in ("amplitude", "orbit_amplitude")]
    return [v for v in variables if v is not None and dataset.attrs.get("analysis") == "forced"]


def _about_outcome(dataset: xr.Dataset) -> Iterator[str]:
    outcome = dataset["outcome"]
    counts = {word: int((outcome.values == code).sum()) for code, word in flag_words(outcome).items() if code}
    above = "have an error above the tolerance, so judge them by their error bound"
    said = {word: f"{word.replace('_', ' ')} {count:,}" for word, count in counts.items() if count}
    if "tolerance_not_met" in said:
        said["tolerance_not_met"] = f"{counts['tolerance_not_met']:,} {above}"
    wrong = ", ".join(said.values())
    points = f"{outcome.size:,} point{'s' if outcome.size != 1 else ''}"
    yield f"{points} computed, with these remarks: {wrong}." if wrong else f"{points} computed, all successfully."


def _about_errors(dataset: xr.Dataset) -> Iterator[str]:
    for name, variable in dataset.data_vars.items():
        if str(name).endswith("_error") and variable.dtype.kind == "f" and np.isfinite(variable.values).any():
            middle, largest = np.nanmedian(variable.values), np.nanmax(variable.values)
            name = _capital(variable.attrs.get("long_name", name))
            yield f"{name}: median {middle:.2g}, at most {largest:.2g}{behind(units_of(variable))}."


def _about_orders(dataset: xr.Dataset) -> Iterator[str]:
    """Speeds at which orders of the excitation meet the modes of a single point, within the operating range if given."""
    name = next((name for name in FREQUENCIES if name in dataset), None)
    orders = stored_orders(dataset.attrs)
    if name is None or orders is None or dataset["outcome"].size != 1:
        return
    factor, unit = suitable("rpm", json.loads(dataset.attrs.get(ASKED, "[]")))
    speeds = orders.speeds(value_in(dataset[name], "Hz").reshape(-1)) * factor
    operating = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    rest = f" ({orders.frequency})" if orders.discs or orders.planes else ""
    if operating:
        low, high = (end * factor for end in operating)
        for sentence in orders.within(speeds, low, high, unit):
            yield f"From {low:g} to {high:g} {unit} of the {orders.shaft}{rest}: {sentence}."
        return
    for order, column in zip(orders.per_turn, speeds.T, strict=True):
        met = [f"{speed:.6g}" for speed in column[np.isfinite(column)]]
        more = f" and {len(met) - MOST_RANGES} more speeds" if len(met) > MOST_RANGES else ""
        yield f"{_capital(order)} meets modes at {', '.join(met[:MOST_RANGES])}{more} {unit} of the {orders.shaft}{rest}."


def _place(dataset: xr.Dataset, variable: xr.DataArray, place: tuple[Any, ...]) -> str:
    """``name = value unit`` for every swept parameter at one place of ``variable``."""
    parts = coordinates(dataset, variable, place)
    return ", ".join(f"{name} = {value} {unit}".removesuffix(" 1") for name, value, unit in parts)


def _label(variable: xr.DataArray, dim: Any, k: int) -> str:
    return str(variable[dim].values[k]) if dim in variable.coords else str(k + 1)


def _capital(text: object) -> str:
    return str(text)[:1].upper() + str(text)[1:]


def _share(share: float) -> str:
    """A share in percent; a small one is never shown as 0, a large one never as 100."""
    return f"{100 * share:.3g} %" if share in (0, 1) else f"{min(max(100 * share, 0.001), 99.999):.5g} %"


def axes_table(dataset: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of the swept parameters: name, meaning, smallest value, largest value, unit, and number of values."""
    axes = [dataset[d] for d in dataset["outcome"].dims if d in dataset.coords]
    columns = [c for c in dataset.coords.values() if c.dims == ("point",) and c.name != "point"]
    return [
        (
            scene_key(c),
            c.attrs.get("long_name", ""),
            digits(c.min().item()),
            digits(c.max().item()),
            units_of(c),
            str(c.size),
        )
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


# Lists of a driveline in its drawing, each with the entry that stands for nothing.
_ELEMENTS = {"beta": 0.0, "phase": 0.0, "ratio": 1.0, "k": None, "J": None}


def chain(dataset: xr.Dataset) -> list[dict[str, str]]:
    """The texts in the drawing of a driveline: name, joint, gear, stiffness and inertia of each element; else empty."""
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}"))
    lists = {name: fixed[name] for name in _ELEMENTS if name in fixed and fixed[name]["value"]}
    if dataset.attrs.get("system") != "driveline" or not lists:
        return []
    varying = {scene_key(c) for c in dataset.coords.values() if c.ndim}

    def text(name: str, i: int) -> str:
        if name not in lists or f"{name}[{i}]" in varying:
            return f"{name} varies" if name in lists else ""
        value, (factor, units) = lists[name]["value"][i], unit_of(dataset, name, lists[name]["units"])
        return "" if value == _ELEMENTS[name] else f"{digits(value * factor)} {written_units(units)}".removesuffix(" 1")

    count = len(next(iter(lists.values()))["value"])
    names = scene_of(dataset).get("parts") or [str(i + 1) for i in range(count)]
    return [{"name": names[i], **{name: text(name, i) for name in _ELEMENTS}} for i in range(count)]


Table = tuple[list[str], list[list[str]]]


def values_tables(dataset: xr.Dataset) -> list[Table]:
    """Heads and rows of tables of a result of few points: one for the results of the same dimensions, a column each."""
    numbers = [v for v in dataset.data_vars.values() if v.dtype.kind in "fiub" and v.name != "outcome"]
    shown = [v for v in numbers if v.size <= _FEW_VALUES]
    if dataset["outcome"].size > FEW_POINTS or sum(v.size for v in shown) > _FEW_VALUES:
        return []
    alike: dict[tuple[Any, ...], list[xr.DataArray]] = {}
    for variable in shown:
        alike.setdefault(variable.dims, []).append(variable)
    tables = []
    for variables in alike.values():
        # A row for each place, with its coordinates and the value of every variable.
        places = [coordinates(dataset, variables[0], place) for place in np.ndindex(variables[0].shape)]
        head = [f"{name}{in_brackets(unit)}" for name, _, unit in places[0]] if places else []
        head += [f"{str(v.name).replace('_', ' ')}{in_brackets(units_of(v))}" for v in variables]
        known = [valid(dataset, str(v.name)) if flag_words(v) else v for v in variables]
        columns = [[value_text(v, value) for value in v.values.reshape(-1)] for v in known]
        rows = [[value for _, value, _ in place] + [c[k] for c in columns] for k, place in enumerate(places)]
        tables.append((head, rows))
    return tables


def value_text(variable: xr.DataArray, value: Any) -> str:
    """A value as text: the meaning of a code."""
    meanings = flag_words(variable)
    return meanings.get(int(value), "no value").replace("_", " ") if meanings else digits(value)


def coordinates(dataset: xr.Dataset, variable: xr.DataArray, place: tuple[Any, ...]) -> list[tuple[str, str, str]]:
    """Name, value and unit of every coordinate at one place of ``variable``."""
    rows = []
    for dim, k in zip(variable.dims, place, strict=True):
        columns = [c for c in dataset.coords.values() if c.dims == (dim,) and dim == "point" and c.name != "point"]
        for axis in columns or ([dataset[dim]] if dim in dataset.coords else []):
            words = axis.dtype.kind in "UO"
            name = scene_key(axis).replace("_", " ") if words else scene_key(axis)
            rows.append((name, str(axis.values[k]) if words else digits(axis.values[k]), units_of(axis)))
    return rows


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
