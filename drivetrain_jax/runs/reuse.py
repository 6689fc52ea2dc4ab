"""Reuse points of another result: a longer axis, a finer grid, one more axis, a part of a sweep, or a longer list of points.

Numerics (code, versions, instruction set), method, options and fixed values must be the same. Reused values meet the same
tolerance as computed ones. Their last bits may differ, because the number of steps of a point depends on the points in its
chunk.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import sweep_first
from drivetrain_jax.runs.axes import Grid, entry_of
from drivetrain_jax.runs.identity import differences_of, not_valid
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.scene import Scene, restore_scene, result_variables
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import map_variable, read_attribute
from drivetrain_jax.store.files import digest
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
    names: tuple[str, ...]
    grid: Grid
    theirs: np.ndarray
    ours: np.ndarray
    is_covered: bool

    def blocks(self) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Yield our points and their results in blocks, so that no result is loaded as a whole."""
        arrays = {name: sweep_first(map_variable(self.path, name), self.grid) for name in self.names}
        for start in range(0, self.ours.size, _BLOCK):
            place = self.grid.place(self.theirs[start : start + _BLOCK])
            results = {name: np.array(array[place]) for name, array in arrays.items()}
            if self.grid.path_is_fixed:
                results = {name: values[:, None] for name, values in results.items()}
            yield self.ours[start : start + _BLOCK], results


@dataclass(frozen=True)
class ReusedPoints:
    """The points that a run takes from other results."""

    sources: tuple[ReusableResult, ...] = ()

    @property
    def count(self) -> int:
        """Number of points; every point of a path counts."""
        return sum(source.ours.size * source.grid.path_length for source in self.sources)

    @property
    def digest(self) -> str | None:
        """Digest of the sources, None without any: the chunks of the other points depend on it."""
        return digest([[source.digest, source.ours] for source in self.sources]) if self.sources else None

    @property
    def attrs(self) -> dict[str, str | int]:
        """Attributes of the result that record the reuse."""
        if not self.sources:
            return {}
        return {"reused_points": self.count, "reused_from": " ".join(s.digest for s in self.sources)}

    def blocks(self) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Yield the reused points and their results in blocks."""
        for source in self.sources:
            yield from source.blocks()

    def others(self, size: int) -> np.ndarray | None:
        """The other ones of ``size`` points; None if nothing is reused."""
        if not self.sources:
            return None
        left = np.ones(size, bool)
        for source in self.sources:
            left[source.ours] = False
        return np.flatnonzero(left)


NO_REUSE = ReusedPoints()


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
    names = ("scene", "digest", "drivetrain_jax_version", "numerics", "numerics_detail")
    attrs = {name: read_attribute(path, name) for name in names}
    if attrs["digest"] is None:
        raise NotReusable(f"reuse = {str(path)!r}: not a result of drivetrain_jax; allowed is such a result")
    scene = _same_computation(path, attrs, job)
    _check_intact(path)
    grid = Grid.of(scene)
    theirs, ours = _same_points(scene, grid, job.scene, job.grid)
    if theirs.size:
        outcome = sweep_first(map_variable(path, OUTCOME.name), grid)[grid.place(theirs)]
        kept = ~(outcome == Outcome.LOST).any(axis=tuple(range(1, outcome.ndim)))
        theirs, ours = theirs[kept], ours[kept]
    if not theirs.size:
        raise NotReusable(f"reuse = {str(path)!r}: holds none of the points; allowed is a result that shares some")
    wanted = set(scene.request.outputs) <= set(job.scene.request.outputs)
    is_covered = wanted and np.unique(theirs).size == grid.size
    stored = tuple(variable.name for variable in result_variables(job.scene))
    return ReusableResult(path, str(attrs["digest"]), stored, grid, theirs, ours, is_covered)


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
    if grid.zipped:
        return _same_rows(grid, our_grid)
    axes, ours = ({axis.name: axis.values for axis in each.axes} for each in (grid, our_grid))
    # Position along each of their axes for each value along ours; -1 for none.
    along = {name: _match(_values(scene, axes, name), values) for name, values in ours.items()}
    constant = {name: _match(axes[name], _values(our_scene, ours, name))[:1] for name in axes.keys() - ours.keys()}
    if any(place.size == 0 or place[0] < 0 for place in constant.values()):
        return nothing
    if our_grid.zipped:
        chosen = np.flatnonzero(np.min([*along.values()], axis=0) >= 0)
        index = {name: place[chosen] for name, place in along.items()}
    else:
        kept = np.meshgrid(*(np.flatnonzero(place >= 0) for place in along.values()), indexing="ij")
        chosen = np.ravel_multi_index([k.ravel() for k in kept], our_grid.shape) if kept else np.zeros(1, np.int64)
        index = {name: place[k.ravel()] for (name, place), k in zip(along.items(), kept, strict=True)}
    place = [np.broadcast_to({**constant, **index}[axis.name], chosen.shape) for axis in grid.axes]
    theirs = np.ravel_multi_index(tuple(place), grid.shape) if place else np.zeros(chosen.shape, np.int64)
    return np.asarray(theirs), np.asarray(chosen)


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


def _values(scene: Scene, axes: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """Values of a parameter, which varies along one of ``axes`` or is fixed; None if the analysis does not use it."""
    base, entry = entry_of(name)
    if name in axes:
        return axes[name]
    if base not in scene.analysis.model(scene.system).parameters:
        return None
    value = scene.fixed.get(base)
    if entry is not None:
        value = value[entry] if isinstance(value, tuple) and entry < len(value) else None
    return np.array([value] if isinstance(value, (int, float)) else [], float)


def _match(theirs: np.ndarray | None, ours: np.ndarray | None) -> np.ndarray:
    """Position among ``theirs`` for each of ``ours``, -1 for none; a parameter that is not used has any value."""
    if theirs is None or ours is None:
        return np.zeros(1 if ours is None else len(ours), np.int64)
    return _positions(theirs, ours) if theirs.size and ours.size else np.full(len(ours), -1)


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
    """Rows of a list of points for each equal row of another list that varies the same parameters."""
    names = sorted(axis.name for axis in grid.axes)
    if not other.zipped or names != sorted(axis.name for axis in other.axes):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    theirs, ours = (
        list(zip(*({a.name: a.values.tolist() for a in each.axes}[name] for name in names), strict=True))
        for each in (grid, other)
    )
    place = {row: i for i, row in enumerate(theirs)}
    pairs = [(place[row], i) for i, row in enumerate(ours) if row in place]
    found = np.array(pairs, np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]
