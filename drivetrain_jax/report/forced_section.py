"""Forced motion at the points of a stability result, for its comparison with a limit in a report."""

from __future__ import annotations

import tomllib
from typing import Any

import xarray as xr

from drivetrain_jax.runs.forced_limit import Limit
from drivetrain_jax.runs.run import run
from drivetrain_jax.runs.scene import find_system


def limit_of(result: xr.Dataset, given: Any) -> Limit | None:
    """The checked limit of the amplitude; None if the system of ``result`` has no forced response."""
    system = find_system(str(result.attrs.get("system")))
    return Limit.of(system, given) if "forced" in system.models and system.displacements is not None else None


def forced_motion(stability: xr.Dataset) -> xr.Dataset:
    """The forced amplitudes at the points of a ``floquet`` result, without a value where it is not stable."""
    scene = tomllib.loads(str(stability.attrs["scene"]))
    found = run({**scene, "analysis": "forced", "outputs": ["amplitude"], "options": {}})
    multipliers = abs(stability.get("floquet_multiplier", xr.DataArray(0.0)))
    radius = stability.get("spectral_radius", multipliers.max([d for d in multipliers.dims if d == "multiplier"]))
    grows = stability["verdict"] == 1 if "verdict" in stability else radius > 1
    amplitude = found["amplitude"].where(~grows)
    name = f"{amplitude.attrs['long_name']}, where stable"
    return found.assign(amplitude=amplitude.assign_attrs(long_name=name))
