"""Figures of critical speeds: curves along one axis (the critical-speed map), maps over two axes, mode shapes."""

from __future__ import annotations

import json
import math
import textwrap
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib import ticker
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import stored_orders
from drivetrain_jax.view import cells, interference
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STATE_COLOURS,
    STYLE,
    axis_label,
    in_brackets,
    scene_key,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import suitable, unit_of, value_in

_FREQUENCIES = ("critical_speed", "natural_frequency", "angular_frequency")
_HEIGHT, _SHAPE_HEIGHT, _MAP_HEIGHT = 3.4, 1.15, 2.3
_MOST_SHAPES, _MOST_MAPS = 6, 4
# Largest number of letters of a label along one map.
_LETTERS = 32
# Least distance between the names of two curves, in points.
_LABEL_HEIGHT = 8.0
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
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if not names and "mode_shape" in dataset:
            return _shapes(dataset)
        shown = next((name for name in _FREQUENCIES if name in dataset), None)
        orders = stored_orders(dataset.attrs)
        if shown and not names and orders:
            cells.require_values(dataset[shown], positive=True)
            colours = [to_hex(colour) for colour in _colours(dataset.sizes["mode"])]
            return interference.draw(dataset, orders, colours, {})
        if shown is None or not names:
            stored = ", ".join(str(name) for name in dataset.data_vars)
            needed = "an axis and one of " + ", ".join(_FREQUENCIES) if names else "mode_shape, or an axis"
            raise InputError(f"outputs = {stored}: nothing to plot; the figure needs {needed}")
        if len(names) == 1:
            return _curves(dataset, names[0], shown)
        if len(names) == 2:
            return _maps(dataset, names, shown)
        raise InputError(f"axes = {', '.join(names)}: allowed are one or two axes for a figure of critical speeds")


def _colours(count: int) -> np.ndarray:
    # The yellow end of the colour map is too light for lines on white.
    return matplotlib.colormaps["viridis"](np.linspace(0.0, 0.75, count))


