"""Figures of the analysis ``parameters``: constants over one parameter as curves, or as a table."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.style import LINE_COLOURS


def plot(dataset: xr.Dataset) -> Figure:
    """One panel for every stored constant over the axis of ``dataset``; without axes a table of the values."""
    return charts.chart(dataset, colours=LINE_COLOURS[:1])
