"""Figures of natural frequencies: curves and maps, interference diagrams, and mode shapes of shafts and planetary gears."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import FREQUENCIES, RIGID_PART, Orders, in_hertz, operating_range, stored_orders
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, fit_axis, is_logarithmic, plain_decades, write_names
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FRAME_GREY,
    LINE_COLOURS,
    axis_label,
    in_brackets,
    parameters,
    suitable,
    unit_of,
    units_of,
    value_in,
    variable_label,
)

# Colours of rigid modes, of the families in their order, and of coupled modes.
_RIGID, _FAMILIES, _COUPLED = "#9a9a9a", ("#16324f", "#d1771e", "#3f8f5f", "#7a4fa0", "#999933"), "#a0308c"
# Gears in a row; most mode shapes of gears and of shafts; most maps, and contours in them.
_COLUMNS, _GEARS, _SHAFTS, _MAPS, _CONTOURS = 4, 16, 6, 4, 8
# Relative difference below which frequencies are one multiple frequency, with one shape drawn.
_SAME = 1e-8
# Relative distances at which neighbours are close, and at which they are two frequencies.
_NEAR, _SPLIT = 0.01, 1e-6
# Range of interference diagrams relative to the outermost crossings, and to the highest operating speed; most modes of which
# all orders have numbers, which stand below the line of the mode.
_SPACE, _BEYOND, _FEW_MODES = 1.12, 1.4, 8
# Width of a number relative to the range of speeds.
_WIDTH = 0.08
_NUMBER: dict[str, Any] = {"inside": True, "va": "top", "path_effects": [withStroke(linewidth=2, foreground="white")]}
# Results that are drawn, the first one that is stored.
_SPEEDS = ("critical_speed", *FREQUENCIES)
# Line styles of the orders, and their colours in maps.
_DASHES: tuple[Any, ...] = ("solid", "dashed", "dotted", "dashdot", (0, (9, 2)), (0, (6, 2, 1, 2, 1, 2)), (0, (1, 4)))
_ORDER_COLOURS = "black", LINE_COLOURS[1]
# Colours of backward, planar and forward whirl.
_SENSES = ("#16324f", "#9a9a9a", "#d1771e")
# Height of a Campbell diagram relative to the highest frequency.
_TOP = 1.05
_OPERATING: dict[str, Any] = {"color": LINE_COLOURS[1], "alpha": 0.2, "zorder": 0, "label": "operating speeds"}
# Curves and contours where the separation margin is the required one or less.
_REQUIRED: dict[str, Any] = {"color": FAILED_COLOUR, "label": "less than the required separation margin"}
# Height of the shaft's segment of greatest stiffness, in units of the largest deflection; symbols of its points.
_THICKNESS = 0.3
_SYMBOLS: dict[str, dict[str, Any]] = {
    "support": {"marker": "^", "markersize": 6, "markerfacecolor": "white"},
    "mass": {"marker": "s", "markersize": 5, "markerfacecolor": FRAME_GREY},
    "hinge": {"marker": "o", "markersize": 4, "markerfacecolor": "white"},
}
# Radii relative to the radius of the carrier, from the paper's base radii 77.4, 100.3, 275 and 176.8 mm.
_SUN, _PLANET, _RING, _CARRIER = 77.4 / 176.8, 100.3 / 176.8, 275 / 176.8, 1.0
_LARGEST = 0.28
# Largest radius of a planet relative to half the distance of neighbours, so that planets at rest do not touch.
_CLEAR = 0.94
_BODIES = {"ring": "#7a7a7a", "carrier": "#2f7d4f", "sun": "#c8553d", "planet": "#1f4e79"}
_CIRCLE = np.exp(1j * np.linspace(0, 2 * np.pi, 73))
# Marks across the rim of the ring, whose centre is hidden.
_MARKS = np.exp(1j * np.array([1, 5, 9]) * np.pi / 6)[:, None] * [1.0, 1.08]
_SPOKE = np.array([0.0, 1.0])
_REST: dict[str, Any] = {"linewidth": 0.5, "linestyle": (0, (3, 2))}


def modes(dataset: xr.Dataset) -> Figure:
    """Frequencies over one axis, coloured by the type of the mode, or the mode shapes of a single point.

    A single point without shapes is an interference diagram, if the numbers of teeth are known.
    Curves follow the stored ``branch``, so colours do not change where frequencies cross or veer; without it they follow
    the order of the frequencies. Zero frequencies are not visible on the logarithmic scale.
    """
    names = charts.sweep_axes(dataset)
    if len(names) > 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis for a figure of frequencies, or none for mode shapes")
    charts.require(dataset, "natural_frequency")
    if names:
        return _types_over(dataset, names[0])
    orders = stored_orders(dataset.attrs)
    if "mode_shape" in dataset or not orders:
        return _gears(dataset)
    types, colours = _types(dataset, dominant=True).tolist(), type_colours(dataset)
    kinds = {kind: colour for kind, colour in colours.items() if kind in types and kind != "rigid"}
    return _interference(dataset, orders, [colours[kind] for kind in types], kinds if "mode_type" in dataset else {})


def type_colours(dataset: xr.Dataset) -> dict[str, str]:
    """Colour of every type of modes by name."""
    if "mode_type" not in dataset:
        return {"coupled": _COUPLED}
    rigid, *families, coupled = charts.flags(dataset["mode_type"])
    return {rigid: _RIGID, **dict(zip(families, cycle(_FAMILIES), strict=False)), coupled: _COUPLED}


def _types(dataset: xr.Dataset, dominant: bool = False) -> np.ndarray:
    """Type of every mode by name, or with ``dominant`` the dominant family of a coupled mode, if stored.

    All modes are coupled if the variable is missing.
    """
    if "mode_type" not in dataset:
        return np.full(dataset["natural_frequency"].shape, "coupled")
    types = np.array(charts.flags(dataset["mode_type"]))[dataset["mode_type"].values]
    if not (dominant and "dominant_family" in dataset):
        return types
    families = np.array(charts.flags(dataset["dominant_family"]))
    return np.where(types == "coupled", families[dataset["dominant_family"].values], types)


def _types_over(dataset: xr.Dataset, name: str) -> Figure:
    charts.require_values(dataset["natural_frequency"], positive=True)
    dataset = dataset.transpose(name, ...)
    x, frequency = dataset[name].values, dataset["natural_frequency"].values
    types, colours = _types(dataset, dominant=True), type_colours(dataset)
    close = _close(frequency)
    sheet = Sheet(1 + bool(close), height=4.4 / (1 + bool(close)), sharey=False)
    axes = sheet.axes[0, 0]
    moving = np.where(frequency > RIGID_PART * np.nanmax(frequency), frequency, np.nan)
    order = np.argsort(dataset["branch"].values if "branch" in dataset else frequency, axis=1, kind="stable")
    branches, kinds = (np.take_along_axis(array, order, axis=1) for array in (moving, types))
    _draw_coloured(axes, x, branches, np.vectorize(colours.get)(kinds))
    axes.set(yscale="log", ylim=(0.93 * np.nanmin(moving), 1.07 * np.nanmax(moving)))
    plain_decades(axes, "y")
    labels = [variable_label(dataset["natural_frequency"])]
    if close:
        _draw_distances(sheet, sheet.axes[1, 0], x, frequency, close)
        units = in_brackets(units_of(dataset["natural_frequency"]))
        labels.append(f"distance of close modes (numbers at the right){units}")
    fit_axis(axes, "x", x)
    _draw_missing(sheet, dataset, name)
    sheet.label(axis_label(dataset[name]), *labels)
    shown = [kind for kind in colours if (types[np.isfinite(moving)] == kind).any() and "mode_type" in dataset]
    sheet.add(*(Line2D([], [], color=colours[kind], label=kind) for kind in shown))
    mixed = "coupled" in _types(dataset) and "coupled" not in types
    return sheet.finish(dataset, "coupled modes in the colour of their dominant family" if mixed else "")


def _draw_missing(sheet: Sheet, dataset: xr.Dataset, name: str) -> None:
    """Draw points without a value, failed or pending, as bands along the axis ``name``."""
    codes = charts.computed(dataset)
    for (axes,) in sheet.axes if codes.any() else ():
        sheet.add(*charts.draw_flags(axes, codes, name))


def _draw_coloured(axes: Axes, x: np.ndarray, curves: np.ndarray, colours: np.ndarray) -> None:
    """Draw ``curves`` (points, n) whose pieces have the colour of their end; snapping to whole pixels would make steps."""
    for curve, look in zip(curves.T, colours.T, strict=True):
        points = np.stack([x, curve], axis=-1)
        style: dict[str, Any] = {"colors": look[1:].tolist(), "linewidths": 1.1, "capstyle": "round", "snap": False}
        if np.isfinite(curve).any():
            axes.add_collection(LineCollection([*np.stack([points[:-1], points[1:]], axis=1)], **style))


def _ends(x: np.ndarray, curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the last finite points of ``curves`` (points, n), and these points (n, 2)."""
    last = len(x) - 1 - np.isfinite(curves[::-1]).argmax(axis=0)
    return last, np.stack([x[last], curves[last, np.arange(curves.shape[1])]], axis=-1)


