"""One HDF5 file from a Zarr store: the same arrays, coordinates and labels as those of a run that writes HDF5 itself."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax.store import shards
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import ResultFile
from drivetrain_jax.sweep.assemble import Table
from drivetrain_jax.sweep.grid import Grid
from drivetrain_jax.sweep.scene import load_scene


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the new file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is none or damaged, or if ``out`` exists or cannot be written.
    """
    if not shards.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    if out.exists() or not out.parent.is_dir():
        raise InputError(f"out = {str(out)!r}: allowed is a new file in an existing folder")
    attrs = shards.attributes(store)
    scene = load_scene(tomllib.loads(attrs["scene"]))
    kept = {name: value for name, value in attrs.items() if name != "groups"}
    parts, grid = PartsFolder(out), Grid.of(scene)
    try:
        parts.open()
        with ResultFile(parts.result) as file:
            table = Table(scene, grid, lambda blank: file.lay_out(blank.assign_attrs(kept)))
            _fill(store, attrs, table)
            table.lay_out()
            file.finish(out)
        parts.close(remove=True)
    except OSError as error:
        raise InputError(f"out = {str(out)!r}: {error.strerror or error}; allowed is a disk with room") from None
    finally:
        parts.close(remove=not out.exists())
    return grid.size * grid.path_length


def _fill(store: Path, attrs: Mapping[str, Any], table: Table) -> None:
    names = [shards.POINT, *(variable.name for variable in table.variables)]
    for group in shards.groups_of(attrs):
        for shard in range(group.shards):
            arrays = shards.read(store, group, shard, names)
            if arrays is None:
                raise InputError(
                    f"store = {str(store)!r}: shard {shard} of {group.name} is damaged; run its scene again"
                )
            points = arrays.pop(shards.POINT)
            rows = points >= 0
            table.fill(points[rows], {name: values[rows] for name, values in arrays.items()})
