"""The chart maker: lines and maps of the variables of a result, chosen by their dimensions, units and flags."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, LogNorm, Normalize, SymLogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import overlays
from drivetrain_jax.view.sheet import Sheet, cell_edges, fit_axis, is_logarithmic, plain_decades
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FLAG_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    PENDING_COLOUR,
    PREDICTION,
    axis_label,
    in_brackets,
    scene_key,
    symbol,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import size, suitable, value_in, with_prefixes

FAILED, PENDING = "failed", "pending"
LIMIT: dict[str, Any] = {"color": FRAME_GREY, "linewidth": 0.8, "linestyle": (0, (2, 2))}
_NO_PARAMETERS = ("point", PENDING)
# Flags that always have their number of points in the legend, and the most points of which all flags have it.
_ALARMING, _COUNTED = ("undecided", FAILED, PENDING), 1000
# Ratio of the largest to the smallest positive value above which a colour scale is logarithmic.
_WIDE = 3.0
# Line styles of variables that share a panel, and number of points below which lines have markers.
_DASHES, _FEW = ("-", (0, (4, 1.5)), ":"), 12
# Variables with a band of error: the stored error and its factor.
_BANDS = {"lyapunov_spectrum": ("lyapunov_standard_error", 3.0), "basin_fraction": ("basin_error", 1.0)}
# Position between largest decay (-1), none (0) and largest growth (1), and colour; lightness falls monotonically. White is
# reserved for cells without a value.
_GROWTH_COLOURS = (
    (-1.0, "#fbfce0"),
    (-0.5, "#a9dcc3"),
    (0.0, "#86b1d6"),
    (0.12, "#d98e48"),
    (0.5, "#b8432f"),
    (1.0, "#2d0a2b"),
)
# Distance of a spectral radius from 1 that rounding can make.
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
    return InputError(f"axes = {axes}: allowed is {allowed}")


def require(dataset: xr.Dataset, *names: str) -> None:
    """Raise :class:`InputError` unless all of these variables are stored."""
    if missing := [name for name in names if name not in dataset]:
        stored = ", ".join(str(name) for name in dataset.data_vars)
        raise InputError(f"outputs = {stored}: {' and '.join(missing)} missing; the figure needs {' and '.join(names)}")


def require_any(dataset: xr.Dataset, *names: str) -> list[str]:
    """The stored variables among ``names``; raises :class:`InputError` if none is stored."""
    stored = [name for name in names if name in dataset]
    if not stored:
        listed = ", ".join(str(name) for name in dataset.data_vars)
        raise InputError(f"outputs = {listed}: nothing to plot; the figure needs {' or '.join(names)}")
    return stored


def require_values(variable: xr.DataArray, positive: bool = False) -> None:
    """Raise :class:`InputError` unless ``variable`` has a finite value (above zero if ``positive``)."""
    finite = variable.values[np.isfinite(variable.values)]
    largest = finite.max() if finite.size else np.nan
    if not (largest > 0 if positive else finite.size):
        kind = "positive" if positive else "finite"
        raise InputError(f"{variable.name} = {largest:g}: nothing to plot; allowed is a result with a {kind} value")


def role(dataset: xr.Dataset, name: str) -> str:
    """The parameter with the role ``name`` in the system (attribute ``roles``), or an empty string."""
    return json.loads(dataset.attrs.get("roles", "{}")).get(name, "")


def horizontal_first(dataset: xr.Dataset, names: Sequence[str]) -> list[str]:
    """``names`` with the horizontal axis first: one with predicted resonances, else the speed, else the last one."""
    speed = role(dataset, "speed")
    usual = speed if speed in names else names[-1]
    horizontal = next((name for name in names if f"resonance_{name}" in dataset.coords), usual)
    return [horizontal, *(name for name in names if name != horizontal)]


def along_points(dataset: xr.Dataset) -> xr.Dataset:
    """A list of points as a result over the first parameter that varies; raises :class:`InputError` if none does."""
    varying = varying_parameters(dataset)
    if not varying:
        raise InputError("points: all points are the same, there is nothing to plot; give points that differ")
    return dataset.swap_dims(point=varying[0]).sortby(varying[0])


def varying_parameters(dataset: xr.Dataset) -> list[str]:
    """Parameters with several values in a list of points."""
    own = {str(name): c for name, c in dataset.coords.items() if c.dims == ("point",) and name not in _NO_PARAMETERS}
    return [name for name, values in own.items() if np.unique(values).size > 1]


def valid(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """The variable ``name`` without what failed points store: codes above the last flag for failed and pending points, NaN
    in a variable without flags."""
    variable, known = dataset[name], dataset["outcome"] < FIRST_FAILURE
    flags = len(_flags(variable))
    if not flags:
        return variable.where(known)
    variable = variable.where(known, flags)
    return variable.where(~dataset[PENDING], flags + 1) if PENDING in dataset.coords else variable


def _flags(variable: xr.DataArray) -> list[str]:
    return str(variable.attrs.get("flag_meanings", "")).split()


def flag_scale(variable: xr.DataArray) -> dict[str, Any]:
    """The colours of a variable of :func:`valid` with flags."""
    colours = [*(FLAG_COLOURS.get(flag, FRAME_GREY) for flag in _flags(variable)), FAILED_COLOUR, PENDING_COLOUR]
    return {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}


def flag_entries(variable: xr.DataArray) -> list[Patch]:
    """Legend entries of the flags that occur in a variable of :func:`valid`; with their numbers of points, unless these are
    many."""
    names = [*_flags(variable), FAILED, PENDING]
    counts = np.bincount(variable.values.astype(int).ravel(), minlength=len(names))
    colours = flag_scale(variable)["cmap"].colors
    notes = [
        f" ({n})" if variable.size <= _COUNTED or name in _ALARMING else ""
        for name, n in zip(names, counts, strict=True)
    ]
    kinds = zip(names, colours, notes, counts, strict=True)
    return [_patch(name, colour, note) for name, colour, note, n in kinds if n]


def failure_entries(dataset: xr.Dataset) -> list[Patch]:
    """Legend entries of points without a value: failed or pending."""
    waiting = int(dataset[PENDING].sum()) if PENDING in dataset.coords else 0
    counts = {FAILED: (FAILED_COLOUR, int(_failures(dataset).sum())), PENDING: (PENDING_COLOUR, waiting)}
    return [_patch(name, colour, f" ({count})") for name, (colour, count) in counts.items() if count]


def _patch(name: str, colour: str, note: str) -> Patch:
    return Patch(facecolor=colour, edgecolor=FRAME_GREY, linewidth=0.6, label=name.replace("_", " ") + note)


def _failures(dataset: xr.Dataset) -> xr.DataArray:
    """True where a finished point has no value."""
    failed = dataset["outcome"] >= FIRST_FAILURE
    return failed & ~dataset[PENDING] if PENDING in dataset.coords else failed


def draw_failures(axes: Axes, dataset: xr.Dataset, name: str) -> list[Line2D]:
    """Draw crosses at the foot of ``axes`` for failed points along the axis ``name``; returns a legend entry."""
    x = dataset[name].values[_failures(dataset).values]
    if not x.size:
        return []
    style: dict[str, Any] = {"linestyle": "", "marker": "x", "markersize": 3.5, "clip_on": False, "zorder": 5}
    style |= {"color": FAILED_COLOUR, "label": f"{FAILED} ({x.size})", "transform": axes.get_xaxis_transform()}
    return axes.plot(x, np.zeros(x.size), **style)


def draw_cells(axes: Axes, field: xr.DataArray, horizontal: str, vertical: str, **options: Any) -> QuadMesh:
    """Draw ``field`` as cells over the two axes; limits and scales of ``axes`` follow the cells."""
    x, y = (field[name].values.astype(float) for name in (horizontal, vertical))
    field = field.transpose(vertical, horizontal)
    edges = cell_edges(x), cell_edges(y)
    mesh = axes.pcolormesh(*edges, field.values, rasterized=True, **options)
    if PENDING in field.coords and not _flags(field):
        waiting = np.where(field[PENDING].values, 0.0, np.nan)
        axes.pcolormesh(*edges, waiting, cmap=ListedColormap([PENDING_COLOUR]), rasterized=True)
    fit_axis(axes, "x", x)
    fit_axis(axes, "y", y)
    return mesh


def draw_strip(axes: Axes, codes: xr.DataArray, name: str, heights: tuple[float, float], **options: Any) -> list[Patch]:
    """Draw flags of :func:`valid` along the axis ``name`` between two heights, in fractions of the panel; returns their
    legend entries."""
    codes = codes.sortby(name)
    place = {"transform": axes.get_xaxis_transform(), "clip_on": False, "rasterized": True}
    x = cell_edges(codes[name].values.astype(float))
    axes.pcolormesh(x, heights, codes.values[None, :], **flag_scale(codes), **place, **options)
    entries = flag_entries(codes)
    for entry in entries:
        entry.set_alpha(options.get("alpha"))
    return entries


class Growth(NamedTuple):
    """``values = factor ln(spectral radius)`` with their ``label``; colours are linear below ``linear`` and end at
    ``largest``, the same in every figure."""

    factor: xr.DataArray | float
    label: str
    linear: float
    largest: float

    def of(self, radius: xr.DataArray) -> Any:
        """The growth that a spectral radius means; a radius of 0 is infinite decay."""
        with np.errstate(divide="ignore"):
            return np.log(radius) * self.factor


def growth_of(dataset: xr.Dataset) -> Growth:
    """The growth of small disturbances in ``dataset``, in the most useful unit that its parameters allow: per second where
    the speed is known, per turn of the shaft, else per period."""
    periods, speed = dataset.attrs.get("periods_per_turn", 0), role(dataset, "speed")
    axis = dataset.coords.get(speed)
    turns = None if axis is None else size(str(axis.attrs.get("units", "1")), "rps")
    if periods and axis is not None and turns is not None:
        return Growth(axis * turns * periods, "rate of growth [1/s]", 1e-3, 1e2)
    if periods:
        return Growth(float(periods), "growth per turn, ln(factor)", 1e-6, 1e1)
    return Growth(1 / np.log(10), "$\\log_{10}$ of the spectral radius", 1e-6, 1.0)


def _is_radius(name: object) -> bool:
    return str(name).endswith("spectral_radius")


def _draw_growth(axes: Axes, part: xr.Dataset, field: xr.DataArray, names: Sequence[str]) -> tuple[QuadMesh, str, dict]:
    """Draw the growth that the spectral radius ``field`` means; returns label and options of the colour bar."""
    growth = growth_of(part)
    low, high, values = -growth.largest, growth.largest, growth.of(field)
    cmap = LinearSegmentedColormap.from_list("growth", [((1 + x) / 2, colour) for x, colour in _GROWTH_COLOURS], N=1024)
    norm = SymLogNorm(growth.linear, linscale=0.5, vmin=low, vmax=high, base=10)
    below, above = bool((values < low).any()), bool((values > high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    # A radius of 0 is the fastest decay, not a missing value.
    cmap = cmap.with_extremes(bad=FAILED_COLOUR)
    mesh = draw_cells(axes, values.clip(low, high), names[0], names[1], cmap=cmap, norm=norm)
    decades = 10.0 ** np.arange(np.log10(growth.linear) + 1, np.log10(high) + 0.5)
    return mesh, growth.label, {"extend": extend, "ticks": [*-decades[::-1], 0.0, *decades]}


def shades(values: np.ndarray) -> dict[str, Any]:
    """Colours of ``values``, darker for larger; logarithmic for positive values (and zeros) that differ widely."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    logarithmic = low >= 0 and positive.size > 0 and high > _WIDE * positive.min()
    norm = LogNorm(positive.min(), high) if logarithmic else Normalize(low, high)
    return {"cmap": matplotlib.colormaps["cividis_r"].with_extremes(bad=FAILED_COLOUR), "norm": norm}


