"""Figures of responses over the frequency: sweeps by one or several methods, branches of orbits, and responses of gears."""

from __future__ import annotations

import json
import math
from typing import Any

import matplotlib
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
    entry_name,
    in_brackets,
    parameters,
    size,
    units_of,
    variable_label,
)

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
# Line styles of stable and unstable motions, of jumps, and of backbones; dashes are short, so that a short piece has some.
_SOLID, _DASHED, _JUMPED, _BACKBONE = "-", (0, (2, 1)), ":", (0, (6, 2, 1, 2))
_UNSTABLE_ENTRY = Line2D([], [], color=FRAME_GREY, linestyle=_DASHED, label="unstable")
_JUMP_ENTRY = Line2D([], [], color=FRAME_GREY, linestyle=_JUMPED, linewidth=0.7, label="jump of a sweep")
_SPECIAL = {"fold_frequency": ("fold", (0, (8, 2, 1, 2))), "doubling_frequency": ("period doubling", (0, (4, 2)))}
_STABLE, _UNSTABLE = range(2)
# A step of a sweep is a jump if it exceeds these ratios to the range of the values and to the neighbouring steps.
_JUMP, _STEEPER = 0.04, 6.0
# Relative distance below which motions next to a fold belong together.
_NEAR = 0.15
# Part of an angle by which rounding can make it negative.
_ROUNDING = 1e-6
# Bodies and coordinates of the gear by the letters in the names of the coordinates.
_BODIES = {"c": "carrier", "r": "ring", "s": "sun"}
_KINDS = {
    "x": "translation $x$",
    "y": "translation $y$",
    "u": "rotation times base radius $u$",
    "xi": r"radial motion $\xi$",
    "eta": r"tangential motion $\eta$",
}
# Part of the largest amplitude below which an amplitude is rounding.
_AT_REST = 1e-12


