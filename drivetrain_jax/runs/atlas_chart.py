"""Evaluate a stored atlas as a chart, with its boundaries as curves and its tips as points."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax._errors import shown as quoted
from drivetrain_jax._programs import program_identity, remembered
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.atlas import to_arrays
from drivetrain_jax.atlas.boundaries import boundaries
from drivetrain_jax.atlas.criteria import has_boundaries
from drivetrain_jax.atlas.exclusion import Search
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.tips import Tips, find_tips
from drivetrain_jax.atlas.windows import narrow, stability_along
from drivetrain_jax.runs.atlas_file import StoredAtlas, as_given, check_same, moved_within, open_atlas
from drivetrain_jax.store.files import source_digest
from drivetrain_jax.systems import System, get_system

Convert = Callable[[Any], Any]
# Values of each parameter that is not an axis of the chart.
_SLICES = 3


def chart(source: str | Path | xr.Dataset, part: Mapping[str, float | tuple[float, float]], cells: int) -> xr.Dataset:
    """The ``floquet`` result on ``cells`` values of each of two parameters of the atlas in ``source``.

    ``part`` fixes parameters (numbers) or restricts them (ranges). Any further parameter gets three values. The chart also
    has the stability boundaries (``boundary_NAME``, segments separated by NaN, for each value of the further parameters),
    if the system has them. A chart of two parameters has the tips of the tongues as well (``tip_NAME``, their names,
    ``tip_NAME_error``, ``tip_opens``, ``tip_proved``), and boxes that may contain more tips (``undecided_NAME``). Its
    attribute ``proof`` says how many verdicts are proved. A chart of one parameter has its unstable ranges
    (``unstable_NAME``).

    Raises :class:`InputError` for values outside the atlas, :class:`ChunkError` if a direct solve in a gap fails.
    """
    if not isinstance(cells, (int, np.integer)) or isinstance(cells, bool) or not 2 <= cells <= 20_000:
        raise InputError(f"cells = {quoted(cells)}: expected a whole number, 2 <= cells <= 20000")
    atlas = open_atlas(source).viewed(part)
    ranges = _ranges(atlas, atlas.in_parameters(part))
    fixed = {name: value for name, value in ranges.items() if not isinstance(value, tuple)}
    shown = _shown(atlas.scene.system, [name for name in ranges if name not in fixed])
    if not shown:
        raise InputError(f"part: fixes {', '.join(fixed)}; a chart needs a varying parameter; use query for one point")
    axes = {
        name: np.linspace(*ranges[name], num=cells if name in shown[:2] else _SLICES)
        for name in atlas.parameters
        if name in shown
    }
    dataset = atlas.grid(**axes, **fixed)
    if "verdict" in dataset:
        said = atlas.proof(
            {name: axes[name] for name in atlas.parameters if name in axes}, fixed, dataset["verdict"].values
        )
        curves = "; boundaries and tips hold by estimate" if len(shown) > 1 and "proved" in said else ""
        dataset = dataset.assign_attrs(proof=said + curves)
    if len(shown) > 1 and has_boundaries(atlas.stability.atlas, atlas.scene.system):
        plane, slices = {n: ranges[n] for n in shown[:2]}, {n: axes[n] for n in axes if n not in shown[:2]}
        dataset = dataset.assign_coords(_stored_curves(atlas, fixed, plane, slices))
    elif has_boundaries(atlas.stability.atlas, atlas.scene.system):
        (name,) = shown
        line = stability_along(narrow(atlas.stability.atlas.slice(fixed), {name: ranges[name]}), atlas.scene.system)
        ends = np.reshape([(i.lower, i.upper) for i in line.intervals if not i.stable], (-1, 2))
        about = atlas.labels(name) | {"long_name": f"lower and upper end of an unstable range, {name}"}
        dataset = dataset.assign_coords({f"unstable_{name}": (("unstable_range", "end"), ends, about)})
    for name, (quantity, convert) in atlas.views.items():
        dataset = in_physical_units(dataset, name, quantity, convert)
    return dataset


def with_boundaries(dataset: xr.Dataset, source: str | Path | xr.Dataset) -> xr.Dataset:
    """``dataset``, a chart over two parameters, with the boundaries and tips of the atlas in ``source``.

    Raises :class:`InputError` for an atlas of another system or of other fixed values, or of less than the chart's range.
    """
    atlas = open_atlas(source)
    system = atlas.scene.system
    if (name := dataset.attrs.get("system")) != system.name:
        raise InputError(f"system = {name!r}: the atlas is one of {system.name}; expected a chart of {system.name}")
    entries = json.loads(dataset.attrs.get("fixed_parameters", "{}"))
    known = {name: np.asarray(entry["value"]) for name, entry in entries.items()}
    swept = {str(axis.attrs.get("parameter", name)): axis for name, axis in dataset.coords.items()}
    known |= {name: axis.values for name, axis in swept.items()}
    for name in atlas.fixed.keys() & known.keys():
        check_same(name, known[name].tolist(), atlas.fixed[name])
    plane, fixed = {}, {}
    for name in _shown(system, list(atlas.parameters)):
        if name not in known:
            raise InputError(f"{name}: missing in the chart; expected {atlas.allowed(name)}")
        inside = atlas.check_within(name, np.ravel(known[name]))
        low, high = float(inside.min()), float(inside.max())
        plane |= {name: (low, high)} if low < high else {}
        fixed |= {} if low < high else {name: low}
    if len(plane) != 2 or dataset["outcome"].squeeze().ndim != 2:
        raise InputError(f"axes: the chart varies {', '.join(plane)}; expected two parameters of the atlas beside it")
    dataset = dataset.assign_coords(_stored_curves(atlas, fixed, plane, {}))
    for name in plane:
        axis = dataset[swept[name].dims[0]]
        if axis.name != name:
            # The largest value, because one may be 0.
            k = int(np.argmax(np.abs(known[name])))
            size = axis.values[k] / known[name][k]
            dataset = _curves_in_physical_units(
                dataset, name, axis.name, axis.attrs["units"], partial(np.multiply, size)
            )
    return dataset


def in_physical_units(dataset: xr.Dataset, name: str, quantity: Parameter, convert: Convert) -> xr.Dataset:
    """``dataset`` with the parameter ``name``, its boundaries and its tips also, or instead, as physical data."""
    other, parameter = quantity.name, dataset[name]
    dataset = _curves_in_physical_units(dataset, name, other, quantity.units, convert)
    about = {"units": quantity.units, "long_name": quantity.long_name}
    dataset = dataset.assign_coords({other: (parameter.dims, convert(parameter.values), about)})
    roles = {role: other if p == name else p for role, p in json.loads(dataset.attrs["roles"]).items()}
    dataset = dataset.assign_attrs(roles=json.dumps(roles))
    return dataset.swap_dims({name: other}) if parameter.ndim else dataset


def _curves_in_physical_units(dataset: xr.Dataset, name: str, other: str, units: str, convert: Convert) -> xr.Dataset:
    """``dataset`` with the boundaries and tips along ``name`` as values of the physical datum ``other``."""
    for prefix, suffix in (("boundary_", ""), ("tip_", ""), ("tip_", "_error"), ("undecided_", ""), ("unstable_", "")):
        if (old := f"{prefix}{name}{suffix}") in dataset.coords:
            values, label = dataset[old], dataset[old].attrs["long_name"].replace(name, other)
            # The conversions are linear.
            new = (values.dims, convert(values.values), {"units": units, "long_name": label})
            dataset = dataset.drop_vars(old).assign_coords({f"{prefix}{other}{suffix}": new})
    return dataset


def _ranges(atlas: StoredAtlas, part: Mapping[str, Any]) -> dict[str, Any]:
    moved = {}
    for name, value in part.items():
        if name not in atlas.parameters:
            atlas.refuse(name, value)
        low, high = atlas.ranges[name]
        rising = not isinstance(value, tuple) or value[0] < value[1]
        moved[name] = moved_within(value, (low, high))
        if not rising or not all(low <= end <= high for end in np.atleast_1d(moved[name])):
            shown, *ends = atlas.viewed_as(name, *np.atleast_1d(value))
            text = as_given(tuple(ends))
            raise InputError(f"{shown.name} = {text}: expected a number or LOW:HIGH, {atlas.allowed(name)}")
    return {name: moved.get(name, atlas.ranges[name]) for name in atlas.parameters}


def _shown(system: type[System], names: list[str]) -> list[str]:
    """The parameters with the two of the chart first: the axis of the resonances, or the speed without resonances."""
    axis = system.resonances.axis if system.resonances else system.roles.get("speed")
    return sorted(names, key=lambda name: name != axis)


def _stored_curves(
    atlas: StoredAtlas,
    fixed: Mapping[str, float],
    ranges: Mapping[str, tuple[float, float]],
    slices: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    """The curves of a chart, traced once for this atlas, part and code, and then kept in the user's cache."""
    system, floquet = atlas.scene.system, atlas.scene_on({}).analysis
    known = get_system(system.name) is system
    panels = atlas.stability.atlas
    content = {
        # Words as such: an array of objects has no content of its own.
        "panels": {n: x.tolist() if x.dtype == object else x for n, x in to_arrays(panels).items()},
        "given": [panels.parameters, dict(panels.fixed), panels.tolerance, dict(fixed), dict(ranges), dict(slices)],
        "code": source_digest({"atlas_chart.py": Path(__file__)}),
    }
    identity = program_identity(system, floquet, content) if known else ""
    return remembered(partial(_curves, atlas, fixed, ranges, slices), identity)


