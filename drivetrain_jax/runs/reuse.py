"""Compare stored work with a scene: name the differences, and reuse equal points.

A scene reuses points of a longer or shorter axis, of a coarser grid, of one axis less, of a part of a sweep, or of a list of
points. Numerics (code, versions, instruction set), method, options and fixed values must be the same. Reused values meet the
same tolerance as computed ones. Their last bits may differ, because the number of steps of a point depends on the points in
its chunk.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import InputError, clipped, counted
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import misfits, sweep_first
from drivetrain_jax.runs.axes import Grid, entry_of
from drivetrain_jax.runs.job import Job, scene_content
from drivetrain_jax.runs.scene import Scene, is_of_function, restore_scene, result_variables
from drivetrain_jax.store import checksums, consolidate
from drivetrain_jax.store.files import digest

# Points that are copied at a time.
_BLOCK = 1 << 18
# Tolerance for equal axis values, in relative units: another ``num`` gives other roundings.
_ROUNDINGS = 4 * np.finfo(float).eps


class NotReusable(InputError):
    """Raised if no point of a result can be reused."""

    def __init__(self, path: Path, why: str, allowed: str) -> None:
        super().__init__(f"reuse = {str(path)!r}: {why}; allowed is {allowed}")


class Damaged(NotReusable):
    """A damaged result; ``what`` names the damaged variables."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(path, f"damaged ({what})", "to restore the file or to compute it again")
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
        arrays = {name: sweep_first(consolidate.map_variable(self.path, name), self.grid) for name in self.names}
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


def combined(job: Job, results: Iterable[ReusableResult]) -> ReusedPoints:
    """The points of ``job`` that these results contain, each from the first result that has it."""
    free = np.ones(job.grid.size, bool)
    sources = []
    for source in results:
        keep = free[source.ours]
        free[source.ours] = False
        sources.append(replace(source, theirs=source.theirs[keep], ours=source.ours[keep]))
    return ReusedPoints(tuple(source for source in sources if source.ours.size))


def find(job: Job, path: Path) -> ReusableResult:
    """The points of ``job`` that the result at ``path`` contains, without lost ones.

    Raises :class:`NotReusable`, or :class:`InputError` if there is no readable result.
    """
    try:
        attrs = consolidate.read_attributes(path)
    except InputError as error:
        raise InputError(str(error).replace("file = ", "reuse = ", 1)) from None
    if "digest" not in attrs:
        raise NotReusable(path, "not a result of drivetrain_jax", "such a result")
    try:
        scene = restore_scene(attrs.get("scene"))
        reasons = differences_of(scene, attrs, job, points=False)
    except InputError as error:
        raise NotReusable(path, not_valid(error), "a result that differs in its points only") from None
    if reasons:
        raise NotReusable(path, reasons[0], "a result that differs in its points only")
    # The checksums of the new result would hide damage.
    if wrong := checksums.damaged(path) or misfits(consolidate.layout(path), scene):
        raise Damaged(path, checksums.named(wrong))
    if "checksums" not in attrs:
        raise Damaged(path, "it has no checksums")
    grid = Grid.of(scene)
    theirs, ours = _same_points(scene, grid, job.scene, job.grid)
    if theirs.size:
        outcome = sweep_first(consolidate.map_variable(path, OUTCOME.name), grid)[grid.place(theirs)]
        kept = ~(outcome == Outcome.LOST).any(axis=tuple(range(1, outcome.ndim)))
        theirs, ours = theirs[kept], ours[kept]
    if not theirs.size:
        raise NotReusable(path, "holds none of the points", "a result that shares some")
    wanted = set(scene.request.outputs) <= set(job.scene.request.outputs)
    is_covered = wanted and np.unique(theirs).size == grid.size
    stored = tuple(variable.name for variable in result_variables(job.scene))
    return ReusableResult(path, str(attrs["digest"]), stored, grid, theirs, ours, is_covered)


_NOTHING = np.empty(0, np.int64), np.empty(0, np.int64)


def _same_points(theirs: Scene, grid: Grid, ours: Scene, our_grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of equal points of both grids; none if lines or fixed values differ."""
    axes = {axis.name for axis in (*theirs.axes, *ours.axes)}
    # Positions are compared by one parameter an axis.
    several = any(axis.also for axis in (*grid.axes, *our_grid.axes))
    if several or _line(grid) != _line(our_grid) or _constants(theirs, axes) != _constants(ours, axes):
        return _NOTHING
    if grid.zipped and our_grid.zipped:
        return _same_rows(grid, our_grid)
    if not grid.zipped:
        return _within(theirs, grid, ours, our_grid)
    rows, listed = _within(ours, our_grid, theirs, grid)
    rows, first = np.unique(rows, return_index=True)
    return listed[first], rows


def _within(scene: Scene, grid: Grid, other: Scene, points: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Points of ``grid``, an outer product, that ``points`` has too: their numbers in both."""
    axes, columns = ({axis.name: axis.values for axis in one.axes} for one in (grid, points))
    # Position along each axis for each value of the points; -1 for none.
    along = {name: _match(_values(scene, axes, name), values) for name, values in columns.items()}
    constant = {name: _match(axes[name], _values(other, columns, name))[:1] for name in axes.keys() - columns.keys()}
    if any(place.size == 0 or place[0] < 0 for place in constant.values()):
        return _NOTHING
    if points.zipped:
        chosen = np.flatnonzero(np.min([*along.values()], axis=0) >= 0)
        index = {name: place[chosen] for name, place in along.items()}
    else:
        kept = np.meshgrid(*(np.flatnonzero(place >= 0) for place in along.values()), indexing="ij")
        chosen = np.ravel_multi_index([k.ravel() for k in kept], points.shape) if kept else np.zeros(1, np.int64)
        index = {name: place[k.ravel()] for (name, place), k in zip(along.items(), kept, strict=True)}
    place = [np.broadcast_to({**constant, **index}[axis.name], chosen.shape) for axis in grid.axes]
    return np.ravel_multi_index(place, grid.shape) if place else np.zeros(chosen.shape, np.int64), chosen


def _line(grid: Grid) -> tuple[Any, ...]:
    """The identity of the path of a grid, empty without one."""
    return () if grid.path is None else (grid.path.name, grid.path.values.tolist(), grid.path_is_fixed)


def _constants(scene: Scene, varied: set[str]) -> dict[str, Any]:
    """The parameters that the analysis uses, and list entries, unless they are ``varied``."""
    used, entries = scene.analysis.model(scene.system).parameters, {}
    for name, value in scene.fixed.items():
        if isinstance(value, tuple):
            entries |= {name: len(value)} | {f"{name}[{i}]": entry for i, entry in enumerate(value)}
        else:
            entries[name] = value
    return {name: value for name, value in entries.items() if entry_of(name)[0] in used and name not in varied}


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
    """Position among ``theirs`` for each of ``ours`` within the tolerance of an axis, -1 for none.

    A parameter that is not used (None) has any value.
    """
    if theirs is None or ours is None:
        return np.zeros(1 if ours is None else len(ours), np.int64)
    if not (theirs.size and ours.size):
        return np.full(len(ours), -1)
    order = np.argsort(theirs)
    rising = theirs[order].astype(float)
    right = np.clip(np.searchsorted(rising, ours), 0, len(rising) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(abs(rising[left] - ours) < abs(rising[right] - ours), left, right)
    sought, place = np.unique(np.asarray(ours, float), return_inverse=True)
    extent_of_theirs, other = _extents(rising)[nearest], _extents(sought)[place]
    # The ends of an axis are exact, its inner values have rounding errors; use the smaller tolerance of the two axes.
    extent = np.where(
        (extent_of_theirs > 0) & (other > 0), np.minimum(extent_of_theirs, other), np.maximum(extent_of_theirs, other)
    )
    equal = abs(rising[nearest] - ours) <= _ROUNDINGS * (abs(rising[nearest]) + extent)
    return np.where(equal, order[nearest], -1)


def _extents(rising: np.ndarray) -> np.ndarray:
    """Length of the even axis on which each value would have its nearest neighbour; 0 for both ends, which are exact."""
    gaps = np.diff(rising)
    between = np.minimum(gaps[1:], gaps[:-1]) * len(rising)
    return np.pad(between, 1)[: len(rising)] if len(rising) > 1 else np.zeros(len(rising))


def _same_rows(grid: Grid, other: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a list of points for each equal row of another list that varies the same parameters."""
    theirs, ours = ({axis.name: axis.values.tolist() for axis in one.axes} for one in (grid, other))
    if theirs.keys() != ours.keys():
        return _NOTHING
    place = {row: i for i, row in enumerate(zip(*theirs.values(), strict=True))}
    rows = zip(*(ours[name] for name in theirs), strict=True)
    pairs = np.array([(place[row], i) for i, row in enumerate(rows) if row in place], np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def differences(stored: Mapping[str, Any], job: Job) -> list[str]:
    """Differences of stored work from that of ``job``, as text.

    ``stored`` holds the scene (TOML), the package version, ``numerics`` and ``numerics_detail``.
    """
    text = stored.get("scene")
    if is_of_function(text) and not job.scene.is_named:
        same = "the values of over or the outputs differ"
        reason = same if text == job.scene.text else "the function, an option or a fixed value differs"
        return list(_of_code(stored, job)) or [reason]
    try:
        scene = restore_scene(text)
    except InputError as error:
        return [not_valid(error)]
    return differences_of(scene, stored, job)


def not_valid(error: InputError) -> str:
    """The text that the scene of stored work is not valid."""
    return f"its scene is not valid now ({' '.join(str(error).split())})"


def differences_of(scene: Scene, stored: Mapping[str, Any], job: Job, *, points: bool = True) -> list[str]:
    """Like :func:`differences`, for work of ``scene``.

    Without ``points``, axes and fixed values may differ, and the work may have more results than requested.
    """
    return [*_of_scenes(scene, job.scene, points), *_of_code(stored, job)]


def _of_code(stored: Mapping[str, Any], job: Job) -> Iterator[str]:
    """Differences of the code, its packages and the machine."""
    if stored.get("drivetrain_jax_version") != drivetrain_jax.__version__:
        yield f"drivetrain_jax is {drivetrain_jax.__version__}, was {stored.get('drivetrain_jax_version')}"
    if stored.get("numerics") != job.numerics:
        yield from _of_numerics(stored.get("numerics_detail"), job.numerics_detail)


def _of_scenes(theirs: Scene, ours: Scene, points: bool) -> Iterator[str]:
    old, new = scene_content(theirs), scene_content(ours)
    for key in ("system", "analysis", "method"):
        if old[key] != new[key]:
            yield f"{key} is {new[key]}, was {old[key]}"
    yield from _of_tables("options", old["options"], new["options"])
    if points:
        if old["outputs"] != new["outputs"]:
            yield f"outputs are {', '.join(new['outputs'])}, were {', '.join(old['outputs'])}"
        yield from _of_tables("fixed", old["fixed"], new["fixed"])
        yield from _of_axes(theirs, ours)
    elif missing := [name for name in new["outputs"] if name not in old["outputs"]]:
        yield f"lacks {', '.join(missing)}"


def _of_tables(table: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted({*old, *new}):
        if old.get(name) != new.get(name):
            yield f"{table}.{name} is {_text(new.get(name))}, was {_text(old.get(name))}"


def _of_axes(theirs: Scene, ours: Scene) -> Iterator[str]:
    old, new = ({axis.shown.name: axis.shown.values for axis in scene.axes} for scene in (theirs, ours))
    if list(old) != list(new) or theirs.zipped != ours.zipped:
        kinds = ["points" if scene.zipped else "axes" for scene in (ours, theirs)]
        yield f"{kinds[0]} are {', '.join(new) or 'none'}, {kinds[1]} were {', '.join(old) or 'none'}"
        return
    for name, values in new.items():
        if not np.array_equal(values, old[name]):
            now, before = (_range(row, ours) for row in (values, old[name]))
            yield f"{'points' if ours.zipped else 'axes'}.{name} has {now}, had {before}"


def _range(values: np.ndarray, scene: Scene) -> str:
    if scene.analysis.continuous:
        return f"the range from {values[0]:.10g} to {values[-1]:.10g}"
    ends = f"at {values[0]:.10g}" if len(values) == 1 else f"from {values[0]:.10g} to {values[-1]:.10g}"
    return f"{counted(len(values), 'value', 'values')} {ends}"


def _of_numerics(stored: str | None, present: Mapping[str, Any]) -> list[str]:
    """Differences of versions, sources and machine, as far as they were recorded."""
    try:
        old = json.loads(stored or "")
    except ValueError:
        return ["the code, a version or the machine differs"]
    changes = []
    for key, value in present.items():
        before = old.get(key)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            changed = [name for name in sorted({*value, *before}) if value.get(name) != before.get(name)]
            if key == "versions":
                changes += [f"{name} is {value.get(name)}, was {before.get(name)}" for name in changed]
            elif changed:
                changes.append(f"the code has changed in {', '.join(changed[:3])}{', ...' if len(changed) > 3 else ''}")
        elif value != before:
            changes.append(f"{key} is {_text(value)}, was {_text(before)}")
    return changes or ["the code, a version or the machine differs"]


def _text(value: Any) -> str:
    return "not given" if value is None else clipped(str(list(value) if isinstance(value, tuple) else value))
