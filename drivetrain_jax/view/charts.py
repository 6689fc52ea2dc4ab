"""The chart maker: lines and maps of the variables of a result, chosen by their dimensions, units and flags."""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, LogNorm, Normalize, SymLogNorm, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import overlays
from drivetrain_jax.view.sheet import LETTERS, Sheet, cell_edges, fit_axis, is_logarithmic, plain_decades, widen
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FLAG_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    PENDING_COLOUR,
    PREDICTION,
    axis_label,
    coordinate_text,
    entry_name,
    in_brackets,
    power_of_ten,
    ranges_text,
    scene_key,
    size,
    suitable,
    symbol,
    units_of,
    unstable_text,
    value_in,
    variable_label,
    with_prefixes,
)

FAILED, PENDING = "failed", "pending"
# The flag of points that have a value, where nothing else is known about them.
_COMPUTED = "computed"
LIMIT: dict[str, Any] = {"color": FRAME_GREY, "linewidth": 0.8, "linestyle": (0, (2, 2))}
_NO_PARAMETERS = ("point", PENDING)
# Flags that always have their number of points in the legend, and the most points of which all flags have it.
_ALARMING, _COUNTED = ("undecided", FAILED, PENDING), 1000
# Part of a flag's colour in bands behind lines; the rest is white.
_PALE = 0.35
# Most panels of lines; most values of a further axis that all have a map; most entries of a dimension in a table.
_MOST_PANELS, _FEW_MAPS, _MOST_ENTRIES = 8, 4, 24
# Line spacing of a table, least height of a map, and height of all maps, in inches.
_ROW, _LOWEST, _PAGE = 0.24, 1.3, 10.0
# Least range of a vertical axis relative to its values.
_LEAST_RANGE = 0.01
# Relative change up to which a sum is a number in the legend.
_CONSTANT = 1e-3
# Ratio of the largest to the smallest positive value above which a colour scale is logarithmic.
_WIDE = 3.0
# Line styles of variables that share a panel, and number of points below which lines have markers.
_DASHES, _FEW = ("-", (0, (4, 1.5)), ":"), 12
# Variables with a band other than their error bound: the stored error, its factor, and the name of the band.
_BANDS = {
    "lyapunov_spectrum": ("lyapunov_standard_error", 3.0, "three standard errors"),
    "lyapunov_history": ("lyapunov_standard_error", 3.0, "three standard errors"),
    "basin_fraction": ("basin_error", 1.0, "standard error"),
}
# Variables whose sum is the mean divergence of the flow.
_SUMMED = ("lyapunov_spectrum", "paper_estimator")
# Variables whose sign says whether disturbances grow, and the part of their scale that is linear.
_EXPONENTS, _SMALL = ("lyapunov_spectrum", "floquet_exponent"), 1e-3
# Position between largest decay (-1), none (0) and largest growth (1), and colour; lightness falls monotonically. White is
# reserved for cells without a value.
_GROWTH_COLOURS = (
    (-1.0, "#fbfce0"), (-0.5, "#a9dcc3"), (0.0, "#86b1d6"), (0.12, "#d98e48"), (0.5, "#b8432f"), (1.0, "#2d0a2b"),
)  # fmt: skip
# Distance of a spectral radius from 1 that rounding can make, and positive values relative to the largest.
_ROUNDING = 1e-12


