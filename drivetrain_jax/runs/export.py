"""Convert a Zarr store to one HDF5 file: arrays, coordinates and labels equal those of an HDF5 run."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import InputError, RetryableError
from drivetrain_jax.runs.assemble import labelled
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import restore_scene, result_variables
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.consolidate import ResultFile, release
from drivetrain_jax.store.parts import PartsFolder


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the new file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is not a sound Zarr store, or if ``out`` exists, and :class:`RetryableError`
    after an I/O error.
    """
    if not zarr_store.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    parts = PartsFolder(out)
    if out.exists() or not out.parent.is_dir() or parts.holds_work():
        raise InputError(f"out = {str(out)!r}: allowed is a new file in an existing folder, without unfinished work")
    if not zarr_store.is_sealed(store):
        raise _damaged(store, "its attributes are damaged, or it is not finished")
    attrs = zarr_store.attributes(store)
    scene = restore_scene(attrs["scene"])
    kept = {name: value for name, value in attrs.items() if name not in (zarr_store.SEAL, "coordinates")}
    shapes, shards = zarr_store.result_shapes(store), zarr_store.shards_of(store)
    zeros = {v.name: np.broadcast_to(np.zeros((), v.dtype), shapes[v.name]) for v in result_variables(scene)}
    try:
        parts.open()
        with ResultFile(parts.result) as file:
            arrays = file.lay_out(labelled(scene, zeros, kept))
            for shard in range(shards.count):
                results = zarr_store.read(store, shards, shard)
                if results is None:
                    raise _damaged(store, f"shard {shard} is damaged")
                for name, values in results.items():
                    arrays[name][shards.place(shard)] = values
                release(arrays.values())
            file.finish(out)
    except OSError as error:
        raise RetryableError(f"out = {str(out)!r}: {error}; the same command tries again") from None
    finally:
        parts.close(remove=True)
    return math.prod(Grid.of(scene).result_shape)


def _damaged(store: Path, what: str) -> InputError:
    return InputError(f"store = {str(store)!r}: {what}; allowed is a sound store: run its scene again with --fresh")
