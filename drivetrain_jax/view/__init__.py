"""Figures of results: a Dataset in, a matplotlib Figure out. Needs neither jax nor the package that computed it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_MODULES = {"floquet": "stability", "forced": "response"}

__all__ = ["plot"]


def plot(dataset: xr.Dataset) -> Figure:
    """The figure that suits the analysis of ``dataset`` (attribute ``analysis``).

    ``floquet`` gives a stability chart, ``forced`` amplitudes of the periodic response. The figure belongs to no
    window: write it with ``figure.savefig(path)``. Raises :class:`InputError` for an analysis without a figure and
    for a result in which there is nothing to plot.
    """
    analysis = dataset.attrs.get("analysis")
    if analysis not in _MODULES:
        raise InputError(f"analysis = {analysis!r}: allowed is one of {', '.join(_MODULES)}")
    return import_module(f"drivetrain_jax.view.{_MODULES[analysis]}").plot(dataset)
