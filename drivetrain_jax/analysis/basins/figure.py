"""Figure of the analysis ``basins``: attractors along one axis, and the share of initial states of each."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.style import ATTRACTOR_COLOURS

_NEEDED = ("attractor_u_max", "basin_fraction")
# Relative change of size between neighbours of the axis within which an attractor is the same.
_NEAR = 0.2
# Number of missing values in a row after which an attractor ends.
_LOST = 2
# Sizes below this are motions at rest.
_REST = 1e-300


def plot(dataset: xr.Dataset) -> Figure:
    """Largest displacement of every attractor, and the share of its basin with standard error, over the only axis.

    Raises :class:`InputError` for another number of axes, and if ``basin_fraction`` or ``attractor_u_max`` is missing.
    """
    names = charts.sweep_axes(dataset)
    if len(names) != 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis of several values for a figure of basins")
    charts.require(dataset, *_NEEDED)
    (name,) = names
    dataset = dataset.transpose(name, "attractor", ...)
    size, share = (dataset[key].values for key in _NEEDED)
    # Without a stored period multiple, attractors with a size are periodic.
    multiple = dataset["attractor_multiple"].values if "attractor_multiple" in dataset else np.isfinite(size)
    branch = _followed(dataset[name].values, size, np.isfinite(share), multiple)
    motions = np.arange(branch.max(initial=-1) + 1) + 1
    place, attractor = np.nonzero(branch >= 0)
    shown = dataset.drop_dims("attractor").assign_coords(motion=motions)
    for key in (*_NEEDED, "basin_error"):
        if key in dataset:
            values = np.full((len(size), len(motions)), np.nan)
            values[place, branch[place, attractor]] = dataset[key].values[place, attractor]
            shown[key] = (name, "motion"), values, dataset[key].attrs
    dots = {"linestyle": "", "marker": "o", "markersize": 2.5}
    sheet = charts.stack(shown, name, [[key] for key in _NEEDED], colours=ATTRACTOR_COLOURS, **dots)
    upper, lower = sheet.axes[:, 0]
    upper.set_ylim(bottom=min(0.0, float(dataset["attractor_u_max"].min())))
    lower.set_ylim(-0.03, 1.03)
    return sheet.finish(dataset)


def _followed(x: np.ndarray, size: np.ndarray, exists: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    """Branch numbers of attractors ``(values of the axis, attractors)``, -1 for none.

    Results are ordered by size, so the number of an attractor changes where a larger one appears. A branch goes on with the
    attractor of its period multiple that is nearest to its last size, or to the straight line through the last two: this
    overshoots near a peak. A branch ends after two misses.
    """
    branch, followed = np.full(size.shape, -1), []
    # All non-periodic motions are one attractor, which has no size.
    size = np.where(np.isfinite(size), size, np.inf)
    for i, row in enumerate(size):
        here, gaps = np.flatnonzero(exists[i]), []
        for b, places in enumerate(followed):
            rows, _ = recent = tuple(np.array(places[-2:]).T)
            likely = size[recent]
            if np.isfinite(likely).all():
                line = np.polynomial.Polynomial.fit(x[rows], likely, len(rows) - 1)
                likely = np.append(likely[-1], line(x[i]))
            alike = [k for k in here if multiple[i, k] == multiple[places[-1]] and i - rows[-1] <= _LOST]
            gaps += [(_gap(row[k], likely), k, b) for k in alike]
        for gap, k, b in sorted(gaps):
            if branch[i, k] < 0 and b not in branch[i] and gap <= _NEAR:
                branch[i, k] = b
                followed[b].append((i, k))
        for k in here[branch[i, here] < 0]:
            branch[i, k] = len(followed)
            followed.append([(i, k)])
    return branch


def _gap(size: float, likely: np.ndarray) -> float:
    """Relative difference of ``size`` from the nearest of the ``likely`` sizes; 0 if the attractor has no size on either."""
    if not np.isfinite(size):
        return 0.0 if size == likely[-1] else np.inf
    return float(np.abs(size - likely).min()) / max(abs(size), _REST)
