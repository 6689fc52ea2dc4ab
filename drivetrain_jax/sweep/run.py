"""Runs a scene: in memory, or into a file that is resumed after any interruption and never damaged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.store.chunks import Part, PartsFolder
from drivetrain_jax.store.consolidate import ResultFile, open_result
from drivetrain_jax.store.provenance import physical_memory
from drivetrain_jax.sweep.assemble import Table, bytes_per_point, failures, to_dataset
from drivetrain_jax.sweep.engine import ChunkError, Engine
from drivetrain_jax.sweep.executor import Where
from drivetrain_jax.sweep.plan import Chunk
from drivetrain_jax.sweep.scene import load_scene
from drivetrain_jax.sweep.target import Target

# Finished chunks are written together, this often (seconds): small ones would cost more to write than to compute.
_WRITE_INTERVAL = 0.25


@dataclass
class Progress:
    """How far a run is. ``computed`` and ``reused`` and ``failed`` count points; costs are in the plan's units."""

    total: int
    computed: int = 0
    reused: int = 0
    failed: int = 0
    cost: float = 0.0
    total_cost: float = 0.0

    def __str__(self) -> str:
        return f"points: total={self.total} computed={self.computed} reused={self.reused} failed={self.failed}"


Report = Callable[[Progress], None]


class Incomplete(RuntimeError):
    """A run stopped before its end; finished chunks are kept. ``progress`` says how far it came."""

    def __init__(self, reason: str, progress: Progress) -> None:
        super().__init__(reason)
        self.progress = progress


class Interrupted(KeyboardInterrupt):
    """The user stopped a run; finished chunks are kept. ``progress`` says how far it came."""

    def __init__(self, progress: Progress) -> None:
        super().__init__("interrupted")
        self.progress = progress


def run(
    scene: str | Path | Mapping[str, Any],
    out: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    fresh: bool = False,
    threads: int | None = None,
    workers: int | None = None,
    dask: str | None = None,
    report: Report | None = None,
) -> xr.Dataset:
    """Compute a scene and return its labelled result.

    Without ``out`` everything happens in memory. With it the result is written to that netCDF4/HDF5 file; unfinished
    work is kept in ``FILE.nc.parts/`` and taken up by the next call, and a complete result is only read.

    :param scene: path of a scene file, or a mapping with the same keys.
    :param overrides: entries to replace, by dotted key: ``{"fixed.zeta": 0.002}``.
    :param fresh: replace a result, or drop unfinished work, of another scene or version at ``out``.
    :param threads: chunks computed at a time in threads of this process (default: the cores it may use).
    :param workers: this many spawned processes instead: one that crashes costs the chunk it was computing. A script that
        asks for them has to be guarded by ``if __name__ == "__main__"``.
    :param dask: the Dask cluster at ``tcp://host:port``, or ``local:N`` processes of Dask's own, instead.
    :param report: called with the :class:`Progress` after every chunk.
    :raises InputError: one line naming the field, what was given, what is allowed. Nothing is computed or written.
    :raises Incomplete: something failed on the way; the same call resumes.
    """
    where = Where(threads, workers, dask)
    if out is None:
        return _in_memory(_engine(scene, overrides, on_disk=False), where, report)
    run_to_file(scene, Path(out), overrides=overrides, fresh=fresh, where=where, report=report)
    return open_result(Path(out))


def run_to_file(
    scene: str | Path | Mapping[str, Any],
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    fresh: bool = False,
    where: Where = Where(),  # noqa: B008
    report: Report | None = None,
) -> Progress:
    """Like :func:`run` with ``out``, but returns the counts instead of the result."""
    engine = _engine(scene, overrides, on_disk=True)
    target = Target(out, engine.digest)
    if target.state == "complete" and not fresh:
        target.parts.discard()
        return Progress(engine.total, reused=engine.total, failed=target.failed)
    if target.state == "stale" and not fresh:
        raise InputError(
            f"out = {str(out)!r}: holds {target.obstacle} of another scene or version; --fresh replaces it"
        )
    parts = target.parts
    progress = _progress(engine)
    parts.open()
    try:
        if fresh or target.state == "absent":
            parts.start(target.plan)
        _resume(engine, out, parts, progress, where, report)
        parts.close(remove=True)
    except KeyboardInterrupt:
        raise Interrupted(progress) from None
    except (ChunkError, OSError, MemoryError) as error:
        raise Incomplete(f"{error or type(error).__name__}; the same command resumes", progress) from error
    finally:
        parts.close()
    return progress


def _engine(scene: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None, on_disk: bool) -> Engine:
    """The engine of a scene that this machine can run."""
    checked = load_scene(scene, overrides)
    engine = Engine(checked)
    needed, present = engine.total * bytes_per_point(checked, on_disk), physical_memory()
    if needed > present:
        limit = f"allowed here is up to {present / 1e9:.0f} GB"
        raise InputError(f"axes: {engine.total} points need {needed / 1e9:.0f} GB of memory; {limit}")
    return engine


def _progress(engine: Engine) -> Progress:
    """Counts before the first chunk; points that no solver can do are done already, without a value."""
    hopeless = engine.grid.size - sum(group.order.size for group in engine.plan.groups)
    points = hopeless * engine.grid.path_length
    return Progress(engine.total, computed=points, failed=points)


