"""Figure of the analysis ``harmonic_response``: amplitudes over the frequency, a panel for each kind of coordinate."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from drivetrain_jax.view import charts
from drivetrain_jax.view.sheet import Sheet, plain_decades
from drivetrain_jax.view.style import LINE_COLOURS, axis_label, in_brackets, units_of

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
_THIN, _WIDER, _ROUNDING = 0.9, 0.8, 1e-12


def plot(dataset: xr.Dataset) -> Figure:
    """Amplitudes of a single point over the frequency, or the largest of all coordinates over one axis and the frequency.

    A panel holds the coordinates whose names begin alike (``x``, ``u``), a line for each body. Raises :class:`InputError`
    for more than one axis, and without ``amplitude``.
    """
    charts.require(dataset, "amplitude")
    charts.require_values(dataset["amplitude"], positive=True)
    names, amplitude = charts.sweep_axes(dataset), dataset["amplitude"]
    if len(names) > 1 or names == ["point"]:
        raise charts.wrong_axes(dataset, "one axis, or none")
    if names:
        about = amplitude.attrs | {"long_name": f"largest {amplitude.attrs.get('long_name', 'amplitude')}"}
        largest = dataset.assign(amplitude=amplitude.max("dof").assign_attrs(about))
        return charts.maps([("amplitude", [largest])], ["frequency", names[0]], height=3.0).finish(dataset)
    dofs = amplitude["dof"].values.astype(str).tolist()
    kinds = list(dict.fromkeys(dof.partition("_")[0] for dof in dofs))
    planets = [body for body in dict.fromkeys(dof.partition("_")[2] for dof in dofs) if body not in _BODIES]
    # The lowest and widest lines are the lightest.
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.05, 1.0, len(planets)))
    colours = dict(zip(_BODIES, LINE_COLOURS, strict=False)) | dict(zip(planets, shades, strict=True))
    sheet = Sheet(len(kinds), height=1.6, sharey=False)
    # The amplitude of a coordinate that does not respond is rounding.
    values = amplitude.where(amplitude > _ROUNDING * float(amplitude.max()))
    for dof in dofs:
        kind, _, body = dof.partition("_")
        below = len(planets) - 1 - planets.index(body) if body in planets else 0
        name = _BODIES.get(body) or (f"planet {body}" if body.isdigit() else body)
        style = {"color": colours[body], "linewidth": _THIN + _WIDER * below, "label": name}
        sheet.add(*sheet.axes[kinds.index(kind), 0].semilogy(amplitude["frequency"], values.sel(dof=dof), **style))
    for (axes,) in sheet.axes:
        plain_decades(axes, "y")
    sheet.axes[0, 0].set_xlim(*amplitude["frequency"].values[[0, -1]])
    units = in_brackets(units_of(amplitude))
    sheet.label(axis_label(amplitude["frequency"]), *(f"{_KINDS.get(kind, kind)}{units}" for kind in kinds))
    return sheet.finish(dataset)