def _close(frequency: np.ndarray) -> list[int]:
    """Lower modes of neighbours that come closer than 1 % somewhere, and are not one multiple frequency everywhere."""
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.diff(frequency, axis=1) / frequency[:, 1:]
    near = (np.nanmin(apart, axis=0, initial=np.inf) < _NEAR) & (np.nanmax(apart, axis=0, initial=0.0) > _SPLIT)
    return np.flatnonzero(near & (np.nanmin(frequency, axis=0)[:-1] > 0)).tolist()


def _draw_distances(sheet: Sheet, axes: Axes, x: np.ndarray, frequency: np.ndarray, close: list[int]) -> None:
    """Draw the distances of neighbours: the splits and veerings that the axis of the frequencies cannot show."""
    colours, ends = _colours(len(close)), []
    for colour, mode in zip(colours, close, strict=True):
        distance = frequency[:, mode + 1] - frequency[:, mode]
        distance = np.where(distance > _SPLIT * frequency[:, mode + 1], distance, np.nan)
        axes.plot(x, distance, color=colour, label=f"modes {mode + 1} and {mode + 2}")
        ends.append((x[-1], distance[-1]))
    axes.set_yscale("log")
    plain_decades(axes, "y")
    names = [f"{mode + 1}/{mode + 2}" for mode in close]
    sheet.later(partial(write_names, axes, ends, names, colours=colours))