def _abscissa(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """The coordinate of the horizontal axis: the axis, or the first parameter of a list of points."""
    if name in dataset.coords and name != "point":
        return dataset[name]
    own = [c for c in dataset.coords.values() if c.dims == (name,) and c.name != name]
    if not own:
        raise InputError("points: no parameter varies; the figure needs one")
    return own[0]


def _curves(dataset: xr.Dataset, name: str, shown: str) -> Figure:
    abscissa = _abscissa(dataset, name)
    order = np.argsort(abscissa.values, kind="stable")
    x, y = abscissa.values[order], dataset[shown].transpose("mode", name).values[:, order]
    logarithmic = cells.is_logarithmic(x)
    cells.require_values(dataset[shown], positive=logarithmic)
    panels = Panels(height=_HEIGHT, margins=Margins(right=0.75, left=1.0))
    axes = panels.axes[0][0]
    drawn = np.where(y > _NEGLIGIBLE * np.nanmax(y), y, np.nan) if logarithmic else y
    for colour, curve, mode in zip(_colours(len(y)), drawn, dataset["mode"].values, strict=True):
        axes.plot(x, curve, color=colour, marker="o" if len(x) < 12 else None, markersize=3, label=f"mode {mode}")
    cells.fit_axis(axes, "x", x)
    axes.set_xlim(x[0], x[-1])
    if logarithmic:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    _label_curves(axes)
    higher = _draw_orders(axes, dataset, x, drawn) if shown == "critical_speed" else []
    operating = _draw_range(axes, _operating(dataset, shown))
    if logarithmic:
        cells.plain_decades(axes, "y")
    axes.grid(color=FRAME_GREY, alpha=0.2, linewidth=0.5)
    axes.set_ylabel(variable_label(dataset[shown]))
    panels.label_axes(_every(dataset, abscissa, name))
    panels.titles(dataset)
    panels.legend([*higher, *operating, *_doubtful(axes, dataset, name, x, drawn, order)])
    return panels.figure


def _draw_orders(axes: Axes, dataset: xr.Dataset, x: np.ndarray, speeds: np.ndarray) -> list[Artist]:
    """Draw the speeds at which higher orders meet the modes of ``speeds`` (modes, points); returns legend entries."""
    orders = stored_orders(dataset.attrs)
    handles: list[Artist] = []
    for (label, times), dashes in zip(orders.per_turn.items() if orders else (), _DASHES, strict=False):
        style = {"linestyle": dashes, "linewidth": 1.2 if times == 1 else 0.7}
        if times != 1:
            axes.set_prop_cycle(color=_colours(len(speeds)))
            axes.plot(x, speeds.T / times, **style)
        handles.append(Line2D([], [], color=FRAME_GREY, label=label, **style))
    return handles


def _operating(dataset: xr.Dataset, shown: str) -> tuple[float, float] | None:
    """Lowest and highest operating speed in the units of ``shown``, if stored."""
    options = json.loads(dataset.attrs.get("options", "{}"))
    low, high = (options.get(f"operating_{end}", 0.0) for end in ("min", "max"))
    rpm = suitable("rpm", [str(dataset[shown].attrs.get("units", "rpm"))])[0]
    return (low * rpm, high * rpm) if high > 0 else None


def _draw_range(axes: Axes, operating: tuple[float, float] | None) -> list[Artist]:
    """Draw the operating speeds as a band, down to the lower edge of ``axes`` if they begin at standstill."""
    if operating is None:
        return []
    low, high = operating
    # A logarithmic axis has no zero.
    low = low or min(axes.get_ylim()[0], high / 10)
    return [axes.axhspan(low, high, color=LINE_COLOURS[1], alpha=0.2, zorder=0, label="operating speeds")]


def _label_curves(axes: Axes) -> None:
    """Write the names of the curves at their right ends, without overlaps."""
    taken = -np.inf
    for line in axes.get_lines():
        x, y = map(np.asarray, line.get_data())
        present = np.flatnonzero(np.isfinite(y))
        if not present.size:
            continue
        end = (x[present[-1]], y[present[-1]])
        height = axes.transData.transform(end)[1] * 72 / axes.figure.dpi
        if height > taken + _LABEL_HEIGHT:
            label, colour = line.get_label(), line.get_color()
            axes.annotate(label, end, (4, 0), textcoords="offset points", va="center", color=colour)  # pyright: ignore[reportArgumentType]
            taken = height


def _every(dataset: xr.Dataset, abscissa: xr.DataArray, name: str) -> str:
    """Label of the horizontal axis, including parameters of a list of points that equal it."""
    equal = [
        str(c.name)
        for c in dataset.coords.values()
        if c.dims == (name,) and c.name not in (abscissa.name, name) and np.array_equal(c.values, abscissa.values)
    ]
    return " = ".join([axis_label(abscissa), *equal])


def _doubtful(
    axes: Axes, dataset: xr.Dataset, name: str, x: np.ndarray, y: np.ndarray, order: np.ndarray
) -> list[Artist]:
    """Draw crosses over uncertified frequencies."""
    if "count_certified" not in dataset:
        return []
    doubtful = dataset["count_certified"].transpose("mode", name).values[:, order] == 0
    if not (doubtful & np.isfinite(y)).any():
        return []
    style = {"linestyle": "none", "marker": "x", "color": STATE_COLOURS[cells.FAILED], "markersize": 5}
    for row, curve in zip(doubtful, y, strict=True):
        axes.plot(x[row], curve[row], **style)
    return [Line2D([], [], **style, label="not certified by the count")]


def _maps(dataset: xr.Dataset, names: list[str], shown: str) -> Figure:
    cells.require_values(dataset[shown], positive=True)
    horizontal = cells.horizontal_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    modes = [mode for mode in range(dataset.sizes["mode"]) if float(dataset[shown].isel(mode=mode).max()) > 0]
    modes = modes[:_MOST_MAPS]
    panels = Panels(len(modes), height=_MAP_HEIGHT, margins=Margins(right=1.25, left=1.0))
    operating: dict[str, Artist] = {}
    for (axes,), mode in zip(panels.axes, modes, strict=True):
        field = dataset[shown].isel(mode=mode)
        values = field.values[np.isfinite(field.values) & (field.values > 0)]
        low, high = values.min(), values.max()
        norm = LogNorm(low, high) if high > 3 * low else Normalize(low, high)
        cmap = matplotlib.colormaps["viridis"].with_extremes(bad=STATE_COLOURS[cells.FAILED])
        field = field.where(field.isnull() | (field > low), low)
        mesh = cells.draw_cells(axes, field, horizontal, vertical, cmap=cmap, norm=norm)
        operating |= _draw_limits(axes, dataset, shown, mode, (horizontal, vertical))
        label = f"mode {dataset['mode'].values[mode]}: {variable_label(field)}"
        bar: dict[str, Any] = {"format": ticker.StrMethodFormatter("{x:g}"), "ticks": _ticks(low, high)}
        panels.colorbar(axes, mesh, label, **bar)
        panels.figure.axes[-1].yaxis.set_minor_formatter(ticker.NullFormatter())
        axes.set_ylabel(textwrap.fill(axis_label(dataset[vertical]), _LETTERS))
    panels.label_axes(axis_label(dataset[horizontal]))
    panels.titles(dataset)
    panels.legend([*operating.values(), *cells.failure_legend(dataset)])
    return panels.figure


def _draw_limits(axes: Axes, dataset: xr.Dataset, shown: str, mode: int, names: tuple[str, str]) -> dict[str, Artist]:
    """Draw lines where an order meets ``mode`` at the lowest or highest operating speed; returns legend entries."""
    field, orders = dataset[shown].isel(mode=mode), getattr(stored_orders(dataset.attrs), "per_turn", {"": 1.0})
    x, y, heights = field[names[0]], field[names[1]], field.transpose(*reversed(names))
    handles: dict[str, Artist] = {}
    # A white outline keeps the lines visible on the dark end of the map.
    style = {"linewidth": 1.0, "path_effects": [withStroke(linewidth=2.4, foreground="white")]}
    for (order, times), colour in zip(orders.items(), _ORDER_COLOURS, strict=False):
        limits = zip(("lowest", "highest"), _operating(dataset, shown) or (), ("dashed", "solid"), strict=False)
        for name, speed, dashes in limits:
            if not float(field.min()) < times * speed < float(field.max()):
                continue
            axes.contour(x, y, heights, [times * speed], colors=colour, linestyles=dashes).set(**style)
            label = f"{name} operating speed" + ("" if times == 1 else f", {order}")
            handles[label] = Line2D([], [], color=colour, linestyle=dashes, label=label, **style)
    return handles


def _ticks(low: float, high: float) -> np.ndarray:
    """Ticks at 1, 2, 5 and their decades, or round numbers if these are too few."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    marks = np.outer(decades, [1, 2, 5]).ravel()
    inside = marks[(marks >= low) & (marks <= high)]
    return inside if len(inside) > 1 else ticker.MaxNLocator(5).tick_values(low, high)  # pyright: ignore[reportReturnType]


def _shapes(dataset: xr.Dataset) -> Figure:
    count = min(dataset.sizes["mode"], _MOST_SHAPES)
    panels = Panels(count, height=_SHAPE_HEIGHT, margins=Margins(right=0.3, between_rows=0.3))
    shaft = _Shaft.of(dataset)
    x = dataset["x"].values * shaft.total
    for (axes,), index, colour in zip(panels.axes, range(count), _colours(count), strict=True):
        shape = dataset["mode_shape"].isel(mode=index).values
        shaft.draw(axes)
        axes.axhline(0.0, color=FRAME_GREY, linewidth=0.6)
        axes.plot(x, shape, color=colour)
        axes.fill_between(x, shape, color=colour, alpha=0.15, linewidth=0)
        axes.set(xlim=(-0.02 * shaft.total, 1.02 * shaft.total), ylim=(-1.25, 1.25), yticks=(-1.0, 0.0, 1.0))
        axes.set_title(_name(dataset, index), loc="left", pad=3, color=FRAME_GREY, size=8)
    distance = f"distance from A{in_brackets(unit_of(dataset, 'length', 'm')[1])}"
    panels.label_axes(distance if shaft.edges else variable_label(dataset["x"]), "deflection, largest 1")
    panels.titles(dataset)
    panels.legend(shaft.legend())
    return panels.figure


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
            axes.plot(
                places, [level] * len(places), clip_on=False, linestyle="none", color=FRAME_GREY, **_SYMBOLS[name]
            )

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
