"""Figures of the analysis ``lyapunov``: spectra with their errors, convergence, and verdict."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS, axis_label, coordinate_text

_CURVES = ("lyapunov_spectrum", "paper_estimator", "sum_rule_residual", "chaos_k01")
# Variables whose sum is drawn too: the mean divergence of the flow, which is the subject of the paper's criterion (39).
_SUMMED = ("lyapunov_spectrum", "paper_estimator")
_MOST_COLUMNS = 4


def plot(dataset: xr.Dataset) -> Figure:
    """The exponents over one axis, over two axes as maps (columns for a third axis of up to four values), or over time.

    Over one axis: spectrum with bands of three standard errors, the paper's estimator, the sum rule's residual and K, if
    stored, with the verdict as a coloured strip. A single point shows the convergence history. Raises :class:`InputError`
    if none of these is stored.
    """
    names = charts.sweep_axes(dataset)
    if not names:
        return _convergence(dataset)
    if len(names) == 1:
        return _curves(dataset, names[0])
    columns = [name for name in names if dataset.sizes[name] <= _MOST_COLUMNS]
    if len(names) > 3 or (len(names) == 3 and not columns):
        raise charts.wrong_axes(dataset, f"one or two axes, or a third one of up to {_MOST_COLUMNS} values")
    across = columns[-1] if len(names) == 3 else None
    largest = dataset.isel(exponent=0) if "exponent" in dataset.dims else dataset
    if "lyapunov_spectrum" in largest:
        spectrum = largest["lyapunov_spectrum"].assign_attrs(long_name="largest Lyapunov exponent")
        largest = largest.assign(lyapunov_spectrum=spectrum)
    parts = [largest.isel({across: k}) for k in range(dataset.sizes[across])] if across else [largest]
    rows = [(key, parts) for key in charts.require_any(dataset, "lyapunov_spectrum", "verdict")]
    titles = [[coordinate_text(part[across]) for part in parts], [""] * len(parts)] if across else ()
    axes = charts.horizontal_first(dataset, [name for name in names if name != across])
    return charts.maps(rows, axes, titles=titles).finish(dataset)


def _convergence(dataset: xr.Dataset) -> Figure:
    if "lyapunov_history" not in dataset:
        raise InputError("outputs: lyapunov_history missing; the figure of a single point shows how it converges")
    sheet = Sheet(height=3.0)
    axes, history = sheet.axes[0, 0], dataset["lyapunov_history"]
    label = charts.draw_lines(sheet, axes, dataset, "segment", ["lyapunov_history"])
    for k, colour in zip(range(history.sizes["exponent"]), LINE_COLOURS, strict=False):
        last = history.isel(exponent=k).dropna("segment")
        if last.size and "lyapunov_standard_error" in dataset:
            low, high = (last[-1] + side * dataset["lyapunov_standard_error"][k].item() for side in (-3, 3))
            axes.axhspan(low, high, color=colour, alpha=0.15, linewidth=0)
    axes.set_xlim(0, history.sizes["segment"])
    sheet.label(f"{axis_label(history['segment'])}; band: three standard errors", label)
    return sheet.finish(dataset)


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    shown = charts.require_any(dataset, *_CURVES)
    sheet = charts.stack(dataset, name, [[key] for key in shown], marker=".", markersize=2.5)
    for (axes,), key in zip(sheet.axes, shown, strict=True):
        axes.axhline(0, color=FRAME_GREY, linewidth=0.6, zorder=0)
        if key in _SUMMED:
            charts.draw_sum(sheet, axes, dataset[key], name)
    if "lyapunov_spectrum" in shown and "verdict" in dataset:
        sheet.add(*charts.draw_strip(sheet.axes[0, 0], charts.valid(dataset, "verdict"), name, (1.0, 1.05)))
    return sheet.finish(dataset)
