"""Figures of critical speeds: curves along one axis (the critical-speed map), maps over two axes, mode shapes."""

from __future__ import annotations

import json
import math
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import FREQUENCIES, operating_range, stored_orders
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, is_logarithmic, plain_decades, write_names
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FRAME_GREY,
    LINE_COLOURS,
    axis_label,
    in_brackets,
    parameters,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import suitable, unit_of

_MOST_SHAPES, _MOST_MAPS, _CONTOURS = 6, 4, 8
# Line styles and colours of the orders, from the first on.
_DASHES, _ORDER_COLOURS = ("solid", (0, (4, 2))), ("black", LINE_COLOURS[1])
# Ratio to the other frequencies below which a frequency counts as zero; a logarithmic axis cannot show zero.
_NEGLIGIBLE = 1e-9
# Height of the shaft's segment of greatest stiffness, in units of the largest deflection; symbols of its points.
_THICKNESS = 0.3
_SYMBOLS: dict[str, dict[str, Any]] = {
    "support": {"marker": "^", "markersize": 6, "markerfacecolor": "white"},
    "mass": {"marker": "s", "markersize": 5, "markerfacecolor": FRAME_GREY},
    "hinge": {"marker": "o", "markersize": 4, "markerfacecolor": "white"},
}


def plot(dataset: xr.Dataset) -> Figure:
    """Curves of the frequencies of all modes along one axis, maps of the first modes over two axes, or the mode shapes.

    Along a logarithmic axis (support stiffness) both axes are logarithmic: the critical-speed map. A list of points is
    drawn along its first parameter. A single point without shapes is an interference diagram. Uncertified frequencies are
    crossed. Raises :class:`InputError` for more than two axes, and if no variable that can be drawn is stored or has a
    value.
    """
    names = charts.sweep_axes(dataset)
    if not names and "mode_shape" in dataset:
        return _shapes(dataset)
    shown = next((name for name in ("critical_speed", *FREQUENCIES) if name in dataset), None)
    orders = stored_orders(dataset.attrs)
    if shown and not names and orders:
        return charts.interference(dataset, orders, [to_hex(c) for c in _colours(dataset.sizes["mode"])], {})
    if shown is None or not names:
        stored = ", ".join(str(name) for name in dataset.data_vars)
        needed = "an axis and one of " + ", ".join(FREQUENCIES) if names else "mode_shape, or an axis"
        raise InputError(f"outputs = {stored}: nothing to plot; the figure needs {needed}")
    if len(names) == 1:
        dataset = charts.along_points(dataset) if names == ["point"] else dataset
        return _curves(dataset, charts.sweep_axes(dataset)[0], shown)
    if len(names) == 2:
        return _maps(dataset, names, shown)
    raise charts.wrong_axes(dataset, "one or two axes for a figure of critical speeds")


def _colours(count: int) -> np.ndarray:
    # The yellow end of the colour map is too light for lines on white.
    return matplotlib.colormaps["viridis"](np.linspace(0.0, 0.75, count))


