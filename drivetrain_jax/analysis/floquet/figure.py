"""Stability charts of the analysis ``floquet``."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts, overlays
from drivetrain_jax.view.sheet import Sheet
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS, axis_label, coordinate_text

# Largest number of values of an axis across a figure of small panels.
_FEW = 4
_MARKERS = {"stable": "o", "unstable": "o", "undecided": "D", charts.FAILED: "x", charts.PENDING: "."}


def plot(dataset: xr.Dataset) -> Figure:
    """The chart of a ``floquet`` result, by number of swept axes.

    - none: the multipliers in the complex plane;
    - one: the rate of growth, or the distance of the spectral radius from 1, with its error band;
    - two: regions of the verdict and a map of the growth (per second, turn or period), both with the limit of stability;
    - more: regions of the verdict for the first, middle and last value of two further axes;
    - ``[points]``: the points coloured by their verdict.

    Raises :class:`InputError` if needed variables are not stored.
    """
    names = charts.sweep_axes(dataset)
    if names == ["point"]:
        varying = charts.varying_parameters(dataset)
        return _curve(charts.along_points(dataset), "o") if len(varying) < 2 else _points(dataset, varying)
    if not names:
        return _multipliers(dataset)
    if len(names) == 1:
        return _curve(dataset)
    if len(names) > 2:
        return _small_multiples(dataset, names)
    shown = charts.require_any(dataset, "verdict", "spectral_radius")
    return charts.maps([(name, [dataset]) for name in shown], charts.horizontal_first(dataset, names)).finish(dataset)


def _curve(dataset: xr.Dataset, marker: str = "") -> Figure:
    charts.require_any(dataset, "spectral_radius")
    (name,) = charts.sweep_axes(dataset)
    sheet = charts.stack(dataset, name, [["spectral_radius"]], height=3.0, marker=marker)
    if "verdict" in dataset:
        sheet.add(*charts.draw_strip(sheet.axes[0, 0], charts.valid(dataset, "verdict"), name, (-0.04, 0.0)))
        sheet.axes[0, 0].tick_params(axis="x", pad=10)
    return sheet.finish(dataset)


def _small_multiples(dataset: xr.Dataset, names: list[str]) -> Figure:
    charts.require_any(dataset, "verdict")
    # Axes of few values run across the figure, if two other axes remain.
    long = [name for name in names if dataset.sizes[name] > _FEW]
    horizontal = charts.horizontal_first(dataset, long if len(long) > 1 else names)[0]
    vertical = max((name for name in names if name != horizontal), key=lambda name: dataset.sizes[name])
    sliced = [name for name in names if name not in (horizontal, vertical)]
    # Only the first row has labels of the resonances, so an axis that changes their positions runs across.
    dependent = dataset.coords.get(f"resonance_{horizontal}", xr.DataArray(0)).dims
    sliced.sort(key=lambda name: name not in dependent)
    count = math.prod(dataset.sizes[name] for name in sliced)
    dataset = dataset.isel({name: dataset.sizes[name] // 2 for name in sliced[2:]})
    # If all is stable there is no boundary to draw: show the spectral radius instead, on a scale of its own.
    plain = _is_stable(dataset) and not overlays.traced(dataset, horizontal, vertical)
    dataset = dataset.assign(radius=dataset["spectral_radius"]) if plain else dataset
    rows = [dataset.isel({sliced[1]: k}) for k in _spread(dataset, sliced[1])] if len(sliced) > 1 else [dataset]
    parts = [[row.isel({sliced[0]: k}) for k in _spread(dataset, sliced[0])] for row in rows]
    titles = [[", ".join(coordinate_text(part[name]) for name in sliced[:2]) for part in row] for row in parts]
    shown = [("radius" if plain else "verdict", row) for row in parts]
    sheet = charts.maps(shown, (horizontal, vertical), height=1.8 if len(rows) > 1 else 2.8, titles=titles)
    drawn = sheet.axes.size
    notes = ["stable everywhere"] * plain + [f"{drawn} of {count} charts shown"] * (drawn < count)
    return sheet.finish(dataset, "; ".join(notes))


def _is_stable(dataset: xr.Dataset) -> bool:
    """True if all cells are stable and have a spectral radius."""
    return "spectral_radius" in dataset and bool((charts.valid(dataset, "verdict") == 0).all())


def _spread(dataset: xr.Dataset, name: str) -> list[int]:
    """First, middle and last index of an axis."""
    return sorted({0, dataset.sizes[name] // 2, dataset.sizes[name] - 1})


def _points(dataset: xr.Dataset, varying: list[str]) -> Figure:
    charts.require_any(dataset, "verdict")
    horizontal, vertical, *_ = charts.horizontal_first(dataset, varying)
    codes = charts.valid(dataset, "verdict")
    sheet = Sheet(height=3.4)
    axes = sheet.axes[0, 0]
    for entry in charts.flag_entries(codes):
        flag = str(entry.get_label()).rpartition(" (")[0]
        code = [*codes.attrs["flag_meanings"].split(), charts.FAILED, charts.PENDING].index(flag)
        chosen = dataset.isel(point=codes.values == code)
        look = (
            {"facecolors": "none", "edgecolors": FRAME_GREY} if flag == "stable" else {"color": entry.get_facecolor()}
        )
        look |= {"s": 22, "marker": _MARKERS[flag], "label": entry.get_label()}
        sheet.add(axes.scatter(chosen[horizontal], chosen[vertical], **look))
    sheet.label(axis_label(dataset[horizontal]), axis_label(dataset[vertical]))
    return sheet.finish(dataset)


def _multipliers(dataset: xr.Dataset) -> Figure:
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
