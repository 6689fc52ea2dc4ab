"""Figures of critical speeds: curves along one axis (the critical-speed map), maps over two axes, mode shapes."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import stored_orders
from drivetrain_jax.view import charts, interference
from drivetrain_jax.view.sheet import Sheet, is_logarithmic, plain_decades, write_names
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FRAME_GREY,
    LINE_COLOURS,
    axis_label,
    in_brackets,
    scene_key,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import suitable, unit_of, value_in

_FREQUENCIES = ("critical_speed", "natural_frequency", "angular_frequency")
_MOST_SHAPES, _MOST_MAPS = 6, 4
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
    shown = next((name for name in _FREQUENCIES if name in dataset), None)
    orders = stored_orders(dataset.attrs)
    if shown and not names and orders:
        return interference.draw(dataset, orders, [to_hex(c) for c in _colours(dataset.sizes["mode"])], {})
    if shown is None or not names:
        stored = ", ".join(str(name) for name in dataset.data_vars)
        needed = "an axis and one of " + ", ".join(_FREQUENCIES) if names else "mode_shape, or an axis"
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
    sheet = charts.stack(dataset.assign({shown: speeds}), name, [[shown]], height=3.4, colours=colours, named=False)
    axes = sheet.axes[0, 0]
    axes.set_xlim(x[0], x[-1])
    axes.set(yscale="log") if logarithmic else axes.set_ylim(bottom=0.0)
    present = [np.flatnonzero(np.isfinite(curve)) for curve in drawn]
    kept = [k for k, places in enumerate(present) if places.size]
    ends = np.array([(x[present[k][-1]], drawn[k, present[k][-1]]) for k in kept]).reshape(-1, 2)
    modes = [f"mode {mode}" for mode in dataset["mode"].values[kept]]
    sheet.later(lambda: write_names(axes, ends, modes, colours=colours[kept]))
    if shown == "critical_speed":
        _draw_orders(sheet, axes, dataset, x, drawn)
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
        style: dict[str, Any] = {"linestyle": "none", "marker": "x", "color": FAILED_COLOUR, "markersize": 5}
        for row, curve in zip(doubtful, drawn, strict=True):
            sheet.add(
                *(axes.plot(x[row], curve[row], **style, label="not certified by the count") if row.any() else ())
            )
    # Other parameters of a list of points that equal the first.
    equal = [str(c.name) for c in dataset.coords.values() if c.dims == (name,) and c.name not in (name, "point")]
    equal = [other for other in equal if np.array_equal(dataset[other].values, x)]
    sheet.label(" = ".join([axis_label(dataset[name]), *equal]), variable_label(dataset[shown]))
    return sheet.finish(dataset)


def _draw_orders(sheet: Sheet, axes: Axes, dataset: xr.Dataset, x: np.ndarray, speeds: np.ndarray) -> None:
    """Draw the speeds at which higher orders meet the modes of ``speeds`` (modes, points)."""
    orders = stored_orders(dataset.attrs)
    for (label, times), dashes in zip(orders.per_turn.items() if orders else (), _DASHES, strict=False):
        style = {"linestyle": dashes, "linewidth": 1.2 if times == 1 else 0.7}
        if times != 1:
            axes.set_prop_cycle(color=_colours(len(speeds)))
            axes.plot(x, speeds.T / times, **style)
        sheet.add(Line2D([], [], color=FRAME_GREY, label=label, **style))


def _operating(dataset: xr.Dataset, shown: str) -> tuple[float, float] | None:
    """Lowest and highest operating speed in the units of ``shown``, if stored."""
    options = json.loads(dataset.attrs.get("options", "{}"))
    low, high = (options.get(f"operating_{end}", 0.0) for end in ("min", "max"))
    rpm = suitable("rpm", [str(dataset[shown].attrs.get("units", "rpm"))])[0]
    return (low * rpm, high * rpm) if high > 0 else None


def _maps(dataset: xr.Dataset, names: list[str], shown: str) -> Figure:
    charts.require_values(dataset[shown], positive=True)
    names = charts.horizontal_first(dataset, names)
    rows = [row for row in charts.split(dataset, shown) if float(row[1][0][shown].max()) > 0][:_MOST_MAPS]
    sheet = charts.maps(rows, names)
    for (axes,), (_, (part,)) in zip(sheet.axes, rows, strict=True):
        _draw_limits(sheet, axes, part, shown, names)
    return sheet.finish(dataset)


def _draw_limits(sheet: Sheet, axes: Axes, part: xr.Dataset, shown: str, names: list[str]) -> None:
    """Draw lines where an order meets the mode at the lowest or highest operating speed."""
    field, orders = part[shown], getattr(stored_orders(part.attrs), "per_turn", {"": 1.0})
    x, y, heights = field[names[0]], field[names[1]], field.transpose(*reversed(names))
    # A white outline keeps the lines visible on the dark end of the map.
    style = {"linewidth": 1.0, "path_effects": [withStroke(linewidth=2.4, foreground="white")]}
    for (order, times), colour in zip(orders.items(), _ORDER_COLOURS, strict=False):
        limits = zip(("lowest", "highest"), _operating(part, shown) or (), ("dashed", "solid"), strict=False)
        for name, speed, dashes in limits:
            if not float(field.min()) < times * speed < float(field.max()):
                continue
            axes.contour(x, y, heights, [times * speed], colors=colour, linestyles=dashes).set(**style)
            label = f"{name} operating speed" + ("" if times == 1 else f", {order}")
            sheet.add(Line2D([], [], color=colour, linestyle=dashes, label=label, **style))


def _shapes(dataset: xr.Dataset) -> Figure:
    count = min(dataset.sizes["mode"], _MOST_SHAPES)
    sheet = Sheet(count, height=1.4)
    shaft = _Shaft.of(dataset)
    x = dataset["x"].values * shaft.total
    for (axes,), index, colour in zip(sheet.axes, range(count), _colours(count), strict=True):
        shape = dataset["mode_shape"].isel(mode=index).values
        shaft.draw(axes)
        axes.axhline(0.0, color=FRAME_GREY, linewidth=0.6)
        axes.plot(x, shape, color=colour)
        axes.fill_between(x, shape, color=colour, alpha=0.15, linewidth=0)
        axes.set(xlim=(-0.02 * shaft.total, 1.02 * shaft.total), ylim=(-1.25, 1.25), yticks=(-1.0, 0.0, 1.0))
        axes.set_title(_name(dataset, index), loc="left", pad=3, color=FRAME_GREY, size=8)
    distance = f"distance from A{in_brackets(unit_of(dataset, 'length', 'm')[1])}"
    sheet.label(distance if shaft.edges else variable_label(dataset["x"]), "deflection, largest 1")
    sheet.add(*shaft.legend())
    return sheet.finish(dataset)


class _Shaft(NamedTuple):
    """The shaft behind its mode shapes: ends of the segments (in the unit of the figure), thickness, places of its points.

    Without stored lengths there are no ``edges``, and ``total`` is 1.
    """

    total: float
    edges: list[float]
    thickness: list[float]
    points: dict[str, list[float]]

    @classmethod
    def of(cls, dataset: xr.Dataset) -> _Shaft:
        """The shaft of the fixed parameters of a result, axes of one value among them."""
        given = json.loads(dataset.attrs.get("fixed_parameters", "{}"))
        fixed = {name: x["value"] for name, x in given.items()}
        for coordinate in dataset.coords.values():
            name, _, place = scene_key(coordinate).rstrip("]").partition("[")
            if coordinate.ndim or coordinate.dtype.kind != "f":
                continue
            number = float(value_in(coordinate, given.get(name, {}).get("units", "1")))
            if not place:
                fixed[name] = number
            elif int(place) < len(fixed.get(name, [])):
                fixed[name][int(place)] = number
        if not {"length", "EI"} <= fixed.keys():
            return cls(1.0, [], [], {})
        edges = [0.0, *np.cumsum(unit_of(dataset, "length", "m")[0] * np.array(fixed["length"])).tolist()]

        def ends(name: str, none: float) -> list[float]:
            joints = fixed.get(f"{name}_joint", [])
            joints = joints if isinstance(joints, list) else [joints] * (len(edges) - 2)
            return [fixed.get(f"{name}_A", none), *(joints or [none] * (len(edges) - 2)), fixed.get(f"{name}_D", none)]

        hinges = fixed.get("k_hinge", [])
        hinges = hinges if isinstance(hinges, list) else [hinges] * (len(edges) - 2)
        points = {
            "support": [x for x, k in zip(edges, ends("k", 0.0), strict=True) if k > 0],
            "mass": [x for x, *m in zip(edges, ends("m", 0.0), ends("I", 0.0), strict=True) if max(m) > 0],
            "hinge": [x for x, k in zip(edges[1:-1], hinges, strict=False) if k < math.inf],
        }
        # The stiffness of a round shaft goes with the fourth power of its diameter.
        diameters = np.asarray(fixed["EI"]) ** 0.25
        return cls(edges[-1], edges, (_THICKNESS * diameters / diameters.max()).tolist(), points)

    def draw(self, axes: Axes) -> None:
        """Draw the segments as grey boxes about the axis, and the symbols of the points."""
        for left, right, height in zip(self.edges, self.edges[1:], self.thickness, strict=False):
            box = (left, -height / 2), right - left, height
            axes.add_patch(Rectangle(*box, facecolor=FRAME_GREY, alpha=0.2, edgecolor="none"))
        for name, places in self.points.items():
            level = -0.45 * _THICKNESS - 0.2 if name == "support" else 0.0
            style: dict[str, Any] = {"clip_on": False, "linestyle": "none", "color": FRAME_GREY} | _SYMBOLS[name]
            # An empty line that is not clipped would disturb the layout.
            if places:
                axes.plot(places, [level] * len(places), **style)

    def legend(self) -> list[Artist]:
        """Entries for the symbols that are drawn."""
        drawn = (name for name, places in self.points.items() if places)
        return [Line2D([], [], linestyle="none", color=FRAME_GREY, label=name, **_SYMBOLS[name]) for name in drawn]


def _name(dataset: xr.Dataset, index: int) -> str:
    """``mode 1: critical speed 8371.5 rpm``, with stored quantities only."""
    text = f"mode {dataset['mode'].values[index]}"
    shown = next((name for name in _FREQUENCIES if name in dataset), None)
    if shown is None:
        return text
    field = dataset[shown]
    return f"{text}: {field.attrs.get('long_name', shown)} {field.values[index]:.5g} {units_of(field)}"
