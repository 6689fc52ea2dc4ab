"""Figure of the analysis ``basins``: attractors along one axis and the share of initial states that reach each."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells
from drivetrain_jax.view.layout import Margins, Panels
from drivetrain_jax.view.style import ATTRACTOR_COLOURS, STYLE, axis_label, variable_label

_NEEDED = ("attractor_u_max", "basin_fraction")
# Change of size from one value of the axis to the next, over the size, within which an attractor is the same.
_NEAR = 0.2
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


def _followed(size: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Numbers of the branches that attractors ``(values of the axis, attractors)`` belong to, -1 where there is none.

    Results are in order of size, so that the number of an attractor changes where a larger one appears.
    """
    branch, last = np.full(size.shape, -1), {}
    # Those without a size do not repeat: all of them are one.
    size = np.where(np.isfinite(size), size, np.inf)
    for i, row in enumerate(size):
        here = np.flatnonzero(exists[i])
        with np.errstate(invalid="ignore"):
            gaps = {(k, b): 0.0 if row[k] == was else abs(row[k] - was) for k in here for b, was in last.items()}
        for (k, b), gap in sorted(gaps.items(), key=lambda item: item[1]):
            if branch[i, k] < 0 and b not in branch[i] and (gap == 0 or gap <= _NEAR * abs(row[k]) < np.inf):
                branch[i, k] = b
        for k in here[branch[i, here] < 0]:
            branch[i, k] = len(last) + np.count_nonzero(branch[i] >= len(last))
        last |= {int(branch[i, k]): row[k] for k in here}
    return branch


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    panels = Panels(2, height=_HEIGHT, margins=Margins(left=1.0, right=0.3), share_y=False)
    (upper,), (lower,) = panels.axes
    handles = []
    size, share = (dataset[each].transpose(name, "attractor").values for each in _NEEDED)
    error = dataset["basin_error"].transpose(name, "attractor").values if "basin_error" in dataset else 0 * share
    branch = _followed(size, np.isfinite(share))
    for number in range(branch.max(initial=-1) + 1):
        i, k = np.nonzero(branch == number)
        x = dataset[name].values[i]
        style = {
            "color": ATTRACTOR_COLOURS[number % len(ATTRACTOR_COLOURS)],
            "linestyle": "",
            "marker": "o",
            "markersize": 2.5,
        }
        handles += upper.plot(x, size[i, k], **style, label=f"attractor {number + 1}")
        lower.errorbar(x, share[i, k], error[i, k], **style, elinewidth=0.8)
    cells.fit_axis(upper, "x", dataset[name].values)
    upper.set_ylim(bottom=min(0.0, float(dataset["attractor_u_max"].min())))
    lower.set_ylim(-0.03, 1.03)
    panels.label_row(upper, variable_label(dataset["attractor_u_max"]))
    panels.label_row(lower, "share of the initial states [1]")
    panels.label_axes(axis_label(dataset[name]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure
