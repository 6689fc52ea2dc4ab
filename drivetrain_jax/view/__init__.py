"""Figures of results: a matplotlib Figure from a Dataset, without jax or the code that computed it.

Other packages add figures of their analyses through the entry point group ``drivetrain_jax.figures``; each entry point names
a function from a Dataset to a Figure.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from drivetrain_jax._errors import InputError
from drivetrain_jax._plugins import FIGURES, call_plugin, load_plugin, plugin_names

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["plot"]


def plot(dataset: xr.Dataset, *others: xr.Dataset) -> Figure:
    """The figure of the analysis of ``dataset`` (attribute ``analysis``), for example a stability chart.

    A result of another function has lines, maps or a table of its variables. ``others`` are results of the same analysis by
    other methods, drawn into the same axes (``frequency_response``). Axes of one value count as fixed. Save the figure with
    ``figure.savefig(path)``. Raises :class:`InputError` for a dataset that is no result, for a result without values to
    plot, and for results that cannot share a figure.
    """
    # Local import: the rules import xarray, whose first import comes back here for the accessor.
    from drivetrain_jax._rules import BUILT_IN, Declared

    analysis = str(dataset.attrs.get("analysis"))
    if analysis == "atlas":
        drawn = "what its `grid` and `drivetrain plot` make of it"
        raise InputError(f"analysis = 'atlas': is a function; expected {drawn}")
    plugin = None if analysis in BUILT_IN else load_plugin(FIGURES, analysis, "a function")
    record = BUILT_IN.get(analysis, Declared())
    if others and plugin is None and not record.overlaid:
        allowed = ", ".join(name for name, other in BUILT_IN.items() if other.overlaid)
        raise InputError(
            f"analysis = {analysis!r}: several results in one figure; expected one, or several of {allowed}"
        )
    for other in (one.attrs.get("analysis") for one in others):
        if other != analysis:
            raise InputError(f"analysis = {other!r}: expected the analysis of the first result, {analysis}")
    # Local imports: matplotlib takes long, and results without a figure need none.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if plugin is not None:
        allowed = "a matplotlib Figure"
        return call_plugin(FIGURES, analysis, "figure", plugin, dataset, *others, kind=Figure, allowed=allowed)
    if analysis not in BUILT_IN and "outcome" not in dataset:
        known = ", ".join((*sorted({*BUILT_IN} - {"atlas"}), *plugin_names(FIGURES)))
        raise InputError(f"analysis = {analysis!r}: has no figure; expected one of {known}")

    from drivetrain_jax.view.charts import chart, prepare
    from drivetrain_jax.view.style import STYLE, alike

    with rc_context(STYLE):
        first, figure = prepare(dataset), None
        datasets = [first, *(alike(prepare(one), first) for one in others)]
        if record.figure:
            module, _, name = record.figure.partition(".")
            figure = getattr(import_module(f"drivetrain_jax.view.{module}"), name)(*datasets)
        look = {"logarithmic": record.logarithmic, "dots": record.dots}
        return figure or chart(datasets[0], record.panels, record.fields, **look)
