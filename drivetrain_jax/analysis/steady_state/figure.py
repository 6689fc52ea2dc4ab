"""Figures of the analysis ``steady_state``: regimes and amplitudes over parameters, basins, and a single motion."""

from __future__ import annotations

import itertools
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
    - any other two: the regime and the largest displacement, with a predicted threshold.

    Raises :class:`InputError` for other axes, and if variables are missing.
    """
    names = charts.sweep_axes(dataset)
    if not names:
        return _motion(dataset)
    if len(names) == 1 and names != ["point"]:
        return _curves(dataset, names[0])
    initial = [charts.role(dataset, role) for role in ("initial_displacement", "initial_rate")]
    if set(names) == set(initial):
        return _basins(dataset, *initial)
    if len(names) != 2:
        raise charts.wrong_axes(dataset, "one or two axes, or none, for a figure of steady states")
    rows = [(name, [dataset]) for name in charts.require_any(dataset, "regime", "u_max")]
    return charts.maps(rows, _speed_first(dataset, names)).finish(dataset)


def _speed_first(dataset: xr.Dataset, names: list[str]) -> list[str]:
    """The speed and the other axis: a predicted threshold is a curve over the speed."""
    return sorted(names, key=lambda name: name != charts.role(dataset, "speed"))


def _curves(dataset: xr.Dataset, name: str) -> Figure:
    extremes = charts.require_any(dataset, "u_max", "u_min")
    panels = [extremes, *([key] for key in _CURVES if key in dataset)]
    dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 1.8}
    sheet = charts.stack(dataset, name, panels, height=1.95, **dots)
    first = sheet.axes[0, 0]
    if "period_multiple" in dataset:
        # Extremes of motions that are not periodic depend on the time of observation.
        for key in extremes:
            values = charts.valid(dataset, key).where(dataset["period_multiple"] == 0)
            other = dots | {"color": FLAG_COLOURS["non_periodic"], "label": "not periodic"}
            sheet.add(*(first.plot(dataset[name], values, **other) if bool(values.notnull().any()) else ()))
    sheet.add(*charts.draw_flanks(dataset, first))
    if "regime" in dataset:
        for axes in sheet.axes[:, 0]:
            band = {"alpha": 0.35, "zorder": 0}
            sheet.add(*charts.draw_strip(axes, charts.valid(dataset, "regime"), name, (0.0, 1.0), **band))
    return sheet.finish(dataset)


def _basins(dataset: xr.Dataset, horizontal: str, vertical: str) -> Figure:
    charts.require(dataset, "u_max", "period_multiple")
    codes, names = _attractors(dataset)
    sheet = Sheet(height=4.6)
    axes = sheet.axes[0, 0]
    colours = [*ATTRACTOR_COLOURS[: len(names)], FAILED_COLOUR]
    scale = {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(names) + 0.5}
    charts.draw_cells(axes, codes, horizontal, vertical, **scale)
    for k, (colour, label) in enumerate(zip(colours, [*names, "other or failed"], strict=True)):
        share = float((codes == k).mean())
        patch = Patch(facecolor=colour, edgecolor=FRAME_GREY, linewidth=0.6, label=f"{label}: {share:.1%}")
        sheet.add(*([patch] if share > 0 else []))
    axes.set_box_aspect(1)
    sheet.label(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    return sheet.finish(dataset)


def _attractors(dataset: xr.Dataset) -> tuple[xr.DataArray, list[str]]:
    """The attractors by falling share: the number of each point's attractor, and its properties."""
    known = (dataset["outcome"] < FIRST_FAILURE).values
    multiple, high = dataset["period_multiple"].values, dataset["u_max"].values
    units = units_of(dataset["u_max"])
    # All non-periodic motions count as one attractor.
    level = np.where(multiple > 0, np.log(np.abs(np.where(known, high, 1.0)) + 1e-300) / _SAME, 0.0)
    keys = [(int(m), round(float(x))) for m, x in zip(multiple[known], level[known], strict=True)]
    merged = _merge(keys)
    kinds, counts = np.unique(merged, return_counts=True)
    kinds = kinds[np.argsort(-counts)][: len(ATTRACTOR_COLOURS)]
    codes = np.full(known.shape, len(kinds))
    flat = np.full(len(merged), len(kinds))
    names = []
    for number, kind in enumerate(kinds):
        flat[merged == kind] = number
        first = int(np.flatnonzero(merged == kind)[0])
        m = keys[first][0]
        size = high[known][first]
        names.append(f"period {m}, largest u {size:.4g} {units}".rstrip() if m else "non-periodic")
    codes[known] = flat
    return dataset["outcome"].copy(data=codes), names


def _merge(keys: list[tuple[int, int]]) -> np.ndarray:
    """Numbers of classes of ``(multiple, level)`` whose levels form chains of neighbours."""
    order = sorted(range(len(keys)), key=keys.__getitem__)
    numbers = np.zeros(len(keys), int)
    current = 0
    for before, here in itertools.pairwise(order):
        near = keys[before][0] == keys[here][0] and keys[here][1] - keys[before][1] <= 1
        current += not near
        numbers[here] = current
    return numbers


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
