"""The grid of a result as coloured cells: axes, cell edges and states."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view.prefixes import with_prefixes
from drivetrain_jax.view.style import FRAME_GREY, STATE_COLOURS, STATE_HATCHES, STATE_NAMES, scene_key, symbol

STABLE, UNSTABLE, UNDECIDED, FAILED = range(4)
_PENDING, _PENDING_COLOUR = "pending", "#c4c4c4"
_NO_PARAMETERS = ("point", _PENDING)


def prepare(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with rising axes in units with suitable prefixes.

    Axes of one value become scalar coordinates. Infinite axis values are dropped and recorded in the attribute ``left_out``.
    """
    dataset = _finite(dataset)
    single = {name: 0 for name in dataset["outcome"].dims if dataset.sizes[name] == 1}
    dataset = with_prefixes(dataset.isel(single))
    axes = [name for name in dataset["outcome"].dims if name in dataset.coords]
    return _with_pending(dataset.sortby(axes) if axes else dataset)


def _finite(dataset: xr.Dataset) -> xr.Dataset:
    left_out = []
    for name in dataset.coords:
        coordinate = dataset[name]
        infinite = np.isinf(coordinate.values) if coordinate.dtype.kind == "f" else np.zeros(coordinate.shape, bool)
        if infinite.any() and not infinite.all() and coordinate.dims[0] in dataset["outcome"].dims:
            dataset = dataset.isel({coordinate.dims[0]: ~infinite})
            left_out.append(f"{symbol(scene_key(coordinate))} = inf left out")
    return dataset.assign_attrs(left_out=", ".join(left_out)) if left_out else dataset


