"""Stores of finished blocks: files that are joined at the end, or the shards of a Zarr store."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import PENDING, labelled, missing_value, sweep_first, template, with_pending
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.job import Block, Job, Results
from drivetrain_jax.runs.scene import restore_scene, result_variables
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.consolidate import Labelled, ResultFile, release
from drivetrain_jax.store.files import flush_tree, move_folder
from drivetrain_jax.store.parts import PartsFolder


class BlockStore(Protocol):
    """Keeps the results of blocks, points first; every worker that computes blocks must see ``place``."""

    @property
    def place(self) -> str:
        """Absolute path of the store."""
        ...

    def numbers(self) -> list[int]:
        """Numbers of the stored blocks, damaged ones included."""
        ...

    def write(self, number: int, results: Results) -> None:
        """Store the results of a block."""

    def read(self, number: int) -> Results | None:
        """The results of a block; None if it is missing or damaged."""
        ...


def stored_blocks(
    store: BlockStore, job: Job, points: np.ndarray | None = None, first: int = 0, without: Container[int] = ()
) -> Iterator[tuple[Block, Results]]:
    """Yield the intact blocks of ``job``, or of some of its ``points``, ``without`` these numbers.

    Numbers in the store start at ``first``. A block that does not fit the job counts as damaged.
    """
    numbers, variables = set(store.numbers()), result_variables(job.problem)
    kinds = {v.name: (v.dtype, 1 + (job.grid.path is not None) + len(v.dims)) for v in variables}
    for block in job.blocks(points) if numbers else ():
        if first + block.number not in numbers or block.number in without:
            continue
        found, count = store.read(first + block.number) or {}, len(job.points(block))
        if {n: (str(x.dtype), x.ndim) for n, x in found.items()} == kinds and {len(x) for x in found.values()} == {
            count
        }:
            yield block, found


@dataclass(frozen=True)
class ZarrBlocks:
    """The blocks of ``job`` as shards of the Zarr store at ``place``, each with a checksum that marks it as done."""

    job: Job
    place: str

    @classmethod
    def among(cls, parts: PartsFolder, job: Job) -> ZarrBlocks:
        """The growing store among the parts."""
        return cls(job, os.path.abspath(parts.path / zarr_store.UNFINISHED))

    def create(self) -> None:
        """Create the store; renew all but the shards of one that a stopped run has left, whose metadata may be damaged."""
        path, half = Path(self.place), Path(self.place).with_name("half")
        shutil.rmtree(half, ignore_errors=True)
        fills = {v.name: missing_value(v) for v in result_variables(self.job.scene)} | {OUTCOME.name: PENDING}
        zarr_store.create(half, with_pending(self.template), self.job.boxes, fills)
        shutil.copytree(half, path, dirs_exist_ok=True)
        shutil.rmtree(half)

    @property
    def template(self) -> Labelled:
        """The result without its data."""
        return template(self.job.scene, self.job.grid, self.job.attrs)

    def numbers(self) -> list[int]:
        """Numbers of the shards that are marked done."""
        return np.flatnonzero(zarr_store.done(Path(self.place))).tolist() if os.path.isdir(self.place) else []

    def write(self, number: int, results: Results) -> None:
        """Write a shard and mark it done."""
        grid, box = self.job.grid, self.job.boxes.place(number)
        position, arrays = grid.path_position, {}
        sizes = [part.stop - part.start for axis, part in enumerate(box) if axis != position]
        for name, values in results.items():
            # A fixed path parameter is not a dimension of the result.
            rows = values[:, 0] if grid.path_is_fixed else values
            rows = rows.reshape((*sizes, *rows.shape[1:]))
            arrays[name] = rows if position is None else np.moveaxis(rows, len(sizes), position)
        zarr_store.write(Path(self.place), box, arrays, number)

    def read(self, number: int) -> Results | None:
        """The results of a shard."""
        grid, found = self.job.grid, zarr_store.read(Path(self.place), self.job.boxes, number)
        if found is None:
            return None
        moved = {name: sweep_first(values, grid) for name, values in found.items()}
        rows = {name: values.reshape(-1, *values.shape[len(grid.shape) :]) for name, values in moved.items()}
        return {name: values[:, None] if grid.path_is_fixed else values for name, values in rows.items()}

    def finish(self, parts: PartsFolder, **attrs: str | float) -> None:
        """Move the store into place. A former one is moved away first, because a folder cannot be replaced in one step.

        Raises :class:`ChunkError` if a shard that a worker reported as written is missing.
        """
        path, final = Path(self.place), self.template
        absent = int(np.sum(~zarr_store.done(path)))
        if absent:
            raise ChunkError(f"{absent} shards are missing; every worker must see the store at {self.place!r}")
        zarr_store.seal(path, {**final.attrs, **attrs}, {OUTCOME.name: final.data[OUTCOME.name].attrs})
        flush_tree(path)
        former = parts.path / zarr_store.FORMER
        if parts.out.exists():
            shutil.rmtree(former, ignore_errors=True)
            move_folder(parts.out, former)
        move_folder(path, parts.out)


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the new file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is not a sound Zarr store, or if ``out`` exists, and :class:`RetryableError`
    after an I/O error.
    """
    if out.suffix.lower() == ".csv":
        raise InputError(f"FILE.nc = {str(out)!r}: allowed is a name in .nc; a table is written by --csv {out}")
    if not zarr_store.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    if not zarr_store.is_sealed(store):
        raise _damaged(store, "its attributes are damaged, or it is not finished")
    if out.exists() or not out.parent.is_dir() or PartsFolder(out).holds_work():
        raise InputError(f"out = {str(out)!r}: allowed is a new file in an existing folder, without unfinished work")
    attrs, layout, shards = zarr_store.attributes(store), zarr_store.layout(store), zarr_store.shards_of(store)
    scene = restore_scene(attrs["scene"])
    kept = {name: value for name, value in attrs.items() if name not in (zarr_store.SEAL, "coordinates")}
    zeros = {v.name: np.broadcast_to(np.zeros((), v.dtype), layout[v.name][1]) for v in result_variables(scene)}
    try:
        with ResultFile(out.with_name(f"{out.name}.{os.getpid()}.tmp")) as file:
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
    return math.prod(Grid.of(scene).result_shape)


def _damaged(store: Path, what: str) -> InputError:
    return InputError(f"store = {str(store)!r}: {what}; allowed is a sound store: run its scene again with --fresh")
