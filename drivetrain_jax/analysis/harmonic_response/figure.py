"""Figure of the analysis ``harmonic_response``: amplitudes over the frequency, a panel for each kind of coordinate."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import LINE_COLOURS, STYLE, axis_label, in_brackets, units_of, variable_label

_HEIGHT, _ROUNDING = 1.5, 1e-12
_COLOURS = (*LINE_COLOURS, "#3f8f5f", "#7a4fa0", "#999933", "#333333", "#a0308c")

# Bodies and coordinates of the gear by the letters in the names of the coordinates.
_BODIES = {"c": "carrier", "r": "ring", "s": "sun"}
_KINDS = {
    "x": "translation $x$",
    "y": "translation $y$",
    "u": "rotation times base radius $u$",
    "xi": r"radial motion $\xi$",
    "eta": r"tangential motion $\eta$",
}
# Widths of the thinnest line and of the steps to those below, so that equal curves stay visible.
_THIN, _WIDER = 0.9, 0.8


def plot(dataset: xr.Dataset) -> Figure:
    """Amplitudes of a single point over the frequency, or the largest of all coordinates over one axis and the frequency.

    A panel holds the coordinates whose names begin alike (``x``, ``u``), a line for each body. Raises :class:`InputError`
    for more than one axis, and without ``amplitude``.
    """
    with matplotlib.rc_context(STYLE):
        dataset = cells.prepare(dataset)
        cells.require(dataset, "amplitude")
        cells.require_values(dataset["amplitude"], positive=True)
        names = cells.sweep_axes(dataset)
        if not names:
            return _lines(dataset)
        if len(names) > 1 or names == ["point"]:
            raise InputError(f"axes = {', '.join(names)}: allowed is one axis, or none")
        return _map(dataset, names[0])


def _lines(dataset: xr.Dataset) -> Figure:
    amplitude = dataset["amplitude"]
    kinds: dict[str, list[str]] = {}
    for dof in amplitude["dof"].values:
        kinds.setdefault(str(dof).partition("_")[0], []).append(str(dof))
    panels = Panels(len(kinds), height=_HEIGHT, margins=Margins(right=0.3, left=0.95, label=0.6), share_y=False)
    bodies = list(dict.fromkeys(dof.partition("_")[2] for dofs in kinds.values() for dof in dofs))
    colours: dict[str, Any] = {body: _COLOURS[i % len(_COLOURS)] for i, body in enumerate(bodies)}
    planets = [body for body in bodies if body not in _BODIES]
    # The lowest and widest lines are the lightest.
    colours |= dict(zip(planets, matplotlib.colormaps["viridis_r"](np.linspace(0.05, 1.0, len(planets))), strict=True))
    handles: dict[str, Artist] = {}
    # The amplitude of a coordinate that does not respond is rounding.
    smallest = _ROUNDING * float(amplitude.max())
    for (axes,), (kind, dofs) in zip(panels.axes, kinds.items(), strict=True):
        for dof in dofs:
            body = dof.partition("_")[2]
            values = amplitude.sel(dof=dof).where(lambda x: x > smallest)
            below = len(planets) - 1 - planets.index(body) if body in planets else 0
            style = {"color": colours[body], "linewidth": _THIN + _WIDER * below}
            name = _BODIES.get(body) or (f"planet {body}" if body.isdigit() else body)
            (handles[body],) = axes.semilogy(amplitude["frequency"], values, label=name, **style)
        panels.label_row(axes, f"{_KINDS.get(kind, kind)}{in_brackets(units_of(amplitude))}")
    panels.axes[0][0].set_xlim(*amplitude["frequency"].values[[0, -1]])
    panels.label_axes(axis_label(amplitude["frequency"]))
    panels.titles(dataset)
    panels.legend([handles[body] for body in bodies])
    return panels.figure


def _map(dataset: xr.Dataset, name: str) -> Figure:
    largest = dataset["amplitude"].max("dof")
    panels = Panels(height=3.0, margins=Margins(right=1.1))
    axes = panels.axes[0][0]
    field = largest.copy(data=np.log10(largest.where(largest > 0).values))
    mesh = cells.draw_cells(axes, field, "frequency", name, cmap="cividis")
    panels.colorbar(axes, mesh, rf"$\log_{{10}}$ of the largest {variable_label(dataset['amplitude'])}")
    panels.label_axes(axis_label(dataset["frequency"]), axis_label(dataset[name]))
    panels.titles(dataset)
    return panels.figure
