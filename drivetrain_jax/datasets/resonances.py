"""Predicted resonances of the system of a result, computed on demand from its parameters."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import BUILT_IN, Resonances
from drivetrain_jax.view.style import is_joined, scene_key

LABELS = "resonance"


def resonances(dataset: xr.Dataset) -> xr.DataArray | None:
    """The predicted resonances of the system of ``dataset``, values of one of its axes; None without any.

    Returns: ``resonance_AXIS``; its dimensions are the axes that the predictions depend on, then ``resonance`` (labels).
    """
    predicted = _predicted(str(dataset.attrs.get("system")))
    if predicted is None or is_joined(dataset):
        return None
    # Axes given in physical data: the predictions are those along their parameters.
    given = {name: str(c.dims[0]) for name, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] != name}
    used = (predicted.axis, *predicted.parameters)
    given = {str(n): dim for n, dim in given.items() if n in used and dim in dataset and dim != "point"}
    found = _along_parameters(dataset.swap_dims({dim: name for name, dim in given.items()}), predicted)
    return None if found is None else _along_given(found, dataset, given, predicted.axis)


def _along_given(found: xr.DataArray, dataset: xr.Dataset, given: dict[str, str], axis: str) -> xr.DataArray:
    """``found`` along the axes of the dataset, as values of the quantity that is given in place of ``axis``."""
    swapped = {name: dim for name, dim in given.items() if name in found.dims}
    own = {dim: (name, dataset[dim].values, dataset[dim].attrs) for name, dim in swapped.items()}
    found = found.assign_coords(own).swap_dims(swapped)
    found = found.drop_vars(list(swapped))
    if axis not in given:
        return found
    quantity = dataset[given[axis]]
    order = np.argsort(dataset[axis].values)
    known = dataset[axis].values[order], quantity.values[order]
    # Quantity and parameter are proportional, or else known within the axis alone.
    ratio = known[1][-1] / known[0][-1]
    if np.allclose(known[1], ratio * known[0], rtol=1e-12, atol=0):
        values = found.values * ratio
    else:
        values = np.interp(found.values, *known, left=np.nan, right=np.nan)
    attrs = found.attrs | {"units": quantity.attrs["units"]}
    return xr.DataArray(values, found.coords, found.dims, f"{LABELS}_{given[axis]}", attrs)


def _along_parameters(dataset: xr.Dataset, predicted: Resonances) -> xr.DataArray | None:
    if predicted.axis not in dataset.dims:
        return None
    if any(name in dataset.coords or _value(dataset, name) is not None for name in predicted.without):
        return None
    values = {name: _value(dataset, name) for name in predicted.parameters}
    if any(value is None for value in values.values()):
        return None
    dims = [str(dim) for dim in dataset.dims if dim in values]
    mesh = dict(zip(dims, np.meshgrid(*(values[dim] for dim in dims), indexing="ij"), strict=True))
    about = {"units": dataset[predicted.axis].attrs["units"], "long_name": predicted.long_name}
    return xr.DataArray(
        predicted.values(values | mesh),
        {dim: dataset[dim] for dim in dims} | {LABELS: (LABELS, list(predicted.labels), {"long_name": "resonance"})},
        [*dims, LABELS],
        f"{LABELS}_{predicted.axis}",
        about,
    )


def _predicted(system: str) -> Resonances | None:
    if system in BUILT_IN:
        return BUILT_IN[system]
    # Local import: the module imports jax.
    from drivetrain_jax.runs.scene import find_system

    try:
        return find_system(system).resonances
    except InputError:
        # The package of the system is not installed, or the dataset is a sweep of a function.
        return None


def _value(dataset: xr.Dataset, name: str) -> Any:
    """The values of a parameter along its axis, or its fixed value; None without either."""
    if name in dataset.coords and dataset[name].dims in ((), (name,)):
        return dataset[name].values
    swept = {scene_key(coordinate).partition("[")[0] for coordinate in dataset.coords.values() if coordinate.ndim}
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}")).get(name)
    if fixed is None or name in swept:
        return None
    # JSON has no infinity.
    return np.inf if fixed["value"] == "inf" else fixed["value"]