def _curves(dataset: xr.Dataset, name: str, shown: str) -> Figure:
    x, y = dataset[name].values, dataset[shown].transpose("mode", name)
    logarithmic = is_logarithmic(x)
    charts.require_values(y, positive=logarithmic)
    speeds = y.where(y > _NEGLIGIBLE * y.max()) if logarithmic else y
    colours, drawn = _colours(len(y)), speeds.values
    sheet = charts.stack(dataset.assign({shown: speeds}), name, [[shown]], colours=colours, named=False)
    axes = sheet.axes[0, 0]
    axes.set_xlim(x[0], x[-1])
    axes.set(yscale="log") if logarithmic else axes.set_ylim(bottom=0.0)
    kept = np.isfinite(drawn).any(axis=1)
    last = len(x) - 1 - np.isfinite(drawn[:, ::-1]).argmax(axis=1)
    ends = np.stack([x[last], drawn[np.arange(len(drawn)), last]], axis=-1)[kept]
    modes = [f"mode {mode}" for mode in dataset["mode"].values[kept]]
    sheet.later(lambda: write_names(axes, ends, modes, colours=colours[kept]))
    orders = stored_orders(dataset.attrs) if shown == "critical_speed" else None
    for (label, times), dashes in zip(orders.per_turn.items() if orders else (), _DASHES, strict=False):
        style = {"linestyle": dashes, "linewidth": 1.2 if times == 1 else 0.7}
        for curve, colour in zip(drawn, colours, strict=True) if times != 1 else ():
            axes.plot(x, curve / times, color=colour, **style)
        sheet.add(Line2D([], [], color=FRAME_GREY, label=label, **style))
    if operating := _operating(dataset, shown):
        # A logarithmic axis has no zero.
        low = operating[0] or min(axes.get_ylim()[0], operating[1] / 10)
        band = {"color": LINE_COLOURS[1], "alpha": 0.2, "zorder": 0, "label": "operating speeds"}
        sheet.add(axes.axhspan(low, operating[1], **band))
    if logarithmic:
        plain_decades(axes, "y")
    axes.grid(color=FRAME_GREY, alpha=0.2, linewidth=0.5)
    if "count_certified" in dataset:
        doubtful = (dataset["count_certified"].transpose("mode", name).values == 0) & np.isfinite(drawn)
        mode, place = np.nonzero(doubtful)
        style: dict[str, Any] = {"color": FAILED_COLOUR, "markersize": 5, "label": "not certified by the count"}
        sheet.add(*(axes.plot(x[place], drawn[mode, place], "x", **style) if mode.size else ()))
    # Other parameters of a list of points that equal the first.
    equal = [str(c.name) for c in dataset.coords.values() if c.dims == (name,) and c.name not in (name, "point")]
    equal = [other for other in equal if np.array_equal(dataset[other].values, x)]
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
    rows = [row for row in charts.split([dataset], shown) if float(row[1][0][shown].max()) > 0][:_MOST_MAPS]
    sheet, orders = charts.maps(rows, names, titled=["mode"]), stored_orders(dataset.attrs)
    # A white outline keeps the lines visible on the dark end of the map.
    style = {"linewidth": 1.0, "path_effects": [withStroke(linewidth=2.4, foreground="white")]}
    for (axes,), (_, (part,)) in zip(sheet.axes, rows, strict=True):
        field = part[shown].transpose(*reversed(names))
        x, y, low, high = field[names[0]], field[names[1]], float(field.min()), float(field.max())
        if min(field.shape) > 1 and low < high:
            lines = axes.contour(x, y, field, _CONTOURS, colors="white", linewidths=0.5)
            axes.clabel(lines, fontsize=6.5, fmt="%g")
        per_turn = orders.per_turn if orders else {"": 1.0}
        for (order, times), colour in zip(per_turn.items(), _ORDER_COLOURS, strict=False):
            limits = zip(("lowest", "highest"), _operating(part, shown) or (), ("dashed", "solid"), strict=False)
            for name, speed, dashes in limits:
                if low < times * speed < high:
                    axes.contour(x, y, field, [times * speed], colors=colour, linestyles=dashes).set(**style)
                    label = f"{name} operating speed" + ("" if times == 1 else f", {order}")
                    sheet.add(Line2D([], [], color=colour, linestyle=dashes, label=label, **style))
    return sheet.finish(dataset)


def _shapes(dataset: xr.Dataset) -> Figure:
    count = min(dataset.sizes["mode"], _MOST_SHAPES)
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
        name = next((name for name in ("critical_speed", *FREQUENCIES) if name in dataset), None)
        text = f"mode {dataset['mode'].values[index]}"
        if name:
            value = f"{dataset[name].values[index]:.5g} {units_of(dataset[name])}"
            text += f": {dataset[name].attrs.get('long_name', name)} {value}"
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


def _draw_shaft(
    sheet: Sheet, axes: Axes, edges: list[float], thickness: list[float], points: dict[str, list[float]]
) -> None:
    """Draw the segments as grey boxes about the axis, and the symbols of the points."""
    for left, right, height in zip(edges, edges[1:], thickness, strict=False):
        box = (left, -height / 2), right - left, height
        axes.add_patch(Rectangle(*box, facecolor=FRAME_GREY, alpha=0.2, edgecolor="none"))
    for name, places in points.items():
        level = -0.45 * _THICKNESS - 0.2 if name == "support" else 0.0
        style: dict[str, Any] = {"clip_on": False, "linestyle": "none", "color": FRAME_GREY, "label": name}
        # An empty line that is not clipped would disturb the layout.
        sheet.add(*(axes.plot(places, [level] * len(places), **style, **_SYMBOLS[name]) if places else ()))
