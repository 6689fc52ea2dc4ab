"""The schema of a result: names, dimensions, units and CF attributes, before it becomes a Dataset or a file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax._quantities import Dimension, Variable

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"
# Long attributes, which would fill the display of a dataset, and the group of the file that holds them.
DETAILS, GROUP = frozenset({"numerics_detail"}), "provenance"


@dataclass(frozen=True)
class Coordinate:
    """Values of a parameter or prediction along dimensions of the result.

    ``parameter`` is the key of the parameter in the scene if it differs from ``name``.
    """

    name: str
    dims: tuple[str, ...]
    values: np.ndarray
    units: str
    long_name: str
    parameter: str = ""


@dataclass(frozen=True)
class Entry:
    """One variable of a result. ``fill`` is the value for missing data."""

    dims: tuple[str, ...]
    values: np.ndarray
    attrs: Mapping[str, Any]
    fill: float | None = None


@dataclass(frozen=True)
class Labelled:
    """A result with its labels as plain data. Converting it to a Dataset needs xarray, writing a file does not.

    A Dataset lacks the attributes ``DETAILS``.
    """

    coords: Mapping[str, Entry]
    data: Mapping[str, Entry]
    attrs: Mapping[str, Any]

    @classmethod
    def build(
        cls,
        sweep_dims: Sequence[str],
        coordinates: Iterable[Coordinate],
        dimensions: Iterable[Dimension],
        results: Iterable[tuple[Variable, np.ndarray]],
        attrs: Mapping[str, str | float],
    ) -> Labelled:
        """The labelled ``results``.

        Every variable has the dimensions ``sweep_dims`` followed by its own. Coordinates are written for the sweep
        (``coordinates``) and for the ``dimensions`` that a result uses; each has ``units`` and ``long_name``. A dimension
        without values is numbered from 1.
        """
        results = list(results)
        coords = {c.name: Entry(c.dims, c.values, _coordinate_attrs(c)) for c in coordinates}
        sizes = {d: n for v, values in results for d, n in zip(reversed(v.dims), reversed(values.shape), strict=False)}
        for d in dimensions:
            if d.name in sizes:
                coords[d.name] = Entry((d.name,), np.asarray(d.labels(sizes[d.name])), _labels(d.units, d.long_name))
        data = {
            v.name: Entry((*sweep_dims, *v.dims), values, _variable_attrs(v), _fill(values)) for v, values in results
        }
        return cls(coords, data, attrs)

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the dimensions, those of the coordinates first. ``ValueError`` if two entries disagree."""
        sizes: dict[str, int] = {}
        for name, entry in {**self.coords, **self.data}.items():
            for dim, size in zip(entry.dims, entry.values.shape, strict=True):
                if sizes.setdefault(dim, size) != size:
                    raise ValueError(f"{name}: length {size} along {dim!r}, which has length {sizes[dim]}")
        return sizes

    def with_attrs(self, **attrs: Any) -> Labelled:
        """A copy with these attributes added or replaced."""
        return replace(self, attrs={**self.attrs, **attrs})

    def to_dataset(self) -> xr.Dataset:
        """The result as a Dataset."""
        import xarray as xr  # Local import: xarray and pandas take half a second

        data, coords = (
            {n: (e.dims, e.values, e.attrs) for n, e in entries.items()} for entries in (self.data, self.coords)
        )
        dataset = xr.Dataset(data, coords, {name: value for name, value in self.attrs.items() if name not in DETAILS})
        for name, entry in {**self.coords, **self.data}.items():
            dataset.variables[name].encoding["_FillValue"] = entry.fill
        return dataset


def _fill(values: np.ndarray) -> float | None:
    return np.nan if values.dtype.kind == "f" else None


def _labels(units: str, long_name: str) -> dict[str, Any]:
    return {"units": units, "long_name": long_name}


def _coordinate_attrs(coordinate: Coordinate) -> dict[str, Any]:
    attrs = _labels(coordinate.units, coordinate.long_name)
    return attrs | {"parameter": coordinate.parameter} if coordinate.parameter else attrs


def _variable_attrs(variable: Variable) -> dict[str, Any]:
    """CF attributes; flag values have the type of the variable, as CF requires."""
    attrs = _labels(variable.units, variable.long_name)
    if ", " in variable.units:
        # CF allows one unit per variable.
        attrs = _labels("1", f"{variable.long_name} [{variable.units}]") | {"units_of_components": variable.units}
    if variable.flags:
        attrs["flag_values"] = np.arange(len(variable.flags), dtype=variable.dtype)
        attrs["flag_meanings"] = " ".join(flag.replace(" ", "_") for flag in variable.flags)
    if variable.lower is not None:
        attrs["valid_min"] = variable.lower
    return attrs
