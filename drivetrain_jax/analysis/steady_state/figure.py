"""Figures of the analysis ``steady_state``: regimes and amplitudes over parameters, basins, and a single motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet
from drivetrain_jax.view.style import (
    ATTRACTOR_COLOURS,
    FAILED_COLOUR,
    FLAG_COLOURS,
    FRAME_GREY,
    LINE_COLOURS,
    PENDING_COLOUR,
    axis_label,
    units_of,
    variable_label,
)

_CURVES = ("period_multiple", "spectral_radius", "lyapunov_exponent", "impact_velocity", "contact_fraction")
# Relative difference of amplitudes below which attractors are the same.
_SAME = 1e-5


def plot(dataset: xr.Dataset) -> Figure:
    """The figure of a ``steady_state`` result, by its axes.

    - none: time history and phase portrait of the motion (needs ``u_history`` and ``v_history``);
    - one: extremes, period multiple, growth, impact velocity and contact fraction of both flanks along the axis, over bands
      of the regimes;
    - the initial state: basins of the attractors with the share of each;
    - any others: the regime and the largest displacement, with a predicted threshold.

    Raises :class:`InputError` if variables are missing.
    """
    names = charts.sweep_axes(dataset)
    initial = [charts.role(dataset, role) for role in ("initial_displacement", "initial_rate")]
    if not names:
        return _motion(dataset)
    if len(names) == 1 and names != ["point"]:
        return _curves(dataset, names[0])
    return (
        _basins(dataset, *initial) if set(names) == set(initial) else charts.chart(dataset, fields=["regime", "u_max"])
    )


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    extremes = charts.require(dataset, "u_max", "u_min", some=True)
    dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 1.8}
    sheet = charts.stack(dataset, name, [extremes, *([key] for key in _CURVES if key in dataset)], **dots)
    first = sheet.axes[0, 0]
    # Extremes of motions that are not periodic depend on the time of observation.
    for key in extremes if "period_multiple" in dataset else ():
        values = charts.valid(dataset, key).where(dataset["period_multiple"] == 0)
        other = dots | {"color": FLAG_COLOURS["non_periodic"], "label": "not periodic"}
        sheet.add(*(first.plot(dataset[name], values, **other) if bool(values.notnull().any()) else ()))
    sheet.add(*charts.draw_flanks(dataset, first))
    return sheet.finish(dataset)


def _basins(dataset: xr.Dataset, horizontal: str, vertical: str) -> Figure:
    charts.require(dataset, "u_max", "period_multiple")
    codes, names = _attractors(dataset)
    sheet = Sheet(height=4.6)
    axes = sheet.axes[0, 0]
    colours = [*ATTRACTOR_COLOURS[: len(names)], FAILED_COLOUR, PENDING_COLOUR]
    scale = {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(names) + 1.5}
    charts.draw_cells(axes, codes.drop_vars(charts.PENDING, errors="ignore"), horizontal, vertical, **scale)
    for k, (colour, label) in enumerate(zip(colours, [*names, "other or failed", charts.PENDING], strict=True)):
        share = float((codes == k).mean())
        patch = Patch(facecolor=colour, edgecolor=FRAME_GREY, linewidth=0.6, label=f"{label}: {share:.1%}")
        sheet.add(*([patch] if share > 0 else []))
    sheet.label(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    return sheet.finish(dataset)


def _attractors(dataset: xr.Dataset) -> tuple[xr.DataArray, list[str]]:
    """The number of each point's attractor, by falling share, with the properties of the attractors; one more for other or
    failed points, two more for pending ones."""
    known = (dataset["outcome"] < FIRST_FAILURE).values
    multiple, high = (dataset[name].values[known] for name in ("period_multiple", "u_max"))
    # All non-periodic motions count as one attractor.
    level = np.where(multiple > 0, np.log(np.abs(high) + 1e-300) / _SAME, 0.0)
    # Motions of one period whose sizes form a chain of neighbours are one attractor.
    order = np.lexsort((level, multiple))
    first = np.append(True, (np.diff(multiple[order]) != 0) | (np.diff(level[order]) > 1))[: order.size]
    kind = np.empty(order.size, int)
    kind[order] = np.cumsum(first) - 1
    shown = np.argsort(-np.bincount(kind), kind="stable")[: len(ATTRACTOR_COLOURS)]
    numbers = np.full(kind.max(initial=-1) + 1, len(shown))
    numbers[shown] = np.arange(len(shown))
    examples, units = order[first][shown], units_of(dataset["u_max"])
    names = [
        f"period {m}, largest u {size:.4g} {units}".removesuffix(" 1") if m else "non-periodic"
        for m, size in zip(multiple[examples], high[examples], strict=True)
    ]
    codes = np.full(known.shape, len(names))
    codes[known] = numbers[kind]
    codes[dataset.get(charts.PENDING, known & False)] = len(names) + 1
    return dataset["outcome"].copy(data=codes), names


def _motion(dataset: xr.Dataset) -> Figure:
    charts.require(dataset, "u_history", "v_history")
    charts.require_values(dataset["u_history"])
    u, v, part = dataset["u_history"], dataset["v_history"], dataset["sample"]
    sheet = Sheet(1, 2, height=2.8, sharex=False, sharey=False)
    axes: list[Axes] = sheet.axes[0].tolist()
    history, portrait = axes
    sheet.add(*history.plot(part, u, color=LINE_COLOURS[0], label="displacement"))
    portrait.plot(np.append(u, u[0]), np.append(v, v[0]), color=LINE_COLOURS[0])
    start: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 4, "color": LINE_COLOURS[1]}
    portrait.plot(u[0], v[0], **start)
    sheet.add(*history.plot(part[0], u[0], label="start of a drive period", **start))
    sheet.add(*charts.draw_flanks(dataset, history, portrait=portrait))
    history.set(xlim=(0, 1), xlabel="part of the motion's period", ylabel=variable_label(u))
    portrait.set(xlabel=variable_label(u), ylabel=variable_label(v))
    return sheet.finish(dataset)
