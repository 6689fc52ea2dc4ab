"""Figures of the analysis ``lyapunov``: spectra with their errors, convergence, and verdict."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import cells
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import (
    FRAME_GREY,
    LINE_COLOURS,
    STATE_COLOURS,
    STYLE,
    axis_label,
    coordinate_text,
    units_of,
    variable_label,
)

# In the order of the flags of the verdict; lightness falls from regular to irregular, undecided is grey.
KIND_COLOURS = ("#e6f0f7", "#b5d3ea", "#6ea6d0", "#d1771e", "#5b1020", "#b0b0b0")
_COLOURS = (*LINE_COLOURS, "#3f8f5f", "#7a4fa0", "#999933", "#333333")
_HEIGHT = 1.9
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
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        names = cells.sweep_axes(dataset)
        if not names:
            return _convergence(dataset)
        if len(names) == 1:
            return _curves(dataset, names[0])
        columns = [name for name in names if dataset.sizes[name] <= _MOST_COLUMNS]
        if len(names) == 2 or (len(names) == 3 and columns):
            return _maps(dataset, names, columns[-1] if len(names) == 3 else None)
        raise InputError(
            f"axes = {', '.join(names)}: allowed are one or two axes, or a third one of up to {_MOST_COLUMNS} values"
        )


def _convergence(dataset: xr.Dataset) -> Figure:
    if "lyapunov_history" not in dataset:
        raise InputError("outputs: lyapunov_history missing; the figure of a single point shows how it converges")
    panels = Panels(height=3.0, margins=Margins(right=0.3))
    axes = panels.axes[0][0]
    history = dataset["lyapunov_history"]
    handles: list[Artist] = []
    for k in range(history.sizes["exponent"]):
        handles += axes.plot(history["segment"], history.isel(exponent=k), color=_COLOURS[k], label=f"$L_{{{k + 1}}}$")
        if "lyapunov_standard_error" in dataset:
            last, error = history.isel(exponent=k).dropna("segment"), dataset["lyapunov_standard_error"][k].item()
            if last.size:
                axes.axhspan(last[-1] - 3 * error, last[-1] + 3 * error, color=_COLOURS[k], alpha=0.15, linewidth=0)
    axes.set_xlim(0, history.sizes["segment"])
    panels.label_row(axes, variable_label(history))
    panels.label_axes(f"{axis_label(history['segment'])}; band: three standard errors")
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    shown = cells.require_any(dataset, *_CURVES)
    panels = Panels(len(shown), height=_HEIGHT, margins=Margins(right=0.3, left=1.05, label=0.52), share_y=False)
    handles: list[Artist] = []
    for (axes,), key in zip(panels.axes, shown, strict=True):
        _draw_curves(axes, dataset, key, name)
        axes.axhline(0, color=FRAME_GREY, linewidth=0.6, zorder=0)
        panels.label_row(axes, variable_label(dataset[key]))
        if key == "lyapunov_spectrum" and "verdict" in dataset:
            handles = _verdict_strip(axes, dataset, name)
    cells.fit_axis(panels.axes[0][0], "x", dataset[name].values)
    panels.label_axes(axis_label(dataset[name]))
    panels.titles(dataset)
    panels.legend(handles)
    return panels.figure


def _draw_curves(axes: Axes, dataset: xr.Dataset, key: str, name: str) -> None:
    variable = dataset[key]
    own = [dim for dim in variable.dims if dim != name]
    x = dataset[name].values
    for k in range(variable.sizes[own[0]] if own else 1):
        values = variable.isel({own[0]: k}).values if own else variable.values
        axes.plot(x, values, color=_COLOURS[k], marker=".", markersize=2.5, label=f"{k + 1}" if own else None)
        if key == "lyapunov_spectrum" and "lyapunov_standard_error" in dataset:
            band = 3 * dataset["lyapunov_standard_error"].isel({own[0]: k}).values
            axes.fill_between(x, values - band, values + band, color=_COLOURS[k], alpha=0.2, linewidth=0)
    columns = variable.sizes[own[0]] if own else 0
    if own and key in _SUMMED:
        total = variable.values.sum(axis=-1)
        # A constant line far below would hide where the exponents part.
        constant = key == "lyapunov_spectrum" and np.ptp(total) < 1e-3 * np.abs(total).max()
        text = f"sum {total.mean():.4g} throughout" if constant else "sum"
        axes.plot(*(([], []) if constant else (x, total)), color=FRAME_GREY, linestyle="--", label=text)
        columns += 1
    if own:
        axes.legend(title=own[0], ncols=columns, loc="best", fontsize=7.5, title_fontsize=7.5)


def _verdict_strip(axes: Axes, dataset: xr.Dataset, name: str) -> list[Artist]:
    """Draw the verdict along the upper edge of the panel."""
    cells.draw_strip(axes, _kind(dataset), name, (1.0, 1.05), **_scale())
    return _kind_legend(dataset)


def _maps(dataset: xr.Dataset, names: list[str], split: str | None) -> Figure:
    rest = [name for name in names if name != split]
    horizontal = cells.horizontal_axis(dataset, rest)
    vertical = next(name for name in rest if name != horizontal)
    rows = cells.require_any(dataset, "lyapunov_spectrum", "verdict")
    parts = [dataset] if split is None else [dataset.isel({split: k}) for k in range(dataset.sizes[split])]
    panels = Panels(len(rows), len(parts), height=_HEIGHT, margins=Margins(right=1.05))
    for axes_row, key in zip(panels.axes, rows, strict=True):
        _map_row(panels, axes_row, parts, key, (horizontal, vertical))
    if split is not None:
        for axes, part in zip(panels.axes[0], parts, strict=True):
            axes.text(0.5, 1.03, coordinate_text(part[split]), transform=axes.transAxes, ha="center", size=8)
    for axes in panels.axes[-1]:
        axes.locator_params(axis="x", nbins=4)
    panels.label_axes(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    panels.titles(dataset)
    panels.legend(_kind_legend(dataset) if "verdict" in dataset else [])
    return panels.figure


def _map_row(panels: Panels, row: list[Axes], parts: list[xr.Dataset], key: str, names: tuple[str, str]) -> None:
    if key == "verdict":
        for axes, part in zip(row, parts, strict=True):
            cells.draw_cells(axes, _kind(part), *names, **_scale())
        return
    largest = [part["lyapunov_spectrum"].isel(exponent=0) for part in parts]
    finite = np.concatenate([field.values[np.isfinite(field.values)] for field in largest])
    low, high = (finite.min(), finite.max()) if finite.size else (-1.0, 1.0)
    for axes, field in zip(row, largest, strict=True):
        mesh = cells.draw_cells(axes, field, *names, cmap="cividis", vmin=low, vmax=high)
    units = units_of(parts[0]["lyapunov_spectrum"])
    panels.colorbar(row[-1], mesh, f"largest Lyapunov exponent [{units}]")


def _kind(dataset: xr.Dataset) -> xr.DataArray:
    """The verdict of each point; one code above the last for points without a value."""
    return dataset["verdict"].where(dataset["outcome"] < FIRST_FAILURE, len(KIND_COLOURS))


def _scale() -> dict[str, Any]:
    """Colours of :func:`_kind`."""
    colours = ListedColormap((*KIND_COLOURS, STATE_COLOURS[cells.FAILED]), name="kinds")
    return {"cmap": colours, "vmin": -0.5, "vmax": len(KIND_COLOURS) + 0.5}


def _kind_legend(dataset: xr.Dataset) -> list[Artist]:
    """Legend entries of the verdicts that occur and of missing values, with their number of points."""
    meanings = str(dataset["verdict"].attrs.get("flag_meanings", "")).split()
    counts = np.bincount(_kind(dataset).values.astype(int).ravel(), minlength=len(meanings))
    kinds = [
        Patch(
            facecolor=KIND_COLOURS[code], edgecolor=FRAME_GREY, linewidth=0.6,
            label=f"{meaning.replace('_', ' ')} ({counts[code]})",
        )
        for code, meaning in enumerate(meanings)
        if counts[code]
    ]  # fmt: skip
    return [*kinds, *cells.failure_legend(dataset)]