def maps(
    rows: Sequence[tuple[str, Sequence[xr.Dataset]]],
    names: Sequence[str],
    *,
    height: float = 2.5,
    titles: Sequence[Sequence[str]] = (),
    forced: bool = False,
) -> Sheet:
    """A sheet of maps over the axes ``names`` (horizontal, vertical): in each row one variable of several parts of a result.

    Flags have their colours, spectral radii become growth with the limit of stability, other variables share a colour scale
    in all panels with the same label. Boundaries, tips, predicted resonances (``forced``: those that the forcing excites)
    and thresholds are drawn over the panels, if stored.
    """
    sheet = Sheet(len(rows), len(rows[0][1]), height=height)
    fields = [[valid(part, name) for part in parts] for name, parts in rows]
    labels = [variable_label(row[0]) for row in fields]
    scales: dict[str, dict[str, Any]] = {}
    for label in dict.fromkeys(labels):
        row = [field for row, other in zip(fields, labels, strict=True) if other == label for field in row]
        whole = xr.DataArray(np.concatenate([field.values.ravel() for field in row]), dims="point", attrs=row[0].attrs)
        scales[label] = flag_scale(whole) if _flags(whole) else shades(whole.values)
        sheet.add(*(flag_entries(whole) if _flags(whole) else ()))
    single = sheet.axes.size == len(rows)
    for k, (row, (name, parts), label) in enumerate(zip(fields, rows, labels, strict=True)):
        for j, (axes, field, part) in enumerate(zip(sheet.axes[k], row, parts, strict=True)):
            bar: dict[str, Any] = {}
            if _is_radius(name):
                mesh, label, bar = _draw_growth(axes, part, field, names)
            else:
                mesh = draw_cells(axes, _above(field, scales[label]), names[0], names[1], **scales[label])
            sheet.add(*(() if _flags(field) else failure_entries(part)))
            _draw_limits(sheet, axes, part, name, names, tips=single and k == 0)
            # Not over other variables, so that narrow tongues stay visible there.
            lines = overlays.predictions(part, names[0], names[1], forced) if name == rows[0][0] else []
            sheet.add(*overlays.draw_predictions(axes, lines, below=bool(_flags(field))))
            if k == 0:
                labelled = lines if single else [line for line in lines if line.order == 1]
                if labelled:
                    sheet.later(partial(overlays.label_predictions, axes, labelled))
            if titles and titles[k][j]:
                axes.set_title(titles[k][j], pad=24 if k == 0 and lines else 4)
            sheet.add(*_draw_threshold(axes, part, *names))
        if not _flags(row[0]):
            sheet.colorbar(sheet.axes[k], mesh, label, **bar)
    part = rows[0][1][0]
    if not single and not is_logarithmic(part[names[0]].values):
        # No tick at the right end, clear of the next panel.
        sheet.axes[0, 0].xaxis.set_major_locator(MaxNLocator(4, prune="upper"))
    sheet.label(axis_label(part[names[0]]), axis_label(part[names[1]]))
    return sheet


