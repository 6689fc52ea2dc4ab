"""Compare the layout of a result file with its scene: a copy may have been cut, reordered or transposed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.assemble import axis_coordinates
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import Scene, result_variables
from drivetrain_jax.store import gate


def rearranged(path: Path, scene: Scene, grid: Grid) -> list[str]:
    """Names of the coordinates and results at ``path`` whose values, dimensions or shapes differ from those of ``scene``.

    Results are not read, so this is fast; checksums detect damaged values.
    """
    try:
        return _rearranged(path, scene, grid)
    except InputError:
        return ["its structure"]


def _rearranged(path: Path, scene: Scene, grid: Grid) -> list[str]:
    dims = ("point",) if scene.zipped else tuple(axis.dim for axis in scene.axes)
    expected = {c.name: c.values for c in axis_coordinates(scene) if c.name != "point"}
    with cast(Any, gate.opened(path)) as file:
        for own in scene.dimensions:
            if own.name in file:
                expected[own.name] = np.asarray(own.labels(file[own.name].size))
        wrong = [name for name, values in expected.items() if not _holds(file.get(name), values)]
        for variable in result_variables(scene):
            wrong += [] if _lies(file.get(variable.name), (*dims, *variable.dims), grid) else [variable.name]
    return wrong


def _holds(stored: h5py.Dataset | h5py.Group | None, values: np.ndarray) -> bool:
    if not isinstance(stored, h5py.Dataset):
        return False
    words = h5py.check_string_dtype(stored.dtype) is not None
    return np.array_equal((stored.asstr() if words else stored)[()], values)


def _lies(stored: h5py.Dataset | h5py.Group | None, dims: tuple[str, ...], grid: Grid) -> bool:
    if not isinstance(stored, h5py.Dataset) or stored.shape[: len(grid.result_shape)] != grid.result_shape:
        return False
    return [scales[0].name if len(scales) else None for scales in stored.dims] == [f"/{dim}" for dim in dims]
