"""Forces, stiffnesses and pressures with the usual prefix: 85 MN/m for 8.5e7 N/m."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax.view.units import CONVERTED

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
# Units whose first symbol takes a prefix: N, N/m, N m, N m/rad, N m2, N s/m, Pa.
_PREFIXED = re.compile(r"(N|Pa)(?![A-Za-z])")


def prefixed(values: Any, units: str) -> tuple[float, str]:
    """The divisor of ``values`` for a unit with a suitable prefix, and this unit.

    The prefix suits the median of the moduli without zeros and infinity, because the ends of an axis may lie decades apart.
    """
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size) & (size > 0)]
    if not (_PREFIXED.match(units) and size.size):
        return 1.0, units
    middle = np.median(size)
    return next(((factor, prefix + units) for factor, prefix in _PREFIXES if middle >= factor), (1.0, units))


def with_prefixes(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with its axes and results in units with suitable prefixes."""
    found: dict[Hashable, tuple[float, str]] = {}
    changed = {}
    for name, variable in sorted(dataset.variables.items(), key=lambda item: len(str(item[0]))):
        units = str(variable.attrs.get("units", ""))
        # A scalar coordinate belongs to the fixed parameters, whose captions choose prefixes themselves.
        wanted = variable.dtype.kind == "f" and CONVERTED not in variable.attrs and _PREFIXED.match(units)
        if not wanted or not (variable.ndim or name in dataset.data_vars):
            continue
        # One prefix for results of the same unit, which may share an axis, and for NAME, `boundary_NAME`, `tip_NAME_error`.
        axes = [axis for axis, (_, known) in found.items() if f"_{axis}" in str(name) and known.endswith(units)]
        key = units if name in dataset.data_vars else (axes or [name])[-1]
        factor, written = found.setdefault(key, prefixed(variable.values, units))
        changed[name] = (variable.dims, variable.values / factor, {**variable.attrs, "units": written})
    coords = {name: values for name, values in changed.items() if name in dataset.coords}
    return dataset.assign({n: v for n, v in changed.items() if n not in coords}).assign_coords(coords)
