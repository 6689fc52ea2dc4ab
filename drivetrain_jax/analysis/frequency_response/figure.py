"""Figures of the analysis ``frequency_response``: one line by one or several methods, branches of orbits, or maps."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import charts, overlays
from drivetrain_jax.view.sheet import Sheet, fit_axis
from drivetrain_jax.view.style import (
    FAILED_COLOUR,
    FLAG_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    axis_label,
    in_brackets,
    units_of,
    variable_label,
)
from drivetrain_jax.view.units import suitable, value_in

_DASHES, _PALE = (0, (3, 1.6)), 0.3
_STABLE, _UNSTABLE = range(2)
# A step of a sweep is a jump if it exceeds these ratios to the range of the values and to the neighbouring steps.
_JUMP, _STEEPER = 0.04, 6.0
# Margin above and below the angles of the phase; rounding tolerance of an angle.
_ANGLE_MARGIN, _ROUNDING = 0.1, 1e-6
_QUARTERS = ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"]
# Relative distance below which motions next to a fold belong together.
_NEAR = 0.15
_SPECIAL = {"fold_frequency": ("fold", (0, (1, 2))), "doubling_frequency": ("period doubling", (0, (4, 2)))}


class _Look(NamedTuple):
    """Line style of one method; the exact solution lies on top, as thin lines with markers."""

    label: str
    colour: str
    width: float = 1.3


_DIRECTIONS = {"up": ">", "down": "<"}
_MARKS = 45
_MARK_STYLE = {"markeredgecolor": "#111111", "markersize": 3, "fillstyle": "none", "markeredgewidth": 0.6}
# From the back to the front.
_METHODS = {
    "multiple_scales": _Look("multiple scales", "#7b3294"),
    "averaging": _Look("averaging", "#7b3294"),
    "describing_function": _Look("describing function", "#2a9d5c"),
    "harmonic_balance": _Look("harmonic balance", "#d1771e"),
    "exact": _Look("exact", "#111111", 0.8),
}


def plot(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """Half the peak-to-peak displacement over the frequency, and the phase if stored; or maps.

    Each of ``dataset`` and ``others`` (results for the same parameters by other methods) may have the speed as its single
    axis. Stable motions are solid lines, unstable ones dashed, jumps of a sweep dotted. One dataset with a second axis
    gives maps of both sweeps. A dataset of forced orbits shows their branches. Raises :class:`InputError` for other axes or
    parameters, for a method given twice, and if no variable of the figure is stored.
    """
    results = [dataset, *others]
    names, path = charts.sweep_axes(dataset), _path(dataset)
    if not others and "branch_amplitude" in dataset:
        return _orbits(dataset, path)
    if not others and len(names) == 2:
        parts = [dataset.sel(sweep_direction=direction) for direction in _DIRECTIONS]
        rows = [(name, parts) for name in charts.require_any(dataset, "u_max", "regime")]
        titles = [[f"sweep {direction}" for direction in _DIRECTIONS]] + [["", ""]] * (len(rows) - 1)
        axes = sorted(names, key=lambda name: name != path)
        return charts.maps(rows, axes, titles=titles).finish(dataset)
    for result in results:
        if charts.sweep_axes(result) != [path]:
            allowed = f"{path} of several values, with one more axis if it is a single result"
            raise charts.wrong_axes(result, allowed)
        charts.require(result, "u_max", "u_min")
    _check_comparable(results)
    return _lines(sorted(results, key=lambda r: list(_METHODS).index(_method(r))))


def _path(result: xr.Dataset) -> str:
    """The axis of the frequencies: the speed of the system."""
    return charts.role(result, "speed")


def _along(result: xr.Dataset) -> xr.DataArray:
    return result[_path(result)]


def _method(result: xr.Dataset) -> str:
    return result.attrs.get("method", "exact")


def _look(result: xr.Dataset) -> _Look:
    return _METHODS[_method(result)]


def _amplitude(result: xr.Dataset) -> xr.DataArray:
    return (result["u_max"] - result["u_min"]) / 2


def _check_comparable(results: list[xr.Dataset]) -> None:
    """Raise :class:`InputError` unless all results have the same parameters, shown in the heading, and differ in the
    legend."""
    first, *others = (_fixed_values(result) for result in results)
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


def _fixed_values(result: xr.Dataset) -> dict[str, object]:
    """Parameters of ``result`` that do not vary, axes of one value included."""
    fixed = json.loads(result.attrs.get("fixed_parameters", "{}"))
    values = {name: entry.get("value") if isinstance(entry, dict) else entry for name, entry in fixed.items()}
    return values | {str(name): c.item() for name, c in result.coords.items() if c.ndim == 0}


def _label(result: xr.Dataset) -> str:
    """The method, with the number of harmonics or the range of the fit."""
    label = _look(result).label
    if _method(result) == "harmonic_balance":
        count = json.loads(result.attrs.get("options", "{}")).get("harmonics")
        return f"{label}, {count} harmonic{'s' if count != 1 else ''}"
    if "fit_range" in result:
        fit = result["fit_range"]
        return f"{label}, $R$ = {float(fit.values.flat[0]):.3g} {units_of(fit)}".removesuffix(" 1")
    return label


def _lines(results: list[xr.Dataset]) -> Figure:
    with_phase = all("phase" in result for result in results)
    sheet = Sheet(1 + with_phase, height=2.9, sharey=False)
    upper, *lower = sheet.axes[:, 0]
    for result in results:
        _draw_branches(upper, result)
        amplitude = _amplitude(result)
        jumps = {str(d): _jumps(amplitude.sel(sweep_direction=d).values) for d in amplitude["sweep_direction"].values}
        _draw_sweeps(upper, result, amplitude, jumps)
        for axes in lower:
            _draw_sweeps(axes, result, _lag(result), jumps)
        line: dict[str, Any] = {"color": _look(result).colour, "linewidth": _look(result).width}
        if _method(result) != "exact":
            sheet.add(Line2D([], [], **line, label=_label(result)))
        for direction, mark in _DIRECTIONS.items() if _method(result) == "exact" else ():
            sheet.add(Line2D([], [], **line, **_MARK_STYLE, marker=mark, label=f"exact, {direction}"))
    # The margin of matplotlib is a share of the range, which is small for a flat curve.
    upper.set_ylim(0, 1.03 * upper.get_ylim()[1])
    _draw_special(sheet, upper, results)
    best = results[-1]
    if "regime" in best:
        regime = charts.valid(best, "regime")
        for foot, direction in ((1.01, "down"), (1.055, "up")):
            codes = regime.sel(sweep_direction=direction)
            charts.draw_strip(upper, codes, _path(best), (foot, foot + 0.035))
            place = {"transform": upper.transAxes, "va": "center", "size": 6.5, "color": FRAME_GREY}
            upper.text(1.005, foot + 0.0175, direction, **place)
        sheet.add(*charts.flag_entries(regime))
    half = charts.half_play(best)
    if half is not None and half < upper.get_ylim()[1]:
        style = {"color": "#a8a8a8", "linewidth": 0.9, "zorder": 0.5, "label": "half the backlash"}
        sheet.add(upper.axhline(half, **style))
    if any("stability" in result for result in results):
        sheet.add(Line2D([], [], color=FRAME_GREY, linewidth=1.2, linestyle=_DASHES, label="unstable"))
    fit_axis(upper, "x", np.unique(np.concatenate([_along(result).values for result in results])))
    labels = [f"half the peak-to-peak displacement{in_brackets(units_of(results[0]['u_max']))}"]
    for axes in lower:
        # In rad with numbers in the unit of the figure: half a turn, or a full turn for the lags of a negative drive.
        angle = units_of(results[0]["phase"])
        longer = any(bool((_lag(result) > np.pi + _ANGLE_MARGIN).any()) for result in results)
        ticks = np.arange(5 if longer else 3) * np.pi / 2
        numbers = [f"{tick * suitable('rad', [angle])[0]:g}" for tick in ticks]
        axes.set_ylim(-_ANGLE_MARGIN, ticks[-1] + _ANGLE_MARGIN)
        axes.set_yticks(ticks, _QUARTERS[: len(ticks)] if angle == "rad" else numbers)
        labels.append(f"lag of the fundamental{in_brackets(angle)}")
    sheet.label(axis_label(_along(results[0])), *labels)
    return sheet.finish(results[0])


def _draw_special(sheet: Sheet, axes: Axes, results: list[xr.Dataset]) -> None:
    """Draw what is not a periodic motion of a sweep: crosses for none, backbones of free motions, dots for other motions."""
    dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 2.0, "color": FLAG_COLOURS["non_periodic"]}
    backbone: dict[str, Any] = {"linewidth": 0.7, "linestyle": (0, (6, 2, 1, 2))}
    omega = [_along(r).values[r["u_max"].isnull().any("sweep_direction").values] for r in results]
    if count := sum(map(len, omega)):
        cross: dict[str, Any] = {"linestyle": "", "marker": "x", "markersize": 3.5, "clip_on": False, "zorder": 5}
        x = np.unique(np.concatenate(omega))
        label = f"no motion found ({count})"
        sheet.add(*axes.plot(x, np.zeros(len(x)), color=FAILED_COLOUR, **cross, label=label))
    height = axes.get_ylim()[1]
    for result in results:
        if "backbone_amplitude" in result:
            free = result["backbone_amplitude"].values
            # Break the line at steps larger than the height of the axes.
            line = _broken(_along(result).values, free, np.abs(np.diff(free)) > height)
            axes.plot(*line, **backbone, color=_look(result).colour, scaley=False)
            sheet.add(Line2D([], [], **backbone, color=FRAME_GREY, label="backbone"))
        wandering = _amplitude(result).where(_wandering(result)).transpose(_path(result), ...)
        if bool(wandering.notnull().any()):
            sheet.add(*axes.plot(_along(result), wandering, **dots, label="not periodic")[:1])


def _draw_sweeps(axes: Axes, result: xr.Dataset, values: xr.DataArray, jumps: dict[str, np.ndarray]) -> None:
    """Draw both sweeps: stable pieces solid, unstable ones dashed, jumps dotted, the exact ones with markers."""
    look, omega = _look(result), _along(result).values
    line: dict[str, Any] = {"color": look.colour, "linewidth": look.width}
    every = max(len(omega) // _MARKS, 1)
    for direction, mark in _DIRECTIONS.items():
        y = values.sel(sweep_direction=direction).values
        unstable = np.zeros(y.shape, bool)
        if "stability" in result:
            unstable = result["stability"].sel(sweep_direction=direction).values == _UNSTABLE
        # A motion that is not periodic has no stability; its extremes are dots.
        wandering = _wandering(result).sel(sweep_direction=direction).values
        unstable, y = unstable & ~wandering, np.where(wandering, np.nan, y)
        for kind, style in ((~unstable, "-"), (unstable, _DASHES)):
            broken = _broken(omega, np.where(_grown(kind), y, np.nan), jumps[direction])
            axes.plot(*broken, **line, linestyle=style, solid_capstyle="butt")
            if style is _DASHES and kind.any():
                # A pale line below the dashes: a short unstable piece would look like a gap.
                axes.plot(*broken, **line, alpha=_PALE, zorder=1.5)
        for i in np.flatnonzero(jumps[direction]):
            axes.plot(omega[i : i + 2], y[i : i + 2], color=look.colour, linewidth=0.7, linestyle=":")
        if _method(result) == "exact":
            shown = slice(every // 2 if direction == "down" else 0, None, every)
            axes.plot(omega[shown], y[shown], mark, **_MARK_STYLE)


def _grown(kind: np.ndarray) -> np.ndarray:
    """``kind`` extended by one point on either side, so that pieces of different kind meet."""
    grown = kind.copy()
    grown[:-1] |= kind[1:] & ~kind[:-1]
    return grown


def _jumps(y: np.ndarray) -> np.ndarray:
    """Flags of the steps along a sweep that are jumps, shape (L - 1,)."""
    if y.size < 4 or not np.isfinite(y).any():
        return np.zeros(max(y.size - 1, 0), bool)
    step = np.abs(np.diff(y))
    padded = np.pad(np.where(np.isfinite(step), step, np.inf), 1, constant_values=np.inf)
    beside = np.minimum(padded[:-2], padded[2:])
    return (step > _JUMP * np.ptp(y[np.isfinite(y)])) & (step > _STEEPER * beside)


def _broken(x: np.ndarray, y: np.ndarray, jumps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line with a gap at every jump."""
    places = np.flatnonzero(jumps) + 1
    return np.insert(x.astype(float), places, np.nan), np.insert(y, places, np.nan)


