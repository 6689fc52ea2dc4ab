"""Results of blocks: the labelled result that they make, and the stores that keep them until they are joined."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax._machine import machine
from drivetrain_jax._programs import PACKAGES
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.physical import described
from drivetrain_jax.runs.scene import Problem, Scene, restore_scene, result_variables
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.consolidate import CONVENTIONS, Entry, Labelled, ResultFile, release
from drivetrain_jax.store.files import command, flush_tree, move_folder, now, versions
from drivetrain_jax.store.parts import Arrays, PartsFolder

if TYPE_CHECKING:
    from drivetrain_jax.runs.job import Block, Job

# Code of points that are not computed yet, which no finished result contains.
PENDING = len(Outcome)
# Bytes of mapped results kept in memory.
_RESIDENT = 1 << 26


class ResultBuffer:
    """Results of all points of a grid, filled block by block.

    ``arrays`` holds all values: the axes in scene order (or the points), then the dimensions of the result.
    ``allocate`` returns such arrays for those of :func:`blank` (default: a copy in memory).
    """

    def __init__(self, scene: Scene, grid: Grid, allocate: Callable[[Arrays], Arrays] | None = None) -> None:
        self.variables = result_variables(scene)
        self._scene, self._grid, self._allocate = scene, grid, allocate
        self._unreleased = 0
        self.arrays: Arrays = {}

    def fill(self, points: np.ndarray, results: Arrays) -> None:
        """Write the results of ``points``."""
        grid = self._grid
        for name, array in self.lay_out(results).items():
            if grid.path_position is None:
                array.reshape(grid.size, *array.shape[len(grid.shape) :])[points] = results[name]
            else:
                sweep_first(array, grid)[grid.place(points)] = results[name]
        self.release_after(results)

    def block(self, place: tuple[slice, ...], like: Arrays) -> dict[str, np.ndarray]:
        """Views of the arrays at a block of the grid, or a range of the points, to be overwritten.

        ``like`` holds the results of one point.
        """
        return {name: values[place] for name, values in self.lay_out(like).items()}

    def release_after(self, results: Arrays) -> None:
        """Periodically release pages of the memory map."""
        self._unreleased += sum(values.nbytes for values in results.values())
        if self._unreleased >= _RESIDENT:
            self._unreleased = 0
            release(self.arrays.values())

    def lay_out(self, like: Arrays | None = None) -> Arrays:
        """The arrays. Results ``like`` those that fill them give the lengths of dimensions that depend on the system."""
        if not self.arrays:
            arrays = blank(self._scene, self._grid, like)
            self.arrays = self._allocate(arrays) if self._allocate else {n: np.array(x) for n, x in arrays.items()}
        return self.arrays


def sweep_first(array: np.ndarray, grid: Grid) -> np.ndarray:
    """``array`` of a result, with a path axis moved behind the other axes of the sweep."""
    position = grid.path_position
    return array if position is None else np.moveaxis(array, position, len(grid.shape))


def blank(scene: Problem, grid: Grid, like: Arrays | None = None) -> Arrays:
    """Results of which none is computed, as arrays that take no memory.

    Lengths of dimensions that depend on the system are those of the results ``like``, or found by tracing.
    """
    sizes, variables = {d.name: len(d.values) for d in scene.dimensions}, result_variables(scene)
    if not all(sizes[dim] for variable in variables for dim in variable.dims):
        # Local import: `kernel` imports jax and this module.
        from drivetrain_jax.runs.kernel import result_shapes

        shapes = {n: x.shape for n, x in like.items()} if like else result_shapes(scene, grid, scene.solvers[0])
        for variable in variables:
            sizes |= zip(reversed(variable.dims), reversed(shapes[variable.name]), strict=False)
    arrays = {}
    for v in variables:
        value = np.array(PENDING if v.name == OUTCOME.name else v.missing, v.dtype)
        arrays[v.name] = np.broadcast_to(value, (*grid.result_shape, *(sizes[dim] for dim in v.dims)))
    return arrays


def labelled(scene: Scene, arrays: Arrays, attrs: Mapping[str, str | float]) -> Labelled:
    """The labelled result: dimensions are the axes in scene order (or ``point``), then those of the variable.

    Coordinates are the axes as the scene gives them, and the parameters that vary along them. The attribute ``parameter`` is
    the key of a parameter in the scene if it differs from the name.
    """
    sweep_dims = ("point",) if scene.zipped else tuple(axis.dim for axis in scene.axes)
    coordinates = {}
    if scene.zipped:
        about = {"units": "1", "long_name": "position of the point in the lists"}
        coordinates["point"] = Entry(("point",), np.arange(len(scene.axes[0].values)), about)
    for axis in scene.axes:
        for part in (*axis.given, *axis.together):
            # Positions of swept entries count from 0.
            entry = "" if part.entry is None else f", entry {part.entry}"
            about = {"units": part.parameter.units, "long_name": f"{part.parameter.long_name}{entry}"}
            about |= {} if part.name == part.own_dim else {"parameter": part.name}
            coordinates[part.own_dim] = Entry(("point",) if scene.zipped else (axis.dim,), part.values, about)
    results = [(v, arrays[v.name]) for v in result_variables(scene)]
    return Labelled.build(sweep_dims, coordinates, scene.dimensions, results, result_attrs(scene) | dict(attrs))


def with_pending(result: Labelled) -> Labelled:
    """``result`` with the meaning of the code ``PENDING`` added."""
    outcome = result.data[OUTCOME.name]
    meanings = f"{outcome.attrs['flag_meanings']} pending"
    codes = np.arange(PENDING + 1, dtype=OUTCOME.dtype)
    entry = replace(outcome, attrs={**outcome.attrs, "flag_values": codes, "flag_meanings": meanings})
    return replace(result, data={**result.data, OUTCOME.name: entry})


def _finite(value: Any) -> Any:
    """``value`` for JSON, which has no infinity; the word "inf" is read by every parser of numbers."""
    return str(value) if value == math.inf else value


def result_attrs(scene: Scene) -> dict[str, str]:
    """Attributes of the result that do not depend on the single run."""
    system = scene.system
    known = described(system)
    fixed, data = (
        {n: {"value": _finite(x), "units": known[n].units, "long_name": known[n].long_name} for n, x in values.items()}
        for values in (scene.fixed, scene.data)
    )
    # Figures need the state, families of resonances, and periods of the equations in a turn.
    families = system.resonances.families if system.resonances else ()
    drawn: dict[str, Any] = {
        "state": [vars(component) for component in system.state],
        "resonance_families": {f.prefix: {k: v for k, v in vars(f).items() if k != "prefix"} for f in families},
    }
    drawn = {name: json.dumps(value) for name, value in drawn.items() if value}
    drawn |= {"periods_per_turn": system.periods_per_turn} if system.periods_per_turn else {}
    # An axis given in physical data takes the role of its parameter.
    dim_of = {axis.name: axis.dim for axis in scene.axes if axis.given}
    roles = {role: dim_of.get(name, name) for role, name in system.roles.items()}
    installed, created, version = versions((*PACKAGES, "h5py")), now(), drivetrain_jax.__version__
    cited = {"references": system.source} if system.source else {}
    return {
        "Conventions": CONVENTIONS,
        "title": scene.title,
        "source": f"drivetrain_jax {version}",
        "history": f"{created}: {command()}",
        **cited,
        "system": system.name,
        "roles": json.dumps(roles),
        **drawn,
        "analysis": scene.analysis.name,
        "method": scene.request.method,
        "options": json.dumps({name: _finite(value) for name, value in scene.request.options.items()}),
        "scene": scene.text,
        "fixed_parameters": json.dumps(fixed),
        **({"physical_data": json.dumps(data)} if data else {}),
        "drivetrain_jax_version": version,
        "versions": ", ".join(f"{name} {number}" for name, number in installed.items()),
        "machine": machine(),
        "created": created,
    }


def stored_blocks(
    store: BlockStore, job: Job, points: np.ndarray | None = None, first: int = 0, without: Container[int] = ()
) -> Iterator[tuple[Block, Arrays]]:
    """Yield the intact blocks of ``job``, or of some of its ``points``, ``without`` these; numbers in the store start at
    ``first``."""
    numbers = set(store.numbers())
    for block in job.blocks(points) if numbers else ():
        number = first + block.number
        if number in numbers and block.number not in without and (results := store.read(number)) is not None:
            yield block, results


@dataclass(frozen=True)
class ZarrBlocks:
    """The blocks of ``job`` as shards of the Zarr store at ``place``, each with a checksum that marks it as done."""

    job: Job
    place: str

    def create(self) -> None:
        """Create the store; renew all but the shards of one that a stopped run has left, whose metadata may be damaged."""
        path, half = Path(self.place), Path(self.place).with_name("half")
        shutil.rmtree(half, ignore_errors=True)
        zarr_store.create(half, with_pending(self.template), self.job.boxes)
        shutil.copytree(half, path, dirs_exist_ok=True)
        shutil.rmtree(half)

    @property
    def template(self) -> Labelled:
        """The result without its data."""
        return labelled(self.job.scene, blank(self.job.scene, self.job.grid), self.job.attrs)

    def numbers(self) -> list[int]:
        """Numbers of the shards that are marked done."""
        return np.flatnonzero(zarr_store.done(Path(self.place))).tolist() if os.path.isdir(self.place) else []

    def write(self, number: int, results: Arrays) -> None:
        """Write a shard and mark it done."""
        grid, box = self.job.grid, self.job.boxes.place(number)
        position, arrays = grid.path_position, {}
        sizes = [part.stop - part.start for axis, part in enumerate(box) if axis != position]
        for name, values in results.items():
            rows = values.reshape((*sizes, *values.shape[1:]))
            arrays[name] = rows if position is None else np.moveaxis(rows, len(sizes), position)
        zarr_store.write(Path(self.place), box, arrays, number)

    def read(self, number: int) -> Arrays | None:
        """The results of a shard."""
        grid, shard = self.job.grid, zarr_store.read(Path(self.place), self.job.boxes, number)
        if shard is None:
            return None
        moved = {name: sweep_first(values, grid) for name, values in shard.items()}
        return {name: values.reshape(-1, *values.shape[len(grid.shape) :]) for name, values in moved.items()}

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


BlockStore = PartsFolder | ZarrBlocks


def export(store: Path, out: Path) -> int:
    """Write the result in the Zarr ``store`` to the new file ``out``, shard by shard; returns the number of points.

    Raises :class:`InputError` if ``store`` is not a sound Zarr store, or if ``out`` exists, and :class:`RetryableError`
    after an I/O error.
    """
    if out.suffix.lower() == ".csv":
        raise InputError(f"FILE.nc = {str(out)!r}: expected a name in .nc; a table is written by --csv {out}")
    if not zarr_store.is_store(store):
        raise InputError(f"store = {str(store)!r}: not a Zarr store; give one of `drivetrain run --store zarr`")
    if not zarr_store.is_sealed(store):
        raise _damaged(store, "its attributes are damaged, or it is unfinished or of another program")
    if out.exists() or not out.parent.is_dir() or PartsFolder(out).holds_work():
        raise InputError(f"out = {str(out)!r}: expected a new file in an existing folder, without unfinished work")
    attrs, layout, shards = zarr_store.attributes(store), zarr_store.layout(store), zarr_store.shards_of(store)
    scene = restore_scene(attrs["scene"])
    kept = {name: value for name, value in attrs.items() if name not in (zarr_store.SEAL, "coordinates")}
    zeros = {name: np.broadcast_to(np.zeros((), kind), shape) for name, (kind, shape) in layout.items()}
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
    return InputError(f"store = {str(store)!r}: {what}; expected a sound store: run its scene again with --fresh")
