"""Maps of a frequency response over the frequency and one more parameter: displacement and regime of both sweeps."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drivetrain_jax.view import cells
from drivetrain_jax.view.layout import Margins, Panels
from drivetrain_jax.view.style import FRAME_GREY, PREDICTION, STATE_COLOURS, axis_label, variable_label

# Lightness falls with the number of flanks; what does not repeat stands out in hue.
REGIME_COLOURS = ("#ffffff", "#b9cde5", "#4a6fa5", "#d1771e", STATE_COLOURS[cells.FAILED])
_FAILED = len(REGIME_COLOURS) - 1
_HEIGHT = 2.3


def plot(dataset: xr.Dataset, names: list[str]) -> Figure:
    """``u_max`` and ``regime``, as far as they are stored, over the axes ``names``; one column for each sweep.

    Where results carry a prediction for the other axis (the end of the motion without separation) it is drawn over
    them. Raises :class:`InputError` if neither is stored.
    """
    shown = cells.require_any(dataset, "u_max", "regime")
    horizontal = cells.speed_axis(dataset, names)
    vertical = next(name for name in names if name != horizontal)
    panels = Panels(len(shown), 2, height=_HEIGHT, margins=Margins(right=0.95, top=0.8))
    handles: list[Patch | Line2D] = []
    for row, name in zip(panels.axes, shown, strict=True):
        for axes, direction in zip(row, ("up", "down"), strict=True):
            field = dataset[name].sel(sweep_direction=direction)
            draw = _draw_displacement if name == "u_max" else _draw_regimes
            mesh = draw(axes, dataset, field, horizontal, vertical)
        if name == "u_max":
            panels.colorbar(row[-1], mesh, variable_label(dataset[name]))
        else:
            handles += _regime_legend(dataset)
    for axes, direction in zip(panels.axes[0], ("up", "down"), strict=True):
        axes.set_title(f"sweep {direction}")
    *_, line = (_draw_prediction(axes, dataset, horizontal, vertical) for row in panels.axes for axes in row)
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend([*handles, *line])
    return panels.figure


def _draw_displacement(axes: Axes, dataset: xr.Dataset, field: xr.DataArray, horizontal: str, vertical: str) -> object:
    values = dataset["u_max"].values
    finite = values[np.isfinite(values)]
    limits = {"vmin": finite.min(), "vmax": finite.max()} if finite.size else {}
    return cells.draw_cells(axes, field, horizontal, vertical, cmap="cividis_r", **limits)


def _draw_regimes(axes: Axes, dataset: xr.Dataset, field: xr.DataArray, horizontal: str, vertical: str) -> object:
    codes = field.where(dataset["outcome"] < cells.FIRST_FAILURE, _FAILED)
    cmap = ListedColormap(REGIME_COLOURS, name="regimes")
    return cells.draw_cells(axes, codes, horizontal, vertical, cmap=cmap, vmin=-0.5, vmax=_FAILED + 0.5)


def _regime_legend(dataset: xr.Dataset) -> list[Patch]:
    """The regimes that occur, by the names of their flags."""
    names = str(dataset["regime"].attrs.get("flag_meanings", "")).split()
    present = set(np.unique(dataset["regime"].values[(dataset["outcome"] < cells.FIRST_FAILURE).values]).tolist())
    labels = [(code, name.replace("_", " ")) for code, name in enumerate(names) if code in present]
    if (dataset["outcome"] >= cells.FIRST_FAILURE).any():
        labels.append((_FAILED, "no value"))
    return [Patch(facecolor=REGIME_COLOURS[c], edgecolor=FRAME_GREY, linewidth=0.6, label=text) for c, text in labels]


def _draw_prediction(axes: Axes, dataset: xr.Dataset, horizontal: str, vertical: str) -> list[Line2D]:
    """The predicted value of the vertical parameter along the frequency, if there is one."""
    name = f"resonance_{vertical}"
    if name not in dataset.coords or horizontal not in dataset[name].dims:
        return []
    style = {"color": PREDICTION, "linewidth": 1.0}
    axes.plot(dataset[horizontal], dataset[name].isel(resonance=0), **style, scalex=False, scaley=False)
    return [Line2D([], [], **style, label=str(dataset["resonance"].values[0]))]
