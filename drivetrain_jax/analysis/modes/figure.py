"""Figures of the analysis ``modes``: natural frequencies along an axis, and mode shapes drawn as the gear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import Orders, stored_orders
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, fit_axis, plain_decades, write_names
from drivetrain_jax.view.style import FRAME_GREY, axis_label, in_brackets, parameters, units_of, variable_label

# Colours of rigid modes, of the families in their order, and of coupled modes.
_RIGID, _FAMILIES, _COUPLED = "#9a9a9a", ("#16324f", "#d1771e", "#3f8f5f", "#7a4fa0", "#999933"), "#a0308c"
_COLUMNS, _MOST_SHAPES = 4, 16
# Relative difference below which frequencies are one multiple frequency, with one shape drawn.
_SAME = 1e-8
# Relative distances at which neighbours are close, and at which they are two frequencies.
_NEAR, _SPLIT = 0.01, 1e-6
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


def plot(dataset: xr.Dataset) -> Figure:
    """Frequencies over one axis, coloured by the type of the mode, or the mode shapes of a single point.

    A single point without shapes is an interference diagram, if the numbers of teeth are known.
    Curves follow the stored ``branch``, so colours do not change where frequencies cross or veer; without it every point is
    a dot. Zero frequencies are not visible on the logarithmic scale. Raises :class:`InputError` for more than one axis, and
    if needed variables are not stored or have no value.
    """
    names = charts.sweep_axes(dataset)
    if not names and "mode_shape" not in dataset and (orders := stored_orders(dataset.attrs)):
        return _interference(dataset, orders)
    if not names:
        return _shapes(dataset)
    if len(names) == 1 and names != ["point"]:
        return _curves(dataset, names[0])
    raise charts.wrong_axes(dataset, "one axis for a figure of frequencies, or none for mode shapes")


def _meanings(dataset: xr.Dataset) -> list[str]:
    return dataset["mode_type"].attrs["flag_meanings"].split()


def type_colours(dataset: xr.Dataset) -> dict[str, str]:
    """Colour of every type of modes by name."""
    if "mode_type" not in dataset:
        return {"coupled": _COUPLED}
    rigid, *families, coupled = _meanings(dataset)
    return {rigid: _RIGID, **dict(zip(families, cycle(_FAMILIES), strict=False)), coupled: _COUPLED}


def _types(dataset: xr.Dataset, dominant: bool = False) -> np.ndarray:
    """Type of every mode by name, or with ``dominant`` the dominant family of a coupled mode, if stored.

    All modes are coupled if the variable is missing.
    """
    if "mode_type" not in dataset:
        return np.full(dataset["natural_frequency"].shape, "coupled")
    types = np.array(_meanings(dataset))[dataset["mode_type"].values]
    if not (dominant and "dominant_family" in dataset):
        return types
    families = np.array(dataset["dominant_family"].attrs["flag_meanings"].split())
    return np.where(types == "coupled", families[dataset["dominant_family"].values], types)


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    charts.require(dataset, "natural_frequency")
    charts.require_values(dataset["natural_frequency"], positive=True)
    dataset = dataset.transpose(name, ...)
    x, frequency = dataset[name].values, dataset["natural_frequency"].values
    types, colours = _types(dataset, dominant=True), type_colours(dataset)
    close = _close(frequency)
    sheet = Sheet(1 + bool(close), height=4.4 / (1 + bool(close)), sharey=False)
    axes, *lower = sheet.axes[:, 0]
    moving = np.where(frequency > 1e-6 * np.nanmax(frequency), frequency, np.nan)
    if "branch" in dataset:
        order = np.argsort(dataset["branch"].values, axis=1, kind="stable")
        branches, kinds = (np.take_along_axis(array, order, axis=1) for array in (moving, types))
        for curve, kind in zip(branches.T, kinds.T, strict=True):
            if np.isfinite(curve).any():
                axes.add_collection(_segments(x, curve, [colours[str(k)] for k in kind]))
    else:
        for kind, colour in colours.items():
            rows, modes = np.nonzero(types == kind)
            axes.plot(x[rows], moving[rows, modes], ".", markersize=2.5, color=colour)
    axes.set(yscale="log", ylim=(0.93 * np.nanmin(moving), 1.07 * np.nanmax(moving)))
    plain_decades(axes, "y")
    labels = [variable_label(dataset["natural_frequency"])]
    for below in lower:
        _draw_distances(sheet, below, x, frequency, close)
        units = in_brackets(units_of(dataset["natural_frequency"]))
        labels.append(f"distance of close modes (numbers at the right){units}")
    fit_axis(axes, "x", x)
    sheet.label(axis_label(dataset[name]), *labels)
    shown = [kind for kind in colours if (types[np.isfinite(moving)] == kind).any()]
    if "mode_type" in dataset:
        sheet.add(*(Line2D([], [], color=colours[kind], label=kind) for kind in shown))
    mixed = "coupled" in _types(dataset) and "coupled" not in types
    return sheet.finish(dataset, "coupled modes in the colour of their dominant family" if mixed else "")


def _interference(dataset: xr.Dataset, orders: Orders) -> Figure:
    charts.require(dataset, "natural_frequency")
    types, colours = _types(dataset, dominant=True).tolist(), type_colours(dataset)
    kinds = {kind: colour for kind, colour in colours.items() if kind in types and kind != "rigid"}
    kinds = kinds if "mode_type" in dataset else {}
    return charts.interference(dataset, orders, [colours[kind] for kind in types], kinds)


def _close(frequency: np.ndarray) -> list[int]:
    """Lower modes of neighbours that come closer than 1 % somewhere, and are not one multiple frequency everywhere."""
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.diff(frequency, axis=1) / frequency[:, 1:]
    near = (np.nanmin(apart, axis=0, initial=np.inf) < _NEAR) & (np.nanmax(apart, axis=0, initial=0.0) > _SPLIT)
    return np.flatnonzero(near & (np.nanmin(frequency, axis=0)[:-1] > 0)).tolist()


def _draw_distances(sheet: Sheet, axes: Axes, x: np.ndarray, frequency: np.ndarray, close: list[int]) -> None:
    """Draw the distances of neighbours in Hz: the splits and veerings that the axis of the frequencies cannot show."""
    colours, ends = matplotlib.colormaps["viridis"](np.linspace(0, 0.8, len(close))), []
    for colour, mode in zip(colours, close, strict=True):
        distance = frequency[:, mode + 1] - frequency[:, mode]
        distance = np.where(distance > _SPLIT * frequency[:, mode + 1], distance, np.nan)
        axes.plot(x, distance, color=colour, label=f"modes {mode + 1} and {mode + 2}")
        ends.append((x[-1], distance[-1]))
    axes.set_yscale("log")
    plain_decades(axes, "y")
    names = [f"{mode + 1}/{mode + 2}" for mode in close]
    sheet.later(lambda: write_names(axes, ends, names, colours=colours))


def _segments(x: np.ndarray, curve: np.ndarray, colours: list[str]) -> LineCollection:
    """One branch through points with these ``colours``; a piece between two points has the colour of its end."""
    points = np.stack([x, curve], axis=-1)
    return LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        colors=colours[1:],
        linewidths=1.1,
        capstyle="round",
        # Snapping single pieces to whole pixels would make steps.
        snap=False,
    )


def _angles(dataset: xr.Dataset) -> list[float]:
    """Angles of the planets, from the fixed parameters or from scalar coordinates of single entries."""
    name = charts.role(dataset, "planets")
    angles = parameters(dataset).get(name)
    if angles is None:
        raise InputError(f"{name or 'planets'}: missing; the figure of mode shapes needs the angles of planets")
    return [float(angle) for angle in angles]


def _distinct(frequency: np.ndarray) -> list[tuple[int, int]]:
    """First mode and multiplicity of every frequency."""
    start = [i for i in range(len(frequency)) if i == 0 or frequency[i] - frequency[i - 1] > _SAME * frequency[i]]
    return [(i, j - i) for i, j in zip(start, [*start[1:], len(frequency)], strict=True)]


def _shapes(dataset: xr.Dataset) -> Figure:
    charts.require(dataset, "natural_frequency", "mode_shape")
    angles, types, colours = _angles(dataset), _types(dataset), type_colours(dataset)
    families, frequency = _types(dataset, dominant=True), dataset["natural_frequency"].values
    if not np.isfinite(frequency).all():
        raise InputError("natural_frequency = nan: nothing to plot; the point has no result")
    distinct = _distinct(frequency)
    drawn, left_out = distinct[:_MOST_SHAPES], max(len(distinct) - _MOST_SHAPES, 0)
    units = units_of(dataset["natural_frequency"])
    digits = 1 if units == "Hz" or frequency.max() > 1e3 else 4
    shares = {"dominant_family", "dominant_share"} <= set(dataset) and bool((types == "coupled").any())
    sheet = Sheet(-(-len(drawn) // _COLUMNS), _COLUMNS, height=1.95)
    for axes in sheet.axes.flat:
        axes.axis("off")
    for axes, (mode, count) in zip(sheet.axes.flat, drawn, strict=False):
        shape = dataset["mode_shape"].transpose("mode", "dof").values[mode]
        _draw_gear(axes, dict(zip(dataset["dof"].values, shape, strict=True)), angles)
        multiple = f" ×{count}" if count > 1 else ""
        kind, family = str(types[mode]), str(families[mode])
        named = f", {kind}"
        if kind == "coupled" and shares:
            # Truncated and not rounded to 100 %.
            share = np.floor(1e4 * float(dataset["dominant_share"].values[mode])) / 100
            named = f"\n{share:.2f} % {family}"
        axes.set_title(f"{frequency[mode]:.{digits}f} {units}{multiple}{named}", size=8, color=colours[family], pad=1.5)
    sheet.add(*(Line2D([], [], color=colour, label=body) for body, colour in _BODIES.items()))
    sheet.add(Line2D([], [], color=FRAME_GREY, **_REST, label="at rest"))
    return sheet.finish(dataset, f"{left_out} higher frequencies not drawn" if left_out else "")


def displacements(shape: Mapping[str, float], planets: int) -> tuple[np.ndarray, np.ndarray]:
    """``[x, y, u]`` of carrier, ring and sun (3, 3) and ``[xi, eta, u]`` of the planets (N, 3) of one mode shape.

    The largest translation or rim movement is scaled to 0.28 of the carrier's radius. Bodies without translations stay in
    place, and the centres of the planets move with the carrier.
    """
    central = [[shape.get(f"x_{body}", 0.0), shape.get(f"y_{body}", 0.0), shape[f"u_{body}"]] for body in "crs"]
    moved = [
        [shape.get(f"xi_{i}", 0.0), shape.get(f"eta_{i}", shape["u_c"]), shape[f"u_{i}"]] for i in range(1, planets + 1)
    ]
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
            rest.append(np.stack([(centre + line).real, (centre + line).imag], axis=-1))
            moved.append(np.stack([displaced.real, displaced.imag], axis=-1))
            colours.append(_BODIES[name])
    axes.add_collection(LineCollection(rest, colors=FRAME_GREY, **_REST))
    axes.add_collection(LineCollection(moved, colors=colours, linewidths=1.1))
    axes.set(aspect="equal", xlim=(-1.9, 1.9), ylim=(-1.9, 1.9))
