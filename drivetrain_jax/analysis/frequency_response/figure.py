"""Figures of the analysis ``frequency_response``: one line by one or several methods, branches of orbits, or maps."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, fit_axis
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FLAG_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    axis_label,
    in_brackets,
    parameters,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import suitable, value_in

# Label, colour and line width of each method, from the back to the front; the exact solution is a thin line with markers.
_METHODS = {
    "multiple_scales": ("multiple scales", "#7b3294", 1.3),
    "averaging": ("averaging", "#7b3294", 1.3),
    "describing_function": ("describing function", "#2a9d5c", 1.3),
    "harmonic_balance": ("harmonic balance", "#d1771e", 1.3),
    "exact": ("exact", "#111111", 0.8),
}
_DIRECTIONS, _MOST_MARKS = {"up": ">", "down": "<"}, 45
_MARK_STYLE = {"markeredgecolor": "#111111", "markersize": 3, "fillstyle": "none", "markeredgewidth": 0.6}
_SOLID: dict[str, Any] = {"solid_capstyle": "butt"}
_DASHED: dict[str, Any] = {"linestyle": (0, (3, 1.6))}
_JUMPED: dict[str, Any] = {"linewidth": 0.7, "linestyle": ":"}
_UNSTABLE_ENTRY = Line2D([], [], color=FRAME_GREY, linewidth=1.2, **_DASHED, label="unstable")
_JUMP_ENTRY = Line2D([], [], color=FRAME_GREY, **_JUMPED, label="jump of a sweep")
_BACKBONE: dict[str, Any] = {"linewidth": 0.7, "linestyle": (0, (6, 2, 1, 2))}
_SPECIAL = {"fold_frequency": ("fold", (0, (1, 2))), "doubling_frequency": ("period doubling", (0, (4, 2)))}
_STABLE, _UNSTABLE = range(2)
# A step of a sweep is a jump if it exceeds these ratios to the range of the values and to the neighbouring steps.
_JUMP, _STEEPER = 0.04, 6.0
# Margin above and below the angles of the phase; rounding tolerance of an angle.
_ANGLE_MARGIN, _ROUNDING = 0.1, 1e-6
_QUARTERS = ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"]
# Relative distance below which motions next to a fold belong together.
_NEAR = 0.15


def plot(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """Half the peak-to-peak displacement over the frequency, and the phase if stored; or maps.

    Each of ``dataset`` and ``others`` (results for the same parameters by other methods) may have the speed as its single
    axis. Stable motions are solid lines, unstable ones dashed, jumps of a sweep dotted. One dataset with a second axis
    gives maps of both sweeps. A dataset of forced orbits shows their branches. Raises :class:`InputError` for other axes or
    parameters, for a method given twice, and if no variable of the figure is stored.
    """
    results = [dataset, *others]
    names, path = charts.sweep_axes(dataset), charts.role(dataset, "speed")
    if not others and "branch_amplitude" in dataset:
        return _orbits(dataset, path)
    if not others and len(names) == 2:
        parts = [dataset.sel(sweep_direction=direction) for direction in _DIRECTIONS]
        rows = [(name, parts) for name in charts.require(dataset, "u_max", "regime", some=True)]
        axes = charts.horizontal_first(dataset, names)
        return charts.maps(rows, axes, titled=["sweep_direction"]).finish(dataset)
    for result in results:
        if charts.sweep_axes(result) != [path]:
            allowed = f"{path} of several values, with one more axis if it is a single result"
            raise charts.wrong_axes(result, allowed)
        charts.require(result, "u_max", "u_min")
    _check_comparable(results)
    return _lines(sorted(results, key=lambda result: list(_METHODS).index(_method(result))), path)


def _method(result: xr.Dataset) -> str:
    return result.attrs.get("method", "exact")


def _check_comparable(results: list[xr.Dataset]) -> None:
    """Raise :class:`InputError` unless all results have the same parameters, shown in the heading, and differ in the
    legend."""
    first, *others = map(parameters, results)
    for other in others:
        for name in first | other:
            if first.get(name) != other.get(name):
                raise InputError(
                    f"{name} = {other.get(name)}: allowed is the value of the first result, {first.get(name)}"
                )
    labels = [_label(result) for result in results]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"files: {label!r} is given twice; allowed is every method once")


def _label(result: xr.Dataset) -> str:
    """The method, with the number of harmonics or the range of the fit."""
    label, *_ = _METHODS[_method(result)]
    if _method(result) == "harmonic_balance":
        count = json.loads(result.attrs.get("options", "{}")).get("harmonics")
        return f"{label}, {count} harmonic{'s' if count != 1 else ''}"
    if "fit_range" in result:
        fit = result["fit_range"]
        return f"{label}, $R$ = {float(fit.values.flat[0]):.3g} {units_of(fit)}".removesuffix(" 1")
    return label


def _lines(results: list[xr.Dataset], path: str) -> Figure:
    with_phase = all("phase" in result for result in results)
    sheet = Sheet(1 + with_phase, height=2.9, sharey=False)
    upper, *lower = sheet.axes[:, 0]
    lags = []
    for result in results:
        _, colour, width = _METHODS[_method(result)]
        line: dict[str, Any] = {"color": colour, "linewidth": width}
        if {"branch_u_max", "branch_u_min", "branch_stability"} <= set(result):
            sheet.add(*_draw_saddles(upper, result, path, line))
        for direction, mark in _DIRECTIONS.items():
            sweep = result.sel(sweep_direction=direction)
            exact = {"marker": mark, **_MARK_STYLE} if _method(result) == "exact" else {}
            label = f"exact, {direction}" if exact else _label(result)
            sheet.add(Line2D([], [], **line, **exact, label=label))
            sheet.add(*_draw_sweep(upper, sweep, _amplitude(sweep).values, line, exact))
            for axes in lower:
                # The phase [rad] modulo a turn; small negative values from rounding stay.
                lags.append((value_in(sweep["phase"], "rad") + _ROUNDING) % (2 * np.pi) - _ROUNDING)
                sheet.add(*_draw_sweep(axes, sweep, lags[-1], line, exact))
    # The margin of matplotlib is a share of the range, which is small for a flat curve.
    upper.set_ylim(0, 1.03 * upper.get_ylim()[1])
    for result in results:
        _draw_special(sheet, upper, result, path)
    best = results[-1]
    if "regime" in best:
        regime = charts.valid(best, "regime")
        for foot, direction in ((1.01, "down"), (1.055, "up")):
            charts.draw_flags(upper, regime.sel(sweep_direction=direction), path, (foot, foot + 0.035))
            place: dict[str, Any] = {"transform": upper.transAxes, "color": FRAME_GREY}
            # A frame, because the colour of motions without separation is none.
            upper.add_patch(Rectangle((0, foot), 1, 0.035, fill=False, linewidth=0.4, clip_on=False, **place))
            upper.text(1.005, foot + 0.0175, direction, va="center", size=6.5, **place)
        sheet.add(*charts.flag_entries(regime))
    half = charts.half_play(best)
    if half is not None and half < upper.get_ylim()[1]:
        style = {"color": "#a8a8a8", "linewidth": 0.9, "zorder": 0.5, "label": "half the backlash"}
        sheet.add(upper.axhline(half, **style))
    fit_axis(upper, "x", np.unique(np.concatenate([result[path].values for result in results])))
    labels = [f"half the peak-to-peak displacement{in_brackets(units_of(results[0]['u_max']))}"]
    for axes in lower:
        # In rad with numbers in the unit of the figure: half a turn, or a full turn for the lags of a negative drive.
        angle, longer = units_of(results[0]["phase"]), np.nanmax(lags) > np.pi + _ANGLE_MARGIN
        ticks = np.arange(5 if longer else 3) * np.pi / 2
        numbers = [f"{tick * suitable('rad', [angle])[0]:g}" for tick in ticks]
        axes.set_ylim(-_ANGLE_MARGIN, ticks[-1] + _ANGLE_MARGIN)
        axes.set_yticks(ticks, _QUARTERS[: len(ticks)] if angle == "rad" else numbers)
        labels.append(f"lag of the fundamental{in_brackets(angle)}")
    sheet.label(axis_label(results[0][path]), *labels)
    return sheet.finish(results[0])


def _amplitude(result: xr.Dataset, prefix: str = "") -> xr.DataArray:
    return (result[f"{prefix}u_max"] - result[f"{prefix}u_min"]) / 2


def _wandering(result: xr.Dataset) -> xr.DataArray:
    """True where a sweep met a motion that is not periodic: it has no stability, and its extremes are dots."""
    if "regime" not in result:
        return result["u_max"].isnull() & False
    return result["regime"] == result["regime"].attrs["flag_meanings"].split().index("non_periodic")


def _jumps(y: np.ndarray) -> np.ndarray:
    """Flags of the steps along a sweep that are jumps, shape (L - 1,)."""
    if y.size < 4 or not np.isfinite(y).any():
        return np.zeros(max(y.size - 1, 0), bool)
    step = np.abs(np.diff(y))
    padded = np.pad(np.where(np.isfinite(step), step, np.inf), 1, constant_values=np.inf)
    beside = np.minimum(padded[:-2], padded[2:])
    return (step > _JUMP * np.ptp(y[np.isfinite(y)])) & (step > _STEEPER * beside)


def _draw_sweep(
    axes: Axes, sweep: xr.Dataset, y: np.ndarray, line: dict[str, Any], mark: dict[str, Any]
) -> Iterator[Line2D]:
    """Draw a sweep: stable pieces solid, unstable ones dashed, jumps dotted; with markers for an exact one; yields legend
    entries."""
    path, jumps = charts.role(sweep, "speed"), np.flatnonzero(_jumps(_amplitude(sweep).values))
    x, wandering = sweep[path].values.astype(float), _wandering(sweep).values
    unstable = (sweep["stability"].values == _UNSTABLE) & ~wandering if "stability" in sweep else wandering & False
    y, broken = np.where(wandering, np.nan, y), np.insert(x, jumps + 1, np.nan)
    for kind, style in ((~unstable, _SOLID), (unstable, _DASHED)):
        # One point more at either end, so that pieces of different kind meet.
        kind = kind | np.append(kind[1:], False)
        piece = np.insert(np.where(kind | np.append(False, kind[:-1]), y, np.nan), jumps + 1, np.nan)
        axes.plot(broken, piece, **line, **style)
        if style is _DASHED and kind.any():
            # A pale line below the dashes: a short unstable piece would look like a gap.
            axes.plot(broken, piece, **line, alpha=0.3, zorder=1.5)
            yield _UNSTABLE_ENTRY
    for i in jumps:
        axes.plot(x[i : i + 2], y[i : i + 2], **(line | _JUMPED))
        yield _JUMP_ENTRY
    if mark:
        every = max(len(x) // _MOST_MARKS, 1)
        shown = slice(every // 2 if mark["marker"] == _DIRECTIONS["down"] else 0, None, every)
        axes.plot(x[shown], y[shown], linestyle="", **mark)


def _draw_saddles(axes: Axes, result: xr.Dataset, path: str, line: dict[str, Any]) -> Iterator[Line2D]:
    """Draw unstable motions off the sweeps as dashed lines, one for each branch number, to the stable ones they meet; yields
    their legend entry."""
    x, amplitude = result[path].values, _amplitude(result, "branch_").transpose(path, "branch").values
    unstable = result["branch_stability"].transpose(path, "branch").values == _UNSTABLE
    stable, saddles = np.where(unstable, np.nan, amplitude), np.where(unstable, amplitude, np.nan)
    near = _NEAR * np.nanmax(stable, initial=0.0)
    for y in saddles.T:
        for piece in np.ma.clump_unmasked(np.ma.masked_invalid(y)):
            met = []
            for end in (piece.start, piece.stop - 1):
                distance = np.nan_to_num(np.abs(stable[end] - y[end]), nan=np.inf)
                met.append(stable[end, distance.argmin()] if distance.min() < near else y[end])
            places, values = x[piece], y[piece]
            axes.plot([places[0], *places, places[-1]], [met[0], *values, met[1]], **line, **_DASHED)
            yield _UNSTABLE_ENTRY


def _draw_special(sheet: Sheet, axes: Axes, result: xr.Dataset, path: str) -> None:
    """Draw what is not a periodic motion of a sweep: crosses for none, backbones of free motions, dots for other motions."""
    x, height = result[path].values, axes.get_ylim()[1]
    missing = x[result["u_max"].isnull().any("sweep_direction").values & ~np.asarray(result.get(charts.PENDING, False))]
    if missing.size:
        cross: dict[str, Any] = {"linestyle": "", "marker": "x", "markersize": 3.5, "clip_on": False, "zorder": 5}
        label = f"no motion found ({missing.size})"
        sheet.add(*axes.plot(missing, 0 * missing, color=FAILED_COLOUR, **cross, label=label))
    if "backbone_amplitude" in result:
        free = result["backbone_amplitude"].values
        # Break the line at steps larger than the height of the axes.
        gaps = np.flatnonzero(np.abs(np.diff(free)) > height) + 1
        broken = (np.insert(values.astype(float), gaps, np.nan) for values in (x, free))
        axes.plot(*broken, **_BACKBONE, color=_METHODS[_method(result)][1], scaley=False)
        sheet.add(Line2D([], [], **_BACKBONE, color=FRAME_GREY, label="backbone"))
    wandering = _amplitude(result).where(_wandering(result)).transpose(path, ...)
    if bool(wandering.notnull().any()):
        dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 2.0, "label": "not periodic"}
        sheet.add(*axes.plot(x, wandering, **dots, color=FLAG_COLOURS["non_periodic"])[:1])
    _draw_bifurcations(sheet, axes, result)


def _draw_bifurcations(sheet: Sheet, axes: Axes, result: xr.Dataset) -> None:
    """Draw folds and period doublings as vertical lines."""
    for key, (label, dashes) in _SPECIAL.items():
        for value in np.unique(result[key].values[np.isfinite(result[key].values)]) if key in result else ():
            style = {"color": FRAME_GREY, "linewidth": 0.8, "linestyle": dashes, "label": label, "zorder": 1}
            sheet.add(axes.axvline(value, **style))


def _orbits(dataset: xr.Dataset, path: str) -> Figure:
    """Amplitudes of all orbits over the speed, one panel for each displacement: stable orbits filled, unstable open.

    Vertical lines mark folds and period doublings, if stored.
    """
    charts.require(dataset, "branch_amplitude", "branch_stability")
    if charts.sweep_axes(dataset) != [path]:
        raise charts.wrong_axes(dataset, f"{path} of several values")
    amplitude, x = dataset["branch_amplitude"], dataset[path].values
    (own,) = (str(dim) for dim in amplitude.dims if dim not in (path, "branch"))
    sheet = Sheet(amplitude.sizes[own], height=2.6, sharey=False)
    stability = dataset["branch_stability"].transpose(path, "branch").values
    for (axes,), name, colour in zip(sheet.axes, amplitude[own].values.tolist(), LINE_COLOURS, strict=False):
        values = amplitude.sel({own: name}).transpose(path, "branch").values
        for kind, label, face in ((_STABLE, "stable", colour), (_UNSTABLE, "unstable", "none")):
            place, branch = np.nonzero(stability == kind)
            style = {"color": colour, "markerfacecolor": face, "markersize": 2.4, "markeredgewidth": 0.7}
            label = f"{label}, {charts.entry_name(own, name)}"
            sheet.add(*(axes.plot(x[place], values[place, branch], "o", **style, label=label) if place.size else ()))
        _draw_bifurcations(sheet, axes, dataset)
        axes.set_ylim(bottom=0.0)
    charts.fit_panels(sheet, dataset, path)
    sheet.label(axis_label(dataset[path]), variable_label(amplitude))
    return sheet.finish(dataset)