def split(dataset: xr.Dataset, name: str) -> list[tuple[str, list[xr.Dataset]]]:
    """Rows of :func:`maps` for every entry of the variable's own dimension, which its label names."""
    own = next((str(dim) for dim in dataset[name].dims if dim not in dataset["outcome"].dims), None)
    if own is None:
        return [(name, [dataset])]
    long_name, parts = dataset[name].attrs.get("long_name", name), []
    for k in range(dataset.sizes[own]):
        part = dataset.isel({own: k})
        entry = entry_name(own, part[own].item() if own in part.coords else k)
        parts.append(part.assign({name: part[name].assign_attrs(long_name=f"{entry}: {long_name}")}))
    return [(name, [part]) for part in parts]


def entry_name(dimension: str, entry: object) -> str:
    """``driving shaft`` for a named entry of a dimension, ``shaft 1`` for a numbered one."""
    return f"{entry} {dimension}" if isinstance(entry, str) else f"{dimension} {entry}"


def _above(field: xr.DataArray, scale: Mapping[str, Any]) -> xr.DataArray:
    """``field`` with zeros raised to the lower end of a logarithmic colour scale, where they are lightest."""
    norm = scale.get("norm")
    return field.clip(min=norm.vmin) if isinstance(norm, LogNorm) else field