def _with_pending(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with a coordinate that marks pending cells, and that every variable keeps."""
    outcome = dataset["outcome"]
    if not outcome.ndim or not str(outcome.attrs.get("flag_meanings", "")).endswith(" pending"):
        return dataset
    return dataset.assign_coords({_PENDING: outcome == outcome.attrs["flag_values"][-1]})


def sweep_axes(dataset: xr.Dataset) -> list[str]:
    """Names of the swept axes, in scene order."""
    return [str(name) for name in dataset["outcome"].dims]


def described_axes(dataset: xr.Dataset) -> str:
    """The axes of a prepared ``dataset`` as text, axes of one value included."""
    single = [f"{name} (one value)" for name, c in dataset.coords.items() if c.ndim == 0 and name not in _NO_PARAMETERS]
    return ", ".join([*sweep_axes(dataset), *single]) or "none"


def require(dataset: xr.Dataset, *names: str) -> None:
    """Raise :class:`InputError` unless all of these variables are stored."""
    if missing := [name for name in names if name not in dataset]:
        stored = ", ".join(str(name) for name in dataset.data_vars)
        raise InputError(f"outputs = {stored}: {' and '.join(missing)} missing; the figure needs {' and '.join(names)}")


def require_any(dataset: xr.Dataset, *names: str) -> list[str]:
    """The stored variables among ``names``; raises :class:`InputError` if none is stored."""
    if not (found := [name for name in names if name in dataset]):
        stored = ", ".join(str(name) for name in dataset.data_vars)
        raise InputError(f"outputs = {stored}: nothing to plot; the figure needs {' or '.join(names)}")
    return found


def require_values(variable: xr.DataArray, positive: bool = False) -> None:
    """Raise :class:`InputError` unless ``variable`` has a finite value (above zero if ``positive``)."""
    finite = variable.values[np.isfinite(variable.values)]
    largest = finite.max() if finite.size else np.nan
    if not (largest > 0 if positive else finite.size):
        kind = "positive" if positive else "finite"
        raise InputError(f"{variable.name} = {largest:g}: nothing to plot; allowed is a result with a {kind} value")


def horizontal_axis(dataset: xr.Dataset, names: list[str]) -> str:
    """The axis of ``names`` with predicted resonances, else the speed, else the last axis."""
    return next((name for name in names if f"resonance_{name}" in dataset.coords), speed_axis(dataset, names))


def speed_axis(dataset: xr.Dataset, names: list[str]) -> str:
    """The axis of ``names`` that is the speed of the system (attribute ``roles``), else the last axis."""
    speed = role(dataset, "speed")
    return speed if speed in names else names[-1]


def role(dataset: xr.Dataset, name: str) -> str:
    """The parameter with the role ``name`` in the system (attribute ``roles``), or an empty string."""
    return json.loads(dataset.attrs.get("roles", "{}")).get(name, "")


def is_logarithmic(values: np.ndarray) -> bool:
    """True if ``values`` are spaced by a constant factor rather than a constant step."""
    if len(values) < 3 or values[0] <= 0:
        return False
    steps, factors = np.diff(values), np.diff(np.log(values))
    return bool(np.ptp(factors) < 1e-6 * np.abs(factors).max() and np.ptp(steps) > 1e-6 * np.abs(steps).max())


def cell_edges(values: np.ndarray) -> np.ndarray:
    """The ``n + 1`` edges of cells around ``n`` rising values: midpoints of neighbours (of logarithms on a logarithmic
    axis); outer cells are symmetric about their value."""
    if is_logarithmic(values):
        return np.exp(_midway(np.log(values)))
    return _midway(values)


def _midway(values: np.ndarray) -> np.ndarray:
    if len(values) == 1:
        half = abs(values[0]) / 2 or 0.5
        return np.array([values[0] - half, values[0] + half])
    inner = (values[1:] + values[:-1]) / 2
    return np.concatenate([[2 * values[0] - inner[0]], inner, [2 * values[-1] - inner[-1]]])


def states(dataset: xr.Dataset) -> xr.DataArray:
    """The verdict of each cell, or ``FAILED`` without a value."""
    return dataset["verdict"].where(dataset["outcome"] < FIRST_FAILURE, FAILED)


def draw_cells(axes: Axes, field: xr.DataArray, horizontal: str, vertical: str, **options: Any) -> QuadMesh:
    """Draw ``field`` as cells over the two axes; limits and scales of ``axes`` follow the cells."""
    x, y = (field[name].values.astype(float) for name in (horizontal, vertical))
    mesh = axes.pcolormesh(
        cell_edges(x), cell_edges(y), field.transpose(vertical, horizontal).values, rasterized=True, **options
    )
    if _PENDING in field.coords:
        _cover_pending(axes, cell_edges(x), cell_edges(y), field[_PENDING].transpose(vertical, horizontal).values)
    fit_axis(axes, "x", x)
    fit_axis(axes, "y", y)
    return mesh


def draw_strip(axes: Axes, codes: xr.DataArray, name: str, heights: tuple[float, float], **options: Any) -> None:
    """Draw ``codes`` along the axis ``name`` as a strip between two heights, in fractions of the panel."""
    x = cell_edges(codes[name].values.astype(float))
    place = {"transform": axes.get_xaxis_transform(), "clip_on": False, "rasterized": True}
    axes.pcolormesh(x, heights, codes.values[None, :], **options, **place)
    if _PENDING in codes.coords:
        _cover_pending(axes, x, heights, codes[_PENDING].values[None, :], **place)


def _cover_pending(
    axes: Axes, x: np.ndarray, y: Sequence[float] | np.ndarray, waiting: np.ndarray, **place: Any
) -> None:
    grey = ListedColormap([_PENDING_COLOUR])
    axes.pcolormesh(x, y, np.where(waiting, 0.0, np.nan), cmap=grey, **{"rasterized": True, **place})


def fit_axis(axes: Axes, which: str, values: np.ndarray) -> None:
    """Set scale and limits of one axis from the cells around ``values``; a logarithmic axis shows plain numbers."""
    edges = cell_edges(values)
    logarithmic = is_logarithmic(values)
    axes.set(**{f"{which}scale": "log" if logarithmic else "linear", f"{which}lim": (edges[0], edges[-1])})
    if logarithmic:
        plain_decades(axes, which)


def plain_decades(axes: Axes, which: str) -> None:
    """Set plain numbers at 1, 2, 5 (over many decades only at 1) along a logarithmic axis, or powers of ten if plain numbers
    are long."""
    low, high = getattr(axes, f"get_{which}lim")()
    side = getattr(axes, f"{which}axis")
    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    # %g writes a million as 1e+06.
    side.set_major_formatter(plain if low >= 1e-4 and high < 0.99e6 else LogFormatterMathtext())
    side.set_minor_formatter(NullFormatter())


def draw_states(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> QuadMesh:
    """Draw the regions of the verdict; stable cells are transparent, so that lines below the cells show there alone."""
    cmap = ListedColormap((f"{STATE_COLOURS[STABLE]}00", *STATE_COLOURS[1:]), name="states over lines")
    return draw_cells(axes, states(dataset), horizontal, vertical, cmap=cmap, vmin=-0.5, vmax=3.5)


def state_legend(dataset: xr.Dataset) -> list[Patch]:
    """Legend entries of the states that occur; stable and unstable always, others with their number of cells."""
    counts = np.bincount(states(dataset).values.astype(int).ravel(), minlength=len(STATE_NAMES))
    shown = [code for code in range(FAILED) if code <= UNSTABLE or counts[code]]
    patches = [_state_patch(code, f" ({counts[code]})" if code > UNSTABLE else "") for code in shown]
    return [*patches, *failure_legend(dataset)]


def failure_legend(dataset: xr.Dataset) -> list[Patch]:
    """Legend entries of cells without a value: failed or pending."""
    waiting = int(dataset[_PENDING].sum()) if _PENDING in dataset.coords else 0
    failed = int(_failures(dataset).sum())
    patches = [_state_patch(FAILED, f" ({failed})")] if failed else []
    label = f"{_PENDING} ({waiting})"
    grey = {"facecolor": _PENDING_COLOUR, "edgecolor": FRAME_GREY, "linewidth": 0.6}
    return [*patches, Patch(**grey, label=label)] if waiting else patches


def _failures(dataset: xr.Dataset) -> xr.DataArray:
    """True where a finished point has no value."""
    failed = dataset["outcome"] >= FIRST_FAILURE
    return failed & ~dataset[_PENDING] if _PENDING in dataset.coords else failed


def draw_failures(axes: Axes, dataset: xr.Dataset, name: str) -> list[Line2D]:
    """Draw crosses at the foot of ``axes`` for failed points along the axis ``name``; returns a legend handle."""
    x = dataset[name].values[_failures(dataset).values]
    if not x.size:
        return []
    style = {"color": STATE_COLOURS[FAILED], "linestyle": "", "marker": "x", "markersize": 3.5, "clip_on": False}
    label = f"{STATE_NAMES[FAILED]} ({x.size})"
    return axes.plot(x, np.zeros(x.size), transform=axes.get_xaxis_transform(), **style, zorder=5, label=label)


def _state_patch(code: int, note: str) -> Patch:
    colours: dict[str, Any] = {"facecolor": STATE_COLOURS[code], "edgecolor": FRAME_GREY}
    return Patch(**colours, linewidth=0.6, hatch=STATE_HATCHES[code], label=STATE_NAMES[code] + note)
