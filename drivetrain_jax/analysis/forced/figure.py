"""Figures of the analysis ``forced``: amplitudes of the displacements, and stability of the nonlinear periodic orbit."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts

_AMPLITUDES = ("amplitude", "orbit_amplitude")
_SCALARS = ("orbit_spectral_radius", "condition")


def plot(dataset: xr.Dataset) -> Figure:
    """Amplitudes of the displacements, and the orbit's spectral radius minus 1 and the condition if stored.

    Over one axis as curves (solid: linear response, dashed: nonlinear orbit), over two axes as maps. Raises
    :class:`InputError` for another number of axes, and if none of these variables is stored.
    """
    shown = charts.require_any(dataset, *_AMPLITUDES, *_SCALARS)
    names = charts.sweep_axes(dataset)
    if len(names) == 1 and names != ["point"]:
        amplitudes = [key for key in _AMPLITUDES if key in dataset]
        panels = [amplitudes] * bool(amplitudes) + [[key] for key in _SCALARS if key in dataset]
        decades = (*_AMPLITUDES, "condition")
        return charts.stack(dataset, names[0], panels, forced=True, logarithmic=decades).finish(dataset)
    if len(names) == 2:
        rows = [row for key in shown for row in charts.split(dataset, key)]
        sheet = charts.maps(rows, charts.horizontal_first(dataset, names), forced=True)
        return sheet.finish(dataset)
    raise charts.wrong_axes(dataset, "one or two axes of several values for a figure of forced response")