def _curves(
    atlas: StoredAtlas,
    fixed: Mapping[str, float],
    ranges: Mapping[str, tuple[float, float]],
    slices: Mapping[str, np.ndarray],
) -> dict[str, tuple[str | tuple[str, ...], np.ndarray, dict[str, str]]]:
    """The boundaries over ``ranges`` for every combination of the values of ``slices``, padded with NaN to one length.

    Without slices there are the tips, too.
    """
    whole, system, tips = atlas.stability.atlas.slice(fixed), atlas.scene.system, None
    if not slices and system.resonances is not None and system.resonances.axis in ranges:
        # Tongues open at their tips with increasing angle, and close there with increasing damping.
        tips = find_tips(narrow(whole, ranges), system, opening=system.roles.get("angle") in ranges)
    parts = [narrow(whole.slice(dict(zip(slices, point, strict=True))), ranges) for point in product(*slices.values())]
    curves = [_boundary(part, system, ranges, tips.searches if tips else ()) for part in parts]
    shape = (*map(len, slices.values()), max(curve[name].size for curve in curves for name in ranges))
    coordinates: dict[str, tuple] = {}
    for name in ranges:
        padded = np.full(shape, np.nan)
        for place, curve in zip(np.ndindex(shape[:-1]), curves, strict=True):
            padded[place][: curve[name].size] = curve[name]
        about = {"units": system.parameter(name).units, "long_name": f"boundary of stability, {name}"}
        coordinates[f"boundary_{name}"] = ((*slices, "boundary"), padded, about)
    return coordinates | (_tips(_on_all_sides(tips, _signs(parts[0]), ranges), system, ranges) if tips else {})


