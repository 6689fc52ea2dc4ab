"""Maps of a frequency response over frequency and one more parameter: displacement and regime of both sweeps."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drivetrain_jax.view import cells, regimes
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import STATE_COLOURS, axis_label, variable_label

_HEIGHT = 2.3


def plot(dataset: xr.Dataset, names: list[str]) -> Figure:
    """``u_max`` and ``regime``, if stored, over the axes ``names``; one column for each sweep.

    The predicted limit of motion without separation is drawn over the maps. Raises :class:`InputError` if neither variable
    is stored.
    """
    shown = cells.require_any(dataset, "u_max", "regime")
    horizontal = cells.speed_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    panels = Panels(len(shown), 2, height=_HEIGHT, margins=Margins(right=0.95, top=0.8))
    handles: list[Patch | Line2D] = []
    for row, name in zip(panels.axes, shown, strict=True):
        for axes, direction in zip(row, ("up", "down"), strict=True):
            field = dataset[name].sel(sweep_direction=direction)
            draw = _draw_displacement if name == "u_max" else regimes.draw
            mesh = draw(axes, dataset, field, horizontal, vertical)
        if name == "u_max":
            panels.colorbar(row[-1], mesh, variable_label(dataset[name]))  # pyright: ignore[reportArgumentType]
        else:
            handles += regimes.legend(dataset)
    for axes, direction in zip(panels.axes[0], ("up", "down"), strict=True):
        axes.set_title(f"sweep {direction}")
    *_, line = (regimes.draw_threshold(axes, dataset, horizontal, vertical) for row in panels.axes for axes in row)
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend([*handles, *line])
    return panels.figure


def _draw_displacement(axes: Axes, dataset: xr.Dataset, field: xr.DataArray, horizontal: str, vertical: str) -> object:
    values = dataset["u_max"].values
    finite = values[np.isfinite(values)]
    limits = {"vmin": finite.min(), "vmax": finite.max()} if finite.size else {}
    cmap = matplotlib.colormaps["cividis_r"].with_extremes(bad=STATE_COLOURS[cells.FAILED])
    return cells.draw_cells(axes, field, horizontal, vertical, cmap=cmap, **limits)