def _draw_limits(sheet: Sheet, axes: Axes, part: xr.Dataset, name: str, names: Sequence[str], tips: bool) -> None:
    """Draw the traced boundaries, else the limit of stability along the edges of the cells; ``tips`` with their names."""
    if name != "verdict" and not _is_radius(name):
        return
    sheet.add(*overlays.draw_boundaries(axes, part, *names))
    if tips:
        sheet.add(*overlays.draw_tips(axes, part, *names))
        if "tip_proved" in part.coords:
            sheet.later(partial(overlays.name_tips, axes, part, *names))
    radius = "spectral_radius" if name == "verdict" else name
    if radius not in part or overlays.traced(part, *names):
        return
    field = valid(part, radius)
    x, y = (cell_edges(field[axis].values.astype(float)) for axis in names)
    # Without the bound of the error, so that the line surrounds the cells with the verdict unstable.
    excess = (field - part.get(f"{radius}_error", 0.0)).transpose(names[1], names[0]).values
    up, across = np.nonzero(_changes(excess, 1)), np.nonzero(_changes(excess, 0))
    segments = [np.stack([x[up[1] + 1], y[up[0]], x[up[1] + 1], y[up[0] + 1]], axis=-1)]
    segments += [np.stack([x[across[1]], y[across[0] + 1], x[across[1] + 1], y[across[0] + 1]], axis=-1)]
    lines = LineCollection(np.concatenate(segments).reshape(-1, 2, 2), colors=FRAME_GREY, linewidths=0.5)  # pyright: ignore[reportArgumentType]
    axes.add_collection(lines, autolim=False)


