"""Figure of the analysis ``basins``: attractors along one axis, and the share of initial states of each."""

from __future__ import annotations

from string import ascii_uppercase

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, fit_axis
from drivetrain_jax.view.style import ATTRACTOR_COLOURS, axis_label, variable_label

_NEEDED = ("attractor_u_max", "basin_fraction")
# Relative change of size between neighbours of the axis within which an attractor is the same.
_NEAR = 0.2
# Number of missing values in a row after which an attractor ends.
_LOST = 2
# Sizes below this are motions at rest.
_REST = 1e-300
_MARKERS = "os^D"


def plot(dataset: xr.Dataset) -> Figure:
    """Largest displacement of every attractor, and the share of its basin with standard error, over the only axis.

    Raises :class:`InputError` for another number of axes, and if ``basin_fraction`` or ``attractor_u_max`` is missing.
    """
    names = charts.sweep_axes(dataset)
    if len(names) != 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis of several values for a figure of basins")
    charts.require(dataset, *_NEEDED)
    (name,) = names
    size, share = (dataset[key].transpose(name, "attractor").values for key in _NEEDED)
    error = dataset["basin_error"].transpose(name, "attractor").values if "basin_error" in dataset else 0 * share
    # Without a stored period multiple, attractors with a size are periodic.
    multiple = np.isfinite(size)
    if "attractor_multiple" in dataset:
        multiple = dataset["attractor_multiple"].transpose(name, "attractor").values
    branch = _followed(dataset[name].values, size, np.isfinite(share), multiple)
    sheet = Sheet(2, height=2.2, sharey=False)
    upper, lower = sheet.axes[:, 0]
    for number in range(branch.max(initial=-1) + 1):
        i, k = np.nonzero(branch == number)
        x, turn = dataset[name].values[i], number // len(ATTRACTOR_COLOURS)
        style = {"linestyle": "", "marker": _MARKERS[turn % len(_MARKERS)], "markersize": 2.5}
        style["color"] = ATTRACTOR_COLOURS[number % len(ATTRACTOR_COLOURS)]
        label = f"motion {ascii_uppercase[number % 26]}{number // 26 or ''}"
        sheet.add(*upper.plot(x, size[i, k], **style, label=label))
        lower.errorbar(x, share[i, k], error[i, k], **style, elinewidth=0.8)
    fit_axis(upper, "x", dataset[name].values)
    upper.set_ylim(bottom=min(0.0, float(dataset["attractor_u_max"].min())))
    lower.set_ylim(-0.03, 1.03)
    sheet.label(axis_label(dataset[name]), variable_label(dataset["attractor_u_max"]), "share of the initial states")
    return sheet.finish(dataset)


def _followed(x: np.ndarray, size: np.ndarray, exists: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    """Branch numbers of attractors ``(values of the axis, attractors)``, -1 for none.

    Results are ordered by size, so the number of an attractor changes where a larger one appears. A branch is extrapolated
    from its last two sizes to the nearest attractor of its period multiple. A branch ends after two misses.
    """
    branch, followed = np.full(size.shape, -1), []
    # All non-periodic motions are one attractor, which has no size.
    size = np.where(np.isfinite(size), size, np.inf)
    for i, row in enumerate(size):
        here = np.flatnonzero(exists[i])
        gaps = {}
        for b, places in enumerate(followed):
            last, k = places[-1]
            if i - last <= _LOST:
                likely = (size[last, k], _ahead(x, size, places, i))
                gaps |= {(j, b): _gap(row[j], likely) for j in here if multiple[i, j] == multiple[last, k]}  # pyright: ignore[reportArgumentType]
        for (k, b), gap in sorted(gaps.items(), key=lambda item: item[1]):
            if branch[i, k] < 0 and b not in branch[i] and gap <= _NEAR:
                branch[i, k] = b
                followed[b].append((i, k))
        for k in here[branch[i, here] < 0]:
            branch[i, k] = len(followed)
            followed.append([(i, k)])
    return branch


def _ahead(x: np.ndarray, size: np.ndarray, places: list[tuple[int, int]], i: int) -> float:
    """The size at ``x[i]`` on the straight line through the last two of ``places`` in ``size``, NaN without one."""
    if len(places) < 2:
        return np.nan
    (before, _), (last, _) = places[-2:]
    first, second = (size[place] for place in places[-2:])
    return second + (second - first) * (x[i] - x[last]) / (x[last] - x[before]) if np.isfinite(second) else np.nan


def _gap(size: float, likely: tuple[float, float]) -> float:
    """Relative difference of ``size`` from the nearer of the ``likely`` sizes; 0 if neither attractor has a size.

    Both sizes count, because the straight line overshoots near a peak.
    """
    if not np.isfinite(size):
        return 0.0 if size == likely[0] else np.inf
    return float(np.nanmin(np.abs(size - np.array(likely)))) / max(abs(size), _REST)
