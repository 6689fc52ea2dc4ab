"""Spectral radii as growth: per second where the speed is known, per turn of the shaft, else per period."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, SymLogNorm

from drivetrain_jax.view.boundary_curves import traced
from drivetrain_jax.view.cells import FAILED, cell_edges, draw_cells, role
from drivetrain_jax.view.style import FRAME_GREY, STATE_COLOURS
from drivetrain_jax.view.units import size

# Position between largest decay (-1), none (0) and largest growth (1), and colour; lightness falls monotonically. White is
# reserved for cells without a value.
_COLOURS = (
    (-1.0, "#fbfce0"),
    (-0.5, "#a9dcc3"),
    (0.0, "#86b1d6"),
    (0.12, "#d98e48"),
    (0.5, "#b8432f"),
    (1.0, "#2d0a2b"),
)


# Distance of a spectral radius from 1 that rounding can make.
_ROUNDING = 1e-12


class Growth(NamedTuple):
    """``values = factor ln(spectral radius)`` with their ``label``; colours are linear below ``linear`` and end at
    ``largest``, the same in every figure."""

    factor: xr.DataArray | float
    label: str
    linear: float
    largest: float

    def of(self, radius: xr.DataArray) -> Any:
        """The growth that a spectral radius means; a radius of 0 is infinite decay."""
        with np.errstate(divide="ignore"):
            return np.log(radius) * self.factor

    def norm(self) -> SymLogNorm:
        """The scale of the colours."""
        return SymLogNorm(self.linear, linscale=0.5, vmin=-self.largest, vmax=self.largest, base=10)


def growth_of(dataset: xr.Dataset) -> Growth:
    """The growth of small disturbances in ``dataset``, in the most useful unit that its parameters allow."""
    periods, speed = dataset.attrs.get("periods_per_turn", 0), role(dataset, "speed")
    axis = dataset.coords.get(speed)
    turns = None if axis is None else size(str(axis.attrs.get("units", "1")), "rps")
    if periods and axis is not None and turns is not None:
        return Growth(axis * turns * periods, "rate of growth [1/s]", 1e-3, 1e2)
    if periods:
        return Growth(float(periods), "growth per turn, natural logarithm of the factor", 1e-6, 1e1)
    return Growth(1 / np.log(10), "$\\log_{10}$ of the spectral radius", 1e-6, 1.0)


def draw_growth(
    axes: Axes, dataset: xr.Dataset, radius: xr.DataArray, horizontal: str, vertical: str
) -> tuple[QuadMesh, str, dict[str, Any]]:
    """Draw the growth that ``radius`` means as cells, with the limit of stability; returns label and options of the bar.

    A colour means the same growth in every figure with the same label. Pale yellow, green and blue are decay, from fast to
    none; orange to black is growth. Missing values have the colour of failed cells.
    """
    growth = growth_of(dataset)
    low, high, values = -growth.largest, growth.largest, growth.of(radius)
    cmap = LinearSegmentedColormap.from_list("growth", [((1 + x) / 2, colour) for x, colour in _COLOURS], N=1024)
    cmap = cmap.with_extremes(bad=STATE_COLOURS[FAILED])
    below, above = bool((values < low).any()), bool((values > high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    # A radius of 0 is the fastest decay, not a missing value.
    mesh = draw_cells(axes, values.clip(low, high), horizontal, vertical, cmap=cmap, norm=growth.norm())
    draw_limit(axes, dataset, radius, horizontal, vertical)
    decades = 10.0 ** np.arange(np.log10(growth.linear) + 1, np.log10(high) + 0.5)
    return mesh, growth.label, {"extend": extend, "ticks": [*-decades[::-1], 0.0, *decades]}


def draw_limit(axes: Axes, dataset: xr.Dataset, radius: xr.DataArray, horizontal: str, vertical: str) -> None:
    """Draw the limit of stability along the edges of the cells, where the colours end, unless the boundary is traced."""
    if traced(dataset, horizontal, vertical):
        return
    x, y = (cell_edges(radius[name].values.astype(float)) for name in (horizontal, vertical))
    # Without the bound of the error, so that the line surrounds the cells with the verdict unstable.
    field = (radius - dataset.get("spectral_radius_error", 0.0)).transpose(vertical, horizontal).values
    up, across = np.nonzero(_changes(field, 1)), np.nonzero(_changes(field, 0))
    segments = [np.stack([x[up[1] + 1], y[up[0]], x[up[1] + 1], y[up[0] + 1]], axis=-1)]
    segments += [np.stack([x[across[1]], y[across[0] + 1], x[across[1] + 1], y[across[0] + 1]], axis=-1)]
    lines = LineCollection(np.concatenate(segments).reshape(-1, 2, 2), colors=FRAME_GREY, linewidths=0.5)  # pyright: ignore[reportArgumentType]
    axes.add_collection(lines, autolim=False)


def scale_around_limit(axes: Axes, excess: xr.DataArray) -> None:
    """Set a logarithmic scale on both sides of the limit 0: it tells a spectral radius of 1 - 1e-5 from 1."""
    size = np.abs(excess.values[np.isfinite(excess.values) & (excess.values != 0)])
    # Linear below the smallest values.
    linear = 10.0 ** np.floor(np.log10(max(np.quantile(size, 0.1), _ROUNDING))) if size.size else 1.0
    axes.set_yscale("symlog", linthresh=linear)


def _changes(field: np.ndarray, axis: int) -> np.ndarray:
    """True where one of two neighbours along ``axis`` is unstable and the other is not; False next to a missing value."""
    first, second = np.delete(field, -1, axis), np.delete(field, 0, axis)
    return ((first > 1) != (second > 1)) & np.isfinite(first) & np.isfinite(second)
