"""Figures of results: a matplotlib Figure from a Dataset, without jax and the package that computed it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_MODULES = {
    "floquet": "stability",
    "forced": "response",
    "history": "history",
    "lyapunov": "lyapunov",
    "poincare": "poincare",
    "parameters": "parameters",
    "modes": "modes",
    "frequency_response": "frequency_response",
    "steady_state": "steady_state",
    "basins": "basins",
    "critical_speeds": "critical_speeds",
}
# Analyses of which several results may share a figure.
_OVERLAYS = ("frequency_response",)

__all__ = ["plot"]


def plot(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """The figure of the analysis of ``dataset`` (attribute ``analysis``), for example a stability chart.

    ``others`` are results of the same analysis by other methods, drawn into the same axes (``frequency_response``). Save
    the figure with ``figure.savefig(path)``. Raises :class:`InputError` for an analysis without a figure, for a result
    without values to plot, and for results that cannot share a figure.
    """
    analysis = dataset.attrs.get("analysis")
    if analysis == "atlas":
        drawn = "what its `grid` and `drivetrain plot` make of it"
        raise InputError(f"analysis = 'atlas': is a function; allowed is {drawn}")
    if analysis not in _MODULES:
        raise InputError(f"analysis = {analysis!r}: allowed is one of {', '.join(_MODULES)}")
    if others and analysis not in _OVERLAYS:
        raise InputError(f"analysis = {analysis!r}: several results in one figure; allowed for {', '.join(_OVERLAYS)}")
    for other in others:
        if other.attrs.get("analysis") != analysis:
            raise InputError(
                f"analysis = {other.attrs.get('analysis')!r}: allowed beside the first result is {analysis}"
            )
    return import_module(f"drivetrain_jax.view.{_MODULES[analysis]}").plot(dataset, *others)