def _draw_branches(axes: Axes, result: xr.Dataset) -> None:
    """Draw unstable motions off the sweeps as dashed lines, one for each branch number."""
    if not {"branch_u_max", "branch_u_min", "branch_stability"} <= set(result):
        return
    amplitude = ((result["branch_u_max"] - result["branch_u_min"]) / 2).transpose(_path(result), "branch").values
    unstable = result["branch_stability"].transpose(_path(result), "branch").values == _UNSTABLE
    stable = np.where(unstable, np.nan, amplitude)
    for number in range(amplitude.shape[1]):
        y = np.where(unstable[:, number], amplitude[:, number], np.nan)
        line = _joined(_along(result).values, y, stable)
        axes.plot(*line, color=_look(result).colour, linewidth=_look(result).width, linestyle=_DASHES)


def _joined(x: np.ndarray, y: np.ndarray, stable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pieces of ``y``, extended at both ends to the nearest of the ``stable`` motions (L, n): they meet in a fold."""
    xs: list[float] = []
    ys: list[float] = []
    near = _NEAR * np.nanmax(stable, initial=0.0)
    for i in range(len(x)):
        begins, ends = (not np.isfinite(y[k]) if 0 <= k < len(x) else False for k in (i - 1, i + 1))
        partners = stable[i][np.abs(stable[i] - y[i]) < near]
        nearest = partners[np.argmin(np.abs(partners - y[i]))] if partners.size else y[i]
        piece = [y[i]] if np.isfinite(y[i]) else [np.nan]
        if partners.size:
            piece = [*([nearest] if begins else []), y[i], *([nearest] if ends else [])]
        xs, ys = [*xs, *[x[i] if np.isfinite(y[i]) else np.nan] * len(piece)], [*ys, *piece]
    return np.array(xs), np.array(ys)


def _wandering(result: xr.Dataset) -> xr.DataArray:
    """True where a sweep met a motion that is not periodic."""
    if "regime" not in result:
        return result["u_max"].isnull() & False
    return result["regime"] == result["regime"].attrs["flag_meanings"].split().index("non_periodic")


def _lag(result: xr.Dataset) -> xr.DataArray:
    """The phase [rad] modulo a turn, in [0, 1) turns; small negative values from rounding stay."""
    phase = result["phase"].copy(data=value_in(result["phase"], "rad"))
    return (phase + _ROUNDING) % (2 * np.pi) - _ROUNDING


def _orbits(dataset: xr.Dataset, speed: str) -> Figure:
    """Amplitudes of all orbits over the ``speed``, one panel for each displacement: stable orbits filled, unstable open.

    Vertical lines mark folds and period doublings, if stored.
    """
    charts.require(dataset, "branch_amplitude", "branch_stability")
    if charts.sweep_axes(dataset) != [speed]:
        raise charts.wrong_axes(dataset, f"{speed} of several values")
    amplitude, x = dataset["branch_amplitude"], dataset[speed].values
    (own,) = (str(dim) for dim in amplitude.dims if dim not in (speed, "branch"))
    sheet = Sheet(amplitude.sizes[own], height=2.6, sharey=False)
    lines = overlays.predictions(dataset, speed, forced=True)
    stability = dataset["branch_stability"].transpose(speed, "branch").values
    for (axes,), name, colour in zip(sheet.axes, amplitude[own].values.tolist(), LINE_COLOURS, strict=False):
        values = amplitude.sel({own: name}).transpose(speed, "branch").values
        for kind, label, face in ((_STABLE, "stable", colour), (_UNSTABLE, "unstable", "none")):
            place, branch = np.nonzero(stability == kind)
            style = {"color": colour, "markerfacecolor": face, "markersize": 2.4, "markeredgewidth": 0.7}
            label = f"{label}, {charts.entry_name(own, name)}"
            sheet.add(*axes.plot(x[place], values[place, branch], "o", **style, label=label))
        for key, (label, dashes) in _SPECIAL.items():
            special = np.unique(dataset[key].values) if key in dataset else np.zeros(0)
            style = {"color": FRAME_GREY, "linewidth": 0.8, "linestyle": dashes, "label": label}
            marks: list[Artist] = [axes.axvline(value, **style) for value in special[np.isfinite(special)]]
            sheet.add(*marks)
        axes.set_ylim(bottom=0.0)
        sheet.add(*overlays.draw_predictions(axes, lines))
    fit_axis(sheet.axes[0, 0], "x", x)
    sheet.add(*charts.draw_failures(sheet.axes[0, 0], dataset, speed))
    sheet.label(axis_label(dataset[speed]), variable_label(amplitude))
    sheet.later(lambda: overlays.label_predictions(sheet.axes[0, 0], lines))
    return sheet.finish(dataset)
