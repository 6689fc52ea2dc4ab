"""Compute a scene from an atlas: build it from blocks of solves, evaluate its panels, solve the points in gaps directly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from drivetrain_jax._errors import counted
from drivetrain_jax._machine import in_double_precision
from drivetrain_jax.analysis import OUTCOME, Analysis, Outcome, Request
from drivetrain_jax.analysis.atlas import SOLVES
from drivetrain_jax.atlas import (
    StabilityAtlas,
    floquet_atlas,
    floquet_domain,
    method_of_solves,
    numbers_per_solve,
    prepare_judging,
    solve_rtol,
    stability_atlas,
)
from drivetrain_jax.atlas.construction import MAX_SOLVES
from drivetrain_jax.runs.assemble import ResultBuffer
from drivetrain_jax.runs.axes import Axis, Grid, placed
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.reuse import ReusedPoints
from drivetrain_jax.runs.scene import Problem, Ranges, Scene
from drivetrain_jax.runs.work import DIRECT, Progress, Route, Work
from drivetrain_jax.store.parts import Arrays, Shards

# Cells evaluated at a time, which determines memory and the interval of progress reports, and rows of a tile.
_BLOCK = 1 << 21
_ROWS = 64
# Cells above which preparations run in parallel with the solves.
_LARGE = 1 << 19


class ThroughAtlas(Route):
    """Builds an atlas over ``ranges`` and evaluates it; points that it does not cover are solved."""

    name = "an atlas"
    is_pointwise = False

    def __init__(self, ranges: Ranges, max_solves: int | None) -> None:
        self._ranges, self._max_solves = ranges, max_solves

    def fill(
        self, job: Job, buffer: ResultBuffer, work: Work, progress: Progress, reused: ReusedPoints
    ) -> dict[str, str | int]:
        """Fill all points; nothing is reused, because evaluating is faster than reading."""
        solves = Progress(0, kind="direct solves for the atlas")
        scene, prepared = job.scene, None
        with ThreadPoolExecutor(1, initializer=in_double_precision) as aside:
            if job.grid.size >= _LARGE:
                # Some cells need the kernel that decides single ones, which takes seconds to compile.
                rest = fixed_of(scene, self._ranges), scene.request.options["rtol"], scene.request.outputs
                prepared = aside.submit(prepare_judging, scene.system, self._ranges, *rest)
            atlas, first = build_atlas(scene, self._ranges, work, solves, self._max_solves)
            progress.note = solves.note
            uncovered = evaluate(job, buffer, atlas, work, progress, first)
            if prepared:
                prepared.result()
        panels = len(atlas.atlas.panels)
        return {"atlas_solves": atlas.atlas.solves, "atlas_panels": panels, "atlas_uncovered": uncovered}


def evaluate(
    job: Job,
    buffer: ResultBuffer,
    atlas: StabilityAtlas,
    work: Work,
    progress: Progress,
    first: int = 0,
    *,
    solve: bool = True,
) -> int:
    """Fill all points of ``job`` into ``buffer`` from ``atlas``; returns the number of points that it does not cover.

    Uncovered points are solved unless ``solve`` is false. A resumed run evaluates again, because that is faster than
    reading. For ``first`` see :meth:`Work.do`.
    """
    uncovered: list[np.ndarray] = []
    filled = _points if job.scene.zipped else _blocks
    for block, results in filled(job, atlas, buffer):
        buffer.release_after(results)
        outcome = results[OUTCOME.name]
        lost = np.argwhere(outcome == Outcome.LOST) + [part.start for part in block]
        uncovered.append(np.ravel_multi_index(tuple(lost.T), job.grid.shape))  # pyright: ignore[reportArgumentType]
        progress.computed += outcome.size - len(lost)
        progress.count(outcome[outcome != Outcome.LOST])
        work.report(progress)
    rest = np.concatenate([np.empty(0, int), *uncovered])
    if rest.size and solve:
        work.do(job, buffer.fill, progress, first, np.sort(rest))
    return rest.size


def _points(job: Job, atlas: StabilityAtlas, buffer: ResultBuffer) -> Iterator[tuple[tuple[slice], Arrays]]:
    """Yield positions among the points, and the filled arrays of ``buffer`` there."""
    names, outputs = atlas.atlas.parameters, job.scene.request.outputs
    for start in range(0, job.grid.size, _BLOCK):
        numbers = np.arange(start, min(start + _BLOCK, job.grid.size))
        columns = job.grid.columns(numbers)
        points = np.stack([columns[name] for name in names], axis=-1)
        place = (slice(start, start + len(numbers)),)
        arrays = buffer.block(place, atlas.blank((), outputs))
        for name, values in atlas.at(points, outputs).items():
            arrays[name][...] = values
        yield place, arrays


def _blocks(job: Job, atlas: StabilityAtlas, buffer: ResultBuffer) -> Iterator[tuple[tuple[slice, ...], Arrays]]:
    """Yield positions in the grid block by block, and the filled arrays of ``buffer`` there."""
    axes = {axis.name: axis.values for axis in job.grid.axes}
    # Parameters of one value are fixed; at least two others remain.
    single = [name for name in atlas.atlas.parameters if len(axes[name]) == 1]
    single = single[: max(len(atlas.atlas.parameters) - 2, 0)]
    atlas = atlas.slice({name: float(axes[name][0]) for name in single})
    lengths = {name: len(axes[name]) for name in atlas.atlas.parameters}
    longest = sorted(lengths, key=lambda name: lengths[name])[-2:]
    # The longest axes come last, as rows and columns of tiles. Axes of equal length keep their order.
    atlas = atlas.ordered(sorted(lengths, key=lambda name: (name in longest, name not in longest and lengths[name])))
    names, outputs = atlas.atlas.parameters, job.scene.request.outputs
    sizes = [lengths[name] for name in names]
    boxes = _boxes(tuple(sizes))
    for ranges in map(boxes.place, range(boxes.count)):
        values = [axes[name][part] for name, part in zip(names, ranges, strict=True)]
        place = tuple(dict(zip(names, ranges, strict=True)).get(name, slice(0, 1)) for name in axes)
        arrays = buffer.block(place, atlas.blank((), outputs))
        places = {n: _in_atlas_order(a, names, tuple(axes)) for n, a in arrays.items()}
        atlas.on_grid(values, outputs, places, rows=sizes[-2] if len(sizes) > 1 else None)
        yield place, arrays


def _boxes(sizes: tuple[int, ...]) -> Shards:
    """Boxes of about ``_BLOCK`` cells, with whole tiles of rows."""
    boxes = Shards.of(sizes, None, _BLOCK)
    if len(sizes) == 1 or boxes.lengths[-2] < _ROWS:
        return boxes
    *outer, rows, columns = boxes.lengths
    return replace(boxes, lengths=(*outer, min(-(-rows // _ROWS) * _ROWS, sizes[-2]), columns))


def _in_atlas_order(values: np.ndarray, names: Sequence[str], axes: Sequence[str]) -> np.ndarray:
    """A view of results over the ``axes`` of the scene as results over the parameters ``names`` of an atlas.

    All other axes have one value.
    """
    present = [name for name in axes if name in names]
    order = [present.index(name) for name in names]
    values = np.squeeze(values, axis=tuple(k for k, name in enumerate(axes) if name not in names))
    return np.transpose(values, (*order, *range(len(names), values.ndim)))


# Ratio of the tolerance of the panels to that of the results.
_SHARPER = 0.1


def build_atlas(
    scene: Scene,
    ranges: Mapping[str, tuple[float, float]],
    work: Work,
    progress: Progress,
    max_solves: int | None = None,
) -> tuple[StabilityAtlas, int]:
    """The atlas of ``scene`` over ``ranges``, and the first free number of a block.

    ``progress`` counts the solves and notes gaps.
    """
    fixed = fixed_of(scene, ranges)
    rtol = scene.request.options["rtol"]
    tolerance = _tolerance(scene)
    options, method = {"rtol": solve_rtol(tolerance)}, method_of_solves(scene.system, ranges, fixed, tolerance)
    width = numbers_per_solve(scene.system, ranges, fixed)
    first = 0

    def solve(points: np.ndarray) -> np.ndarray:
        nonlocal first
        job = Job(_solves(scene, fixed, tuple(ranges), points, method, options), DIRECT, full_size=True)
        answers = np.full((len(points), width), np.nan)

        def fill(numbers: np.ndarray, results: Arrays) -> None:
            answers[numbers] = np.concatenate([results[name] for name in SOLVES.default_outputs], axis=1)

        progress.total += len(points)
        work.do(job, fill, progress, first)
        first += job.boxes.count
        return answers

    atlas = floquet_atlas(scene.system, ranges, fixed, tolerance, solve, max_solves or MAX_SOLVES)
    if atlas.gaps:
        have = f"{counted(len(atlas.panels), 'panel', 'panels')} and {counted(len(atlas.gaps), 'gap', 'gaps')}"
        reasons = "; ".join(sorted({gap.reason for gap in atlas.gaps}))
        progress.note = f"the atlas has {have} ({reasons}): what lies in a gap is solved directly"
    return stability_atlas(atlas, scene.system, rtol), first


def node_job(scene: Scene, ranges: Mapping[str, tuple[float, float]], count: int) -> Job:
    """The job of ``count`` solves for an atlas of ``scene``, spread over ``ranges`` like the nodes of its panels."""
    fixed = fixed_of(scene, ranges)
    domain = floquet_domain(scene.system, ranges, fixed)
    spread = np.cos(np.pi * np.random.default_rng(0).random((count, len(ranges))))
    points = domain.points(domain.box().place(spread))
    options = {"rtol": solve_rtol(_tolerance(scene))}
    return Job(_solves(scene, fixed, tuple(ranges), points, "direct", options), DIRECT, full_size=True)


def _tolerance(scene: Scene) -> float:
    return _SHARPER * scene.request.options["rtol"]


def fixed_of(scene: Scene, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    """The parameters of the propagator that are not in ``ranges``, and their values."""
    varying = [part for axis in scene.axes for part in axis.together if part.name not in ranges]
    fixed: dict[str, Any] = {**scene.fixed}
    for part in varying:
        name = part.parameter.name
        fixed[name] = placed(fixed.get(name), part.entry, part.values[0].item())
    return {name: fixed[name] for name in scene.system.models[SOLVES.name].parameters if name in fixed}


def _solves(
    scene: Scene, fixed: Mapping, names: tuple[str, ...], points: np.ndarray, method: str, options: Mapping
) -> Nodes:
    request = Request(SOLVES.default_outputs, method, dict(options))
    nodes = Nodes(scene.system, SOLVES, request, (), True, fixed)
    # Fixed numbers as columns: jax traces a march twice if some of its parameters are the same for all lanes.
    columns = {name: np.full(len(points), value) for name, value in Grid.of(nodes).numbers.items()}
    columns |= dict(zip(names, points.T, strict=True))
    return replace(nodes, axes=tuple(Axis(n, scene.system.parameter(n), None, x) for n, x in columns.items()))


class Nodes(Problem):
    """Points at which the propagator is solved. Its analysis has the name that scenes give to a whole atlas."""

    @staticmethod
    def find_analysis(name: str) -> Analysis:
        """The analysis of the propagator."""
        return SOLVES
