"""Figure of the branches of forced orbits: amplitudes over the speed, with both stabilities, folds and period doublings."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from drivetrain_jax._errors import InputError
from drivetrain_jax.view import cells
from drivetrain_jax.view import resonance_lines as resonances
from drivetrain_jax.view.figure_layout import Margins, Panels
from drivetrain_jax.view.style import FRAME_GREY, LINE_COLOURS, axis_label, variable_label

_HEIGHT = 2.6
_STABLE, _UNSTABLE = range(2)
# Size of a dot and width of its edge, in points.
_SIZE, _EDGE = 2.4, 0.7
_SPECIAL = {"fold_frequency": ("fold", (0, (1, 2))), "doubling_frequency": ("period doubling", (0, (4, 2)))}


def plot(dataset: xr.Dataset, speed: str) -> Figure:
    """Amplitudes of all orbits over the ``speed``, one panel for each displacement: stable orbits filled, unstable open.

    Vertical lines mark folds and period doublings, if stored. Raises :class:`InputError` for another axis.
    """
    cells.require(dataset, "branch_amplitude", "branch_stability")
    if cells.sweep_axes(dataset) != [speed]:
        raise InputError(f"axes = {cells.described_axes(dataset)}: allowed is {speed} of several values")
    amplitude = dataset["branch_amplitude"]
    (own,) = (str(dim) for dim in amplitude.dims if dim not in (speed, "branch"))
    panels = Panels(amplitude.sizes[own], height=_HEIGHT, margins=Margins(right=0.3, left=1.0), share_y=False)
    handles: list[Artist] = []
    lines = resonances.predictions(dataset, speed, forced=True)
    stability = dataset["branch_stability"].transpose(speed, "branch").values
    for (axes,), name, colour in zip(panels.axes, amplitude[own].values, LINE_COLOURS, strict=False):
        values = amplitude.sel({own: name}).transpose(speed, "branch").values
        for kind, label, face in ((_STABLE, "stable", colour), (_UNSTABLE, "unstable", "none")):
            place, branch = np.nonzero(stability == kind)
            x, y = dataset[speed].values[place], values[place, branch]
            (dots,) = axes.plot(x, y, "o", color=colour, label=f"{label}, {name} {own}")
            dots.set(markerfacecolor=face, markersize=_SIZE, markeredgewidth=_EDGE)
            handles.append(dots)
        for key, (label, dashes) in _SPECIAL.items():
            found = np.unique(dataset[key].values) if key in dataset else np.zeros(0)
            for i, value in enumerate(found[np.isfinite(found)]):
                mark = axes.axvline(value, color=FRAME_GREY, linewidth=0.8, linestyle=dashes, label=label)
                handles += [] if i or name != amplitude[own].values[0] else [mark]
        axes.set_ylim(bottom=0.0)
        panels.label_row(axes, variable_label(amplitude))
        predicted = resonances.draw(axes, lines)
    cells.fit_axis(panels.axes[0][0], "x", dataset[speed].values)
    panels.label_axes(axis_label(dataset[speed]))
    resonances.label(panels.axes[0][0], lines)
    panels.titles(dataset)
    panels.legend([*handles, *cells.draw_failures(panels.axes[0][0], dataset, speed), *predicted])
    return panels.figure
