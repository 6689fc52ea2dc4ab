"""Convert a Zarr store to one HDF5 file: arrays, coordinates and labels equal those of an HDF5 run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.assemble import Table
from drivetrain_jax.runs.grid import Grid
from drivetrain_jax.runs.scene import restore_scene
from drivetrain_jax.store import shards
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import ResultFile


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the new file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is not a sound Zarr store, or if ``out`` exists or cannot be written.
    """
    if not shards.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    if out.exists() or not out.parent.is_dir():
        raise InputError(f"out = {str(out)!r}: allowed is a new file in an existing folder")
    if not shards.is_sealed(store):
        raise _damaged(store, "its attributes are damaged, or it is not finished")
    attrs = shards.attributes(store)
    scene = restore_scene(attrs["scene"])
    kept = {name: value for name, value in attrs.items() if name not in (shards.GROUPS, shards.HELD, shards.SEAL)}
    parts, grid, ours = PartsFolder(out), Grid.of(scene), False
    try:
        parts.open()
        if parts.holds_work():
            raise InputError(f"out = {str(out)!r}: unfinished work is in {str(parts.path)!r}; allowed is a new file")
        ours = True
        with ResultFile(parts.result) as file:
            table = Table(scene, grid, lambda blank: file.lay_out(blank.with_attrs(**kept)))
            seen = _fill(store, shards.groups_of(attrs), table, np.zeros(grid.size, bool))
            if seen != attrs[shards.HELD]:
                raise _damaged(store, f"it holds {seen} of {attrs[shards.HELD]} points")
            table.lay_out()
            file.finish(out)
    except OSError as error:
        raise InputError(
            f"out = {str(out)!r}: {error.strerror or error}; allowed is a disk with enough free space"
        ) from None
    finally:
        parts.close(remove=ours)
    return grid.size * grid.path_length


def _fill(store: Path, groups: Sequence[shards.Group], table: Table, seen: np.ndarray) -> int:
    """Write all shards and mark their points in ``seen``; returns the number of points."""
    names = [shards.POINT, *(variable.name for variable in table.variables)]
    for group in groups:
        for shard in range(group.shards):
            arrays = shards.read(store, group, shard, names)
            if arrays is None:
                raise _damaged(store, f"shard {shard} of {group.name} is damaged")
            points, results = shards.without_padding(arrays)
            if (points >= seen.size).any() or seen[points].any() or np.unique(points).size < points.size:
                raise _damaged(store, f"shard {shard} of {group.name} holds points of another one, or of none")
            seen[points] = True
            table.fill(points, results)
    return int(np.count_nonzero(seen))


def _damaged(store: Path, what: str) -> InputError:
    return InputError(f"store = {str(store)!r}: {what}; allowed is a sound store: run its scene again with --fresh")
