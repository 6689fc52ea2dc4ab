"""Figures of results in memory or in files, atlases among them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from drivetrain_jax import view
from drivetrain_jax._errors import InputError, shown
from drivetrain_jax._rules import BUILT_IN as declared
from drivetrain_jax.runs.predicted import LABELS, resonances
from drivetrain_jax.view.style import check_measured, in_units, listed, size

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    Result = xr.Dataset | str | Path

# Default number of cells along each axis in the chart of an atlas.
CELLS = 800
# Most cells of a figure: matplotlib needs some hundred bytes for each.
_MOST_CELLS = 100_000_000


def plot(
    result: Result | list[Result] | tuple[Result, ...],
    *others: Result,
    part: Mapping[str, float | tuple[float, float]] | None = None,
    cells: int | None = None,
    units: str | Sequence[str] | None = None,
) -> Figure:
    """The figure of a result, chosen by its analysis.

    Args:
        result: a dataset, the path of a result file, or a list of them; an atlas is drawn with its boundaries and tips.
        others: results of the same analysis by other methods, drawn into the same axes (``frequency_response``); or the
            atlas of a chart (``floquet``), whose boundaries and tips are drawn over the cells.
        part: the part of an atlas to show: a number or ``(low, high)`` by the name of a parameter.
        cells: the number of cells of an atlas along each axis (default 800).
        units: units of the axes, ``"rpm,deg"`` or a list (default: those in which the scene gives its axes).

    Returns: a matplotlib figure that shows itself in a notebook and belongs to no window: ``figure.savefig("chart.png")``.

    Raises: :class:`~drivetrain_jax.InputError` for a result that has no figure, and for a unit that fits no axis.

    >>> import drivetrain_jax as dt, numpy as np
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.4, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> chart = dt.sweep(dt.floquet, shaft, over={"beta": np.linspace(0, 1, 3), "Omega": np.linspace(1.3, 1.5, 3)})
    >>> len(dt.plot(chart).axes)  # two panels and a colour bar
    3
    """
    sources = [*result, *others] if isinstance(result, (list, tuple)) else [result, *others]
    if not sources:
        raise InputError("result = []: expected a result, or a list of one or more")
    asked = [] if units is None else listed(units)
    datasets = [_dataset(source) for source in sources]
    kinds = [dataset.attrs.get("analysis") for dataset in datasets]
    if kinds == ["atlas"]:
        return drawn([_chart(sources[0], part, cells)], asked)
    if part is not None or cells is not None:
        field = f"part = {shown(part)}" if part is not None else f"cells = {cells}"
        raise InputError(f"{field}: a result on a grid is drawn whole; expected an atlas")
    if kinds == ["floquet", "atlas"]:
        from drivetrain_jax.runs.atlas_chart import with_boundaries

        return drawn([with_boundaries(_loaded(datasets[0]), sources[1])], asked)
    if "atlas" in kinds:
        raise InputError("results: an atlas among several; expected an atlas alone, or a chart and its atlas")
    try:
        return drawn([_loaded(dataset) for dataset in datasets], asked)
    except (KeyError, IndexError) as error:
        if any(isinstance(source, (str, Path)) for source in sources):
            raise
        raise lacks(error, "its figure needs") from error


def lacks(error: Exception, why: str) -> InputError:
    """The error for a part of a result that lacks what ``error`` names."""
    lost = (re.search(r"'[^']+'", str(error)) or ["a dimension"])[0]
    return InputError(f"result: without {lost}, which {why}; expected a whole result")


def drawn(datasets: list[xr.Dataset], asked: list[str], check: bool = True) -> Figure:
    """The figure of ``datasets``, with axes in the units ``asked`` for that fit, else in those of the scene.

    ``check`` raises :class:`InputError` for a unit that measures nothing in the first dataset.
    """
    datasets = [in_physical_data(dataset, asked) for dataset in datasets]
    for k, dataset in enumerate(datasets):
        analysis = declared.get(str(dataset.attrs.get("analysis")))
        # Older files contain their predicted resonances.
        if analysis and analysis.predicted and LABELS not in dataset.coords:
            predicted = resonances(dataset)
            datasets[k] = dataset if predicted is None else dataset.assign_coords({predicted.name: predicted})
    if check:
        check_measured(datasets[0], asked)
    return view.plot(*(in_units(dataset, asked) for dataset in datasets))


def _dataset(source: Any) -> xr.Dataset:
    if isinstance(source, xr.Dataset):
        return source
    if not isinstance(source, (str, Path)):
        kind = type(source).__name__
        raise InputError(f"result: got a {kind}; expected a Dataset, the path of a result, or a list of them")
    from drivetrain_jax.store.checksums import refuse_damaged
    from drivetrain_jax.store.consolidate import open_result
    from drivetrain_jax.store.parts import PartsFolder

    path = Path(source)
    if not path.exists() and PartsFolder(path).holds_work():
        # Local import: the module imports jax, which a complete result does not need.
        from drivetrain_jax.runs import output

        return output.open_result(path)
    refuse_damaged(path)
    return open_result(path)


def _chart(source: Result, part: Mapping[str, Any] | None, cells: int | None) -> xr.Dataset:
    from drivetrain_jax.runs.atlas_chart import chart

    if part is not None and not isinstance(part, Mapping):
        raise InputError(f"part = {shown(part)}: expected numbers or (low, high) by the name of a parameter")
    for name, value in (part or {}).items():
        if isinstance(value, (list, tuple)) and len(value) != 2:
            raise InputError(f"part.{name} = {shown(value)}: expected a number or (low, high)")
    shown_part = {name: tuple(value) if isinstance(value, list) else value for name, value in (part or {}).items()}
    return chart(source, shown_part, CELLS if cells is None else cells)


def in_physical_data(dataset: xr.Dataset, asked: Sequence[str]) -> xr.Dataset:
    """``dataset`` with those dimensionless axes as physical data that then have one of the units ``asked`` for."""
    axes = [dim for dim in dataset["outcome"].dims if dim in dataset.coords] if "outcome" in dataset else []
    pure = [str(dim) for dim in axes if dataset[dim].attrs.get("units") == "1"]
    data = {n: e["value"] for n, e in json.loads(dataset.attrs.get("physical_data", "{}")).items()}
    if not (asked and pure and data):
        return dataset
    # Local import: the modules import jax, which figures in the units of the file do not need.
    from drivetrain_jax.runs.atlas_chart import in_physical_units
    from drivetrain_jax.systems import get_system

    try:
        physical = get_system(str(dataset.attrs.get("system"))).physical
    except InputError:
        return dataset
    known = {n: e["value"] for n, e in json.loads(dataset.attrs.get("fixed_parameters", "{}")).items()} | data
    for name in pure:
        quantity = physical.back(name, known) if physical else None
        if quantity is None or all(size(quantity[0].units, unit) is None for unit in asked):
            continue
        # Predictions along the parameter are computed again along the quantity.
        dataset = in_physical_units(dataset.drop_vars([LABELS, f"{LABELS}_{name}"], errors="ignore"), name, *quantity)
    return dataset


def _loaded(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` in memory, so that cells of an atlas are evaluated once.

    Dimensions without a coordinate, along which results were joined, are numbered.
    """
    if "outcome" not in dataset:
        return dataset
    outcome = dataset["outcome"]
    if outcome.dtype.kind == "U":
        raise InputError("result: has words for codes; expected the result itself, before .drivetrain.named()")
    if outcome.size > _MOST_CELLS:
        some = "select some with .sel or .isel"
        raise InputError(f"result: has {outcome.size:.3g} cells; expected up to {_MOST_CELLS:.0e} in a figure: {some}")
    return dataset.compute().assign_coords({d: range(n) for d, n in outcome.sizes.items() if d not in dataset.coords})
