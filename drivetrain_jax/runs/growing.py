"""Reuse points of another result: a longer axis, a finer grid, one more axis, or a part of a sweep.

Numerics (code, versions, instruction set), method, options and fixed values must be the same. Reused values meet the same
tolerance as computed ones. Their last bits may differ, because the number of steps of a point depends on the points in its
chunk.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import sweep_first
from drivetrain_jax.runs.axes import entry_of
from drivetrain_jax.runs.explain import differences_of, not_valid
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import Scene, restore_scene
from drivetrain_jax.store import checksums, gate
from drivetrain_jax.store.consolidate import map_variable, read_attribute
from drivetrain_jax.store.provenance import digest
from drivetrain_jax.store.zarr_store import is_store

# Points that are copied at a time.
_BLOCK = 1 << 18
# Tolerance for equal axis values, in relative units: another ``num`` gives other roundings.
_ROUNDINGS = 4 * np.finfo(float).eps


class NotReusable(InputError):
    """Raised if no point of a result can be reused."""


class Damaged(NotReusable):
    """A damaged result; ``what`` names the damaged variables."""

    def __init__(self, path: Path, what: str) -> None:
        allowed = "allowed is to restore the file or to compute it again"
        super().__init__(f"reuse = {str(path)!r}: damaged ({what}); {allowed}")
        self.what = what


@dataclass(frozen=True)
class ReusableResult:
    """Results in the file ``path`` of another scene: its points ``theirs[i]`` equal our points ``ours[i]``.

    ``is_covered`` is true if our scene contains all of its points and results, so replacing it loses nothing.
    """

    path: Path
    digest: str
    grid: Grid
    theirs: np.ndarray
    ours: np.ndarray
    is_covered: bool

    def blocks(self, names: Sequence[str]) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Yield our points and their results in blocks, so that no result is loaded as a whole."""
        arrays = {name: sweep_first(map_variable(self.path, name), self.grid) for name in names}
        for start in range(0, self.ours.size, _BLOCK):
            place = self.grid.place(self.theirs[start : start + _BLOCK])
            results = {name: np.array(array[place]) for name, array in arrays.items()}
            if self.grid.path_is_fixed:
                results = {name: values[:, None] for name, values in results.items()}
            yield self.ours[start : start + _BLOCK], results


@dataclass(frozen=True)
class ReusedPoints:
    """The points reused from ``sources``, which are disjoint."""

    sources: tuple[ReusableResult, ...]

    @property
    def points(self) -> np.ndarray:
        """Numbers of the reused points, rising."""
        return np.sort(np.concatenate([np.empty(0, np.int64), *(source.ours for source in self.sources)]))

    @property
    def count(self) -> int:
        """Number of reused results; every point of a path counts."""
        return sum(source.ours.size * source.grid.path_length for source in self.sources)

    @property
    def digest(self) -> str | None:
        """Digest of the sources, None without any: the chunks of the other points depend on it."""
        if not self.sources:
            return None
        return digest([[source.digest, source.ours] for source in self.sources])

    @property
    def attrs(self) -> dict[str, str | int]:
        """Attributes of the result that record the reuse."""
        if not self.sources:
            return {}
        return {"reused_points": self.count, "reused_from": " ".join(s.digest for s in self.sources)}

    def blocks(self, names: Sequence[str]) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Yield the reused points and their results ``names`` in blocks."""
        for source in self.sources:
            yield from source.blocks(names)


NO_REUSE = ReusedPoints(())


def remaining(job: Job, reused: ReusedPoints) -> Job:
    """``job`` restricted to the points that are not reused."""
    if not reused.sources:
        return job
    left = np.ones(job.grid.size, bool)
    left[reused.points] = False
    return job.only(np.flatnonzero(left))


def combined(job: Job, found: Iterable[ReusableResult]) -> ReusedPoints:
    """The points of ``job`` that these results contain, each from the first result that has it."""
    free = np.ones(job.grid.size, bool)
    sources = []
    for source in found:
        keep = free[source.ours]
        free[source.ours] = False
        sources.append(replace(source, theirs=source.theirs[keep], ours=source.ours[keep]))
    return ReusedPoints(tuple(source for source in sources if source.ours.size))


def find(job: Job, path: Path) -> ReusableResult:
    """The points of ``job`` that the result at ``path`` contains, without lost ones.

    Raises :class:`NotReusable`, or :class:`InputError` if there is no readable result.
    """
    if not path.is_file():
        raise NotReusable(f"reuse = {str(path)!r}: {_no_file(path)}")
    with gate.reading(path):
        return _find(job, path)


def _find(job: Job, path: Path) -> ReusableResult:
    names = ("scene", "digest", "drivetrain_jax_version", "numerics", "numerics_detail")
    attrs = {name: read_attribute(path, name) for name in names}
    if attrs["digest"] is None:
        raise NotReusable(f"reuse = {str(path)!r}: not a result of drivetrain_jax; allowed is such a result")
    scene = _same_computation(path, attrs, job)
    _check_intact(path)
    grid = Grid.of(scene)
    theirs, ours = _same_points(scene, grid, job.scene, job.grid)
    none = NotReusable(f"reuse = {str(path)!r}: holds none of the points; allowed is a result that shares some")
    if not theirs.size:
        raise none
    outcome = sweep_first(map_variable(path, OUTCOME.name), grid)[grid.place(theirs)]
    kept = ~(outcome == Outcome.LOST).any(axis=tuple(range(1, outcome.ndim)))
    if not kept.any():
        raise none
    theirs, ours = theirs[kept], ours[kept]
    wanted = set(scene.request.outputs) <= set(job.scene.request.outputs)
    # Several of our points may equal one of theirs, and the reverse.
    is_covered = wanted and np.unique(theirs).size == grid.size
    ours, first = np.unique(ours, return_index=True)
    return ReusableResult(path, str(attrs["digest"]), grid, theirs[first], ours, is_covered)


def _same_computation(path: Path, attrs: Mapping[str, Any], job: Job) -> Scene:
    """The scene of a result that differs from ``job`` in its points only."""
    try:
        scene = restore_scene(attrs["scene"])
        reasons = differences_of(scene, attrs, job, points=False)
    except InputError as error:
        reasons = [not_valid(error)]
    if reasons:
        raise NotReusable(f"reuse = {str(path)!r}: {reasons[0]}; allowed is a result that differs in its points only")
    return scene


def _no_file(path: Path) -> str:
    if is_store(path):
        return "is a Zarr store; allowed is the file that `drivetrain export` makes of it"
    what = "is a folder" if path.is_dir() else "does not exist"
    return f"{what}; allowed is a result written by `drivetrain run`"


def _check_intact(path: Path) -> None:
    """Raise :class:`Damaged` for a damaged source: the checksums of the new result would hide the damage."""
    try:
        wrong = checksums.damaged(path)
    except InputError:
        raise Damaged(path, "its structure") from None
    if wrong or wrong is None:
        raise Damaged(path, checksums.named(wrong) if wrong else "it has no checksums")


def _same_points(scene: Scene, grid: Grid, our_scene: Scene, our_grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of equal points of both grids; none if lines or fixed values differ."""
    nothing = np.empty(0, np.int64), np.empty(0, np.int64)
    if not (_same_lines(grid, our_grid) and _same_fixed(scene, our_scene)):
        return nothing
    if any(axis.also for axis in (*grid.axes, *our_grid.axes)):
        # Positions are compared by one parameter an axis.
        return nothing
    if grid.zipped and our_grid.zipped:
        return _same_rows(grid, our_grid)
    if grid.zipped:
        ours, theirs = _inside(our_scene, our_grid, scene, grid)
        return theirs, ours
    return _inside(scene, grid, our_scene, our_grid)


def _same_lines(grid: Grid, other: Grid) -> bool:
    if grid.path is None or other.path is None:
        return grid.path is other.path
    same = grid.path.name == other.path.name and np.array_equal(grid.path.values, other.path.values)
    return same and grid.path_is_fixed == other.path_is_fixed


def _same_fixed(scene: Scene, other: Scene) -> bool:
    """True if the parameters that neither scene varies agree, as far as the analysis uses them."""
    varied = {axis.name for axis in (*scene.axes, *other.axes)}
    used = scene.analysis.model(scene.system).parameters

    def constant(values: Mapping[str, Any]) -> dict[str, Any]:
        kept = {}
        for name in used:
            if name in varied or name not in values:
                continue
            value = values[name]
            if isinstance(value, tuple):
                value = tuple(None if f"{name}[{i}]" in varied else entry for i, entry in enumerate(value))
            kept[name] = value
        return kept

    return constant(scene.fixed) == constant(other.fixed)


def _value(scene: Scene, name: str) -> float | None:
    """The fixed number of ``scene`` for ``name``, an axis of another scene; None without one."""
    base, entry = entry_of(name)
    value = scene.fixed.get(base)
    if entry is not None:
        value = value[entry] if isinstance(value, tuple) and entry < len(value) else None
    return value if isinstance(value, (int, float)) else None