def prepare(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with rising axes in units with suitable prefixes, and a mark of pending cells that every variable keeps.

    Axes of one value become scalar coordinates. Infinite axis values are dropped and recorded in the attribute ``left_out``.
    """
    if "outcome" not in dataset:
        return dataset
    left_out = []
    for name in dataset.coords:
        coordinate = dataset[name]
        infinite = np.isinf(coordinate.values) if coordinate.dtype.kind == "f" else np.zeros(coordinate.shape, bool)
        if infinite.any() and not infinite.all() and coordinate.dims[0] in dataset["outcome"].dims:
            dataset = dataset.isel({coordinate.dims[0]: ~infinite})
            left_out.append(f"{symbol(scene_key(coordinate))} = inf left out")
    dataset = dataset.assign_attrs(left_out=", ".join(left_out)) if left_out else dataset
    dataset = with_prefixes(dataset.isel({name: 0 for name in dataset["outcome"].dims if dataset.sizes[name] == 1}))
    dataset = dataset.sortby([name for name in dataset["outcome"].dims if name in dataset.coords])
    outcome = dataset["outcome"]
    if not outcome.ndim or not str(outcome.attrs.get("flag_meanings", "")).endswith(f" {PENDING}"):
        return dataset
    return dataset.assign_coords({PENDING: outcome == outcome.attrs["flag_values"][-1]})


def sweep_axes(dataset: xr.Dataset) -> list[str]:
    """Names of the swept axes, in scene order."""
    return [str(name) for name in dataset["outcome"].dims]


def wrong_axes(dataset: xr.Dataset, allowed: str) -> InputError:
    """The error for a result over other axes than the ``allowed`` ones; it names axes of one value, too."""
    single = [f"{name} (one value)" for name, c in dataset.coords.items() if c.ndim == 0 and name not in _NO_PARAMETERS]
    axes = ", ".join([*sweep_axes(dataset), *single]) or "none"
    return InputError(f"axes = {axes}: expected {allowed}")


def require(dataset: xr.Dataset, *names: str, some: bool = False) -> list[str]:
    """The stored variables among ``names``; raises :class:`InputError` unless all are stored, or ``some``."""
    stored = [name for name in names if name in dataset]
    if not stored or (len(stored) < len(names) and not some):
        outputs = ", ".join(str(name) for name in dataset.data_vars)
        missing = " and ".join(name for name in names if name not in dataset)
        lack, needed = ("nothing to plot", " or ") if some else (f"{missing} missing", " and ")
        raise InputError(f"outputs = {outputs}: {lack}; the figure needs {needed.join(names)}")
    return stored


def require_values(variable: xr.DataArray, positive: bool = False) -> None:
    """Raise :class:`InputError` unless ``variable`` has a finite value (above zero if ``positive``)."""
    finite = variable.values[np.isfinite(variable.values)]
    if not (finite.size and (finite.max() > 0 or not positive)):
        kind, largest = "positive" if positive else "finite", finite.max() if finite.size else np.nan
        raise InputError(f"{variable.name} = {largest:g}: nothing to plot; expected a result with a {kind} value")


def role(dataset: xr.Dataset, name: str) -> str:
    """The parameter with the role ``name`` in the system (attribute ``roles``), or an empty string."""
    return json.loads(dataset.attrs.get("roles", "{}")).get(name, "")


def horizontal_first(dataset: xr.Dataset, names: Sequence[str]) -> list[str]:
    """``names`` with the horizontal axis first: the speed, else one with predicted resonances, else the last one."""
    ranks = [name == role(dataset, "speed") or (f"resonance_{name}" in dataset.coords) / 2 for name in names]
    horizontal = names[-1] if not any(ranks) else names[int(np.argmax(ranks))]
    return [horizontal, *(name for name in names if name != horizontal)]


def varying_parameters(dataset: xr.Dataset) -> list[str]:
    """Parameters with several values in a list of points; raises :class:`InputError` without one."""
    columns = [c for name, c in dataset.coords.items() if c.dims == ("point",) and name not in _NO_PARAMETERS]
    varying = [str(values.name) for values in columns if np.unique(values).size > 1]
    if not varying:
        raise InputError("points: all points are the same, there is nothing to plot; give points that differ")
    return varying


def along_points(dataset: xr.Dataset) -> xr.Dataset:
    """A list of points as a result over the first parameter that varies."""
    first, *_ = varying_parameters(dataset)
    return dataset.swap_dims(point=first).sortby(first)


def valid(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """The variable ``name`` without what failed points store: codes above the last flag for failed and pending points, NaN
    in a variable without flags."""
    variable, known = dataset[name], dataset["outcome"] < FIRST_FAILURE
    count = len(flags(variable))
    if not count:
        return variable.where(known)
    variable = variable.where(known, count)
    return variable.where(~dataset[PENDING], count + 1) if PENDING in dataset.coords else variable


def flags(variable: xr.DataArray) -> list[str]:
    """The meanings of the codes of a variable; empty for numbers."""
    return str(variable.attrs.get("flag_meanings", "")).split()


def flag_words(variable: xr.DataArray) -> list[str]:
    """The meanings of the codes of a variable of :func:`valid`, as words."""
    return [flag.replace("_", " ") for flag in (*flags(variable), FAILED, PENDING)]


def flag_scale(variable: xr.DataArray, strength: float = 1.0) -> dict[str, Any]:
    """The colours of a variable of :func:`valid` with flags; a ``strength`` below 1 mixes them with white."""
    names = variable.attrs.get("flag_colours") or [FLAG_COLOURS.get(flag, FRAME_GREY) for flag in flags(variable)]
    colours = to_rgba_array([*names, FAILED_COLOUR, PENDING_COLOUR])
    colours[:, :3] = 1 - strength * (1 - colours[:, :3])
    return {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}


def flag_entries(variable: xr.DataArray, strength: float = 1.0) -> list[Patch]:
    """Legend entries of the flags that occur in a variable of :func:`valid`; with their numbers of points, unless these are
    many."""
    names, entries = flag_words(variable), []
    counts = np.bincount(variable.values.astype(int).ravel(), minlength=len(names))
    for name, colour, count in zip(names, flag_scale(variable, strength)["cmap"].colors, counts, strict=True):
        label = name + f" ({count})" * (variable.size <= _COUNTED or name in _ALARMING)
        if count and name != _COMPUTED:
            entries.append(Patch(facecolor=colour, edgecolor=FRAME_GREY, linewidth=0.6, label=label))
    return entries


def computed(dataset: xr.Dataset) -> xr.DataArray:
    """A variable of :func:`valid` that has only the flags of points without a value: failed or pending."""
    flag = xr.zeros_like(dataset["outcome"], dtype=int).assign_attrs(flag_meanings=_COMPUTED)
    return valid(dataset.assign({_COMPUTED: flag}), _COMPUTED)


def draw_cells(axes: Axes, field: xr.DataArray, horizontal: str, vertical: str, **options: Any) -> QuadMesh:
    """Draw ``field`` as cells over the two axes; limits and scales of ``axes`` follow the cells."""
    x, y = (field[name].values.astype(float) for name in (horizontal, vertical))
    field = field.transpose(vertical, horizontal)
    edges = cell_edges(x), cell_edges(y)
    mesh = axes.pcolormesh(*edges, field.values, rasterized=True, **options)
    if PENDING in field.coords and not flags(field):
        waiting = np.where(field[PENDING].values, 0.0, np.nan)
        axes.pcolormesh(*edges, waiting, cmap=ListedColormap([PENDING_COLOUR]), rasterized=True)
    fit_axis(axes, "x", x)
    fit_axis(axes, "y", y)
    return mesh


def draw_flags(axes: Axes, codes: xr.DataArray, name: str, heights: tuple[float, float] = (0.0, 1.0)) -> list[Patch]:
    """Draw flags of :func:`valid` as bands along the axis ``name`` between two heights, in fractions of the panel; returns
    their legend entries.

    Bands within the panel are pale, and at least as wide as a line.
    """
    codes, strength = codes.sortby(name), _PALE if heights[0] < 1 else 1.0
    x, inside = cell_edges(codes[name].values.astype(float)), {"edgecolors": "face", "linewidth": 0.6, "zorder": -2}
    style: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "clip_on": heights[0] < 1, "rasterized": True}
    style |= flag_scale(codes, strength) | (inside if heights[0] < 1 else {})
    axes.pcolormesh(x, heights, codes.values[None, :], **style)
    return flag_entries(codes, strength)


class Growth(NamedTuple):
    """``values = factor ln(spectral radius)`` with their ``label``; colours are linear below ``linear`` and end at
    ``largest``, the same in every figure."""

    factor: xr.DataArray | float
    label: str
    linear: float
    largest: float

    def from_radius(self, radius: xr.DataArray) -> Any:
        """The growth that a spectral radius means; a radius of 0 is infinite decay."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(radius) * self.factor


def growth_of(dataset: xr.Dataset) -> Growth:
    """The growth of small disturbances in ``dataset``, in the most useful unit that its parameters allow: per second where
    the speed is known, per turn of the shaft, else per period."""
    periods, turns = dataset.attrs.get("periods_per_turn", 0), turns_per_second(dataset)
    if periods and turns is not None:
        return Growth(turns * periods, "rate of growth [1/s]", 1e-3, 1e2)
    if periods:
        return Growth(float(periods), "growth per turn, ln(factor)", 1e-6, 1e1)
    return Growth(1 / np.log(10), "$\\log_{10}$ of the spectral radius", 1e-6, 1.0)


def turns_per_second(dataset: xr.Dataset) -> xr.DataArray | float | None:
    """The speed of the shaft along its axis, or that of the physical data; None if it has no unit."""
    axis = dataset.coords.get(role(dataset, "speed"))
    data = json.loads(dataset.attrs.get("physical_data", "{}")).values()
    speeds = [(axis, str(axis.attrs.get("units", "1")))] if axis is not None else []
    speeds += [(entry["value"], entry.get("units", "1")) for entry in data]
    return next((value * factor for value, units in speeds if (factor := size(units, "rps"))), None)


def _is_radius(name: object) -> bool:
    return str(name).endswith("spectral_radius")


def colours(field: xr.DataArray, growth: Growth | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the cells and of the colour bar for the values of ``field``: the colours of flags; those of ``growth``,
    which change at the limit of stability, if there are values on both sides; or darker ones for larger values, logarithmic
    if positive values (and zeros) differ widely."""
    if flags(field):
        return flag_scale(field), {}
    values = field.values[np.isfinite(field.values)]
    low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
    if growth is None or low * high > 0:
        positive = values[values > _ROUNDING * high]
        logarithmic = low >= 0 and positive.size > 0 and high > _WIDE * positive.min()
        norm = LogNorm(positive.min(), high) if logarithmic else Normalize(low, high)
        return {"cmap": matplotlib.colormaps["cividis_r"].with_extremes(bad=FAILED_COLOUR), "norm": norm}, {}
    high = growth.largest
    cmap = LinearSegmentedColormap.from_list("growth", [((1 + x) / 2, colour) for x, colour in _GROWTH_COLOURS], N=1024)
    norm = SymLogNorm(growth.linear, linscale=0.5, vmin=-high, vmax=high, base=10)
    decades = 10.0 ** np.arange(np.log10(growth.linear) + 1, np.log10(high) + 0.5)
    bar = {"extend": "both", "ticks": [*-decades[::-1], 0.0, *decades]}
    return {"cmap": cmap.with_extremes(bad=FAILED_COLOUR), "norm": norm}, bar


def chart(dataset: xr.Dataset, panels: Sequence[Sequence[str]] = (), fields: Sequence[str] = (), **look: Any) -> Figure:
    """The figure of any result: multipliers, a table or lines of a single point, lines over one axis, maps over two, small
    multiples over more.

    ``panels`` lists the variables of each panel of lines, ``fields`` those of maps; default: all results. ``look`` goes to
    :func:`draw_lines`.
    """
    names, every = sweep_axes(dataset), [[name] for name in results(dataset)]
    if not names and "floquet_multiplier" in dataset:
        return _plane(dataset)
    wanted = panels if len(names) < 2 else [[name] for name in fields or [key for panel in panels for key in panel]]
    stored = [keys for panel in wanted or every if (keys := [key for key in panel if key in dataset])]
    if not stored:
        require(dataset, *(key for panel in wanted or [["a result"]] for key in panel), some=True)
    if names == ["point"]:
        if len(varying_parameters(dataset)) > 1 and _flagged(dataset):
            return _scatter(dataset)
        dataset = along_points(dataset)
        names = sweep_axes(dataset)
    if len(names) > 1:
        return _small_multiples(dataset, [key for keys in stored for key in keys])
    long = [str(d) for (key, *_) in stored for d in dataset[key].dims if dataset.sizes[d] > _MOST_ENTRIES]
    if not names and not long:
        return _table(dataset)
    along = (names or long)[0]
    lines = [keys for keys in stored if all(along in dataset[key].dims and dataset[key].ndim < 3 for key in keys)]
    if not lines:
        raise wrong_axes(dataset, f"none for {stored[0][0]}, which has several dimensions of its own")
    shown = lines[:_MOST_PANELS]
    left_out = f"{len(shown)} of {len(stored)} results shown" if len(shown) < len(stored) else ""
    return stack(dataset, along, shown, **look).finish(dataset, left_out)


def results(dataset: xr.Dataset) -> list[str]:
    """Names of the numbers in a result, without outcomes and errors."""
    numbers = [str(name) for name, variable in dataset.data_vars.items() if variable.dtype.kind in "fiub"]
    return [name for name in numbers if name != "outcome" and not name.endswith("_error")]


def _flagged(dataset: xr.Dataset) -> str:
    """The variable whose flags say what happens at a point, or an empty string."""
    return next((name for name in ("verdict", "regime") if name in dataset), "")


def _plane(dataset: xr.Dataset) -> Figure:
    multipliers = dataset["floquet_multiplier"]
    require_values(multipliers)
    sheet, angle = Sheet(height=4.0), np.linspace(0, 2 * np.pi, 361)
    axes, values = sheet.axes[0, 0], multipliers.values
    circle = axes.plot(np.cos(angle), np.sin(angle), color=FRAME_GREY, linewidth=0.8, label="unit circle")
    style = {"color": LINE_COLOURS[0], "markersize": 5, "label": "Floquet multipliers"}
    sheet.add(*axes.plot(np.real(values), np.imag(values), "o", **style), *circle)
    axes.set_aspect("equal", adjustable="datalim")
    sheet.label("real part of the multiplier", "imaginary part")
    return sheet.finish(dataset)


def _table(dataset: xr.Dataset) -> Figure:
    rows = table_rows(dataset)
    sheet = Sheet(height=_ROW * len(rows))
    axes = sheet.axes[0, 0]
    axes.axis("off")
    axes.set(xlim=(0, 1), ylim=(len(rows) - 0.5, -0.5))
    for k, (label, number, unit) in enumerate(rows):
        axes.text(0, k, label, va="center")
        axes.text(0.72, k, number, va="center", ha="right")
        axes.text(0.74, k, unit, va="center", color=FRAME_GREY)
    return sheet.finish(dataset)


def table_rows(dataset: xr.Dataset) -> list[tuple[str, str, str]]:
    """Name, value and unit of every result of a single point, one row for each entry of its own dimension."""
    rows = []
    for name in results(dataset):
        variable, units = dataset[name], units_of(dataset[name])
        label, words = str(variable.attrs.get("long_name", name)), flags(variable)
        if words:
            # A point without a value stores the last code.
            variable, words = valid(dataset, name), [*words, FAILED, PENDING]
        for place in np.ndindex(variable.shape):
            entry = variable[place]
            numbered = zip(variable.dims, place, strict=True)
            labels = [f", {dim} {entry[dim].item() if dim in entry.coords else k}" for dim, k in numbered]
            value = words[int(entry)].replace("_", " ") if words else power_of_ten(f"{entry.item():.6g}")
            rows.append((label + "".join(labels), value, "" if units == "1" else units))
    return rows


def _scatter(dataset: xr.Dataset) -> Figure:
    """Points over the first parameters that vary, in the colours of their flags."""
    horizontal, vertical, *_ = horizontal_first(dataset, varying_parameters(dataset))
    codes, sheet = valid(dataset, _flagged(dataset)), Sheet(height=3.4)
    look: dict[str, Any] = {"s": 24, "edgecolors": FRAME_GREY, "linewidths": 0.8} | flag_scale(codes)
    sheet.axes[0, 0].scatter(dataset[horizontal], dataset[vertical], c=codes, **look)
    sheet.add(*flag_entries(codes))
    sheet.label(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    return sheet.finish(dataset)


def _small_multiples(dataset: xr.Dataset, fields: Sequence[str]) -> Figure:
    """Maps over the speed and the longest other axis; columns and rows for the values of further axes.

    Of an axis with many values the first, middle and last are shown; with two further axes only the first of ``fields``
    that varies.
    """
    # Flags that are the same everywhere say less than how far from a boundary the points are.
    same = [key for key in fields if flags(dataset[key]) and not np.ptp(valid(dataset, key).values)]
    same = same if len(same) < len(fields) else []
    fields = [key for key in fields if key not in same]
    codes = [valid(dataset, key) for key in same]
    notes = [f"{flag_words(code)[int(code.values.flat[0])]} at every point" for code in codes]
    names = sweep_axes(dataset)
    long = [name for name in names if dataset.sizes[name] > _FEW_MAPS]
    horizontal = horizontal_first(dataset, long if len(long) > 1 else names)[0]
    vertical = max((name for name in names if name != horizontal), key=lambda name: dataset.sizes[name])
    further = [name for name in names if name not in (horizontal, vertical)]
    # Only the first row has labels of the resonances, so an axis that changes their positions runs across.
    dependent = dataset.coords.get(f"resonance_{horizontal}", xr.DataArray(0)).dims
    further.sort(key=lambda name: name not in dependent)
    total = math.prod(dataset.sizes[name] for name in further)
    dataset = dataset.isel({name: dataset.sizes[name] // 2 for name in further[2:]})
    across, down = (_slices(dataset, name) for name in [*further, "", ""][:2])
    parts = [[part.isel(column) for column in across] for part in (dataset.isel(row) for row in down)]
    if len(further) > 1:
        varied = next((key for key in fields if np.ptp(valid(dataset, key).values) != 0), fields[-1])
        rows = [(varied, row) for row in parts]
    else:
        rows = [row for key in fields for row in split(parts[0], key)]
    titled = [*further[:2], *dict.fromkeys(own_dimension(dataset, key) for key in fields)]
    # At most a page.
    height = 1.8 if len(parts) > 1 else min(2.5, max(_LOWEST, _PAGE / len(rows)))
    sheet = maps(rows, (horizontal, vertical), height=height, titled=titled)
    drawn = len(across) * len(down)
    return sheet.finish(dataset, ", ".join(notes + [f"{drawn} of {total} charts shown"] * (drawn < total)))


def _slices(dataset: xr.Dataset, name: str) -> list[dict[str, int]]:
    """The places of an axis that are shown: all of few, else the first, middle and last."""
    size = dataset.sizes.get(name, 0)
    return [{name: k} for k in (range(size) if size <= _FEW_MAPS else (0, size // 2, size - 1))] or [{}]


def maps(
    rows: Sequence[tuple[str, Sequence[xr.Dataset]]],
    names: Sequence[str],
    *,
    height: float = 2.5,
    titled: Sequence[str] = (),
) -> Sheet:
    """A sheet of maps over the axes ``names`` (horizontal, vertical): in each row one variable of several parts of a result.

    A variable has one colour scale in all panels; spectral radii become growth. Boundaries, tips, predicted resonances and
    thresholds are drawn over the panels, if stored. Titles give the coordinates ``titled`` of each part.
    """
    sheet = Sheet(len(rows), len(rows[0][1]), height=height)
    fields = [[_mapped(part, name) for part in parts] for name, parts in rows]
    alike = {name: [k for k, (other, _) in enumerate(rows) if other == name] for name, _ in rows}
    scales: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
    for name, numbers in alike.items():
        values = np.concatenate([field.values.ravel() for k in numbers for field in fields[k]])
        whole = xr.DataArray(values, attrs=fields[numbers[0]][0].attrs)
        scales[name] = colours(whole, _signed(rows[0][1][0], name, whole))
        sheet.add(*(flag_entries(whole) if flags(whole) else ()))
    single, meshes = sheet.axes.size == len(rows), {}
    named = any(flags(row[0]) for row in fields)
    titles = [[_title(part, titled) for part in parts] for _, parts in rows]
    for k, (row, (name, parts)) in enumerate(zip(fields, rows, strict=True)):
        options = scales[name][0]
        for j, (axes, field, part) in enumerate(zip(sheet.axes[k], row, parts, strict=True)):
            flagged = bool(flags(field))
            shown = field if flagged else field.clip(options["norm"].vmin, options["norm"].vmax)
            mesh = draw_cells(axes, shown, *names, **options)
            if not flagged:
                meshes[name] = mesh
                # The entries of a variable with flags count the same points.
                sheet.add(*(() if named else flag_entries(computed(part))))
            if name == "verdict" or _is_radius(name):
                sheet.add(*overlays.draw_boundaries(axes, part, *names))
                if single and k == 0:
                    sheet.add(*overlays.draw_tips(axes, part, *names))
                    sheet.later(partial(overlays.name_tips, axes, part, *names))
            # Not over other variables, so that narrow tongues stay visible there.
            lines = overlays.predictions(part, *names) if name == rows[0][0] else []
            sheet.add(*overlays.draw_predictions(axes, lines, below=flagged))
            if k == 0:
                labelled = lines if single else [line for line in lines if line.order == 1]
                sheet.later(partial(overlays.label_predictions, axes, labelled))
            if k == 0 or titles[k] != titles[k - 1]:
                axes.set_title(titles[k][j], pad=24 if k == 0 and lines else 4)
            sheet.add(*_draw_threshold(axes, part, *names))
    # Below the last rows, so that rows of flags without a colour bar keep the whole width.
    for name, mesh in meshes.items():
        below = len(meshes) < len(alike) and name == list(alike)[-1]
        label = variable_label(fields[alike[name][0]][0])
        sheet.colorbar(alike[name], mesh, label, scales[name][1], below=below)
    part = rows[0][1][0]
    if not single and not is_logarithmic(part[names[0]].values):
        # No tick at the right end, clear of the next panel.
        sheet.axes[0, 0].xaxis.set_major_locator(MaxNLocator(4, prune="upper"))
    sheet.label(axis_label(part[names[0]]), axis_label(part[names[1]]))
    return sheet


def _signed(part: xr.Dataset, name: str, field: xr.DataArray) -> Growth | None:
    """The scale of a variable whose sign says whether disturbances grow; None for any other."""
    if _is_radius(name):
        return growth_of(part)
    largest = np.nanmax(np.abs(field.values), initial=0.0)
    if name not in _EXPONENTS or not largest:
        return None
    end = 10.0 ** np.ceil(np.log10(largest))
    return Growth(1.0, variable_label(part[name]), _SMALL * end, end)


def _mapped(part: xr.Dataset, name: str) -> xr.DataArray:
    """The values that a map of a variable shows: growth for a spectral radius."""
    if not _is_radius(name):
        return valid(part, name)
    growth = growth_of(part)
    return growth.from_radius(valid(part, name)).assign_attrs(long_name=growth.label, units="1")


def own_dimension(dataset: xr.Dataset, name: str) -> str:
    """The dimension of a variable that is no swept axis, or an empty string."""
    return next((str(dim) for dim in dataset[name].dims if dim not in dataset["outcome"].dims), "")


def split(parts: Sequence[xr.Dataset], name: str) -> list[tuple[str, list[xr.Dataset]]]:
    """Rows of :func:`maps` for every entry of the variable's own dimension; without labels for the first, the largest."""
    inner = own_dimension(parts[0], name)
    entries = range(parts[0].sizes[inner] if inner in parts[0].coords else 1) if inner else ()
    numbered = [part.assign_coords({inner: range(part.sizes[inner])} | dict(part.coords)) for part in parts if inner]
    return [(name, [part.isel({inner: k}) for part in numbered]) for k in entries] or [(name, list(parts))]


def _title(part: xr.Dataset, names: Sequence[str]) -> str:
    """``symbol = value units`` of parameters, ``driving shaft`` or ``mode 1`` of entries of another dimension."""

    def text(c: xr.DataArray) -> str:
        return coordinate_text(c) if c.dtype.kind == "f" else entry_name(str(c.name).replace("_", " "), c.item())

    return ", ".join(text(part[name]) for name in names if name in part.coords and not part[name].ndim)


def _draw_threshold(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Line2D]:
    """Draw a predicted limit that is stored as a curve over the horizontal axis."""
    name = f"resonance_{vertical}"
    if name not in dataset.coords or horizontal not in dataset[name].dims:
        return []
    limits, entries = (axes.get_xlim(), axes.get_ylim()), []
    for line in dataset[name].transpose("resonance", horizontal):
        axes.plot(dataset[horizontal], line, color="#ffffff", linewidth=2.6)
        label = str(line["resonance"].item())
        entries += axes.plot(dataset[horizontal], line, color=PREDICTION, linewidth=1.3, label=label)
    axes.set(xlim=limits[0], ylim=limits[1])
    return entries


def stack(dataset: xr.Dataset, along: str, panels: Sequence[Sequence[str]], **look: Any) -> Sheet:
    """A sheet of panels below each other over the axis ``along``, each with the variables of one entry of ``panels``.

    Flags (verdict, regime, failed and pending points) are bands behind the lines. ``look`` goes to :func:`draw_lines`.
    """
    sheet = Sheet(len(panels), height=max(1.7, 3.0 / len(panels) ** 0.5), sharey=False)
    drawn = list(zip(sheet.axes[:, 0], panels, strict=True))
    labels = [draw_lines(sheet, axes, dataset, along, keys, **look) for axes, keys in drawn]
    sheet.label(axis_label(dataset[along]), *labels)
    sheet.add(*(entry for axes, keys in drawn if "u_max" in keys for entry in draw_flanks(dataset, axes)))
    fit_panels(sheet, dataset, along)
    if along in dataset["outcome"].dims:
        codes = valid(dataset, name) if (name := _flagged(dataset)) else computed(dataset)
        for (axes,) in sheet.axes if codes.ndim == 1 and codes.any() else ():
            sheet.add(*draw_flags(axes, codes, along))
        # Those of an atlas, which may be narrower than a cell.
        exact = dataset[f"unstable_{along}"].values if f"unstable_{along}" in dataset.coords else np.empty((0, 2))
        for (axes,), (low, high) in product(sheet.axes, exact):
            k = flags(codes).index("unstable")
            look = {"color": flag_scale(codes, _PALE)["cmap"].colors[k], "linewidth": 2.0, "zorder": -1.5}
            span = axes.axvspan(low, high, **look, label="unstable")
            sheet.add(*(() if (codes == k).any() else (span,)))
        if name and codes.ndim == 1:
            above = 24 if overlays.predictions(dataset, along) else 4
            unstable = unstable_text(dataset, along)
            sheet.axes[0, 0].set_title(_sentence(codes, dataset[along], unstable), loc="left", pad=above)
    return sheet


def _sentence(codes: xr.DataArray, axis: xr.DataArray, exact: str) -> str:
    """The values of ``axis`` at which flags of :func:`valid` other than the most frequent one occur; ``exact`` says the
    unstable ranges, if they are known."""
    names = flag_words(codes)
    counts = np.bincount(codes.values.astype(int), minlength=len(names))
    most = int(counts.argmax())
    words = [exact] if exact else []
    shown = [k for k, n in enumerate(names) if counts[k] and k != most and not (words and n in ("stable", "unstable"))]
    words += [f"{names[k]} at {ranges_text(axis, codes.values == k)}" for k in shown]
    text = "; ".join(words) or (f"{names[most]} at every point" if counts[most] == codes.size else "")
    # The sentence begins at the axes, not at the edge of the figure.
    return textwrap.fill(f"{text[:1].upper()}{text[1:]}." if text else "", LETTERS - 15)


def fit_panels(sheet: Sheet, dataset: xr.Dataset, along: str) -> None:
    """Fit the horizontal axes to the values of ``along``, and draw its predicted resonances."""
    fit_axis(sheet.axes[0, 0], "x", dataset[along].values)
    lines = overlays.predictions(dataset, along)
    for (axes,) in sheet.axes:
        sheet.add(*overlays.draw_predictions(axes, lines))
    sheet.later(partial(overlays.label_predictions, sheet.axes[0, 0], lines))


def draw_lines(
    sheet: Sheet,
    axes: Axes,
    dataset: xr.Dataset,
    along: str,
    keys: Sequence[str],
    *,
    logarithmic: Sequence[str] = (),
    colours: Sequence[Any] = LINE_COLOURS,
    named: bool = True,
    dots: bool = False,
    wider: bool = False,
) -> str:
    """Draw variables over the axis ``along``, a line for each entry of a variable's own dimension; returns the label.

    A spectral radius becomes growth, or its distance from 1, on a logarithmic scale on both sides of the limit of
    stability. Stored errors become bands. A scale is ``logarithmic`` for the keys named, if there are positive values.
    Unless ``named``, the lines are not in the legend. ``dots`` stand for lines that jump between branches. Each line
    is ``wider`` than the next where some are equal.
    """
    titles = [str(dataset[key].attrs.get("long_name", key)).replace(",", "").split() for key in keys]
    x, common = dataset[along].values, [word for word in titles[0] if all(word in title for title in titles)]
    style: dict[str, Any] = {"marker": "o", "markersize": 2.5} if dots or len(x) < _FEW else {}
    style |= {"linestyle": ""} if dots else {}
    label = ""
    for number, key in enumerate(keys):
        known = valid(dataset, key)
        values, label = _scaled(dataset, key, known)
        bound, factor, name = _BANDS.get(key, (f"{key}_error", 1.0, "error bound"))
        if _is_radius(key):
            # Logarithmic on both sides of the limit 0, linear below the smallest values: 1 - 1e-5 differs from 1.
            distance = np.abs(values.values[np.isfinite(values.values) & (values.values != 0)])
            linear = 10.0 ** np.floor(np.log10(max(np.quantile(distance, 0.1), _ROUNDING))) if distance.size else 1.0
            axes.set_yscale("symlog", linthresh=linear)
        inner = next((str(dim) for dim in values.dims if dim != along), None)
        words = " ".join(word for word in titles[number] if word not in common) if len(keys) > 1 else ""
        if inner and words and named:
            dashes: Any = _DASHES[number]
            sheet.add(Line2D([], [], color=FRAME_GREY, linestyle=dashes, label=words))
        for k in range(values.sizes[inner] if inner else 1):
            line = values.isel({inner: k}) if inner else values
            name_of_line = entry_name(inner, line[inner].item() if inner in line.coords else k) if inner else words
            colour = colours[(k if inner else number) % len(colours)]
            look: dict[str, Any] = {"color": colour, "label": name_of_line}
            look |= {"linestyle": _DASHES[number if inner else 0]} | style
            look |= {"linewidth": 0.9 + 0.6 * (values.sizes[inner] - 1 - k)} if wider and inner else {}
            drawn = axes.plot(x, line, **look)
            # The dashes of further variables have an entry of their own.
            sheet.add(*(drawn if name_of_line and named and not (inner and number) else ()))
            if bound in dataset:
                ends = [_scaled(dataset, key, known + side * factor * dataset[bound])[0] for side in (-1, 1)]
                low, high = (end.isel({inner: k}) if inner else end for end in ends)
                band = {"color": look["color"], "alpha": 0.25, "linewidth": 0, "label": name}
                filled, _ = axes.fill_between(x, low, high, **band), axes.get_ylim()
                below, above = (axes.transData.transform(np.stack([x, end], axis=-1))[:, 1] for end in (low, high))
                # A band that nobody sees has no entry.
                sheet.add(*[filled][: int(np.max(above - below, initial=0.0, where=np.isfinite(above - below)) > 1)])
        if key in _SUMMED:
            total = values.sum(inner, skipna=False)
            dashed: dict[str, Any] = {"color": FRAME_GREY, "linestyle": "--"}
            # A sum that does not change would take half of the panel.
            if np.ptp(total.values) <= _CONSTANT * np.abs(total.values).max():
                sheet.add(Line2D([], [], **dashed, label=f"sum {total.values.mean():.4g} throughout"))
            else:
                sheet.add(*axes.plot(x, total, **dashed, label="sum"))
        if _is_radius(key) or key.startswith("lyapunov"):
            sheet.add(axes.axhline(0, label="limit of stability", **LIMIT))
        if dataset[key].dtype.kind in "iu":
            axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    shown = [dataset[key].values for key in keys if key in logarithmic]
    if any((np.isfinite(values) & (values > 0)).any() for values in shown):
        axes.set_yscale("log")
        plain_decades(axes, "y")
    elif axes.get_yscale() == "linear":
        widen(axes, "y", _LEAST_RANGE)
    return label if len(keys) == 1 else f"{' '.join(common)}{in_brackets(units_of(dataset[keys[0]]))}"


def _scaled(dataset: xr.Dataset, name: str, values: xr.DataArray) -> tuple[xr.DataArray, str]:
    """The values that a panel shows, and their label: a spectral radius as growth per second, or as its excess over 1."""
    growth, label = growth_of(dataset), variable_label(dataset[name])
    if not _is_radius(name):
        return values, label
    timed = growth.label.endswith("[1/s]")
    return (growth.from_radius(values), growth.label) if timed else (values - 1, f"{label} minus 1")


def half_play(dataset: xr.Dataset) -> float | None:
    """Half the play in the units of the displacement, or None if it is unknown or varies."""
    play = role(dataset, "half_play")
    shown = next((str(v.attrs.get("units", "m")) for n, v in dataset.items() if re.match(r"u(_|$)", str(n))), "m")
    if play in dataset.coords:
        return float(value_in(dataset[play], shown)) if dataset[play].ndim == 0 else None
    entry = json.loads(dataset.attrs.get("fixed_parameters", "{}")).get(play, {})
    return entry["value"] * suitable(entry.get("units", shown), [shown])[0] if "value" in entry else None


def draw_flanks(dataset: xr.Dataset, along: Axes, portrait: Axes | None = None) -> list[Line2D]:
    """Draw both flanks of the play as horizontal lines, and as vertical lines in a phase portrait; returns the legend entry,
    or nothing if the play is unknown."""
    half = half_play(dataset)
    if half is None:
        return []
    for axes in (portrait,) if portrait is not None else ():
        for side in (half, -half):
            axes.axvline(side, **LIMIT)
    return [along.axhline(side, label="flanks", **LIMIT) for side in (half, -half)][:1]
