"""Convert a Zarr store to one HDF5 file: arrays, coordinates and labels equal those of an HDF5 run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drivetrain_jax._errors import InputError, RetryableError
from drivetrain_jax.runs.assemble import labelled
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import restore_scene, result_variables
from drivetrain_jax.store import checksums, zarr_store
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import ResultFile, read_attribute, release


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is not a sound Zarr store, or if ``out`` exists, and :class:`RetryableError`
    after an I/O error. The file of an export that was killed after its end stays as it is.
    """
    if out.suffix.lower() == ".csv":
        raise InputError(
            f"FILE.nc = {str(out)!r}: allowed is a name that ends in .nc; a table is written by --csv {out}"
        )
    if not zarr_store.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    if not out.parent.is_dir():
        raise _occupied(out)
    if not zarr_store.is_sealed(store):
        raise _damaged(store, "its attributes are damaged, or it is not finished")
    attrs = zarr_store.attributes(store)
    scene = restore_scene(attrs["scene"])
    points = math.prod(Grid.of(scene).result_shape)
    kept = {name: value for name, value in attrs.items() if name not in (zarr_store.SEAL, "coordinates")}
    parts, ours = PartsFolder(out), False
    if out.exists():
        # An export that is killed after it has moved its file into place leaves its folder.
        if not parts.path.is_dir() or not _holds(out, attrs["digest"]):
            raise _occupied(out)
        parts.discard(attrs["digest"])
        return points
    try:
        parts.open()
        if parts.holds_work():
            raise InputError(f"out = {str(out)!r}: unfinished work is in {str(parts.path)!r}; allowed is a new file")
        ours = True
        with ResultFile(parts.result) as file:
            shapes = zarr_store.result_shapes(store)
            zeros = {v.name: np.broadcast_to(np.zeros((), v.dtype), shapes[v.name]) for v in result_variables(scene)}
            _fill(store, file.lay_out(labelled(scene, zeros, kept)))
            file.finish(out)
    except OSError as error:
        raise RetryableError(f"out = {str(out)!r}: {error}; the same command tries again") from None
    finally:
        parts.close(remove=ours)
    return points


def _holds(out: Path, digest: str) -> bool:
    """True if ``out`` is an intact result with this digest."""
    try:
        return out.is_file() and read_attribute(out, "digest") == digest and checksums.damaged(out) == []
    except InputError:
        return False


def _fill(store: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Copy all shards."""
    shards = zarr_store.shards_of(store)
    for shard in range(shards.count):
        results = zarr_store.read(store, shards, shard)
        if results is None:
            raise _damaged(store, f"shard {shard} is damaged")
        for name, values in results.items():
            arrays[name][shards.place(shard)] = values
        release(arrays.values())


def _occupied(out: Path) -> InputError:
    return InputError(f"out = {str(out)!r}: allowed is a new file in an existing folder")


def _damaged(store: Path, what: str) -> InputError:
    return InputError(f"store = {str(store)!r}: {what}; allowed is a sound store: run its scene again with --fresh")
