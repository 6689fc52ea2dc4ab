"""The state of the output path: nothing, unfinished work, the result, or something else; and unfinished work as a result."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import InputError, did_you_mean
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import BlockStore, ResultBuffer, ZarrBlocks, labelled, stored_blocks, with_pending
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.reuse import NO_REUSE, NotReusable, ReusableResult, ReusedPoints, combined, differences, find
from drivetrain_jax.runs.scene import load_scene, restore_scene
from drivetrain_jax.store import checksums, consolidate, zarr_store
from drivetrain_jax.store.checksums import opened
from drivetrain_jax.store.files import behind_link
from drivetrain_jax.store.parts import Arrays, PartsFolder

if TYPE_CHECKING:
    import xarray as xr

HDF5, ZARR = "hdf5", "zarr"
# Results that the remark about missed tolerances names, and the meaning of the code of a verdict that is none.
_BOUND, _VERDICT, _UNDECIDED = "spectral_radius_error", "verdict", "undecided"
# Endings of files of other kinds.
_FOREIGN = {".csv", ".html", ".json", ".mat", ".npy", ".npz", ".pdf", ".png", ".svg", ".toml", ".txt", ".xlsx", ".zip"}


class Output:
    """The result ``out`` and the folder of its parts, compared with the scene of ``job``.

    ``store`` is ``hdf5`` or ``zarr``; default: the form of what is present. ``present`` is the digest of the present result,
    None without one, empty if the metadata of a store are damaged. Raises :class:`InputError` if nothing can be written
    there, or if what is there is not a result of this package.
    """

    def __init__(self, out: Path, job: Job, store: str | None = None) -> None:
        self.out, self.job = behind_link(Path(os.path.expanduser(out))), job
        self.parts = PartsFolder(self.out)
        folder, parts, ending = self.out.parent, self.parts.path, self.out.suffix.lower()
        guess = did_you_mean(ending, (".zarr",)) if ending != ".zarr" else ""
        if guess or ending in _FOREIGN:
            raise self.error(f"a result is netCDF or Zarr; expected a name that ends in .nc or .zarr{guess}")
        try:
            if not folder.is_dir():
                raise self.error(f"the folder {str(folder)!r} does not exist; expected a file in an existing folder")
            if parts.exists() and not (parts.is_dir() and os.access(parts, os.R_OK | os.X_OK)):
                raise self.error(f"{str(parts)!r} is no readable folder; move it away")
        except OSError as error:
            raise self.error(f"{error.strerror} (with '.parts'); expected a shorter name") from None
        # The plan of unfinished work; empty without any.
        self.unfinished = self.parts.plan()
        is_store = zarr_store.is_store(self.out)
        self.store = store or (ZARR if is_store else self.unfinished.get("store", HDF5))
        self._files: Any = zarr_store if self.store == ZARR else consolidate
        # The store of unfinished work.
        growing = os.path.abspath(self.parts.path / zarr_store.UNFINISHED)
        self.blocks: BlockStore = ZarrBlocks(job, growing) if self.store == ZARR else self.parts
        if self.out.is_dir() and not (is_store and self.store == ZARR):
            raise self.error("is a folder; expected the path of a file")
        if self.out.exists() and not self.out.is_dir() and not (self.out.is_file() and self.store == HDF5):
            what = "is a file; expected a new path, or a Zarr store, for store = 'zarr'"
            raise self.error(what if self.store == ZARR else "not a regular file; expected the path of a file")
        self.present = self._digest()

    def error(self, text: str) -> InputError:
        """An error about the output."""
        return InputError(f"out = {str(self.out)!r}: {text}")

    def _digest(self) -> str | None:
        if not self.out.exists():
            return None
        allowed = "expected a new file or a result of drivetrain_jax"
        try:
            digest = self._files.attributes(self.out).get("digest")
        except InputError:
            if self.store == HDF5:
                raise self.error(f"not a readable netCDF4/HDF5 file; {allowed}") from None
            return ""
        if not isinstance(digest, str):
            raise self.error(f"not a result of drivetrain_jax; {allowed}")
        return digest

    def discard(self) -> None:
        """Delete the remains of the run that made the present result, if it was killed before it could delete them.

        Work of another scene, and work that will replace the present result, stay.
        """
        done = self.unfinished.get("digest") in (None, self.present)
        if self.parts.path.exists() and done and not self._replaces_present:
            # Readers can use the result even if the remains cannot be deleted.
            with suppress(InputError, OSError):
                self.parts.open()
                self.parts.close(remove=True)

    @cached_property
    def state(self) -> str:
        """``absent``, ``partial``, ``complete`` or ``stale`` (a result or parts of another scene or version)."""
        if self.present == self.job.digest:
            return "stale" if self._damage else "complete"
        if self.present is None and not self.unfinished:
            return "absent"
        return "partial" if (self._continues if self.unfinished else self._grows) else "stale"

    @property
    def _continues(self) -> bool:
        """True if the unfinished work is that of this scene, to replace what is present.

        A store is moved away before another one replaces it.
        """
        same = self.unfinished.get("digest") == self.job.digest and self.unfinished.get("store") == self.store
        return same and (self.present is None or self._replaces_present)

    @property
    def _replaced(self) -> dict[str, Any]:
        """The present result and the time at which it was written, by the clock of its file system."""
        file = self.out / "zarr.json" if self.out.is_dir() else self.out
        written = file.stat().st_mtime_ns if file.exists() else None
        return {"replaces": self.present, "replaces_written": written}

    @property
    def _replaces_present(self) -> bool:
        """True if the unfinished work began beside the result that is present, not one of the same scene before it."""
        return all(self.unfinished.get(key) == value for key, value in self._replaced.items())

    def plan(self, reused: ReusedPoints = NO_REUSE, fresh: bool = False) -> dict[str, Any]:
        """The digest of new parts, and the entries that a reader needs to interpret them."""
        return {
            **self.job.attrs,
            **self._replaced,
            "store": self.store,
            "fresh": fresh,
            "reuses": reused.digest,
            "reused_files": [os.path.relpath(source.path, self.out.parent) for source in reused.sources],
            # What explains later how stored work differs from a scene.
            "scene": self.job.scene.text,
            "drivetrain_jax_version": drivetrain_jax.__version__,
        }

    def resumes(self, reused: ReusedPoints, fresh: bool) -> bool:
        """True if a run resumes the present parts. A ``fresh`` run resumes only parts of a fresh run."""
        if not fresh:
            return bool(self.unfinished)
        return self._continues and bool(self.unfinished["fresh"]) and self.unfinished["reuses"] == reused.digest

    def check_unchanged(self) -> None:
        """Raise :class:`InputError` if another run has finished or started since this object was created."""
        if (self._digest(), self.parts.plan()) != (self.present, self.unfinished):
            raise self.error("another run has changed it; run the command again")

    @cached_property
    def _damage(self) -> str:
        """The damaged parts of the present result of this scene, or of one whose digest is damaged; empty without damage."""
        if self.present not in (self.job.digest, ""):
            return ""
        return self._files.damage(self.out)

    @cached_property
    def _found(self) -> ReusableResult | NotReusable | None:
        """The points of this scene in the present result, the reason why it has none, or None if none can be reused."""
        if self.present is None or self.store == ZARR or self.job.scene.analysis.continuous:
            return None
        try:
            return find(self.job, self.out)
        except NotReusable as error:
            return error

    @property
    def _grows(self) -> bool:
        """True if this scene contains all points of the present result, so replacing it loses nothing."""
        return isinstance(self._found, ReusableResult) and self._found.is_covered

    def reused_points(self, reuse: Sequence[str | Path], fresh: bool) -> ReusedPoints:
        """The points that a run reuses from the results ``reuse`` and, unless it is ``fresh``, from the present result.

        Raises :class:`InputError` if unfinished work uses other results, or if one of ``reuse`` has no common points.
        """
        if reuse and self.store == ZARR:
            raise InputError("reuse: given together with store = 'zarr'; expected one of them")
        if reuse and not self.job.route.is_pointwise:
            raise InputError("reuse: not available for an atlas; expected a scene with direct solves")
        if not self.job.route.is_pointwise:
            return NO_REUSE
        paths = [Path(path) for path in reuse]
        sources = [find(self.job, path) for path in paths]
        # Unfinished fresh work is resumed as fresh.
        if not (fresh or self.unfinished.get("fresh")):
            if isinstance(self._found, NotReusable) and self._found.damage:
                raise self.error(self.reason)
            sources += [self._found] if isinstance(self._found, ReusableResult) and self._found.is_covered else []
        reused = combined(self.job, sources)
        if not fresh and self.unfinished and self.unfinished.get("reuses") != reused.digest:
            files = ", ".join(self.unfinished.get("reused_files") or ["no other result"])
            raise InputError(
                f"reuse = {[str(p) for p in paths]}: the unfinished work at {str(self.out)!r} takes points from {files}; "
                "expected the same again, or --fresh"
            )
        return reused

    def finished(self) -> Iterator[tuple[np.ndarray, Arrays]]:
        """Yield points and results of unfinished work, reused ones included."""
        if self.unfinished:
            names = self.unfinished.get("reused_files") or ()
            reused = combined(self.job, [find(self.job, self.out.parent / name) for name in names])
        else:
            reused = self.reused_points((), fresh=False)
        for source in reused.sources:
            yield from source.blocks()
        for block, results in stored_blocks(self.blocks, self.job, reused.others(self.job.grid.size)):
            yield self.job.points(block), results

    @property
    def reason(self) -> str:
        """The reason why a run stops, and the remedy."""
        remedy = "--fresh replaces it (fresh=True in Python)"
        if isinstance(self._found, ReusableResult) and not self.unfinished:
            kept = (
                f"--reuse {self.out.name} with another --out takes {ReusedPoints((self._found,)).count} points from it"
            )
            remedy = f"{remedy}, {kept}"
        return f"holds {self.obstacle}; {remedy}"

    @property
    def obstacle(self) -> str:
        """The present file or folder that a run would replace, in words."""
        if what := self._damage or (self._found.damage if isinstance(self._found, NotReusable) else ""):
            return f"a damaged result ({what})"
        stored, what = self.unfinished, "unfinished work" if self.unfinished else "a result"
        if self.unfinished and self.present not in (None, stored.get("replaces")):
            return f"{what} that was started for another result"
        if self.unfinished and self.store != stored.get("store"):
            return f"{what} of --store {stored.get('store')}"
        reasons = differences(stored or self._files.attributes(self.out), self.job)
        more = f" and {len(reasons) - 2} more" if len(reasons) > 2 else ""
        return f"{what} of another scene or version: {'; '.join(reasons[:2]) or 'other sizes of chunks'}{more}"

    def counted(self) -> tuple[int, np.ndarray]:
        """Number of points of the complete result, and their outcomes; of an atlas its solves, which have no outcomes."""
        if self.job.scene.analysis.continuous:
            return int(self._files.attributes(self.out)["solves"]), np.empty(0, OUTCOME.dtype)
        return self.job.total, self._files.map_variable(self.out, OUTCOME.name)


@dataclass(frozen=True)
class Status:
    """Counts of the points at ``out``, and the state: absent, partial, complete or stale (another scene).

    ``failed_by_outcome`` counts the points without a value by outcome; ``remedy`` says what may help those that have not
    converged. ``inaccurate`` points have a value whose error exceeds the target. ``reason`` is the error message that a run
    would give, empty without one. An atlas counts its direct solves, whose ``total`` is 0 before its end (``kind``).
    """

    total: int
    done: int
    failed: int
    state: str
    failed_by_outcome: Mapping[str, int] = field(default_factory=dict)
    reason: str = ""
    remedy: str = ""
    inaccurate: int = 0
    kind: str = "points"

    def __str__(self) -> str:
        total = f" of {self.total}" if self.total else ""
        lines = [f"{self.state}: {self.done}{total} {self.kind} done, {self.failed} without a value"]
        hints = {"not_converged": f" ({self.remedy})" if self.remedy else ""}
        lines += [f"  {name}: {count}{hints.get(name, '')}" for name, count in self.failed_by_outcome.items()]
        lines += [f"  tolerance_not_met: {self.inaccurate}, with a value"] if self.inaccurate else []
        return "\n".join([*lines, *([f"  a run would stop: {self.reason}"] if self.reason else [])])

    def to_json(self) -> str:
        """The counts, the state and the reason as one JSON object."""
        counts = ("total", "done", "failed")
        content = {
            name: x for name, x in vars(self).items() if name in counts or (x and name not in ("remedy", "kind"))
        }
        return json.dumps(content)


def status(
    scene: str | Path | Mapping[str, Any], out: str | Path, overrides: Mapping[str, Any] | None = None
) -> Status:
    """The :class:`Status` of ``scene`` at ``out``. Changes nothing and compiles nothing."""
    job = resolve(load_scene(scene, overrides))
    output, atlas = Output(Path(out), job), job.scene.analysis.continuous
    total, kind = (0, "direct solves") if atlas else (job.total, "points")
    if output.state == "stale":
        return Status(total, 0, 0, "stale", reason=f"it {output.reason}", kind=kind)
    done, outcomes = None, []
    try:
        if output.state == "complete":
            done, codes = output.counted()
            outcomes.append(codes)
        elif output.state == "partial" and job.scene.analysis.continuous:
            stored = map(output.blocks.read, output.blocks.numbers())
            outcomes += [results[OUTCOME.name] for results in stored if results is not None]
        elif output.state == "partial" and job.route.is_pointwise:
            # A run through an atlas has no points before its end.
            outcomes += [results[OUTCOME.name] for _, results in output.finished()]
    except InputError as error:
        return Status(total, 0, 0, "stale", reason=str(error), kind=kind)
    done = sum(codes.size for codes in outcomes) if done is None else done
    counts = {o: sum(int(np.count_nonzero(codes == o)) for codes in outcomes) for o in Outcome}
    without = {o.name.lower(): count for o, count in counts.items() if count and not o.has_value}
    failed, inaccurate = sum(without.values()), counts[Outcome.TOLERANCE_NOT_MET]
    remedy = job.scene.analysis.remedy(job.scene.request)
    return Status(total or done, done, failed, output.state, without, "", remedy, inaccurate, kind)


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
    path = Path(os.path.expanduser(path))
    if path.exists() or not PartsFolder(path).holds_work():
        checksums.refuse_damaged(path)
        return consolidate.open_result(path)
    job = resolve(restore_scene(str(PartsFolder(path).plan().get("scene", ""))))
    output = Output(path, job)
    if output.state != "partial":
        raise InputError(f"file = {str(path)!r}: holds {output.obstacle}; run its scene again")
    if not job.route.is_pointwise:
        raise InputError(f"file = {str(path)!r}: an atlas that is not finished; wait for it or resume it")
    buffer, count = ResultBuffer(job.scene, job.grid), 0
    for points, results in output.finished():
        buffer.fill(points, results)
        count += results[OUTCOME.name].size
    result = labelled(job.scene, buffer.lay_out(), {"digest": job.digest, "points_done": count})
    title = f"{job.scene.title} (unfinished: {count} of {job.total} points)"
    return with_pending(result).with_attrs(title=title).to_dataset()


def missed(out: Path, count: int, total: int) -> str:
    """The remark about ``count`` of ``total`` values of the result at ``out``; a Zarr store gives only these numbers."""
    text = f"{count:,} of {total:,} values {'misses' if count == 1 else 'miss'} the tolerance"
    mark = f"{OUTCOME.name} = {int(Outcome.TOLERANCE_NOT_MET)} marks {'it' if count == 1 else 'them'}"
    if out.is_dir():
        return f"{text}; {mark}"
    with cast(Any, opened(out)) as file:
        rtol = json.loads(file.attrs.get("options", "{}")).get("rtol")
        text += f" {rtol:g}" if rtol else ""
        if OUTCOME.name not in file:
            # An atlas: its values are solves.
            return text
        outcome = file[OUTCOME.name]
        places = np.flatnonzero(outcome[()] == Outcome.TOLERANCE_NOT_MET)
        if _BOUND in file:
            bounds = file[_BOUND][()].reshape(-1)[places]
            place = np.unravel_index(places[np.argmax(bounds)], outcome.shape)
            axes = {dim[0].name.strip("/"): dim[0][i] for dim, i in zip(outcome.dims, place, strict=True)}
            at = ", ".join(f"{name} = {value:.6g}" for name, value in axes.items())
            text += f" (largest error bound {bounds.max():.1e}, at {at})"
        # Analyses have verdicts of their own, with other codes.
        meanings = file[_VERDICT].attrs.get("flag_meanings", "").split() if _VERDICT in file else []
        if _UNDECIDED in meanings:
            code = file[_VERDICT].attrs["flag_values"][meanings.index(_UNDECIDED)]
            undecided = int((file[_VERDICT][()].reshape(-1)[places] == code).sum())
            text += f"; {undecided:,} of them undecided" if undecided else "; the verdicts are decided"
        text += "; direct solves (method = 'direct') have closer bounds" if "atlas_solves" in file.attrs else ""
    return f"{text}; {mark}"
