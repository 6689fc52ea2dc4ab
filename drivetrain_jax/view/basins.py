"""Figure of the analysis ``basins``: attractors along one axis and the share of initial states that reach each."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells
from drivetrain_jax.view.layout import Margins, Panels
from drivetrain_jax.view.style import LINE_COLOURS, STYLE, axis_label, variable_label

_NEEDED = ("basin_fraction", "attractor_u_max")
_HEIGHT = 2.2


def plot(dataset: xr.Dataset) -> Figure:
    """Largest displacement of every attractor, and its basin's share with the standard error, over the only axis.

    Raises :class:`InputError` for other numbers of axes and where ``basin_fraction`` or ``attractor_u_max`` is missing.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if len(names) != 1 or names == ["point"]:
            raise InputError(f"axes = {', '.join(names) or 'none'}: allowed is one axis for a figure of basins")
        cells.require(dataset, *_NEEDED)
        return _curves(dataset, names[0])


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    panels = Panels(2, height=_HEIGHT, margins=Margins(left=1.0, right=0.3), share_y=False)
    (upper,), (lower,) = panels.axes
    handles = []
    shown = dataset["basin_fraction"].notnull().any(name)
    for number in dataset["attractor"].values[shown.values]:
        own = dataset.sel(attractor=number)
        colour = LINE_COLOURS[(int(number) - 1) % len(LINE_COLOURS)]
        style = {"color": colour, "linestyle": "", "marker": "o", "markersize": 2.5}
        handles += upper.plot(own[name], own["attractor_u_max"], **style, label=f"attractor {number}")
        error = own["basin_error"] if "basin_error" in own else np.zeros(own[name].shape)
        lower.errorbar(own[name], own["basin_fraction"], error, **style, elinewidth=0.8)
    cells.fit_axis(upper, "x", dataset[name].values)
    upper.set_ylim(bottom=min(0.0, float(dataset["attractor_u_max"].min())))
    lower.set_ylim(-0.03, 1.03)
    panels.label_row(upper, variable_label(dataset["attractor_u_max"]))
    panels.label_row(lower, "share of the initial states [1]")
    panels.label_axes(axis_label(dataset[name]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure
