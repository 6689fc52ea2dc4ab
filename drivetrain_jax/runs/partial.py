"""Unfinished work as a labelled result, during a run or after it was stopped."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.assemble import ResultBuffer, enter, labelled
from drivetrain_jax.runs.growing import remaining
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.output_state import OutputState
from drivetrain_jax.runs.pending import PENDING, with_pending
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import restore_scene
from drivetrain_jax.runs.shard_writer import block_of
from drivetrain_jax.store import checksums, consolidate
from drivetrain_jax.store.chunks import PartsFolder

if TYPE_CHECKING:
    import xarray as xr


def open_result(path: str | Path) -> xr.Dataset:
    """The result at ``path``, loaded into memory.

    If only unfinished work in ``FILE.nc.parts/`` exists, missing points have the outcome ``pending`` and no value; the
    attribute ``points_done`` counts the others. A running computation is not disturbed.

    Raises :class:`InputError` if there is neither, if the result is damaged, or if the work belongs to other code.

    >>> import drivetrain_jax as dt
    >>> dt.open_result("missing.nc")
    Traceback (most recent call last):
    drivetrain_jax._errors.InputError: file = 'missing.nc': does not exist; give a result written by `drivetrain run`
    """
    path = Path(path).expanduser()
    if path.exists() or not PartsFolder(path).holds_work():
        checksums.refuse_damaged(path)
        return consolidate.open_result(path)
    return _open_partial(path)


def _open_partial(path: Path) -> xr.Dataset:
    plan = PartsFolder(path).plan()
    job = resolve(restore_scene(str(plan.get("scene", ""))))
    output = OutputState(path, job)
    if output.state != "partial":
        raise InputError(f"file = {str(path)!r}: holds {output.obstacle}; allowed is to run its scene again")
    if not job.route.is_pointwise:
        raise InputError(
            f"file = {str(path)!r}: an atlas that is not finished; allowed is to wait for it or to resume it"
        )
    buffer, done = ResultBuffer(job.scene, job.grid), np.zeros(job.grid.size, bool)
    for points, results in _finished(job, output):
        buffer.fill(points, results)
        done[points] = True
    return _labelled(job, buffer, done)


def _finished(job: Job, output: OutputState) -> Iterator[tuple[np.ndarray, Mapping[str, np.ndarray]]]:
    """Yield finished points and their results, reused ones included."""
    reused = output.reused_before()
    yield from reused.blocks([variable.name for variable in ResultBuffer(job.scene, job.grid).variables])
    rest, written = remaining(job, reused), set[int]()
    for shard, points, results in output.sink.shards(job):
        written.add(shard)
        yield points, results
    for part in output.parts.read():
        if part.points is not None:
            if block_of(part) not in written:
                yield part.points, part.results
            continue
        for number, results in part:
            yield rest.plan.chunk(number).points, results


def _labelled(job: Job, buffer: ResultBuffer, done: np.ndarray) -> xr.Dataset:
    arrays = dict(buffer.lay_out())
    enter(arrays[OUTCOME.name], job.grid, np.flatnonzero(~done), PENDING)
    count = int(done.sum()) * job.grid.path_length
    result = labelled(job.scene, arrays, {"digest": job.digest, "points_done": count})
    title = f"{job.scene.title} (unfinished: {count} of {job.total} points)"
    return with_pending(result).with_attrs(title=title).to_dataset()
