"""The shape of a result: names, dimensions, units and CF attributes of one xarray Dataset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drivetrain_jax._quantities import Dimension, Variable

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"


@dataclass(frozen=True)
class Coordinate:
    """Values of a parameter, or of a prediction, along dimensions of the result."""

    name: str
    dims: tuple[str, ...]
    values: np.ndarray
    units: str
    long_name: str


def build_dataset(
    sweep_dims: Sequence[str],
    coordinates: Iterable[Coordinate],
    dimensions: Iterable[Dimension],
    results: Iterable[tuple[Variable, np.ndarray]],
    attrs: Mapping[str, str | float],
) -> xr.Dataset:
    """The labelled result.

    Every variable has the dimensions ``sweep_dims`` followed by its own. Coordinates are written for the sweep
    (``coordinates``) and for those ``dimensions`` that a result uses; every one has ``units`` and ``long_name``. A
    dimension without values of its own is numbered from 0.
    """
    import xarray as xr  # half a second with pandas, which a process that only looks at a result does without

    results = list(results)
    coords = {c.name: (c.dims, c.values, {"units": c.units, "long_name": c.long_name}) for c in coordinates}
    sizes = {
        dim: size for v, values in results for dim, size in zip(reversed(v.dims), reversed(values.shape), strict=False)
    }
    for d in dimensions:
        if d.name in sizes:
            values = np.asarray(d.values) if d.values else np.arange(sizes[d.name])
            coords[d.name] = ((d.name,), values, {"units": d.units, "long_name": d.long_name})
    data = {v.name: ((*sweep_dims, *v.dims), values, _variable_attrs(v)) for v, values in results}
    dataset = xr.Dataset(data, coords, {"Conventions": CONVENTIONS, **attrs})
    for name, variable in dataset.variables.items():
        missing = np.nan if name in data and variable.dtype.kind == "f" else None
        variable.encoding["_FillValue"] = missing
    return dataset


def _variable_attrs(variable: Variable) -> dict[str, object]:
    """CF attributes; the codes of a flag variable have its own type, as the convention demands."""
    attrs: dict[str, object] = {"units": variable.units, "long_name": variable.long_name}
    if variable.flags:
        attrs["flag_values"] = np.arange(len(variable.flags), dtype=variable.dtype)
        attrs["flag_meanings"] = " ".join(flag.replace(" ", "_") for flag in variable.flags)
    return attrs
