"""Figures of motions: histories, sections, periodic motions of gears, and the attractors that initial states lead to."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import Axes3D

from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, widen
from drivetrain_jax.view.style import (
    ATTRACTOR_COLOURS,
    FAILED_COLOUR,
    FRAME_GREY,
    LINE_COLOURS,
    coordinate_text,
    in_brackets,
    power_of_ten,
    state,
    symbol,
    units_of,
)

_LINE: dict[str, Any] = {"color": LINE_COLOURS[0], "linewidth": 0.6, "markersize": 3.5}
# Most values of an axis of histories and of sections; most turns of a curve in space, which stays legible.
_HISTORIES, _SECTIONS, _TURNS = 8, 6, 40
# Strobes of the second panel of a section, and letters in a line above its panels.
_FIRST, _LETTERS = 1000, 110
# Width below which a section is drawn as a point, and least height of a panel, both relative to the size of a component.
_NARROW, _LOW = 1e-9, 1e-3
# Relative change of size between neighbours of the axis within which an attractor is the same, and sizes that are zero.
_NEAR, _REST = 0.3, 1e-300


def history(dataset: xr.Dataset) -> Figure:
    """Displacement and rate over time, phase portrait, and for a single history the curve of both over time in space.

    Displacement and rate are the first two components of the state. One history has four panels. One axis or ``[points]``
    has a row of three panels for each of up to eight values. A history without values has empty panels with a note.
    """
    names = [str(c["name"]) for c in state(dataset)]
    # Displacements are the first half of the state.
    shown = [names[0], names[len(names) // 2]] if names else ["displacement", "rate"]
    charts.require(dataset, *shown)
    # Of a state with an axis of its own, the last entry: the free end of a driveline.
    inner = {d: -1 for d in dataset[shown[0]].dims if d not in (*dataset["outcome"].dims, "time")}
    dataset = dataset.isel(inner)
    if charts.sweep_axes(dataset):
        return _histories(dataset, shown)
    sheet = Sheet(2, 2, height=2.75, sharex=False, sharey=False)
    along, rate, flat, portrait = sheet.axes.flat
    sheet.add(*_draw(dataset, (along, rate, portrait), shown, "time"))
    space = sheet.figure.add_subplot(flat.get_subplotspec(), projection="3d")
    flat.remove()
    assert isinstance(space, Axes3D)
    _draw_space(dataset, space, shown)
    for axes, letter in zip((along, rate, space, portrait), "abcd", strict=True):
        axes.set_title(f"({letter})", loc="left", weight="bold", size=8)
    return sheet.finish(dataset)


def _histories(dataset: xr.Dataset, shown: Sequence[str]) -> Figure:
    name, parts = _parts(dataset, _HISTORIES)
    sheet = Sheet(len(parts), 3, height=1.7, sharex="col", sharey=False)
    for row, part in zip(sheet.axes, parts, strict=True):
        sheet.add(*_draw(part, row, shown, "time"))
        coordinates = {other: c for other, c in part.coords.items() if not c.ndim and other != "point"}
        varies = [name] if name in coordinates else coordinates
        row[1].set_title(", ".join(coordinate_text(coordinates[other]) for other in varies), color=FRAME_GREY, size=8)
        for axes in row if part is not parts[-1] else ():
            axes.set_xlabel("")
    return sheet.finish(dataset)


def _parts(dataset: xr.Dataset, most: int) -> tuple[str, list[xr.Dataset]]:
    """The only axis, empty without one, and the result for each of its values; :class:`InputError` for more of either."""
    name, *more = charts.sweep_axes(dataset) or [""]
    if more or dataset.sizes.get(name, 0) > most:
        raise charts.wrong_axes(dataset, f"one axis of up to {most} values")
    return name, [dataset.isel({name: k}) for k in range(dataset.sizes[name])] if name else [dataset]


def _draw(motion: xr.Dataset, row: Sequence[Axes], shown: Sequence[str], along: str) -> list[Line2D]:
    """Draw displacement and rate ``shown`` over the dimension ``along``, and the phase portrait; returns legend entries."""
    first, second = shown
    for axes, x, y in zip(row, (along, along, first), (first, second, second), strict=True):
        axes.plot(motion[x].values, motion[y].values, **_LINE, marker="o" if motion.sizes[along] == 1 else "")
        axes.set(xlabel=_label(motion, x), ylabel=_label(motion, y))
        if x == along and motion.sizes[along] > 1:
            axes.set_xlim(*motion[along].values[[0, -1]])
        if not np.isfinite(motion[first].values).any():
            axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color=FRAME_GREY)
    return charts.draw_flanks(motion, row[0], portrait=row[2])


def _label(dataset: xr.Dataset, name: str) -> str:
    """``symbol [units]`` of a component or the time, the long name of another coordinate."""
    symbols = {c["name"]: c["symbol"] for c in state(dataset)} | {"time": "$t$"}
    described = dataset[name].attrs.get("long_name") if name in dataset.coords else ""
    return f"{symbols.get(name) or described or symbol(name)}{in_brackets(units_of(dataset[name]))}"


def _draw_space(motion: xr.Dataset, space: Axes3D, shown: Sequence[str]) -> None:
    names = [*shown, "time"]
    curve = thinned(np.stack([motion[name].values for name in names]))
    space.plot(*curve, **_LINE, marker="o" if curve.shape[1] == 1 else "")
    space.set(**{f"{axis}label": _label(motion, name) for axis, name in zip("xyz", names, strict=True)})
    space.tick_params(labelsize=6.5, pad=-2)
    axis: Any
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.labelpad = -3
        axis.label.set_size(7.5)
        axis.pane.set_facecolor("white")
    space.locator_params(nbins=4)
    space.view_init(elev=22, azim=-58)
    space.set_box_aspect((1, 1, 0.8), zoom=0.95)  # pyright: ignore[reportArgumentType]


def thinned(curve: np.ndarray) -> np.ndarray:
    """The curve (3, T) of displacement, rate and time, with NaN in place of all but some turns if there are many."""
    rises = curve[1] > 0
    turn = np.cumsum(np.append(False, rises[:-1] & ~rises[1:]))
    if turn[-1] <= 2 * _TURNS:
        return curve
    return np.where(np.isin(turn, np.linspace(0, turn[-1], _TURNS).astype(int)), curve, np.nan)


def section(dataset: xr.Dataset) -> Figure:
    """The section with all strobes, and with the first 1000 alone if there are more; a row for each value of an axis."""
    charts.require(dataset, "section", some=True)
    name, parts = _parts(dataset, _SECTIONS)
    columns = 2 if dataset.sizes["strobe"] > _FIRST else 1
    sheet = Sheet(len(parts), columns, height=3.2, sharex="row", sharey="row")
    for row, part in zip(sheet.axes, parts, strict=True):
        _draw_section(row, part, name)
    described = state(dataset)[:2] or [{"long_name": f"component {i}", "units": "1"} for i in (1, 2)]
    sheet.label(*(f"{c['long_name']} at the strobes{in_brackets(c['units'])}" for c in described))
    return sheet.finish(dataset)


def _draw_section(row: np.ndarray, part: xr.Dataset, name: str) -> None:
    points = part["section"].values
    scale = state(part)[1].get("scale", 1.0) if len(state(part)) > 1 else 1.0
    first = np.abs(points[:, 0]).max(initial=0.0, where=np.isfinite(points[:, 0]))
    finite = points[np.isfinite(points).all(axis=1)]
    # Points that are equal up to rounding are one point; the usual ratio of the components is the ``scale``.
    spread = np.ptp(finite, axis=0) if len(finite) else np.full(2, np.inf)
    single = (spread <= _NARROW * first * np.array([1.0, scale])).all()
    for axes, shown in zip(row, (points, points[:_FIRST]), strict=False):
        size = 14.0 if single else 0.6 if len(shown) > 2 * _FIRST else 1.5
        axes.scatter(shown[:, 0], shown[:, 1], s=size, color=LINE_COLOURS[0], linewidths=0, rasterized=True)
        axes.set_title(f"{len(shown)} strobes", loc="left", size=7.5)
    notes = [coordinate_text(part[name])] if name else []
    if "torus_residual" in part:
        distance = power_of_ten(f"{np.max(part['torus_residual'].values):.1e}")
        notes.append(f"distance from a smooth curve {distance} of the largest value")
    if "distinct_points" in part and part["distinct_points"].item():
        notes.append(f"distinct points: {part['distinct_points'].item()}")
    notes.append(row[0].get_title("left"))
    row[0].set_title(textwrap.fill("; ".join(notes), _LETTERS // len(row)), loc="left", size=7.5)
    # Rounding errors do not fill the panel.
    widen(row[0], "x", 0.1 * (spread[0] <= _NARROW * first))
    widen(row[0], "y", 0.1 * single, 2 * _LOW * scale * first)


def steady_state(dataset: xr.Dataset) -> Figure | None:
    """The motion of a single point, and the basins of the attractors over the initial state; None for other axes."""
    names = charts.sweep_axes(dataset)
    initial = [charts.role(dataset, role) for role in ("initial_displacement", "initial_rate")]
    if not names:
        return _motion(dataset)
    return _basins(dataset, initial) if set(names) == set(initial) else None


def _motion(dataset: xr.Dataset) -> Figure:
    charts.require(dataset, "u_history", "v_history")
    charts.require_values(dataset["u_history"])
    sheet = Sheet(1, 3, height=2.4, sharex=False, sharey=False)
    # The motion is periodic: its end is its start.
    closed = dataset.isel(sample=[*range(dataset.sizes["sample"]), 0])
    closed = closed.assign_coords(sample=("sample", [*dataset["sample"].values, 1.0], dataset["sample"].attrs))
    sheet.add(*_draw(closed.rename(u_history="u", v_history="v"), sheet.axes[0], ("u", "v"), "sample"))
    u, v = (dataset[name].values[0] for name in ("u_history", "v_history"))
    start: dict[str, Any] = {"marker": "o", "markersize": 4, "color": LINE_COLOURS[1], "linestyle": ""}
    for axes, point in zip(sheet.axes[0], ((0, u), (0, v), (u, v)), strict=True):
        sheet.add(*axes.plot(*point, **start, clip_on=False, label="start of a drive period"))
    return sheet.finish(dataset)


def _basins(dataset: xr.Dataset, initial: Sequence[str]) -> Figure:
    """A map of the attractors, the most frequent ones with a colour of their own."""
    charts.require(dataset, "u_max", "period_multiple")
    known, units = (dataset["outcome"] < FIRST_FAILURE).values, units_of(dataset["u_max"])
    motions = zip(dataset["period_multiple"].values[known], dataset["u_max"].values[known], strict=True)
    # All non-periodic motions count as one attractor.
    named = [f"period {m}, largest u {u:.4g} {units}".removesuffix(" 1") if m else "non-periodic" for m, u in motions]
    names, kinds, counts = np.unique(named, return_inverse=True, return_counts=True)
    most = np.argsort(-counts, kind="stable")[: len(ATTRACTOR_COLOURS)]
    numbers = np.full(names.size, most.size)
    numbers[most] = np.arange(most.size)
    codes = np.full(known.shape, most.size)
    codes[known] = numbers[kinds]
    shares = np.bincount(codes[known], minlength=most.size + 1) / codes.size
    words = [f"{name}: {share:.1%}" for name, share in zip([*names[most], "other"], shares, strict=True)]
    colours = [*ATTRACTOR_COLOURS[: most.size], FAILED_COLOUR]
    attrs = {"flag_meanings": " ".join(word.replace(" ", "_") for word in words), "flag_colours": colours}
    shown = dataset.assign(attractor=dataset["outcome"].copy(data=codes).assign_attrs(attrs))
    return charts.maps([("attractor", [shown])], initial, height=4.6).finish(dataset)


def basins(dataset: xr.Dataset) -> Figure:
    """Largest displacement of every attractor, and the share of its basin with standard error, over the only axis."""
    name, *more = charts.sweep_axes(dataset) or ["point"]
    if more or name == "point":
        raise charts.wrong_axes(dataset, "one axis of several values for a figure of basins")
    needed = charts.require(dataset, "attractor_u_max", "basin_fraction")
    dataset = dataset.transpose(name, "attractor", ...)
    size, share = (dataset[key].values for key in needed)
    # Without a stored period multiple, attractors with a size are periodic.
    multiple = dataset["attractor_multiple"].values if "attractor_multiple" in dataset else np.isfinite(size)
    branch = followed(size, np.isfinite(share), multiple)
    place, attractor = np.nonzero(branch >= 0)
    shown = dataset.drop_dims("attractor").assign_coords(motion=np.arange(1, branch.max(initial=-1) + 2))
    for key in {*needed, "basin_error"} & {*dataset.data_vars}:
        values = np.full((len(size), shown.sizes["motion"]), np.nan)
        values[place, branch[place, attractor]] = dataset[key].values[place, attractor]
        shown[key] = (name, "motion"), values, dataset[key].attrs
    sheet = charts.stack(shown, name, [[key] for key in needed], colours=ATTRACTOR_COLOURS, dots=True)
    upper, lower = sheet.axes[:, 0]
    upper.set_ylim(bottom=min(0.0, float(dataset["attractor_u_max"].min())))
    lower.set_ylim(-0.03, 1.03)
    return sheet.finish(dataset)


def followed(size: np.ndarray, exists: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    """Branch numbers of attractors ``(values of the axis, attractors)``, -1 for none.

    Results are ordered by size, so the number of an attractor changes where a larger one appears. A branch goes on with the
    attractor of its period multiple that is nearest to its last size.
    """
    branch, last = np.full(size.shape, -1), {}
    # All non-periodic motions are one attractor, which has no size.
    size = np.where(np.isfinite(size), size, 0.0)
    for i, row in enumerate(size):
        here = np.flatnonzero(exists[i])
        alike = [(k, b) for k in here for b, (number, _) in last.items() if number == multiple[i, k]]
        gaps = [(abs(row[k] - last[b][1]) / max(abs(row[k]), _REST), k, b) for k, b in alike]
        for gap, k, b in sorted(gaps):
            if branch[i, k] < 0 and b not in branch[i] and gap <= _NEAR:
                branch[i, k] = b
        for k in here:
            branch[i, k] = branch[i, k] if branch[i, k] >= 0 else len(last)
            last[branch[i, k]] = multiple[i, k], row[k]
    return branch
