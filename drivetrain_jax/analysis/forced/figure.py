"""Figures of the analysis ``forced``: amplitudes of the displacements, and stability of the nonlinear periodic orbit."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts

_AMPLITUDES = ("amplitude", "orbit_amplitude")


def plot(dataset: xr.Dataset) -> Figure:
    """Amplitudes (solid: linear response, dashed: nonlinear orbit), and the orbit's growth and the condition if stored."""
    panels = [_AMPLITUDES, ["orbit_spectral_radius"], ["condition"]]
    return charts.chart(dataset, panels, forced=True, logarithmic=(*_AMPLITUDES, "condition"))
