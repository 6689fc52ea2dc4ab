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
from drivetrain_jax.runs.assemble import sweep_first
from drivetrain_jax.runs.axes import Grid, entry_of
from drivetrain_jax.runs.job import Job, scene_content
from drivetrain_jax.runs.scene import Scene, is_of_function, restore_scene, result_variables
from drivetrain_jax.store import checksums, consolidate
from drivetrain_jax.store.files import digest
from drivetrain_jax.store.parts import Arrays

# Points that are copied at a time.
_BLOCK = 1 << 18
# Tolerance for equal axis values, in relative units: another ``num`` gives other roundings.
_ROUNDINGS = 4 * np.finfo(float).eps


class NotReusable(InputError):
    """Raised if no point of a result can be reused; ``damage`` names the damaged variables of the result, if any."""

    def __init__(self, path: Path, why: str, remedy: str, damage: str = "") -> None:
        super().__init__(f"reuse = {str(path)!r}: {why}; {remedy}")
        self.damage = damage


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

    def blocks(self) -> Iterator[tuple[np.ndarray, Arrays]]:
        """Yield our points and their results in blocks, so that no result is loaded as a whole."""
        arrays = {name: sweep_first(consolidate.map_variable(self.path, name), self.grid) for name in self.names}
        for start in range(0, self.ours.size, _BLOCK):
            points = self.theirs[start : start + _BLOCK]
            results = {name: _rows(array, self.grid, points) for name, array in arrays.items()}
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
        sources = " ".join(source.digest for source in self.sources)
        return {"reused_points": self.count, "reused_from": sources} if sources else {}

    def others(self, size: int) -> np.ndarray | None:
        """The other ones of ``size`` points; None if nothing is reused."""
        if not self.sources:
            return None
        left = np.ones(size, bool)
        left[np.concatenate([source.ours for source in self.sources])] = False
        return np.flatnonzero(left)


NO_REUSE = ReusedPoints()


def combined(job: Job, results: Iterable[ReusableResult]) -> ReusedPoints:
    """The points of ``job`` that these results contain, each from the first result that has it."""
    free, sources = np.ones(job.grid.size, bool), []
    for source in results:
        keep = free[source.ours]
        free[source.ours] = False
        sources.append(replace(source, theirs=source.theirs[keep], ours=source.ours[keep]))
    return ReusedPoints(tuple(source for source in sources if source.ours.size))


def find(job: Job, path: Path) -> ReusableResult:
    """The points of ``job`` that the result at ``path`` contains, without lost ones."""
    try:
        attrs = consolidate.attributes(path)
    except InputError as error:
        raise InputError(str(error).replace("file = ", "reuse = ", 1)) from None
    if "digest" not in attrs:
        raise NotReusable(path, "not a result of drivetrain_jax", "expected such a result")
    try:
        scene = restore_scene(attrs.get("scene"))
        reasons = differences_of(scene, attrs, job, points=False)
    except InputError as error:
        reasons, scene = [_not_valid(error)], job.scene
    if reasons:
        raise NotReusable(path, reasons[0], "expected a result that differs in its points only")
    # The checksums of the new result would hide damage.
    if damage := checksums.named(checksums.damaged(path) or []) or (
        "" if "checksums" in attrs else "it has no checksums"
    ):
        raise NotReusable(path, f"damaged ({damage})", "restore the file or compute it again", damage)
    grid = Grid.of(scene)
    theirs, ours = _same_points(scene, grid, job)
    if theirs.size:
        outcome = _rows(sweep_first(consolidate.map_variable(path, OUTCOME.name), grid), grid, theirs)
        kept = ~(outcome == Outcome.LOST).any(axis=tuple(range(1, outcome.ndim)))
        theirs, ours = theirs[kept], ours[kept]
    if not theirs.size:
        raise NotReusable(path, "holds none of the points", "expected one that shares points and fixed values")
    wanted = set(scene.request.outputs) <= set(job.scene.request.outputs)
    is_covered = wanted and np.unique(theirs).size == grid.size
    stored = tuple(variable.name for variable in result_variables(job.scene))
    return ReusableResult(path, str(attrs["digest"]), stored, grid, theirs, ours, is_covered)


