"""Figures of the analysis ``lyapunov``: spectra with their errors, convergence, and verdict."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS

_CURVES = ("lyapunov_spectrum", "paper_estimator", "sum_rule_residual", "chaos_k01")
# Variables whose sum is drawn too: the mean divergence of the flow, which is the subject of the paper's criterion (39).
_SUMMED = ("lyapunov_spectrum", "paper_estimator")


def plot(dataset: xr.Dataset) -> Figure:
    """The exponents over one axis, the largest one and the verdict over more, or the convergence of a single point.

    Over one axis: spectrum with bands of three standard errors, the paper's estimator, the sum rule's residual and K, if
    stored. Raises :class:`InputError` if none of these is stored.
    """
    names = charts.sweep_axes(dataset)
    if not names:
        return _convergence(dataset)
    if len(names) > 1:
        largest = dataset.isel(exponent=0) if "exponent" in dataset.dims else dataset
        if "lyapunov_spectrum" in largest:
            spectrum = largest["lyapunov_spectrum"].assign_attrs(long_name="largest Lyapunov exponent")
            largest = largest.assign(lyapunov_spectrum=spectrum)
        return charts.chart(largest, fields=["verdict", "lyapunov_spectrum"])
    shown = charts.require(dataset, *_CURVES, some=True)
    sheet = charts.stack(dataset, names[0], [[key] for key in shown], marker=".", markersize=2.5)
    for (axes,), key in zip(sheet.axes, shown, strict=True):
        axes.axhline(0, color=FRAME_GREY, linewidth=0.6, zorder=0)
        if key in _SUMMED:
            charts.draw_sum(sheet, axes, dataset[key], names[0])
    return sheet.finish(dataset)


def _convergence(dataset: xr.Dataset) -> Figure:
    charts.require(dataset, "lyapunov_history")
    history = dataset["lyapunov_history"]
    sheet = charts.stack(dataset, "segment", [["lyapunov_history"]])
    for k, colour in zip(range(history.sizes["exponent"]), LINE_COLOURS, strict=False):
        last = history.isel(exponent=k).dropna("segment")
        if last.size and "lyapunov_standard_error" in dataset:
            low, high = (last[-1] + side * dataset["lyapunov_standard_error"][k].item() for side in (-3, 3))
            style = {"alpha": 0.15, "linewidth": 0, "label": "three standard errors"}
            sheet.add(sheet.axes[0, 0].axhspan(low, high, color=colour, **style))
    return sheet.finish(dataset)
