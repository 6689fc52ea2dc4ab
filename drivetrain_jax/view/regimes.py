"""Regimes of motion with backlash as coloured cells: the number of flanks with contact made and lost."""

from __future__ import annotations

import json
import re

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import cells
from drivetrain_jax.view.style import FRAME_GREY, PREDICTION, STATE_COLOURS
from drivetrain_jax.view.units import suitable, value_in

# The lightness of the colours falls with the number of flanks; non-periodic and failed cells differ in hue.
_NAMES = ("no separation", "single-sided", "double-sided", "non-periodic", "failed")
COLOURS = ("#ffffff", "#9cc3e0", "#33517c", "#f2b632", STATE_COLOURS[cells.FAILED])
NON_PERIODIC, FAILED = 3, 4


def draw(axes: Axes, dataset: xr.Dataset, field: xr.DataArray, horizontal: str, vertical: str) -> QuadMesh:
    """Draw the regimes ``field`` of ``dataset``."""
    codes = field.where(dataset["outcome"] < FIRST_FAILURE, FAILED)
    cmap = ListedColormap(COLOURS, name="regimes")
    return cells.draw_cells(axes, codes, horizontal, vertical, cmap=cmap, vmin=-0.5, vmax=FAILED + 0.5)


def legend(dataset: xr.Dataset) -> list[Patch]:
    """Legend entries of the regimes with no, one or two flanks, and of all others that occur."""
    known = (dataset["outcome"] < FIRST_FAILURE).values
    present = {*range(NON_PERIODIC), *np.unique(dataset["regime"].values[known]).tolist()}
    patches = [
        Patch(facecolor=COLOURS[k], edgecolor=FRAME_GREY, linewidth=0.6, label=_NAMES[k]) for k in sorted(present)
    ]
    return [*patches, *cells.failure_legend(dataset)]


def draw_threshold(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Line2D]:
    """Draw the predicted limit of motion without separation, if stored as a curve over the horizontal axis."""
    name = f"resonance_{vertical}"
    if name not in dataset.coords or horizontal not in dataset[name].dims:
        return []
    limits = axes.get_xlim(), axes.get_ylim()
    handles = []
    for line in dataset[name].transpose("resonance", horizontal):
        label = str(line["resonance"].item())
        axes.plot(dataset[horizontal], line, color="#ffffff", linewidth=2.6)
        handles += axes.plot(dataset[horizontal], line, color=PREDICTION, linewidth=1.3, label=label)
    axes.set(xlim=limits[0], ylim=limits[1])
    return handles


def draw_bands(dataset: xr.Dataset, name: str, *panels: Axes) -> list[Patch]:
    """Shade the values of the axis ``name`` by regime, if stored; returns legend entries of the regimes that occur."""
    if "regime" not in dataset:
        return []
    order = np.argsort(dataset[name].values)
    codes = dataset["regime"].where(dataset["outcome"] < FIRST_FAILURE, FAILED).values[order]
    edges = cells.cell_edges(dataset[name].values[order])
    for axes in panels:
        for code, left, right in zip(codes, edges, edges[1:], strict=False):
            axes.axvspan(left, right, facecolor=COLOURS[int(code)], alpha=0.35, linewidth=0, zorder=0)
    present = sorted({int(code) for code in codes if code < FAILED})
    return [
        Patch(facecolor=COLOURS[k], alpha=0.35, edgecolor=FRAME_GREY, linewidth=0.6, label=_NAMES[k]) for k in present
    ]


def draw_sweep_strips(axes: Axes, dataset: xr.Dataset, name: str) -> list[Patch]:
    """Draw the regimes of both sweeps above the panel, if stored; returns legend entries of the regimes that occur."""
    if "regime" not in dataset:
        return []
    style = {"cmap": ListedColormap(COLOURS, name="regimes"), "vmin": -0.5, "vmax": FAILED + 0.5}
    codes = dataset["regime"].where(dataset["outcome"] < FIRST_FAILURE, FAILED).sortby(name)
    for foot, direction in ((1.01, "down"), (1.055, "up")):
        cells.draw_strip(axes, codes.sel(sweep_direction=direction), name, (foot, foot + 0.035), **style)
        place = {"transform": axes.transAxes, "va": "center", "size": 6.5, "color": FRAME_GREY}
        axes.text(1.005, foot + 0.0175, direction, **place)
    present = np.unique(codes.values).astype(int)
    frame = {"edgecolor": FRAME_GREY, "linewidth": 0.6}
    return [Patch(facecolor=COLOURS[k], label=_NAMES[k], **frame) for k in present if k < FAILED]


def half_play(dataset: xr.Dataset) -> float | None:
    """Half the play in the units of the displacement, or None if it is unknown or varies."""
    play = cells.role(dataset, "half_play")
    shown = next((str(v.attrs.get("units", "m")) for n, v in dataset.items() if re.match(r"u(_|$)", str(n))), "m")
    if play in dataset.coords:
        return float(value_in(dataset[play], shown)) if dataset[play].ndim == 0 else None
    entry = json.loads(dataset.attrs.get("fixed_parameters", "{}")).get(play, {})
    return entry["value"] * suitable(entry.get("units", shown), [shown])[0] if "value" in entry else None


def draw_flanks(dataset: xr.Dataset, *horizontal: Axes, portrait: Axes | None = None) -> list[Line2D]:
    """Draw both flanks of the play as horizontal lines, and as vertical lines in a phase portrait.

    Returns the legend entry, or nothing if the play is unknown.
    """
    half = half_play(dataset)
    if half is None:
        return []
    style = {"color": FRAME_GREY, "linewidth": 0.8, "linestyle": (0, (2, 2))}
    lines = [axes.axhline(side, label="flanks", **style) for axes in horizontal for side in (half, -half)]
    for side in (half, -half) if portrait else ():
        portrait.axvline(side, **style)  # pyright: ignore[reportOptionalMemberAccess]
    return lines[:1]
