"""Run a scene in memory, or into a file that survives interruptions and is resumed; and show its progress."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from threading import current_thread, main_thread
from typing import TYPE_CHECKING, Any

from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax._machine import StatusLine, notebook, physical_memory, stop_on_signals, terminal
from drivetrain_jax.runs.assemble import ZarrBlocks
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.output import HDF5, ZARR, Output
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import Scene, load_scene
from drivetrain_jax.runs.work import Progress, Report, Threads, Work, make_executor
from drivetrain_jax.store.consolidate import open_result

if TYPE_CHECKING:
    import xarray as xr


class Incomplete(RuntimeError):
    """Raised when a run stops before its end; finished blocks are kept. ``progress`` holds the counts."""

    def __init__(self, reason: str, progress: Progress) -> None:
        super().__init__(reason)
        self.progress = progress


class Interrupted(KeyboardInterrupt):
    """Raised when the user interrupts a run; finished blocks are kept. ``progress`` holds the counts."""

    def __init__(self, progress: Progress) -> None:
        super().__init__("interrupted; the same call resumes")
        self.progress = progress


def run(
    scene: str | Path | Mapping[str, Any] | Scene,
    out: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    fresh: bool = False,
    threads: int | None = None,
    workers: int | None = None,
    dask: str | None = None,
    reuse: str | Path | Sequence[str | Path] = (),
    report: Report | None = None,
) -> xr.Dataset:
    """The labelled result of a scene.

    With ``out`` the result is written to that netCDF4/HDF5 file. Unfinished work is kept in ``FILE.nc.parts/`` and resumed
    by the next call; a complete result is only read. For results larger than one disk use ``drivetrain run --store zarr``.

    Args:
        scene: path of a scene file, name of one that the package brings, a mapping with the same keys, or a checked scene.
        out: netCDF4/HDF5 file to write; default: only in memory.
        overrides: entries to replace, by dotted key: ``{"fixed.zeta": 0.002}``.
        fresh: compute all points again and replace what is at ``out``. The same call resumes an interrupted run.
        threads: number of threads of this process (default: the usable cores).
        workers: number of Dask processes instead of threads, the same as ``dask="local:N"``.
        dask: Dask cluster instead of threads: ``tcp://host:port``, or ``local:N`` processes. A script that starts processes
            needs the guard ``if __name__ == "__main__"``.
        reuse: path(s) of results whose common points are reused; needs ``out``. A smaller result at ``out`` always is.
        report: called with the :class:`Progress` after every chunk; by default a notebook shows a bar.

    Raises: :class:`InputError` with one line that names the field, the value and the allowed values, before anything is
    computed or written; :class:`Incomplete` if the run failed. Finished blocks stay. It says if the same call may resume.

    >>> import drivetrain_jax as dt
    >>> axes = {"k_sp": {"values": [4e8, 5e8]}}
    >>> dict(dt.run({"system": "planetary", "analysis": "modes", "axes": axes}).sizes)["k_sp"]
    2
    """
    executor = make_executor(threads, workers, dask)
    if out is None and reuse:
        raise InputError("reuse: given without out; expected a run into a file")
    # The handler of a caller, or of another thread, stays.
    ours = current_thread() is main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    shown = ProgressLine() if report is None and notebook() else nullcontext(report)
    with shown as show, stop_on_signals(*[signal.SIGINT] * ours) as check:

        def reported(progress: Progress) -> None:
            check()
            if show is not None:
                show(progress)

        if out is None:
            return _in_memory(resolve(load_scene(scene, overrides)), executor, reported)
        how: dict[str, Any] = {"fresh": fresh, "executor": executor, "reuse": reuse, "report": reported}
        try:
            run_to_file(scene, Path(out), overrides=overrides, store=HDF5, **how)
            check()
        except KeyboardInterrupt as stop:
            raise stop if isinstance(stop, Interrupted) else Interrupted(Progress(0)) from None
    return open_result(Path(out))


def run_to_file(
    scene: str | Path | Mapping[str, Any] | Scene,
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    fresh: bool = False,
    executor: Threads | None = None,
    reuse: str | Path | Sequence[str | Path] = (),
    store: str | None = None,
    report: Report | None = None,
) -> Progress:
    """Like :func:`run` with ``out``, but returns the counts instead of the result.

    ``store`` is ``hdf5`` or ``zarr``, of which each block is a shard; by default the name of ``out`` decides.
    """
    job = resolve(load_scene(scene, overrides))
    named = ZARR if out.suffix.lower() == ".zarr" else HDF5
    if named == ZARR and store == HDF5:
        allowed = f"expected a name such as {out.stem}.nc, or `drivetrain run --store zarr`"
        raise InputError(f"out = {str(out)!r}: names a Zarr store; {allowed}")
    output = Output(out, job, store or named)
    if output.store == ZARR and not job.route.is_pointwise:
        raise InputError("store = 'zarr': not available for an atlas; expected hdf5, or a scene with direct solves")
    if not fresh and output.state == "complete":
        output.discard()
        total, outcomes = output.counted()
        progress = Progress(total, reused=total)
        progress.count(outcomes)
        return progress
    if not fresh and output.state == "stale":
        raise output.error(output.reason)
    executor = executor or Threads()
    executor.check(job.problem.system)
    reused = output.reused_points([reuse] if isinstance(reuse, (str, Path)) else reuse, fresh)
    parts, progress, begins = output.parts, Progress.before(job), False
    try:
        parts.open()
        output.check_unchanged()
        begins = not output.resumes(reused, fresh)
        if begins:
            parts.start(output.plan(reused, fresh))
        work = Work(executor, report, output.blocks)
        if isinstance(work.store, ZarrBlocks):
            work.store.create()
            work.do(job, None, progress)
            work.store.finish(parts, wall_time_s=work.elapsed)
        else:
            job.route.into_file(job, output.out, parts.result, work, progress, reused)
        parts.close(remove=True)
    except KeyboardInterrupt:
        raise Interrupted(progress) from None
    except InputError:
        # Failures at the start, such as no scheduler at the address, must leave no files.
        parts.close(remove=not parts.holds_work() or (begins and progress.computed == 0))
        raise
    except (RetryableError, OSError, MemoryError) as error:
        raise Incomplete(f"{error or type(error).__name__}; the same command resumes", progress) from error
    except ChunkError as error:
        # No "the same command resumes": it would fail again.
        raise Incomplete(str(error), progress) from error
    finally:
        executor.close()
        parts.close()
    return progress


def _in_memory(job: Job, executor: Threads, report: Report | None) -> xr.Dataset:
    """The result of a job that the memory of this machine can hold."""
    needed = 0 if job.scene.analysis.continuous else job.total * job.scene.result_bytes
    if needed > (present := physical_memory()):
        limit = f"expected up to {present / 1e9:.0f} GB here"
        raise InputError(f"axes: {job.total} points need {needed / 1e9:.0f} GB of memory; {limit}")
    progress = Progress.before(job)
    try:
        work = Work(executor, report)
        result = job.route.in_memory(job, work, progress)
        return result.with_attrs(wall_time_s=work.elapsed).to_dataset()
    except ChunkError as error:
        raise Incomplete(str(error), progress) from error
    finally:
        executor.close()


# Seconds before a line appears, and between its updates.
_PATIENCE, _STEP = 0.5, 0.2


class ProgressLine:
    """Context with a report that shows a bar, points done, rate and time; a pipe gets the last state alone.

    A notebook shows no run of less than ``_PATIENCE``. Wrong input removes the line.
    """

    def __init__(self) -> None:
        self._begin, self._line, self._shown = time.monotonic(), StatusLine(), False
        self._due, self._last = self._begin + _PATIENCE, None

    def __enter__(self) -> Report:
        return self._report

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, InputError):
            self._line.write("")
        elif self._last and (self._shown or not notebook()):
            text = self._show(self._last)
            if not notebook():
                print("" if terminal() else text, file=sys.stderr)

    def _report(self, progress: Progress) -> None:
        self._last = progress
        if time.monotonic() >= self._due:
            self._show(progress)

    def _show(self, progress: Progress) -> str:
        now = time.monotonic()
        seconds, done = max(now - self._begin, 1e-9), progress.computed + progress.reused
        # The cost grows evenly in time; points are counted if it is unknown.
        part = progress.cost / progress.total_cost if progress.total_cost else done / max(progress.total, 1)
        left = f", {seconds / part - seconds:.0f} s left" if 0 < part < 1 else ""
        rate = f"{progress.computed / seconds:.3g}/s, {seconds:.0f} s{left}{progress.exceptions}"
        text = f"{done}/{progress.total} {progress.kind}, {rate}"
        self._line.write(text, part)
        self._due, self._shown = now + _STEP, True
        return text