def _in_memory(engine: Engine, where: Where, report: Report | None) -> xr.Dataset:
    table, progress, begin = Table(engine.scene, engine.grid), _progress(engine), time.monotonic()
    try:
        _compute(engine, range(len(engine.plan.costs)), table, progress, where, report)
    except ChunkError as error:
        raise Incomplete(str(error), progress) from error
    return to_dataset(engine.scene, table.lay_out(), _attrs(engine, time.monotonic() - begin))


def _resume(
    engine: Engine, out: Path, parts: PartsFolder, progress: Progress, where: Where, report: Report | None
) -> None:
    """Write the result ``out`` from the parts that exist and those that are computed and kept now."""
    begin = time.monotonic()
    with ResultFile(parts.path / "result.tmp") as file:
        table = Table(engine.scene, engine.grid, lambda blank: file.lay_out(blank.assign_attrs(_attrs(engine, 0.0))))
        missing, earlier = _reuse(engine, parts, table, progress)
        writer, before = _Writer(parts), progress.computed
        try:
            _compute(engine, missing, table, progress, where, report, writer.add)
        finally:
            writer.flush()
            # An interrupt may come between keeping a chunk and counting it: what counts is what was written.
            progress.computed = before + writer.written * engine.grid.path_length
        table.lay_out()
        file.finish(out, wall_time_s=round(earlier + time.monotonic() - begin, 3))


def _reuse(engine: Engine, parts: PartsFolder, table: Table, progress: Progress) -> tuple[list[int], float]:
    """Enter the chunks that are there; the numbers of those that are not, and the seconds the former took."""
    missing, seconds = set(range(len(engine.plan.costs))), 0.0
    for part in parts.read(repair=True):
        seconds += part.seconds
        for number, results in part:
            if number not in missing:
                continue
            missing.remove(number)
            points = engine.plan.chunk(number).points
            table.fill(points, results)
            progress.reused += points.size * engine.grid.path_length
            progress.failed += failures(results[OUTCOME.name])
    return sorted(missing), seconds


def _compute(
    engine: Engine,
    numbers: Iterable[int],
    table: Table,
    progress: Progress,
    where: Where,
    report: Report | None,
    keep: Callable[[Chunk, Mapping[str, np.ndarray]], None] | None = None,
) -> None:
    """Compute chunks into ``table``; ``keep`` gets each as soon as it is there. Lost ones are not kept: a run that is
    resumed tries them again."""
    numbers, costs = list(numbers), engine.plan.costs
    progress.total_cost = float(costs[numbers].sum())
    if report:
        report(progress)
    # Closed on the way out: after an interrupt no further chunk starts.
    with closing(where.compute(engine, numbers)) as finished:
        for chunk, results in finished:
            count = chunk.points.size * engine.grid.path_length
            if results is None:
                table.lose(chunk.points)
                progress.failed += count
            else:
                if keep:
                    keep(chunk, results)
                table.fill(chunk.points, results)
                progress.failed += failures(results[OUTCOME.name])
            progress.computed += count
            progress.cost += float(costs[chunk.number])
            if report:
                report(progress)


class _Writer:
    """Collects finished chunks and writes those of every quarter of a second as one part."""

    def __init__(self, parts: PartsFolder) -> None:
        self._parts = parts
        self._waiting: list[tuple[Chunk, Mapping[str, np.ndarray]]] = []
        self._last = time.monotonic()
        self.written = 0

    def add(self, chunk: Chunk, results: Mapping[str, np.ndarray]) -> None:
        self._waiting.append((chunk, results))
        if time.monotonic() - self._last >= _WRITE_INTERVAL:
            self.flush()

    def flush(self) -> None:
        if not self._waiting:
            return
        chunks, results = zip(*self._waiting, strict=True)
        joined = {name: np.concatenate([r[name] for r in results]) for name in results[0]}
        seconds = time.monotonic() - self._last
        self._parts.write(Part([c.number for c in chunks], [c.points.size for c in chunks], joined, seconds))
        self._waiting.clear()
        self.written += sum(c.points.size for c in chunks)
        self._last = time.monotonic()


def _attrs(engine: Engine, seconds: float) -> dict[str, str | float]:
    return {"digest": engine.digest, "numerics": engine.numerics, "wall_time_s": round(seconds, 3)}


@dataclass(frozen=True)
class Status:
    """How much of a scene is at ``out``: counts of points, and absent, partial, complete or stale (another scene)."""

    total: int
    done: int
    failed: int
    state: str


def status(
    scene: str | Path | Mapping[str, Any], out: str | Path, overrides: Mapping[str, Any] | None = None
) -> Status:
    """What a run of ``scene`` into ``out`` would find. Changes nothing and compiles nothing."""
    engine = Engine(load_scene(scene, overrides))
    target = Target(Path(out), engine.digest)
    if target.state == "complete":
        return Status(engine.total, engine.total, target.failed, target.state)
    chunks = {n: r[OUTCOME.name] for part in target.parts.read() for n, r in part} if target.state == "partial" else {}
    done, failed = (
        sum(outcome.size for outcome in chunks.values()),
        sum(failures(outcome) for outcome in chunks.values()),
    )
    return Status(engine.total, done, failed, target.state)