def frequency_response(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """Half the peak-to-peak displacement over the frequency, and the phase if stored; or maps.

    Each of ``dataset`` and ``others`` (results for the same parameters by other methods) may have the speed as its single
    axis. Stable motions are solid lines, unstable ones dashed, jumps of a sweep dotted. One dataset with a second axis
    gives maps of both sweeps. A dataset of forced orbits shows their branches.
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
    return _sweeps(sorted(results, key=lambda result: list(_METHODS).index(_method(result))), path)


def _method(result: xr.Dataset) -> str:
    return result.attrs.get("method", "exact")


def _check_comparable(results: list[xr.Dataset]) -> None:
    """Raise :class:`InputError` unless all results have the same parameters and differ in the legend."""
    first, *others = map(parameters, results)
    for other in others:
        for name in first | other:
            if first.get(name) != other.get(name):
                allowed = f"expected the value of the first result, {first.get(name)}"
                raise InputError(f"{name} = {other.get(name)}: {allowed}")
    labels = [_label(result) for result in results]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"files: {label!r} is given twice; expected every method once")


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


def _sweeps(results: list[xr.Dataset], path: str) -> Figure:
    with_phase = all("phase" in result for result in results)
    sheet = Sheet(1 + with_phase, height=2.9, sharey=False)
    upper, best = sheet.axes[0, 0], results[-1]
    for result in results:
        label, colour, width = _METHODS[_method(result)]
        line: dict[str, Any] = {"color": colour, "linewidth": width}
        if {"branch_u_max", "branch_u_min", "branch_stability"} <= set(result):
            _draw_saddles(sheet, result, path, line)
        for direction, mark in _DIRECTIONS.items():
            exact = {"marker": mark, **_MARK_STYLE} if _method(result) == "exact" else {}
            label = f"exact, {direction}" if exact else _label(result)
            sheet.add(Line2D([], [], **line, **exact, label=label))
            _draw_sweep(sheet, result.sel(sweep_direction=direction), path, line, exact)
    # The margin of matplotlib is a share of the range, which is small for a flat curve.
    upper.set_ylim(0, 1.03 * upper.get_ylim()[1])
    for result in results:
        _draw_special(sheet, upper, result, path)
    if "regime" in best:
        regime = charts.valid(best, "regime")
        for foot, direction in ((1.01, "down"), (1.055, "up")):
            charts.draw_flags(upper, regime.sel(sweep_direction=direction), path, (foot, foot + 0.035))
            place: dict[str, Any] = {"transform": upper.transAxes, "color": FRAME_GREY}
            upper.text(1.005, foot + 0.0175, direction, va="center", size=6.5, **place)
            # A frame, because the colour of motions without separation is none.
            upper.add_patch(Rectangle((0, foot), 1, 0.035, fill=False, linewidth=0.4, clip_on=False, **place))
        sheet.add(*charts.flag_entries(regime))
    half = charts.half_play(best)
    if half is not None and half < upper.get_ylim()[1]:
        style = {"color": "#a8a8a8", "linewidth": 0.9, "zorder": 0.5, "label": "half the backlash"}
        sheet.add(upper.axhline(half, **style))
    fit_axis(upper, "x", np.unique(np.concatenate([result[path].values for result in results])))
    labels = [f"half the peak-to-peak displacement{in_brackets(units_of(best['u_max']))}"]
    labels += [f"lag of the fundamental{in_brackets(units_of(best['phase']))}"] if with_phase else []
    if with_phase and units_of(best["phase"]) == "rad":
        sheet.axes[1, 0].set_yticks([0, math.pi / 2, math.pi], ["0", r"$\pi/2$", r"$\pi$"])
    sheet.label(axis_label(best[path]), *labels)
    return sheet.finish(results[0])


def _amplitude(result: xr.Dataset, prefix: str = "") -> xr.DataArray:
    return (result[f"{prefix}u_max"] - result[f"{prefix}u_min"]) / 2


def _wandering(result: xr.Dataset) -> xr.DataArray:
    """True where a sweep met a motion that is not periodic: it has no stability, and its extremes are dots."""
    if "regime" not in result:
        return result["u_max"].isnull() & False
    return result["regime"] == charts.flags(result["regime"]).index("non_periodic")


def _jumps(y: np.ndarray) -> np.ndarray:
    """Flags of the steps along a sweep that are jumps, shape (L - 1,)."""
    if y.size < 4 or not np.isfinite(y).any():
        return np.zeros(max(y.size - 1, 0), bool)
    step = np.abs(np.diff(y))
    padded = np.pad(np.where(np.isfinite(step), step, np.inf), 1, constant_values=np.inf)
    beside = np.minimum(padded[:-2], padded[2:])
    return (step > _JUMP * np.ptp(y[np.isfinite(y)])) & (step > _STEEPER * beside)


def _draw_sweep(sheet: Sheet, sweep: xr.Dataset, path: str, line: dict[str, Any], mark: dict[str, Any]) -> None:
    """Draw amplitude and phase of a sweep: stable steps solid, unstable ones dashed, jumps dotted; with a mark, if given."""
    x, wandering, amplitude = sweep[path].values.astype(float), _wandering(sweep).values, _amplitude(sweep).values
    unstable = (sweep["stability"].values == _UNSTABLE) & ~wandering if "stability" in sweep else wandering & False
    jumps, unstable = _jumps(amplitude), unstable[:-1] | unstable[1:]
    curves = [amplitude]
    if len(sheet.axes) > 1:
        # The phase modulo a turn; small negative values from rounding stay.
        turn = 2 * np.pi * (size("rad", units_of(sweep["phase"])) or 1.0)
        curves.append((sweep["phase"].values + _ROUNDING * turn) % turn - _ROUNDING * turn)
    every = max(len(x) // _MOST_MARKS, 1)
    shown = slice(every // 2 if mark.get("marker") == _DIRECTIONS["down"] else 0, None, every)
    for (axes,), curve in zip(sheet.axes, curves, strict=True):
        y = np.where(wandering, np.nan, curve)
        for steps, style in ((~jumps & ~unstable, _SOLID), (~jumps & unstable, _DASHED), (jumps, _JUMPED)):
            # A gap in place of every other step.
            gaps = np.flatnonzero(~steps) + 1
            thin = {"linewidth": 0.7} if style == _JUMPED else {}
            if steps.any():
                axes.plot(np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan), **(line | thin), linestyle=style)
        axes.plot(x[shown], y[shown], linestyle="", **(mark or {"marker": ""}))
    sheet.add(*[_UNSTABLE_ENTRY][: int((~jumps & unstable).any())], *[_JUMP_ENTRY][: int(jumps.any())])


def _draw_saddles(sheet: Sheet, result: xr.Dataset, path: str, line: dict[str, Any]) -> None:
    """Draw unstable motions off the sweeps as dashed lines, one for each branch number, to the stable ones they meet."""
    x, amplitude = result[path].values, _amplitude(result, "branch_").transpose(path, "branch").values
    unstable = result["branch_stability"].transpose(path, "branch").values == _UNSTABLE
    stable, saddles = np.where(unstable, np.nan, amplitude), np.where(unstable, amplitude, np.nan)
    near = _NEAR * np.nanmax(stable, initial=0.0)
    for y in saddles.T:
        for piece in np.ma.clump_unmasked(np.ma.masked_invalid(y)):
            places = np.array([piece.start, *range(piece.start, piece.stop), piece.stop - 1])
            values = y[places]
            for end in (0, -1):
                distance = np.nan_to_num(np.abs(stable[places[end]] - values[end]), nan=np.inf)
                if distance.min() < near:
                    values[end] = stable[places[end], distance.argmin()]
            sheet.axes[0, 0].plot(x[places], values, **line, linestyle=_DASHED)
            sheet.add(_UNSTABLE_ENTRY)


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
        style: dict[str, Any] = {"linewidth": 0.7, "linestyle": _BACKBONE, "color": _METHODS[_method(result)][1]}
        sheet.add(*axes.plot(*broken, **style, scaley=False, label="backbone"))
    wandering = _amplitude(result).where(_wandering(result)).transpose(path, ...)
    if bool(wandering.notnull().any()):
        dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 2.0, "label": "not periodic"}
        sheet.add(*axes.plot(x, wandering, **dots, color=FLAG_COLOURS["non_periodic"])[:1])
    _draw_bifurcations(sheet, axes, result, path)


def _draw_bifurcations(sheet: Sheet, axes: Axes, result: xr.Dataset, path: str) -> None:
    """Draw folds and period doublings within the values of ``path`` as vertical lines."""
    x = result[path]
    for key, (label, dashes) in _SPECIAL.items():
        if key not in result:
            continue
        # Folds are values of the parameter that follows from an axis of physical data.
        units = units_of(result[key])
        follow = (c for c in result.coords.values() if c.dims == (path,) and c.name not in (path, "point"))
        parameter = next((c for c in follow if size(units_of(c), units)), x)
        found = np.unique(result[key].values) / (size(units_of(parameter), units) or 1.0)
        inside = found[(found >= parameter.values.min()) & (found <= parameter.values.max())]
        for value in np.interp(inside, *np.sort([parameter.values, x.values], axis=1)):
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
    (displaced,) = (str(dim) for dim in amplitude.dims if dim not in (path, "branch"))
    sheet = Sheet(amplitude.sizes[displaced], height=2.6, sharey=False)
    stability = dataset["branch_stability"].transpose(path, "branch").values
    for (axes,), name, colour in zip(sheet.axes, amplitude[displaced].values.tolist(), LINE_COLOURS, strict=False):
        values = amplitude.sel({displaced: name}).transpose(path, "branch").values
        for kind, label, face in ((_STABLE, "stable", colour), (_UNSTABLE, "unstable", "none")):
            place, branch = np.nonzero(stability == kind)
            style = {"color": colour, "markerfacecolor": face, "markersize": 2.4, "markeredgewidth": 0.7}
            label = f"{label}, {entry_name(displaced, name)}"
            sheet.add(*(axes.plot(x[place], values[place, branch], "o", **style, label=label) if place.size else ()))
        _draw_bifurcations(sheet, axes, dataset, path)
        axes.set_ylim(bottom=0.0)
    charts.fit_panels(sheet, dataset, path)
    sheet.label(axis_label(dataset[path]), variable_label(amplitude))
    return sheet.finish(dataset)


def harmonic_response(dataset: xr.Dataset) -> Figure:
    """Amplitudes of a single point over the frequency, or the largest of all coordinates over one axis and the frequency.

    A panel holds the coordinates whose names begin alike (``x``, ``u``), a line for each body.
    """
    charts.require(dataset, "amplitude")
    charts.require_values(dataset["amplitude"], positive=True)
    names, amplitude = charts.sweep_axes(dataset), dataset["amplitude"]
    if len(names) > 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis, or none")
    if names:
        about = amplitude.attrs | {"long_name": f"largest {amplitude.attrs.get('long_name', 'amplitude')}"}
        largest = dataset.assign(amplitude=amplitude.max("dof").assign_attrs(about))
        return charts.maps([("amplitude", [largest])], ["frequency", names[0]], height=3.0).finish(dataset)
    kinds, bodies = zip(*(str(dof).split("_", 1) for dof in amplitude["dof"].values), strict=True)
    names = [_BODIES.get(body) or f"planet {body}" for body in bodies]
    planets = [name for name in dict.fromkeys(names) if name not in _BODIES.values()]
    # The lowest and widest lines are the lightest.
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.05, 1.0, len(planets)))
    colours = dict(zip(planets, shades, strict=True)) | dict(zip(_BODIES.values(), LINE_COLOURS, strict=False))
    # The amplitude of a coordinate that does not respond is rounding.
    known = amplitude.where(amplitude > _AT_REST * float(amplitude.max())).assign_coords(dof=names)
    panels, shown = dataset.drop_dims("dof"), list(dict.fromkeys(kinds))
    for kind in shown:
        part = known.isel(dof=[k == kind for k in kinds]).reindex(dof=list(colours)).rename(dof="body")
        panels[kind] = part.assign_attrs(long_name=_KINDS.get(kind, kind))
    look = {"colours": list(colours.values()), "logarithmic": shown, "wider": True}
    return charts.stack(panels, "frequency", [[kind] for kind in shown], **look).finish(dataset)
