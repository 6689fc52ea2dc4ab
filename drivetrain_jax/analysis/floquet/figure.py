"""Stability charts of the analysis ``floquet``."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS


def plot(dataset: xr.Dataset) -> Figure:
    """The chart of a ``floquet`` result: growth and verdict over its axes, or the multipliers of a single point.

    Raises :class:`InputError` if needed variables are not stored.
    """
    if charts.sweep_axes(dataset):
        return charts.chart(dataset, [["spectral_radius"]], ["verdict", "spectral_radius"])
    charts.require_any(dataset, "floquet_multiplier")
    charts.require_values(dataset["floquet_multiplier"])
    sheet = Sheet(height=4.0)
    axes = sheet.axes[0, 0]
    angle = np.linspace(0, 2 * np.pi, 361)
    circle = axes.plot(np.cos(angle), np.sin(angle), color=FRAME_GREY, linewidth=0.8, label="unit circle")
    values = dataset["floquet_multiplier"].values
    style = {"color": LINE_COLOURS[0], "markersize": 5, "label": "Floquet multipliers"}
    sheet.add(*axes.plot(np.real(values), np.imag(values), "o", **style), *circle)
    axes.set_aspect("equal", adjustable="datalim")
    sheet.label("real part of the multiplier", "imaginary part")
    return sheet.finish(dataset)
