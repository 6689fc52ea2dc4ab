"""Figure of the analysis ``basins``: attractors along one axis and the share of initial states that reach each."""

from __future__ import annotations

import math
from string import ascii_uppercase

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
# An attractor that is missing at this many values in a row has ended.
_LOST = 2
# Smaller sizes are those of rest.
_REST = 1e-300
_MARKERS = "os^D"
_ENTRIES, _ENTRY_HEIGHT = 6, 0.15
_HEIGHT = 2.2


def plot(dataset: xr.Dataset) -> Figure:
    """Largest displacement of every attractor, and its basin's share with the standard error, over the only axis.

    Raises :class:`InputError` for other numbers of axes and where ``basin_fraction`` or ``attractor_u_max`` is missing.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if len(names) != 1 or names == ["point"]:
            raise InputError(
                f"axes = {cells.described_axes(dataset)}: allowed is one axis of several values for a figure of basins"
            )
        cells.require(dataset, *_NEEDED)
        return _curves(dataset, names[0])


def _followed(x: np.ndarray, size: np.ndarray, exists: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    """Numbers of the branches that attractors ``(values of the axis, attractors)`` belong to, -1 where there is none.

    Results are in order of size, so that the number of an attractor changes where a larger one appears. A branch goes on
    along its last two sizes to the nearest attractor of its period multiple, and ends where it has none twice.
    """
    branch, followed = np.full(size.shape, -1), []
    # Those without a size do not repeat: all of them are one.
    size = np.where(np.isfinite(size), size, np.inf)
    for i, row in enumerate(size):
        here = np.flatnonzero(exists[i])
        gaps = {}
        for b, places in enumerate(followed):
            last, k = places[-1]
            if i - last <= _LOST:
                likely = (size[last, k], _ahead(x, size, places, i))
                gaps |= {(j, b): _gap(row[j], likely) for j in here if multiple[i, j] == multiple[last, k]}
        for (k, b), gap in sorted(gaps.items(), key=lambda item: item[1]):
            if branch[i, k] < 0 and b not in branch[i] and gap <= _NEAR:
                branch[i, k] = b
                followed[b].append((i, k))
        for k in here[branch[i, here] < 0]:
            branch[i, k] = len(followed)
            followed.append([(i, k)])
    return branch


def _ahead(x: np.ndarray, size: np.ndarray, places: list[tuple[int, int]], i: int) -> float:
    """The size at ``x[i]`` on the straight line through the last two of ``places`` in ``size``, NaN if there is none."""
    if len(places) < 2:
        return np.nan
    (before, _), (last, _) = places[-2:]
    first, second = (size[place] for place in places[-2:])
    return second + (second - first) * (x[i] - x[last]) / (x[last] - x[before]) if np.isfinite(second) else np.nan


def _gap(size: float, likely: tuple[float, float]) -> float:
    """Difference from the nearer of the ``likely`` sizes, over the size; 0 between two without a size.

    Both count: beside a peak the straight line overshoots.
    """
    if not np.isfinite(size):
        return 0.0 if size == likely[0] else np.inf
    return float(np.nanmin(np.abs(size - np.array(likely)))) / max(abs(size), _REST)


def _letter(number: int) -> str:
    return f"{ascii_uppercase[number % 26]}{number // 26 or ''}"


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    size, share = (dataset[each].transpose(name, "attractor").values for each in _NEEDED)
    error = dataset["basin_error"].transpose(name, "attractor").values if "basin_error" in dataset else 0 * share
    exists = np.isfinite(share)
    # Where it is not stored, attractors with a size are periodic.
    multiple = np.isfinite(size)
    if "attractor_multiple" in dataset:
        multiple = dataset["attractor_multiple"].transpose(name, "attractor").values
    branch = _followed(dataset[name].values, size, exists, multiple)
    count = branch.max(initial=-1) + 1
    further = max(math.ceil(count / _ENTRIES) - 2, 0) * _ENTRY_HEIGHT
    panels = Panels(2, height=_HEIGHT, margins=Margins(left=1.0, right=0.3, bottom=0.9 + further), share_y=False)
    (upper,), (lower,) = panels.axes
    handles = []
    for number in range(count):
        i, k = np.nonzero(branch == number)
        x = dataset[name].values[i]
        style = {
            "color": ATTRACTOR_COLOURS[number % len(ATTRACTOR_COLOURS)],
            "linestyle": "",
            "marker": _MARKERS[number // len(ATTRACTOR_COLOURS) % len(_MARKERS)],
            "markersize": 2.5,
        }
        handles += upper.plot(x, size[i, k], **style, label=f"motion {_letter(number)}")
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
