"""Figures of the analysis ``frequency_response``: one line by one or several methods, or maps of many lines."""

from __future__ import annotations

import json
from dataclasses import dataclass

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.frequency_response import maps as rattle_maps
from drivetrain_jax.analysis.frequency_response import orbit_figure
from drivetrain_jax.view import cells, regimes
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import FRAME_GREY, STATE_COLOURS, STYLE, axis_label, in_brackets, units_of
from drivetrain_jax.view.units import suitable, value_in

DASHES = (0, (3, 1.6))
_HEIGHT = 2.9
_UNSTABLE = 1
_PALE = 0.3
# A step of a sweep is a jump if it exceeds these ratios to the range of the values and to the neighbouring steps.
_JUMP, _STEEPER = 0.04, 6.0
# Margin above and below the angles of the phase; rounding tolerance of an angle.
_ANGLE_MARGIN, _ROUNDING = 0.1, 1e-6
# Relative distance below which motions next to a fold belong together.
_NEAR = 0.15


@dataclass(frozen=True)
class _Look:
    """Line style of one method; the exact solution lies on top, as thin lines with markers."""

    label: str
    colour: str
    width: float


_DIRECTIONS = {"up": ">", "down": "<"}
_MARKS = 45
_MARK_STYLE = {"markeredgecolor": "#111111", "markersize": 3, "fillstyle": "none", "markeredgewidth": 0.6}
_METHODS = {
    "multiple_scales": _Look("multiple scales", "#7b3294", 1.3),
    "averaging": _Look("averaging", "#7b3294", 1.3),
    "describing_function": _Look("describing function", "#2a9d5c", 1.3),
    "harmonic_balance": _Look("harmonic balance", "#d1771e", 1.3),
    "exact": _Look("exact", "#111111", 0.8),
}


def plot(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """Half the peak-to-peak displacement over the frequency, and the phase if stored; or maps.

    Each of ``dataset`` and ``others`` (results for the same parameters by other methods) may have the speed as its single
    axis. Stable motions are solid lines, unstable ones dashed, jumps of a sweep dotted. One dataset with a second axis
    gives maps of both sweeps. A dataset of forced orbits shows their branches. Raises :class:`InputError` for other axes or
    parameters, for a method given twice, and if no variable of the figure is stored.
    """
    with matplotlib.rc_context(STYLE):
        results = [cells.prepare(each) for each in (dataset, *others)]
        if len(results) == 1 and "branch_amplitude" in dataset:
            return orbit_figure.plot(results[0], _path(dataset))
        axes = [cells.sweep_axes(each) for each in results]
        if len(results) == 1 and len(axes[0]) == 2:
            return rattle_maps.plot(results[0], axes[0])
        path = _path(dataset)
        for each, names in zip(results, axes, strict=True):
            if names != [path]:
                raise InputError(
                    f"axes = {cells.described_axes(each)}: allowed is {path} of several values, with one more axis if it is "
                    "a single result"
                )
        for each in results:
            cells.require(each, "u_max", "u_min")
        _check_comparable(results)
        return _lines(results)


def _path(result: xr.Dataset) -> str:
    """The axis of the frequencies: the speed of the system."""
    return cells.role(result, "speed")


def _along(result: xr.Dataset) -> xr.DataArray:
    return result[_path(result)]


def _check_comparable(results: list[xr.Dataset]) -> None:
    """Raise :class:`InputError` unless all results have the same parameters, shown in the heading, and differ in the
    legend."""
    first, *others = (_fixed_values(each) for each in results)
    for other in others:
        for name in first | other:
            if first.get(name) != other.get(name):
                raise InputError(
                    f"{name} = {other.get(name)}: allowed is the value of the first result, {first.get(name)}"
                )
    labels = [_label(each, _METHODS[each.attrs.get("method", "exact")]) for each in results]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"files: {label!r} is given twice; allowed is every method once")


def _fixed_values(result: xr.Dataset) -> dict[str, object]:
    """Parameters of ``result`` that do not vary, axes of one value included."""
    fixed = json.loads(result.attrs.get("fixed_parameters", "{}"))
    values = {name: entry.get("value") if isinstance(entry, dict) else entry for name, entry in fixed.items()}
    return values | {str(name): c.item() for name, c in result.coords.items() if c.ndim == 0}


def _lines(results: list[xr.Dataset]) -> Figure:
    with_phase = all("phase" in each for each in results)
    panels = Panels(1 + with_phase, height=_HEIGHT, margins=Margins(right=0.4, top=0.73), share_y=False)
    upper = panels.axes[0][0]
    order = list(_METHODS)
    handles = []
    for each in sorted(results, key=lambda r: order.index(r.attrs.get("method", "exact"))):
        look = _METHODS[each.attrs.get("method", "exact")]
        amplitude = (each["u_max"] - each["u_min"]) / 2
        _draw_branches(upper, each, look)
        jumps = {str(d): _jumps(amplitude.sel(sweep_direction=d).values) for d in amplitude["sweep_direction"].values}
        _draw_sweeps(upper, each, amplitude, look, jumps)
        if with_phase:
            _draw_sweeps(panels.axes[1][0], each, _lag(each), look, jumps)
        handles += _entries(each, look)
    # The margin of matplotlib is a share of the range, which is small for a flat curve.
    upper.set_ylim(0, 1.03 * upper.get_ylim()[1])
    handles += _draw_missing(upper, results)
    handles += _draw_backbones(upper, results)
    handles += _draw_wandering(upper, results)
    handles += _draw_contact(upper, results)
    cells.fit_axis(upper, "x", np.unique(np.concatenate([_along(r).values for r in results])))
    panels.label_row(upper, f"half the peak-to-peak displacement [{units_of(results[0]['u_max'])}]")
    if with_phase:
        angle = units_of(results[0]["phase"])
        _angle_axis(panels.axes[1][0], angle, any(bool((_lag(each) > np.pi + _ANGLE_MARGIN).any()) for each in results))
        panels.label_row(panels.axes[1][0], f"lag of the fundamental{in_brackets(angle)}")
    panels.label_axes(axis_label(_along(results[0])))
    panels.titles(results[0])
    panels.legend([*handles, *_meanings(results)])
    return panels.figure


def _label(result: xr.Dataset, look: _Look) -> str:
    """The method, with the number of harmonics or the range of the fit."""
    options = json.loads(result.attrs.get("options", "{}"))
    if result.attrs.get("method") == "harmonic_balance":
        count = options.get("harmonics")
        return f"{look.label}, {count} harmonic{'s' if count != 1 else ''}"
    if "fit_range" in result:
        fit = result["fit_range"]
        return f"{look.label}, $R$ = {float(fit.values.flat[0]):.3g} {units_of(fit)}".removesuffix(" 1")
    return look.label