def _boundary(
    panels: Atlas, system: type[System], ranges: Mapping[str, tuple[float, float]], searches: Sequence[Search] = ()
) -> dict[str, np.ndarray]:
    """The stability boundary within ``ranges``, segments separated by NaN; empty in a gap of the atlas."""
    segments = [
        _within({name: sign * segment[name] for name, sign in side.items()}, ranges)
        for curve in (boundaries(panels, system, searches) if panels.panels else ())
        for segment in curve.segments()
        for side in _signs(panels)
    ]
    return {name: np.concatenate([np.empty(0), *(np.append(s[name], np.nan) for s in segments)]) for name in ranges}


def _signs(atlas: Atlas) -> list[dict[str, float]]:
    """The signs of the parameters whose moduli lie in ``atlas``: both signs if the range crosses 0."""
    choices = []
    for coordinate, low, high in zip(atlas.coordinates, atlas.lower, atlas.upper, strict=True):
        both = [1.0] if not coordinate.even or high > 0 else []
        choices.append([*both, -1.0] if coordinate.even and low < 0 else both)
    return [dict(zip(atlas.parameters, signs, strict=True)) for signs in product(*choices)]


def _within(places: Mapping[str, np.ndarray], ranges: Mapping[str, tuple[float, float]]) -> dict[str, np.ndarray]:
    """``places`` with NaN outside ``ranges``."""
    inside = np.logical_and.reduce([(low <= places[n]) & (places[n] <= high) for n, (low, high) in ranges.items()])
    return {name: np.where(inside, values, np.nan) for name, values in places.items()}