def _changes(field: np.ndarray, axis: int) -> np.ndarray:
    """True where one of two neighbours along ``axis`` is unstable and the other is not; False next to a missing value."""
    first, second = np.delete(field, -1, axis), np.delete(field, 0, axis)
    return ((first > 1) != (second > 1)) & np.isfinite(first) & np.isfinite(second)


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


def stack(
    dataset: xr.Dataset,
    along: str,
    panels: Sequence[Sequence[str]],
    *,
    height: float = 2.1,
    forced: bool = False,
    **look: Any,
) -> Sheet:
    """A sheet of panels below each other over the axis ``along``, each with the variables of one entry of ``panels``.

    Failed points are crosses at the foot of the first panel. ``forced`` draws the predicted resonances that the forcing
    excites only. ``look`` goes to :func:`draw_lines`.
    """
    sheet = Sheet(len(panels), height=height, sharey=False)
    labels = [
        draw_lines(sheet, axes, dataset, along, keys, **look) for (axes,), keys in zip(sheet.axes, panels, strict=True)
    ]
    fit_axis(sheet.axes[0, 0], "x", dataset[along].values)
    sheet.label(axis_label(dataset[along]), *labels)
    if along in dataset["outcome"].dims:
        sheet.add(*draw_failures(sheet.axes[0, 0], dataset, along))
    lines = overlays.predictions(dataset, along, forced=forced)
    for (axes,) in sheet.axes:
        sheet.add(*overlays.draw_predictions(axes, lines))
    if lines:
        sheet.later(partial(overlays.label_predictions, sheet.axes[0, 0], lines))
    return sheet


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
    **style: Any,
) -> str:
    """Draw variables over the axis ``along``, a line for each entry of a variable's own dimension; returns the label.

    A spectral radius becomes growth, or its distance from 1, on a logarithmic scale on both sides of the limit of
    stability. Stored errors become bands. A scale is ``logarithmic`` for the keys named, if there are positive values.
    Unless ``named``, the lines are not in the legend. ``style`` goes to :meth:`matplotlib.axes.Axes.plot`.
    """
    x, common = dataset[along].values, _common_words([str(dataset[key].attrs.get("long_name", key)) for key in keys])
    if len(x) < _FEW:
        style = {"marker": "o", "markersize": 3} | style
    label = ""
    for number, key in enumerate(keys):
        values, label, error = _scaled(dataset, valid(dataset, key))
        if _is_radius(key):
            scale_around_limit(axes, values)
        own = next((str(dim) for dim in values.dims if dim != along), None)
        for k in range(values.sizes[own] if own else 1):
            line = values.isel({own: k}) if own else values
            names = [entry_name(own, line[own].item() if own in line.coords else k)] if own else []
            names += [_without(str(dataset[key].attrs.get("long_name", key)), common)] if len(keys) > 1 else []
            look: dict[str, Any] = {"color": colours[(k if own else number) % len(colours)], "label": ", ".join(names)}
            look |= {"linestyle": _DASHES[number if own else 0]} | style
            drawn = axes.plot(x, line, **look)
            sheet.add(*(drawn if names and named else ()))
            if error is not None:
                half = error.isel({own: k}) if own else error
                axes.fill_between(x, line - half, line + half, color=look["color"], alpha=0.25, linewidth=0)
        if _is_radius(key) or key == "lyapunov_exponent":
            sheet.add(axes.axhline(0, label="limit of stability", **LIMIT))
        if dataset[key].dtype.kind in "iu":
            axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    shown = [dataset[key].values for key in keys if key in logarithmic]
    if any((np.isfinite(values) & (values > 0)).any() for values in shown):
        axes.set_yscale("log")
        plain_decades(axes, "y")
    return label if len(keys) == 1 else f"{' '.join(common)}{in_brackets(units_of(dataset[keys[0]]))}"