def _draw_sweeps(
    axes: Axes, result: xr.Dataset, values: xr.DataArray, look: _Look, jumps: dict[str, np.ndarray]
) -> None:
    """Draw both sweeps: stable pieces solid, unstable ones dashed, jumps dotted, the exact ones with markers."""
    omega = _along(result).values
    every = max(len(omega) // _MARKS, 1)
    for direction, mark in _DIRECTIONS.items():
        y = values.sel(sweep_direction=direction).values
        unstable = np.zeros(y.shape, bool)
        if "stability" in result:
            unstable = result["stability"].sel(sweep_direction=direction).values == _UNSTABLE
        # A motion that is not periodic has no stability; its extremes are dots.
        wandering = _wandering(result).sel(sweep_direction=direction).values
        unstable, y = unstable & ~wandering, np.where(wandering, np.nan, y)
        for kind, style in ((~unstable, "-"), (unstable, DASHES)):
            broken = _broken(omega, np.where(_grown(kind), y, np.nan), jumps[direction])
            axes.plot(*broken, color=look.colour, linewidth=look.width, linestyle=style, solid_capstyle="butt")
            if style is DASHES and kind.any():
                # A pale line below the dashes: a short unstable piece would look like a gap.
                axes.plot(*broken, color=look.colour, linewidth=look.width, alpha=_PALE, zorder=1.5)
        for i in np.flatnonzero(jumps[direction]):
            axes.plot(omega[i : i + 2], y[i : i + 2], color=look.colour, linewidth=0.7, linestyle=":")
        if look is _METHODS["exact"]:
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


def _draw_branches(axes: Axes, result: xr.Dataset, look: _Look) -> None:
    """Draw unstable motions off the sweeps as dashed lines, one for each branch number."""
    if not {"branch_u_max", "branch_u_min", "branch_stability"} <= set(result):
        return
    amplitude = ((result["branch_u_max"] - result["branch_u_min"]) / 2).transpose(_path(result), "branch").values
    unstable = result["branch_stability"].transpose(_path(result), "branch").values == _UNSTABLE
    for number in range(amplitude.shape[1]):
        y = np.where(unstable[:, number], amplitude[:, number], np.nan)
        x, y = _joined(_along(result).values, y, np.where(unstable, np.nan, amplitude))
        axes.plot(x, y, color=look.colour, linewidth=min(look.width, 1.3), linestyle=DASHES)


def _joined(x: np.ndarray, y: np.ndarray, stable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pieces of ``y``, extended at both ends to the nearest of the ``stable`` motions (L, n): they meet in a fold."""
    xs: list[float] = []
    ys: list[float] = []
    near = _NEAR * np.nanmax(stable, initial=0.0)
    for i in range(len(x)):
        begins, ends = (not np.isfinite(y[k]) if 0 <= k < len(x) else False for k in (i - 1, i + 1))
        partners = stable[i][np.abs(stable[i] - y[i]) < near]
        if not np.isfinite(y[i]):
            xs, ys = [*xs, np.nan], [*ys, np.nan]
            continue
        piece = [y[i]]
        if partners.size:
            nearest = partners[np.argmin(np.abs(partners - y[i]))]
            piece = [*([nearest] if begins else []), y[i], *([nearest] if ends else [])]
        xs, ys = [*xs, *[x[i]] * len(piece)], [*ys, *piece]
    return np.array(xs), np.array(ys)


def _draw_backbones(axes: Axes, results: list[xr.Dataset]) -> list[Line2D]:
    """Draw amplitudes of free motions over their frequency in the colours of the methods, within the limits of the axes."""
    style = {"linewidth": 0.7, "linestyle": (0, (6, 2, 1, 2))}
    with_backbone = [each for each in results if "backbone_amplitude" in each]
    height = axes.get_ylim()[1]
    for each in with_backbone:
        amplitude = each["backbone_amplitude"].values
        # Break the line at steps larger than the height of the axes.
        line = _broken(_along(each).values, amplitude, np.abs(np.diff(amplitude)) > height)
        axes.plot(*line, **style, color=_METHODS[each.attrs["method"]].colour, scaley=False)
    return [Line2D([], [], **style, color=FRAME_GREY, label="backbone")] if with_backbone else []


def _wandering(result: xr.Dataset) -> xr.DataArray:
    """True where a sweep met a motion that is not periodic."""
    return result["regime"] == regimes.NON_PERIODIC if "regime" in result else result["u_max"].isnull() & False


def _draw_wandering(axes: Axes, results: list[xr.Dataset]) -> list[Line2D]:
    """Draw dots for motions that are not periodic; returns their legend entry."""
    style = {"linestyle": "", "marker": "o", "markersize": 2.0, "color": regimes.COLOURS[regimes.NON_PERIODIC]}
    found = False
    for each in results:
        amplitude = ((each["u_max"] - each["u_min"]) / 2).where(_wandering(each))
        for direction in _DIRECTIONS if bool(amplitude.notnull().any()) else ():
            axes.plot(_along(each), amplitude.sel(sweep_direction=direction), **style)
            found = True
    return [Line2D([], [], **style, label="non-periodic")] if found else []


def _draw_contact(axes: Axes, results: list[xr.Dataset]) -> list[Artist]:
    """Draw the regimes of the most exact result above the panel, and half the backlash as a line."""
    order = list(_METHODS)
    best = max(results, key=lambda r: order.index(r.attrs.get("method", "exact")))
    handles: list[Artist] = [*regimes.draw_sweep_strips(axes, best, _path(best))]
    if (half := regimes.half_play(best)) is not None and half < axes.get_ylim()[1]:
        style = {"color": "#a8a8a8", "linewidth": 0.9, "zorder": 0.5, "label": "half the backlash"}
        handles.append(axes.axhline(half, **style))
    return handles


def _draw_missing(axes: Axes, results: list[xr.Dataset]) -> list[Line2D]:
    """Draw crosses on the axis at frequencies where a sweep found no motion."""
    omega = [_along(r).values[r["u_max"].isnull().any("sweep_direction").values] for r in results]
    count = sum(map(len, omega))
    if not count:
        return []
    style = {"color": STATE_COLOURS[cells.FAILED], "linestyle": "", "marker": "x", "markersize": 3.5, "clip_on": False}
    x = np.unique(np.concatenate(omega))
    axes.plot(x, np.zeros(len(x)), **style, zorder=5)
    return [Line2D([], [], **style, label=f"no motion found ({count})")]


def _meanings(results: list[xr.Dataset]) -> list[Line2D]:
    """The legend entry of the dashed lines, if results may have unstable motions."""
    if not any("stability" in r for r in results):
        return []
    return [Line2D([], [], color=FRAME_GREY, linewidth=1.2, linestyle=DASHES, label="unstable")]


def _entries(result: xr.Dataset, look: _Look) -> list[Line2D]:
    """Legend entries of one result; an exact result has one entry for each sweep."""
    style = {"color": look.colour, "linewidth": look.width}
    if look is not _METHODS["exact"]:
        return [Line2D([], [], **style, label=_label(result, look))]
    marks = _DIRECTIONS.items()
    return [Line2D([], [], **style, **_MARK_STYLE, marker=m, label=f"{look.label}, {d}") for d, m in marks]


def _lag(result: xr.Dataset) -> xr.DataArray:
    """The phase [rad] modulo a turn, in [0, 1) turns; small negative values from rounding stay."""
    phase = result["phase"].copy(data=value_in(result["phase"], "rad"))
    return (phase + _ROUNDING) % (2 * np.pi) - _ROUNDING


def _angle_axis(axes: Axes, units: str, longer: bool) -> None:
    """Set an axis of angles in rad, numbered in ``units``: half a turn, or a full turn for larger lags, such as with a drive
    of negative amplitude."""
    quarters = 5 if longer else 3
    axes.set_ylim(-_ANGLE_MARGIN, (quarters - 1) * np.pi / 2 + _ANGLE_MARGIN)
    labels = ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"]
    if units != "rad":
        labels = [f"{k * np.pi / 2 * suitable('rad', [units])[0]:g}" for k in range(5)]
    axes.set_yticks(np.arange(quarters) * np.pi / 2, labels[:quarters])