def _on_all_sides(
    tips_of_one_side: Tips, signs: list[dict[str, float]], ranges: Mapping[str, tuple[float, float]]
) -> Tips:
    tips, boxes = [], []
    for side in signs:
        for tip in tips_of_one_side.tips:
            point = {name: sign * tip.point[name] for name, sign in side.items()}
            # At 0 both signs are the same point.
            known = any(point == other.point for other in tips)
            if not known and all(low <= point[name] <= high for name, (low, high) in ranges.items()):
                # A tongue that opens upwards at positive values opens downwards at negative ones.
                tips.append(replace(tip, point=point, opens=tip.opens == (min(side.values()) > 0)))
        for box in tips_of_one_side.undecided:
            boxes.append({name: tuple(sorted(sign * end for end in box[name])) for name, sign in side.items()})
    return replace(tips_of_one_side, tips=tuple(tips), undecided=tuple(boxes))


def _tips(
    tips: Tips, system: type[System], names: Iterable[str]
) -> dict[str, tuple[str | tuple[str, str], np.ndarray, dict[str, str]]]:
    """The tips as coordinates: names, opening, proof, position and error; and the undecided boxes."""
    labels = np.array([tip.name for tip in tips.tips], dtype=str)
    proved = np.array([tip.proved for tip in tips.tips], np.int8)
    meaning = {
        "units": "1",
        "long_name": "whether there is exactly one tip here within the bounds of the atlas (1) or not (0)",
    }
    other = next(name for name in names if name != system.resonances.axis)  # pyright: ignore[reportOptionalMemberAccess]
    opens = np.array([tip.opens for tip in tips.tips], np.int8)
    direction = {"units": "1", "long_name": f"whether the tongue opens (1) or closes (0) at its tip as {other} rises"}
    coordinates: dict[str, tuple] = {
        "tip": ("tip", labels, {"units": "1", "long_name": "resonance that the tongue grows from"}),
        "tip_opens": ("tip", opens, direction),
        "tip_proved": ("tip", proved, meaning),
    }
    for name in names:
        units = {"units": system.parameter(name).units}
        values = np.array([tip.point[name] for tip in tips.tips])
        errors = np.array([tip.error[name] for tip in tips.tips])
        coordinates[f"tip_{name}"] = ("tip", values, {**units, "long_name": f"tip of a tongue, {name}"})
        coordinates[f"tip_{name}_error"] = ("tip", errors, {**units, "long_name": f"bound of the error of tip_{name}"})
        if tips.undecided:
            boxes = np.array([box[name] for box in tips.undecided])
            about = {**units, "long_name": f"lower and upper {name} of a box that may hide further tips"}
            coordinates[f"undecided_{name}"] = (("undecided_box", "end"), boxes, about)
    return coordinates
