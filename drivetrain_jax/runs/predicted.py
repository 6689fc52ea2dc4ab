"""Resonances that a system predicts for its results, as values of an axis. Without jax, for figures."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.resonances import BUILT_IN
from drivetrain_jax.view.style import is_joined, parameters, scene_key

if TYPE_CHECKING:
    import xarray as xr

LABELS = "resonance"


def resonances(dataset: xr.Dataset) -> xr.DataArray | None:
    """The predicted resonances of the system of ``dataset``, values of one of its axes; None without any.

    Returns: ``resonance_AXIS``; its dimensions are the axes that the predictions depend on, then ``resonance`` (labels).
    """
    # Local import: points over no range need no xarray.
    import xarray as xr

    predicted = BUILT_IN.get(system := str(dataset.attrs.get("system")))
    if system not in BUILT_IN:
        # Local import: the module imports jax.
        from drivetrain_jax.systems import get_system

        # The package of the system may not be installed, or the dataset may be a sweep of a function.
        with suppress(InputError):
            predicted = get_system(system).resonances
    if predicted is None or is_joined(dataset):
        return None
    needed, axis = set(predicted.parameters), predicted.axis
    # The axis of every parameter that varies: its own, or that of the physical data in place of it.
    dims = {name: str(c.dims[0]) for name, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in dataset.coords}
    dims = {str(name): dim for name, dim in dims.items() if name in {axis, *needed} and dim != "point"}
    varied = {scene_key(coordinate).partition("[")[0] for coordinate in dataset.coords.values() if coordinate.ndim}
    known = {name: value for name, value in parameters(dataset).items() if name not in varied}
    known |= {name: dataset[name].values for name in dims}
    if axis not in dims or not needed <= known.keys() or {*predicted.without} & {*known, *dataset.coords}:
        return None
    names = sorted(needed & dims.keys(), key=lambda name: list(dataset.dims).index(dims[name]))
    mesh = dict(zip(names, np.meshgrid(*(known[name] for name in names), indexing="ij"), strict=True))
    values, quantity = predicted.values(known | mesh), dataset[dims[axis]]
    if quantity.name != axis:
        order = np.argsort(known[axis])
        parameter, shown = known[axis][order], quantity.values[order]
        # Quantity and parameter are proportional, or else known within the axis alone.
        ratio = shown[-1] / parameter[-1]
        proportional = np.allclose(shown, ratio * parameter, rtol=1e-12, atol=0)
        values = values * ratio if proportional else np.interp(values, parameter, shown, left=np.nan, right=np.nan)
    coords = {dims[name]: dataset[dims[name]].variable for name in names}
    coords[LABELS] = xr.Variable(LABELS, list(predicted.labels), {"long_name": "resonance"})
    about = {"units": quantity.attrs["units"], "long_name": predicted.long_name}
    return xr.DataArray(values, coords, [*coords], f"{LABELS}_{quantity.name}", about)
