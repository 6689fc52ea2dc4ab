"""Dimensionless axes of a result as the physical data behind them: a speed in rpm where the scene has J1 and k1."""

from __future__ import annotations

import json
from collections.abc import Sequence

import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.resonances import LABELS
from drivetrain_jax.view.units import size


def in_physical_data(dataset: xr.Dataset, asked: Sequence[str]) -> xr.Dataset:
    """``dataset`` with those dimensionless axes as physical data that then have one of the units ``asked`` for."""
    axes = [dim for dim in dataset.get("outcome", xr.DataArray()).dims if dim in dataset.coords]
    pure = [str(dim) for dim in axes if dataset[dim].attrs.get("units") == "1"]
    data = {n: e["value"] for n, e in json.loads(dataset.attrs.get("physical_data", "{}")).items()}
    if not (pure and data):
        return dataset
    # Local import: the modules import jax, which figures in the units of the file do not need.
    from drivetrain_jax.runs.atlas_chart import in_physical_units
    from drivetrain_jax.runs.scene import find_system

    try:
        physical = find_system(str(dataset.attrs.get("system"))).physical
    except InputError:
        return dataset
    known = {n: e["value"] for n, e in json.loads(dataset.attrs.get("fixed_parameters", "{}")).items()} | data
    for name in pure:
        found = physical.back(name, known) if physical else None
        if found is None or all(size(found[0].units, unit) is None for unit in asked):
            continue
        # Predictions along the parameter are computed again along the quantity.
        dataset = in_physical_units(dataset.drop_vars([LABELS, f"{LABELS}_{name}"], errors="ignore"), name, *found)
    return dataset