def _common_words(names: list[str]) -> list[str]:
    """The words that all ``names`` have."""
    return [
        word
        for word in names[0].replace(",", "").split()
        if all(word in name.replace(",", "").split() for name in names)
    ]


def _without(name: str, words: list[str]) -> str:
    return " ".join(word for word in name.replace(",", "").split() if word not in words)


def _scaled(dataset: xr.Dataset, values: xr.DataArray) -> tuple[xr.DataArray, str, xr.DataArray | None]:
    """The values that a panel shows, their label, and half the width of their band of error, if stored.

    A spectral radius is shown as growth per second, or as its excess over 1.
    """
    name, factor = _BANDS.get(str(values.name), (f"{values.name}_error", 1.0))
    label, growth = variable_label(values), growth_of(dataset)
    if _is_radius(values.name) and growth.label.endswith("[1/s]"):
        # The derivative of the logarithm is 1 near the limit of stability.
        values, label, factor = growth.of(values), growth.label, growth.factor
    elif _is_radius(values.name):
        values, label = values - 1, f"{label} minus 1"
    return values, label, dataset[name] * factor if name in dataset else None


def scale_around_limit(axes: Axes, excess: xr.DataArray) -> None:
    """Set a logarithmic scale on both sides of the limit 0: it tells a spectral radius of 1 - 1e-5 from 1."""
    size = np.abs(excess.values[np.isfinite(excess.values) & (excess.values != 0)])
    # Linear below the smallest values.
    linear = 10.0 ** np.floor(np.log10(max(np.quantile(size, 0.1), _ROUNDING))) if size.size else 1.0
    axes.set_yscale("symlog", linthresh=linear)


def draw_sum(sheet: Sheet, axes: Axes, variable: xr.DataArray, along: str) -> None:
    """Draw the sum over the variable's own dimension; a constant one, which may lie far below, only into the legend."""
    total = variable.transpose(along, ...).values.sum(axis=-1)
    constant = np.ptp(total) < 1e-3 * np.abs(total).max()
    text = f"sum {total.mean():.4g}{' ' + units_of(variable) if units_of(variable) != '1' else ''} throughout"
    line = ([], []) if constant else (variable[along], total)
    sheet.add(*axes.plot(*line, color=FRAME_GREY, linestyle="--", label=text if constant else "sum"))


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