def _matters(scene: Scene, name: str) -> bool:
    return entry_of(name)[0] in scene.analysis.model(scene.system).parameters


def _at(scene: Scene, name: str, values: np.ndarray) -> np.ndarray:
    """0 for each of ``values`` that equals the fixed ``name`` of ``scene``, else -1."""
    fixed = _value(scene, name)
    if not _matters(scene, name):
        return np.zeros(len(values), np.int64)
    return np.full(len(values), -1) if fixed is None else _positions(np.array([fixed]), values)


def _among(scene: Scene, name: str, values: np.ndarray) -> int:
    """Position of the fixed ``name`` of ``scene`` among ``values``, -1 if it is missing."""
    fixed = _value(scene, name)
    if not _matters(scene, name):
        return 0
    return -1 if fixed is None else int(_positions(values, np.array([fixed]))[0])


def _inside(scene: Scene, grid: Grid, other_scene: Scene, other: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Points of the outer product ``grid``, and the equal points of ``other``."""
    axes, theirs = ({axis.name: axis.values for axis in one.axes} for one in (grid, other))
    # Position along each axis of ``grid`` for each value along the axes of ``other``; -1 for none.
    along = {
        name: _positions(axes[name], values) if name in axes else _at(scene, name, values)
        for name, values in theirs.items()
    }
    constant = {name: _among(other_scene, name, axes[name]) for name in axes.keys() - theirs.keys()}
    if min(constant.values(), default=0) < 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    columns = [along[axis.name] for axis in other.axes]
    if other.zipped:
        chosen = np.flatnonzero(np.all([column >= 0 for column in columns], axis=0)) if columns else np.zeros(1, int)
        index = {axis.name: column[chosen] for axis, column in zip(other.axes, columns, strict=True)}
    else:
        kept = [np.flatnonzero(column >= 0) for column in columns]
        mesh = np.meshgrid(*kept, indexing="ij")
        chosen = np.ravel_multi_index([m.ravel() for m in mesh], other.shape) if kept else np.zeros(1, int)
        index = {a.name: c[m.ravel()] for a, c, m in zip(other.axes, columns, mesh, strict=True)}
    place = [
        np.broadcast_to(index[axis.name] if axis.name in index else constant[axis.name], chosen.shape)
        for axis in grid.axes
    ]
    return (np.ravel_multi_index(tuple(place), grid.shape) if place else np.zeros(chosen.shape, int)), chosen


def _positions(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Position of each of ``wanted`` among ``values`` within the tolerance of an axis, -1 for none."""
    order = np.argsort(values)
    rising = values[order].astype(float)
    right = np.clip(np.searchsorted(rising, wanted), 0, len(rising) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(abs(rising[left] - wanted) < abs(rising[right] - wanted), left, right)
    sought, place = np.unique(np.asarray(wanted, float), return_inverse=True)
    own, other = _extents(rising)[nearest], _extents(sought)[place]
    # The ends of an axis are exact, its inner values have rounding errors; use the smaller tolerance of the two axes.
    extent = np.where((own > 0) & (other > 0), np.minimum(own, other), np.maximum(own, other))
    room = _ROUNDINGS * (abs(rising[nearest]) + extent)
    return np.where(abs(rising[nearest] - wanted) <= room, order[nearest], -1)


def _extents(rising: np.ndarray) -> np.ndarray:
    """Length of the even axis on which each value would have its nearest neighbour; 0 for both ends, which are exact."""
    gaps = np.diff(rising)
    between = np.minimum(gaps[1:], gaps[:-1]) * len(rising)
    return np.pad(between, 1)[: len(rising)] if len(rising) > 1 else np.zeros(len(rising))


def _same_rows(grid: Grid, other: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of equal rows of two lists of points that vary the same parameters; each common row is in at least one pair."""
    names = [axis.name for axis in grid.axes]
    if sorted(names) != sorted(axis.name for axis in other.axes):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    theirs, ours = (_rows(one, names) for one in (grid, other))
    their_place, our_place = ({row: i for i, row in enumerate(rows)} for rows in (theirs, ours))
    pairs = [(their_place[row], i) for i, row in enumerate(ours) if row in their_place]
    pairs += [(i, our_place[row]) for i, row in enumerate(theirs) if row in our_place]
    found = np.array(pairs, np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _rows(grid: Grid, names: Sequence[str]) -> list[tuple[float, ...]]:
    columns = {axis.name: axis.values.tolist() for axis in grid.axes}
    return list(zip(*(columns[name] for name in names), strict=True))