def _colours(count: int) -> np.ndarray:
    # The yellow end of the colour map is too light for lines on white.
    return matplotlib.colormaps["viridis"](np.linspace(0.0, 0.75, count))


def _gears(dataset: xr.Dataset) -> Figure:
    charts.require(dataset, "mode_shape")
    name, units = charts.role(dataset, "planets"), units_of(dataset["natural_frequency"])
    angles, types, colours = parameters(dataset).get(name), _types(dataset), type_colours(dataset)
    families, frequency = _types(dataset, dominant=True), dataset["natural_frequency"].values
    if angles is None:
        raise InputError(f"{name or 'planets'}: missing; the figure of mode shapes needs the angles of planets")
    if not np.isfinite(frequency).all():
        raise InputError("natural_frequency = nan: nothing to plot; the point has no result")
    starts = np.flatnonzero(np.append(True, np.diff(frequency) > _SAME * frequency[1:]))
    counts = np.diff(np.append(starts, frequency.size))
    drawn, left_out = list(zip(starts, counts, strict=True))[:_GEARS], max(starts.size - _GEARS, 0)
    digits = 1 if units == "Hz" or frequency.max() > 1e3 else 4
    shares = {"dominant_family", "dominant_share"} <= set(dataset)
    sheet = Sheet(-(-len(drawn) // _COLUMNS), _COLUMNS, height=1.95)
    for axes in sheet.axes.flat:
        axes.axis("off")
    for axes, (mode, count) in zip(sheet.axes.flat, drawn, strict=False):
        shape = dataset["mode_shape"].transpose("mode", "dof").values[mode]
        _draw_gear(axes, dict(zip(dataset["dof"].values, shape, strict=True)), [float(angle) for angle in angles])
        multiple, family = f" ×{count}" if count > 1 else "", str(families[mode])
        named = f", {types[mode]}"
        if types[mode] == "coupled" and shares:
            # Truncated and not rounded to 100 %.
            share = np.floor(1e4 * float(dataset["dominant_share"].values[mode])) / 100
            named = f"\n{share:.2f} % {family}"
        title = f"{frequency[mode]:.{digits}f} {units}{multiple}{named}"
        axes.set_title(title, size=8, color=colours[family], pad=1.5)
    sheet.add(*(Line2D([], [], color=colour, label=body) for body, colour in _BODIES.items()))
    sheet.add(Line2D([], [], color=FRAME_GREY, **_REST, label="at rest"))
    return sheet.finish(dataset, f"{left_out} higher frequencies not drawn" if left_out else "")


def displacements(shape: Mapping[str, float], planets: int) -> tuple[np.ndarray, np.ndarray]:
    """``[x, y, u]`` of carrier, ring and sun (3, 3) and ``[xi, eta, u]`` of the planets (N, 3) of one mode shape.

    The largest translation or rim movement is scaled to 0.28 of the carrier's radius. Bodies without translations stay in
    place, and the centres of the planets move with the carrier.
    """
    central = [[shape.get(f"x_{body}", 0.0), shape.get(f"y_{body}", 0.0), shape[f"u_{body}"]] for body in "crs"]
    numbers = range(1, planets + 1)
    moved = [[shape.get(f"xi_{i}", 0.0), shape.get(f"eta_{i}", shape["u_c"]), shape[f"u_{i}"]] for i in numbers]
    scale = _LARGEST / max(np.abs(central).max(), np.abs(moved).max(), 1e-300)
    return scale * np.array(central), scale * np.array(moved)


def drawn_radii(angles: Sequence[float]) -> tuple[float, float, float]:
    """Radii of sun, planets and ring: the paper's ratio, or smaller planets where neighbours at ``angles`` would overlap."""
    turned = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(np.append(turned, turned[0] + 2 * np.pi))
    planet = min(_PLANET, _CLEAR * _CARRIER * np.sin(min(gaps.min(), np.pi) / 2))
    return (_SUN, _PLANET, _RING) if planet == _PLANET else (_CARRIER - planet, planet, _CARRIER + planet)


def _draw_gear(axes: Axes, shape: Mapping[str, float], angles: Sequence[float]) -> None:
    """Draw the bodies at rest and displaced; marks show the rotation of each. Axes are scaled equally."""
    (carrier, ring, sun), planets = displacements(shape, len(angles))
    sun_radius, planet_radius, ring_radius = drawn_radii(angles)
    spokes = np.exp(1j * np.asarray(angles))
    # Points of the complex plane: the centre at rest, its displacement, the radius of the rim, and lines about the centre.
    bodies = [("ring", 0, ring, ring_radius, [ring_radius * _CIRCLE, *(ring_radius * _MARKS)])]
    bodies += [("carrier", 0, carrier, _CARRIER, [_CARRIER * spoke * _SPOKE for spoke in spokes])]
    bodies += [("sun", 0, sun, sun_radius, [sun_radius * _CIRCLE, sun_radius * _SPOKE])]
    for spoke, (radial, tangential, rotation) in zip(spokes, planets, strict=True):
        local = (radial + 1j * tangential) * spoke
        lines = [planet_radius * _CIRCLE, planet_radius * spoke * _SPOKE]
        bodies.append(("planet", _CARRIER * spoke, (local.real, local.imag, rotation), planet_radius, lines))
    rest, moved, colours = [], [], []
    for name, centre, (x, y, rotation), radius, lines in bodies:
        for line in lines:
            displaced = centre + x + 1j * y + line * np.exp(1j * rotation / radius)
            for drawn, place in ((rest, centre + line), (moved, displaced)):
                drawn.append(np.stack([place.real, place.imag], axis=-1))
            colours.append(_BODIES[name])
    axes.add_collection(LineCollection(rest, colors=FRAME_GREY, **_REST))
    axes.add_collection(LineCollection(moved, colors=colours, linewidths=1.1))
    axes.set(aspect="equal", xlim=(-1.9, 1.9), ylim=(-1.9, 1.9))


def critical_speeds(dataset: xr.Dataset) -> Figure:
    """Curves of the frequencies of all modes along one axis, maps of the first modes over two axes, or the mode shapes.

    Along a logarithmic axis (support stiffness) both axes are logarithmic: the critical-speed map. A list of points is
    drawn along its first parameter. A single point without shapes is an interference diagram. Uncertified frequencies are
    crossed.
    """
    names, orders = charts.sweep_axes(dataset), stored_orders(dataset.attrs)
    if not names and "mode_shape" in dataset:
        return _shafts(dataset)
    shown = next((name for name in _SPEEDS if name in dataset), None)
    if shown is None or not (names or orders):
        stored = ", ".join(str(name) for name in dataset.data_vars)
        needed = "an axis and one of " + ", ".join(FREQUENCIES) if names else "mode_shape, or an axis"
        raise InputError(f"outputs = {stored}: nothing to plot; the figure needs {needed}")
    if orders and not names:
        return _interference(dataset, orders, _colours(dataset.sizes["mode"]), {})
    if len(names) == 1:
        dataset = charts.along_points(dataset) if names == ["point"] else dataset
        return _modes_over(dataset, charts.sweep_axes(dataset)[0], shown)
    if len(names) == 2:
        return _maps(dataset, names, shown)
    raise charts.wrong_axes(dataset, "one or two axes for a figure of critical speeds")


def _modes_over(dataset: xr.Dataset, name: str, shown: str) -> Figure:
    x, y = dataset[name].values, dataset[shown].transpose("mode", name)
    logarithmic = is_logarithmic(x)
    charts.require_values(y, positive=logarithmic)
    speeds = y.where(y > RIGID_PART * y.max()) if logarithmic else y
    colours, drawn = _colours(len(y)), speeds.values
    sheet = charts.stack(dataset.assign({shown: speeds}), name, [[shown]], colours=colours, named=False)
    axes = sheet.axes[0, 0]
    axes.set_xlim(x[0], x[-1])
    axes.set(yscale="log") if logarithmic else axes.set_ylim(bottom=0.0)
    kept = np.isfinite(drawn).any(axis=1)
    modes = [f"mode {mode}" for mode in dataset["mode"].values[kept]]
    sheet.later(partial(write_names, axes, _ends(x, drawn[kept].T)[1], modes, colours=colours[kept]))
    orders = stored_orders(dataset.attrs) if shown == "critical_speed" else None
    for (label, times), dashes in zip(orders.per_turn.items() if orders else (), _DASHES, strict=False):
        style: dict[str, Any] = {"linestyle": dashes, "linewidth": 1.2 if times == 1 else 0.7}
        for curve, colour in zip(drawn, colours, strict=True) if times != 1 else ():
            axes.plot(x, curve / times, color=colour, **style)
        sheet.add(Line2D([], [], color=FRAME_GREY, label=label, **style))
    if operating := _operating(dataset, shown):
        # A logarithmic axis has no zero.
        low = operating[0] or min(axes.get_ylim()[0], operating[1] / 10)
        sheet.add(axes.axhspan(low, operating[1], **_OPERATING))
    if {"separation_margin", "required_margin"} <= set(dataset):
        near = (dataset["separation_margin"] < dataset["required_margin"]).transpose("mode", name).values & (drawn > 0)
        lines = axes.plot(x, np.where(near, drawn, np.nan).T, linewidth=5.0, alpha=0.25, zorder=1, **_REQUIRED)
        sheet.add(*lines[: int(near.any())])
    if logarithmic:
        plain_decades(axes, "y")
    axes.grid(color=FRAME_GREY, alpha=0.2, linewidth=0.5)
    if "count_certified" in dataset:
        mode, place = np.nonzero((dataset["count_certified"].transpose("mode", name).values == 0) & np.isfinite(drawn))
        style = {"color": FAILED_COLOUR, "markersize": 5, "label": "not certified by the count"}
        sheet.add(*(axes.plot(x[place], drawn[mode, place], "x", **style) if mode.size else ()))
    # Other parameters of a list of points that equal the first.
    equal = [c for c in dataset.coords.values() if c.dims == (name,) and c.name not in (name, "point")]
    equal = [str(c.name) for c in equal if np.array_equal(c.values, x)]
    sheet.label(" = ".join([axis_label(dataset[name]), *equal]), variable_label(dataset[shown]))
    return sheet.finish(dataset)


def _operating(dataset: xr.Dataset, shown: str) -> tuple[float, float] | None:
    """Lowest and highest operating speed in the units of ``shown``, if stored."""
    rpm = suitable("rpm", [str(dataset[shown].attrs.get("units", "rpm"))])[0]
    stored = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    return (stored[0] * rpm, stored[1] * rpm) if stored else None


def _maps(dataset: xr.Dataset, names: list[str], shown: str) -> Figure:
    """Maps of the first modes on one scale, with contours and the lines where an order meets the mode at the lowest or
    highest operating speed."""
    charts.require_values(dataset[shown], positive=True)
    names = charts.horizontal_first(dataset, names)
    rows = [row for row in charts.split([dataset], shown) if float(row[1][0][shown].max()) > 0][:_MAPS]
    sheet, orders = charts.maps(rows, names, titled=["mode"]), stored_orders(dataset.attrs)
    # A white outline keeps the lines visible on the dark end of the map.
    style = {"linewidth": 1.0, "path_effects": [withStroke(linewidth=2.4, foreground="white")]}
    for (axes,), (_, (part,)) in zip(sheet.axes, rows, strict=True):
        field = part[shown].transpose(*reversed(names))
        x, y, low, high = field[names[0]], field[names[1]], float(field.min()), float(field.max())
        per_turn, drawn = orders.per_turn if orders else {"": 1.0}, []
        for (order, times), colour in zip(per_turn.items(), _ORDER_COLOURS, strict=False):
            limits = zip(("lowest", "highest"), _operating(part, shown) or (), ("dashed", "solid"), strict=False)
            for name, speed, dashes in limits:
                if low < times * speed < high:
                    drawn.append(times * speed)
                    axes.contour(x, y, field, drawn[-1:], colors=colour, linestyles=dashes, zorder=3).set(**style)
                    label = f"{name} operating speed" + ("" if times == 1 else f", {order}")
                    sheet.add(Line2D([], [], color=colour, linestyle=dashes, label=label, **style))
        if min(field.shape) > 1 and low < high:
            if bool(field.notnull().all()):
                # Smooth shading in place of cells.
                (cells,) = axes.collections[:1]
                axes.pcolormesh(x, y, field, shading="gouraud", cmap=cells.cmap, norm=cells.norm, rasterized=True)
                axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
            levels = [level for level in MaxNLocator(_CONTOURS).tick_values(low, high) if level not in drawn]
            lines = axes.contour(x, y, field, levels, colors="white", linewidths=0.5)
            axes.clabel(lines, fontsize=6.5, fmt="%g")
            if {"separation_margin", "required_margin"} <= set(part):
                gap = (part["separation_margin"] - part["required_margin"]).transpose(*reversed(names))
                look: dict[str, Any] = {"colors": "none", "hatches": ["///"], "zorder": 2}
                axes.contourf(x, y, gap, [-np.inf, 0.0], **look).set(edgecolor=FAILED_COLOUR, linewidth=0.0)
                entry = Rectangle((0, 0), 1, 1, fill=False, hatch="///", edgecolor=FAILED_COLOUR, linewidth=0.0)
                entry.set_label(_REQUIRED["label"])
                sheet.add(*[entry][: int((gap < 0).any())])
    return sheet.finish(dataset)


def _shafts(dataset: xr.Dataset) -> Figure:
    count = min(dataset.sizes["mode"], _SHAFTS)
    sheet = Sheet(count, height=1.4)
    edges, thickness, points = _shaft(dataset)
    x = dataset["x"].values * edges[-1]
    for (axes,), index, colour in zip(sheet.axes, range(count), _colours(count), strict=True):
        shape = dataset["mode_shape"].isel(mode=index).values
        _draw_shaft(sheet, axes, edges, thickness, points)
        axes.axhline(0.0, color=FRAME_GREY, linewidth=0.6)
        axes.plot(x, shape, color=colour)
        axes.fill_between(x, shape, color=colour, alpha=0.15, linewidth=0)
        axes.set(xlim=(-0.02 * edges[-1], 1.02 * edges[-1]), ylim=(-1.25, 1.25), yticks=(-1.0, 0.0, 1.0))
        name = next((name for name in _SPEEDS if name in dataset), None)
        text = f"mode {dataset['mode'].values[index]}"
        if name:
            described = dataset[name].attrs.get("long_name", name)
            text += f": {described} {dataset[name].values[index]:.5g} {units_of(dataset[name])}"
        axes.set_title(text, loc="left", pad=3, color=FRAME_GREY, size=8)
    distance = in_brackets(unit_of(dataset, "length", "m")[1]) if thickness else ", fraction of the length"
    sheet.label(f"distance from A{distance}", "deflection, largest 1")
    return sheet.finish(dataset)


def _shaft(dataset: xr.Dataset) -> tuple[list[float], list[float], dict[str, list[float]]]:
    """Ends of the segments (in the unit of the figure), their thickness, and the places of supports, masses and hinges, from
    the fixed parameters, axes of one value among them; without stored lengths a length of 1 without thickness."""
    fixed = parameters(dataset)
    if not {"length", "EI"} <= fixed.keys():
        return [0.0, 1.0], [], {}
    edges = [0.0, *np.cumsum(unit_of(dataset, "length", "m")[0] * np.array(fixed["length"])).tolist()]
    joints = len(edges) - 2

    def ends(name: str) -> list[float]:
        between = fixed.get(f"{name}_joint", []) or [0.0] * joints
        between = between if isinstance(between, list) else [between] * joints
        return [fixed.get(f"{name}_A", 0.0), *between, fixed.get(f"{name}_D", 0.0)]

    hinges = fixed.get("k_hinge", [])
    hinges = hinges if isinstance(hinges, list) else [hinges] * joints
    points = {
        "support": [x for x, k in zip(edges, ends("k"), strict=True) if k > 0],
        "mass": [x for x, *m in zip(edges, ends("m"), ends("I"), strict=True) if max(m) > 0],
        "hinge": [x for x, k in zip(edges[1:-1], hinges, strict=False) if k < math.inf],
    }
    # The stiffness of a round shaft goes with the fourth power of its diameter.
    diameters = np.asarray(fixed["EI"]) ** 0.25
    return edges, (_THICKNESS * diameters / diameters.max()).tolist(), points


def _draw_shaft(sheet: Sheet, axes: Axes, edges: list[float], thickness: list[float], points: dict[str, Any]) -> None:
    for left, right, height in zip(edges, edges[1:], thickness, strict=False):
        box = (left, -height / 2), right - left, height
        axes.add_patch(Rectangle(*box, facecolor=FRAME_GREY, alpha=0.2, edgecolor="none"))
    for name, places in points.items():
        level = -0.45 * _THICKNESS - 0.2 if name == "support" else 0.0
        style: dict[str, Any] = {"clip_on": False, "linestyle": "none", "color": FRAME_GREY, "label": name}
        # An empty line that is not clipped would disturb the layout.
        sheet.add(*(axes.plot(places, [level] * len(places), **style, **_SYMBOLS[name]) if places else ()))


def whirl(dataset: xr.Dataset) -> Figure | None:
    """Campbell diagram: whirl frequencies over the speed of the shaft, coloured by direction, crossed by the lines of its
    orders; None for other axes.

    Curves follow the modes of each direction where these may cross (isotropic supports), otherwise the number of the mode.
    Crossings have their speeds as numbers; on isotropic supports order 1, the unbalance, excites forward whirl alone.
    """
    if charts.sweep_axes(dataset) != ["speed"]:
        return None
    charts.require(dataset, "whirl_frequency", "whirl_direction")
    charts.require_values(dataset["whirl_frequency"], positive=True)
    dataset, frequency = dataset.sortby("speed").transpose("speed", ...), dataset["whirl_frequency"]
    if (dataset["speed"].attrs.get("units"), frequency.attrs["units"]) == ("rpm", "rad/s"):
        # Who counts turns counts oscillations, too.
        turns = frequency.copy(data=in_hertz(frequency.values, "rad/s")).assign_attrs(units="Hz")
        dataset = dataset.assign(whirl_frequency=turns)
    x, y, codes = (dataset[name].values for name in ("speed", "whirl_frequency", "whirl_direction"))
    y = np.where(np.isfinite(y), y, np.nan)
    isotropic = not any(f"k_{place}_y" in parameters(dataset) for place in ("A", "D", "joint"))
    if isotropic:
        y = np.hstack([np.sort(np.where(codes == code, y, np.nan), axis=1) for code in (0, 2)])
        codes = np.broadcast_to(np.repeat((0, 2), y.shape[1] // 2), y.shape)
    kept = np.isfinite(y).sum(axis=0) > 1
    modes = np.cumsum(kept.reshape(1 + isotropic, -1), axis=1).ravel()[kept]
    y, colours = y[:, kept], np.array(_SENSES)[codes[:, kept]]
    sheet = Sheet(height=4.4)
    axes = sheet.axes[0, 0]
    _draw_coloured(axes, x, y, colours)
    axes.set(xlim=(x[0], x[-1]), ylim=(0, _TOP * np.nanmax(y)))
    last, ends = _ends(x, y)
    look = {"colours": colours[last, np.arange(y.shape[1])].tolist()}
    sheet.later(partial(write_names, axes, ends, [str(mode) for mode in modes], **look))
    for colour, name in zip(_SENSES, charts.flags(dataset["whirl_direction"]), strict=True):
        sheet.add(*([Line2D([], [], color=colour, label=name)] if colour in colours[1:] else []))
    orders, units = stored_orders(dataset.attrs), str(dataset["whirl_frequency"].attrs["units"])
    turned = value_in(dataset["speed"], "rad/s") * suitable("rad/s", [units])[0]
    for (label, times), dashes in zip(orders.per_turn.items() if orders else (), _DASHES, strict=False):
        sheet.add(*axes.plot(x, times * turned, color="black", linewidth=0.9, linestyle=dashes, label=label))
        excited = y[:, colours[0] == _SENSES[2]] if isotropic and times == 1 else y
        met = [point for curve in excited.T for point in _crossings(x, curve, times * turned)]
        axes.plot(*np.reshape(met, (-1, 2)).T, "o", markersize=3.5, color="black", markerfacecolor="white")
        numbers = [f"{float(f'{speed:.4g}'):.10g}" for speed, _ in met]
        sheet.later(partial(write_names, axes, met, numbers, offset=4.0, **_NUMBER))
    _draw_missing(sheet, dataset, "speed")
    frequency = variable_label(dataset["whirl_frequency"])
    sheet.label(axis_label(dataset["speed"]), f"{frequency} (number of the mode at the right)")
    return sheet.finish(dataset)


def _crossings(x: np.ndarray, curve: np.ndarray, line: np.ndarray) -> list[tuple[float, float]]:
    gap = curve - line
    places = np.flatnonzero((gap[:-1] >= 0) != (gap[1:] >= 0))
    shares = [(k, gap[k] / (gap[k] - gap[k + 1])) for k in places if np.isfinite(gap[k : k + 2]).all()]
    return [(x[k] + s * (x[k + 1] - x[k]), curve[k] + s * (curve[k + 1] - curve[k])) for k, s in shares]


def _interference(dataset: xr.Dataset, orders: Orders, colours: Any, kinds: Mapping[str, str]) -> Figure:
    """Interference (Campbell) diagram of one point: natural frequencies over the speed of a shaft, crossed by the lines of
    its orders; ``colours`` of its modes, and the ``kinds`` of colours for the legend.

    Crossings have their speeds as numbers, of many modes only those with the first order. With an operating range only its
    surroundings are shown.
    """
    stored = dataset[next(name for name in FREQUENCIES if name in dataset)]
    charts.require_values(stored, positive=True)
    frequency = in_hertz(stored.values, stored.attrs["units"])
    speeds = orders.speeds(frequency)
    operating = operating_range(json.loads(dataset.attrs.get("options", "{}")))
    high, top = _SPACE * np.nanmax(speeds[:, 0]), frequency.max()
    if operating:
        high = _BEYOND * operating[1]
        reached = max(orders.per_turn.values()) * high / 60
        top = np.max(frequency, initial=0.0, where=frequency <= reached) or reached
    sheet = Sheet(height=4.2)
    axes = sheet.axes[0, 0]
    axes.set(xlim=(0, high), ylim=(0, _SPACE * top))
    shown = np.flatnonzero(np.isfinite(speeds[:, 0]) & (frequency < _SPACE * top))
    axes.hlines(frequency[shown], 0, high, colors=np.array(colours)[shown], linewidth=0.9)
    names = [str(mode) for mode in dataset["mode"].values[shown]]
    ends = np.stack([np.full(shown.size, high), frequency[shown]], axis=-1)
    sheet.later(partial(write_names, axes, ends, names))
    sheet.add(*(Line2D([], [], color=colour, label=kind) for kind, colour in kinds.items()))
    for k, ((label, times), dashes) in enumerate(zip(orders.per_turn.items(), cycle(_DASHES))):
        style = {"color": "black", "linewidth": 0.9, "linestyle": dashes, "label": f"{label} ({times:g}/turn)"}
        sheet.add(*axes.plot([0, high], [0, times * high / 60], **style))
        met = np.stack([speeds[shown, k], frequency[shown]], axis=-1)
        gap, inside = speeds[shown] - met[:, :1], met[:, 0] <= high
        # The number of a crossing stands at its right, where another order may cross the mode.
        crowded = np.any((gap > 0) & (gap < _WIDTH * high), axis=1)
        axes.plot(*met[inside].T, "o", markersize=3.5, color="black", markerfacecolor="white")
        if k == 0 or operating or shown.size <= _FEW_MODES:
            # One number for modes of the same frequency.
            numbers = {f"{speed:.0f}": (speed, height) for speed, height in met[inside & ~crowded]}
            sheet.later(partial(write_names, axes, list(numbers.values()), list(numbers), offset=4.0, **_NUMBER))
    if operating:
        sheet.add(axes.axvspan(*operating, **_OPERATING))
    sheet.label(f"speed of the {orders.shaft} [rpm]", f"{orders.frequency} [Hz] (number of the mode at the right)")
    return sheet.finish(dataset)