def _rows(array: np.ndarray, grid: Grid, points: np.ndarray) -> np.ndarray:
    """A copy of the results of these ``points``; a grid without axes has one point, which may occur several times."""
    rows = np.array(array[grid.place(points)])
    return rows if grid.shape else np.repeat(rows, len(points), axis=0)


def _same_points(scene: Scene, grid: Grid, job: Job) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of equal points of a scene and of ``job``; none if lines or fixed values differ.

    Every point gets a key, the position of its values among all values of the parameters that vary in one of both.
    """
    scenes, grids = (scene, job.scene), (grid, job.grid)
    columns = [{axis.name: axis.values for axis in one.axes} for one in grids]
    fixed = [_constants(one) for one in scenes]
    names = dict.fromkeys([*columns[0], *columns[1]])
    lines = [one.path and (one.path.name, one.path.values.tolist(), one.path_is_fixed) for one in grids]
    path = {one.path.name for one in grids if one.path}
    constants = [{n: value for n, value in one.items() if n not in names.keys() | path} for one in fixed]
    # Positions are compared by one parameter an axis.
    several = any(axis.also for one in grids for axis in one.axes)
    if several or lines[0] != lines[1] or constants[0] != constants[1]:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    keys, count = [np.zeros(one.shape, np.int64) for one in grids], 1
    for name in names:
        # A parameter that an analysis does not use has any value.
        if not all(entry_of(name)[0] in one.analysis.model(one.system).parameters for one in scenes):
            continue
        values = [np.atleast_1d({**f, **c}.get(name, np.nan)) for c, f in zip(columns, fixed, strict=True)]
        codes = equal_codes(*values)
        different = 1 + int(max(codes[0].max(), codes[1].max()))
        if count * different > np.iinfo(np.int64).max:
            # As few numbers as there are different keys, at most one per point.
            dense = np.unique(np.concatenate([key.reshape(-1) for key in keys]), return_inverse=True)[1]
            keys = [part.reshape(key.shape) for part, key in zip(np.split(dense, [keys[0].size]), keys, strict=True)]
            count = 1 + int(dense.max())
        count *= different
        for one, key, code in zip(grids, keys, codes, strict=True):
            place = next((i for i, axis in enumerate(one.axes) if axis.name == name), None)
            key *= different
            if place is None or one.zipped:
                key += code[0] if place is None else code
            else:
                key += code.reshape(-1, *[1] * (len(one.axes) - 1 - place))
    theirs, ours = (key.reshape(-1) for key in keys)
    order = np.argsort(theirs, kind="stable")
    place = order[np.searchsorted(theirs, ours, sorter=order).clip(max=theirs.size - 1)]
    equal = np.flatnonzero(theirs[place] == ours)
    return place[equal], equal


def _constants(scene: Scene) -> dict[str, Any]:
    """The fixed parameters that the analysis uses, and the entries of lists."""
    used, entries = scene.analysis.model(scene.system).parameters, {}
    for name in scene.fixed.keys() & set(used):
        value = scene.fixed[name]
        entries[name] = len(value) if isinstance(value, tuple) else value
        entries |= {f"{name}[{i}]": entry for i, entry in enumerate(value)} if isinstance(value, tuple) else {}
    return entries


def equal_codes(*columns: np.ndarray) -> list[np.ndarray]:
    """Numbers of the values of two columns, the same for values that are equal within the rounding of an axis.

    The ends of an axis are exact, its inner values have rounding errors in proportion to its length.
    """
    values, ends = np.concatenate(columns), [len(columns[0])]
    extents = np.concatenate([_extents(np.asarray(column, float)) for column in columns])
    order = np.argsort(values, kind="stable")
    rising, pairs = values[order].astype(float), np.sort([extents[order][1:], extents[order][:-1]], axis=0)
    # The smaller tolerance of both, or the only one.
    extent = np.where(pairs[0] > 0, *pairs)
    with np.errstate(invalid="ignore"):
        near = np.diff(rising) <= _ROUNDINGS * (abs(rising[1:]) + extent)
    # Nothing is near to infinity.
    differs = ~np.where(np.isfinite(rising[1:]), near, rising[1:] == rising[:-1])
    codes = np.empty(len(values), np.int64)
    codes[order] = np.concatenate([[0], np.cumsum(differs)])
    return np.split(codes, ends)


def _extents(column: np.ndarray) -> np.ndarray:
    """Length of the even axis on which each value would have its nearest neighbour; 0 for both ends, which are exact."""
    rising, place = np.unique(column, return_inverse=True)
    gaps = np.diff(rising)
    between = np.minimum(gaps[1:], gaps[:-1]) * len(rising)
    return np.pad(between, 1)[place] if len(rising) > 1 else np.zeros(len(column))


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
        return differences_of(restore_scene(text), stored, job)
    except InputError as error:
        return [_not_valid(error)]


def _not_valid(error: InputError) -> str:
    return f"its scene is not valid now ({' '.join(str(error).split())})"


def differences_of(scene: Scene, stored: Mapping[str, Any], job: Job, *, points: bool = True) -> list[str]:
    """Like :func:`differences`, for work of ``scene``.

    Without ``points``, axes and fixed values may differ, and the work may have more results than requested.
    """
    old, new = _entries(scene, points), _entries(job.scene, points)
    reasons = [
        f"{key} is {_text(new.get(key))}, was {_text(old.get(key))}"
        for key in {**new, **old}
        if not np.array_equal(old.get(key, ""), new.get(key, ""))
    ]
    missing = [] if points else [name for name in job.scene.request.outputs if name not in scene.request.outputs]
    return [*reasons, *([f"lacks {', '.join(missing)}"] if missing else []), *_of_code(stored, job)]


def _entries(scene: Scene, points: bool) -> dict[str, Any]:
    content, where = scene_content(scene), "points" if scene.zipped else "axes"
    entries = {key: content[key] for key in ("system", "analysis", "method")}
    entries |= {f"options.{name}": value for name, value in sorted(content["options"].items())}
    if points:
        shown = [axis.shown for axis in scene.axes]
        entries |= {"outputs": ", ".join(content["outputs"]), where: ", ".join(axis.name for axis in shown)}
        entries |= {f"fixed.{name}": value for name, value in sorted({**scene.data, **content["fixed"]}.items())}
        entries |= {"parts": scene.parts}
        for axis in shown:
            ends = " to ".join(f"{x:.15g}" for x in axis.values[[0, -1]])
            entries[f"{where}.{axis.name}"] = f"the range from {ends}" if scene.analysis.continuous else axis.values
    return entries


def _of_code(stored: Mapping[str, Any], job: Job) -> Iterator[str]:
    """Differences of the code, its packages and the machine, as far as they were recorded."""
    if stored.get("drivetrain_jax_version") != drivetrain_jax.__version__:
        yield f"drivetrain_jax is {drivetrain_jax.__version__}, was {stored.get('drivetrain_jax_version')}"
    if stored.get("numerics") == job.numerics:
        return
    try:
        old = json.loads(stored.get("numerics_detail") or "")
    except ValueError:
        old = job.numerics_detail
    tables = [{**table, **table.get("versions", {})} for table in (old, job.numerics_detail)]
    sources = [table.pop("sources", {}) for table in tables]
    changes = [
        f"{key} is {_text(tables[1].get(key))}, was {_text(tables[0].get(key))}"
        for key in sorted({**tables[1], **tables[0]})
        if key != "versions" and tables[0].get(key) != tables[1].get(key)
    ]
    if changed := sorted(n for n in {**sources[0], **sources[1]} if sources[0].get(n) != sources[1].get(n)):
        changes.insert(0, f"the code has changed in {', '.join(changed[:3])}{', ...' if len(changed) > 3 else ''}")
    yield from changes or ["the code, a version or the machine differs"]


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        first, last = value[0], value[-1]
        ends = f"at {first:.10g}" if len(value) == 1 else f"from {first:.10g} to {last:.10g}"
        return f"{counted(len(value), 'value', 'values')} {ends}"
    return "not given" if value is None else clipped(str(list(value) if isinstance(value, tuple) else value))
