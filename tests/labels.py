"""Datasets of tests as what is written into a file."""

from __future__ import annotations

import xarray as xr

from drivetrain_jax.store.consolidate import Entry, Labelled


def labelled(dataset: xr.Dataset) -> Labelled:
    coords, data = (
        {n: Entry(v.dims, v.values, v.attrs, v.encoding.get("_FillValue")) for n, v in variables.items()}
        for variables in (dataset.coords, dataset.data_vars)
    )
    return Labelled(coords, data, dataset.attrs)
