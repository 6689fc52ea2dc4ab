"""Compute a scene from an atlas: evaluate the panels, and solve the points in gaps directly."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from drivetrain_jax._threads import in_double_precision
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.atlas import StabilityAtlas, prepare_judging
from drivetrain_jax.runs.assemble import Table, failures
from drivetrain_jax.runs.atlas_choice import atlas_ranges, solves_allowed
from drivetrain_jax.runs.engine import Engine
from drivetrain_jax.runs.rounds import build_atlas, fixed_of
from drivetrain_jax.runs.work import Progress, Work

# Cells evaluated at a time; determines memory and the interval of progress reports.
_BLOCK = 1 << 21
_ROWS = 64
# Cells above which preparations run in parallel with the solves.
_LARGE = 1 << 19

Results = Mapping[str, np.ndarray]


def fill_through_atlas(engine: Engine, table: Table, work: Work, progress: Progress) -> dict[str, str | int]:
    """Fill all points of ``engine`` into ``table``; returns attributes of the result."""
    scene = engine.scene
    solves = Progress(0, kind="direct solves for the atlas")
    # In parallel with the solves.
    with ThreadPoolExecutor(1, initializer=in_double_precision) as aside:
        prepared = [aside.submit(_lay_out, engine, table), aside.submit(_prepare_judging, engine)]
        atlas, first = build_atlas(scene, atlas_ranges(scene), work, solves, solves_allowed(scene))
        progress.note = solves.note
        prepared[0].result()
        uncovered = evaluate(engine, table, atlas, work, progress, first)
        prepared[1].result()
    return {"atlas_solves": atlas.atlas.solves, "atlas_panels": len(atlas.atlas.panels), "atlas_uncovered": uncovered}


def _lay_out(engine: Engine, table: Table) -> None:
    """Create the output file while the solves run; for a small file this would delay the solves.

    The thread that fills memory must also allocate it, to reuse memory that earlier results have freed.
    """
    if engine.grid.size >= _LARGE and table.on_disk and not any(variable.dims for variable in table.variables):
        table.lay_out(blank=False)


def _prepare_judging(engine: Engine) -> None:
    """Compile the kernel that decides single cells, which takes seconds: of this many cells some need it."""
    if engine.grid.size < _LARGE:
        return
    scene, ranges = engine.scene, atlas_ranges(engine.scene)
    fixed, rtol = fixed_of(scene, ranges), scene.request.options["rtol"]
    prepare_judging(scene.system, ranges, fixed, rtol, scene.request.outputs)


def evaluate(
    engine: Engine,
    table: Table,
    atlas: StabilityAtlas,
    work: Work,
    progress: Progress,
    first: int = 0,
    *,
    solve: bool = True,
) -> int:
    """All points of ``engine`` into ``table`` from ``atlas``; those that it does not cover are counted, and solved unless
    ``solve`` is false.

    A resumed run evaluates again, because that is faster than reading. For ``first`` see :meth:`Work.do`.
    """
    uncovered: list[np.ndarray] = []
    filled = _points if engine.scene.zipped else _blocks
    for block, results in filled(engine, atlas, table):
        table.release_after(results)
        outcome = results[OUTCOME.name]
        lost = np.argwhere(outcome == Outcome.LOST) + [part.start for part in block]
        uncovered.append(np.ravel_multi_index(tuple(lost.T), engine.grid.shape))  # pyright: ignore[reportArgumentType]
        progress.computed += outcome.size - len(lost)
        progress.failed += failures(outcome) - len(lost)
        if work.report:
            work.report(progress)
    rest = np.concatenate([np.empty(0, int), *uncovered])
    if rest.size and solve:
        work.do(engine.only(rest), table, progress, first)
    return rest.size


def _points(engine: Engine, atlas: StabilityAtlas, table: Table) -> Iterator[tuple[tuple[slice], Results]]:
    """Yield positions among the points, and the filled arrays of ``table`` there."""
    names, outputs = atlas.atlas.parameters, engine.scene.request.outputs
    for start in range(0, engine.grid.size, _BLOCK):
        numbers = np.arange(start, min(start + _BLOCK, engine.grid.size))
        columns = engine.grid.columns(numbers)
        points = np.stack([columns[name] for name in names], axis=-1)
        place = (slice(start, start + len(numbers)),)
        arrays = table.block(place, atlas.blank((), outputs))
        for name, values in atlas.at(points, outputs).items():
            arrays[name][...] = values
        yield place, arrays


def _blocks(engine: Engine, atlas: StabilityAtlas, table: Table) -> Iterator[tuple[tuple[slice, ...], Results]]:
    """Yield positions in the grid block by block, and the filled arrays of ``table`` there."""
    axes = {axis.name: axis.values for axis in engine.grid.axes}
    lengths = {name: len(axes[name]) for name in atlas.atlas.parameters}
    longest = sorted(lengths, key=lambda name: lengths[name])[-2:]
    # Rows and columns of a tile are the last two. Of axes as long as each other their order decides, which stays.
    atlas = atlas.ordered(sorted(lengths, key=lambda name: (name in longest, name not in longest and lengths[name])))
    names, outputs = atlas.atlas.parameters, engine.scene.request.outputs
    sizes = [lengths[name] for name in names]
    for ranges in _cut(sizes):
        values = [axes[name][part] for name, part in zip(names, ranges, strict=True)]
        place = tuple(dict(zip(names, ranges, strict=True)).get(name, slice(0, 1)) for name in axes)
        arrays = table.block(place, atlas.blank((), outputs))
        places = {n: _in_atlas_order(a, names, tuple(axes)) for n, a in arrays.items()}
        atlas.on_grid(values, outputs, places, rows=sizes[-2] if len(sizes) > 1 else None)
        yield place, arrays


def _cut(lengths: Sequence[int]) -> Iterator[tuple[slice, ...]]:
    """Blocks of a grid of about ``_BLOCK`` cells at most, whole along as many of the last axes as possible."""
    whole = len(lengths) - 1
    while whole > 0 and math.prod(lengths[whole:]) <= _BLOCK:
        whole -= 1
    # Axis number `whole` is cut into pieces, earlier axes into single values.
    step = max(1, _BLOCK // max(math.prod(lengths[whole + 1 :]), 1))
    step = step - step % _ROWS if step > _ROWS else step
    starts = list(range(0, lengths[whole], step))
    pieces = [slice(*ends) for ends in itertools.pairwise([*starts, lengths[whole]])]
    for leading in itertools.product(*(range(n) for n in lengths[:whole])):
        for piece in pieces:
            yield (*(slice(i, i + 1) for i in leading), piece, *(slice(0, n) for n in lengths[whole + 1 :]))


def _in_atlas_order(values: np.ndarray, names: Sequence[str], axes: Sequence[str]) -> np.ndarray:
    """A view of results over the ``axes`` of the scene as results over the parameters ``names`` of an atlas; other axes
    have one value."""
    present = [name for name in axes if name in names]
    order = [present.index(name) for name in names]
    values = np.squeeze(values, axis=tuple(k for k, name in enumerate(axes) if name not in names))
    return np.transpose(values, (*order, *range(len(names), values.ndim)))
