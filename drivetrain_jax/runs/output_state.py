"""The state of the output path: nothing, unfinished work, the result, or something else."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import clipped
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.runs.explain import differences
from drivetrain_jax.runs.growing import NO_REUSE, Damaged, NotReusable, ReusableResult, ReusedPoints, combined, find
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.sink import Sink
from drivetrain_jax.runs.sinks import make_sink
from drivetrain_jax.store import gate
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.files import behind_link, move_folder

# Endings of files of other kinds, which a netCDF file would only confuse.
_OTHER_FILES = {
    ".csv",
    ".html",
    ".json",
    ".mat",
    ".npy",
    ".npz",
    ".pdf",
    ".png",
    ".svg",
    ".toml",
    ".txt",
    ".xlsx",
    ".zip",
}


class OutputState:
    """The result file ``out`` and the folder of its parts, compared with the scene of ``job``.

    ``state`` is ``absent``, ``partial``, ``complete`` or ``stale`` (a result or parts of another scene or version). Raises
    :class:`InputError` if nothing can be written there, or if a file there is not a result of this package.
    """

    def __init__(self, out: Path, job: Job, store: str | None = None) -> None:
        self.out = out = behind_link(out.expanduser())
        self.parts = PartsFolder(out)
        _check_name(out, self.parts)
        _check_parts(out, self.parts.path)
        _check_folder(out)
        self.sink = make_sink(out, self.parts, store)
        self.sink.check_place()
        self.job, self.digest = job, job.digest
        self.present = _digest_of(out, self.sink)
        self._plan_seen = self.parts.plan()

    def restore(self) -> None:
        """Restore a store whose replacement was killed.

        Raises :class:`InputError` if that run is still working.
        """
        if self.sink.held == self.out:
            return
        self.check_writable()
        self.parts.open()
        try:
            if self.sink.held != self.out:
                move_folder(self.sink.held, self.out)
        finally:
            self.parts.close()

    @cached_property
    def state(self) -> str:
        """``absent``, ``partial``, ``complete`` or ``stale``."""
        if self.present == self.digest:
            return "stale" if self._rearranged or self._damage else "complete"
        if self.parts.holds_work():
            # Parts that replace a result are only valid for the replacement of that result.
            return "partial" if _same(self.parts.plan(), self.plan(), ("digest", "replaces", "store")) else "stale"
        if self.present is None:
            return "absent"
        return "partial" if self._grows else "stale"

    def plan(self, reused: ReusedPoints = NO_REUSE, fresh: bool = False) -> dict[str, Any]:
        """The digest of new parts, and the entries that a reader needs to interpret them."""
        return {
            "digest": self.digest,
            "replaces": self.present,
            "replaces_written": self.sink.written,
            "store": self.sink.store,
            "fresh": fresh,
            "reuses": reused.digest,
            "reused": reused.count,
            "reused_files": [os.path.relpath(source.path, self.out.parent) for source in reused.sources],
            **provenance_of(self.job),
        }

    def resumes(self, reused: ReusedPoints, fresh: bool) -> bool:
        """True if a run resumes the present parts. A ``fresh`` run resumes only parts of a fresh run."""
        if not fresh:
            return self.parts.holds_work()
        # A run that was killed before it deleted its parts may leave parts that the result already contains.
        names = ("digest", "replaces", "replaces_written", "store", "reuses", "fresh")
        return _same(self.parts.plan(), self.plan(reused, fresh), names)

    def check_unchanged(self) -> None:
        """Raise :class:`InputError` if another run has finished or started since this object was created."""
        if (_digest_of(self.out, self.sink), self.parts.plan()) != (self.present, self._plan_seen):
            raise InputError(f"out = {str(self.out)!r}: another run has changed it; run the command again")

    def check_writable(self) -> None:
        """Raise :class:`InputError` if the folder of the result is not writable."""
        for folder in (self.out.parent, self.parts.path):
            if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
                raise InputError(
                    f"out = {str(self.out)!r}: the folder {str(folder)!r} is not writable; "
                    "allowed is a file in a writable folder"
                )

    @cached_property
    def _damage(self) -> str:
        """The damaged parts of the present result of this scene, or of one whose digest is damaged; empty without damage."""
        return self.sink.damage() if self.present in (self.digest, "") else ""

    @cached_property
    def _rearranged(self) -> list[str]:
        """Names of the variables of the present result whose layout differs from this scene."""
        return self.sink.rearranged(self.job)

    @cached_property
    def _found(self) -> ReusableResult | NotReusable | None:
        """The points of this scene that the present result contains, or the reason why it has none."""
        return None if self.present is None else self.sink.common_points(self.job)

    @property
    def _shared(self) -> ReusableResult | None:
        return self._found if isinstance(self._found, ReusableResult) else None

    @property
    def _grows(self) -> bool:
        """True if this scene contains all points of the present result, so replacing it loses nothing."""
        return self._shared is not None and self._shared.is_covered

    @property
    def remedy(self) -> str:
        """The remedy for the :attr:`obstacle`."""
        replaces = "--fresh replaces it (fresh=True in Python)"
        if self._shared is None or self.parts.holds_work():
            return replaces
        kept = f"--reuse {self.out.name} with another --out takes {ReusedPoints((self._shared,)).count} points from it"
        return f"{replaces}, {kept}"

    def reused_points(self, reuse: Sequence[str | Path], fresh: bool) -> ReusedPoints:
        """The points that a run reuses from the results ``reuse`` and, unless it is ``fresh``, from the present result.

        Raises :class:`InputError` if unfinished work uses other results, or if one of ``reuse`` has no common points.
        """
        if reuse:
            self.sink.check_reuse()
        if not self.job.route.is_pointwise:
            if reuse:
                raise InputError("reuse: not available for an atlas; allowed for a scene with direct solves")
            return NO_REUSE
        paths = [Path(path) for path in reuse]
        found = [find(self.job, path) for path in paths]
        # Unfinished fresh work is resumed as fresh.
        if not (fresh or self.parts.plan().get("fresh")):
            if isinstance(self._found, Damaged):
                raise self.refusal
            found += [self._shared] if self._shared is not None and self._grows else []
        reused = combined(self.job, found)
        if not fresh and self.parts.holds_work() and self.parts.plan().get("reuses") != reused.digest:
            files = ", ".join(self.parts.plan().get("reused_files") or ["no other result"])
            raise InputError(
                f"reuse = {[str(p) for p in paths]}: the unfinished work at {str(self.out)!r} takes points from {files}; "
                "allowed is the same again, or --fresh"
            )
        return reused

    def reused_before(self) -> ReusedPoints:
        """The points that unfinished work reuses from other results, or that a run would reuse."""
        if not self.parts.holds_work():
            return self.reused_points((), fresh=False)
        names = self.parts.plan().get("reused_files") or ()
        return combined(self.job, [find(self.job, self.out.parent / name) for name in names])

    @property
    def refusal(self) -> InputError:
        """The message of a run that may not replace the present result."""
        return InputError(f"out = {str(self.out)!r}: holds {self.obstacle}; {self.remedy}")

    @property
    def obstacle(self) -> str:
        """The reason why a run stops or would stop; empty without one."""
        if self.present == self.digest and self._rearranged:
            return f"a result that was changed in order or shape after it was written ({', '.join(self._rearranged)})"
        what = self._damage or (self._found.what if isinstance(self._found, Damaged) else "")
        if what:
            return f"a damaged result ({what})"
        if self.parts.holds_work():
            stored, what = self.parts.plan(), "unfinished work"
            if self.present != stored.get("replaces"):
                return f"{what} that was started for another result"
            if self.sink.store != stored.get("store"):
                return f"{what} of --store {stored.get('store')}"
        else:
            stored, what = {name: self.sink.attribute(name) for name in provenance_of(self.job)}, "a result"
        reasons = differences(stored, self.job) if stored else ["the difference is unknown"]
        more = f" and {len(reasons) - 2} more" if len(reasons) > 2 else ""
        return f"{what} of another scene or version: {'; '.join(reasons[:2]) or 'other sizes of chunks'}{more}"

    @property
    def outcomes(self) -> np.ndarray:
        """Outcomes of the points of the complete result. An atlas has no points."""
        return np.empty(0, OUTCOME.dtype) if self._solves is not None else self.sink.outcomes()

    def points(self, total: int) -> int:
        """Number of points of the complete result, or of solves of an atlas."""
        return total if self._solves is None else self._solves

    @property
    def _solves(self) -> int | None:
        value = self.sink.attribute("solves")
        with gate.reading(self.sink.held):
            return None if value is None else int(np.squeeze(value))


def provenance_of(job: Job) -> dict[str, str]:
    """Attributes that explain later how stored work differs from a scene."""
    return {
        "scene": job.scene.text,
        "drivetrain_jax_version": drivetrain_jax.__version__,
        **job.numerics_attrs,
    }


def _same(one: Mapping[str, Any], other: Mapping[str, Any], names: Iterable[str]) -> bool:
    return all(one.get(name) == other.get(name) for name in names)


def _check_name(out: Path, parts: PartsFolder) -> None:
    """Check the ending and the length of the name; the folder of the parts has the longest."""
    if out.suffix.lower() in _OTHER_FILES:
        raise InputError(f"out = {clipped(str(out))!r}: a result is a netCDF file; allowed is a name that ends in .nc")
    try:
        parts.path.exists()
    except OSError as error:
        raise InputError(
            f"out = {clipped(str(out))!r}: {error.strerror} (with '.parts'); allowed is a shorter name"
        ) from None


def _check_parts(out: Path, folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"out = {str(out)!r}: {str(folder)!r} is a file; allowed is to move it away")
    if folder.exists() and not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"out = {str(out)!r}: the folder {str(folder)!r} is not readable; allowed is one that is")


def _check_folder(out: Path) -> None:
    folder = out.parent
    if not folder.is_dir():
        raise InputError(
            f"out = {str(out)!r}: the folder {str(folder)!r} does not exist; allowed is a file in an existing folder"
        )


def _digest_of(out: Path, sink: Sink) -> str | None:
    """Digest of the result of ``out``; None without one."""
    if not sink.held.exists():
        return None
    digest = sink.digest()
    if not isinstance(digest, str):
        raise InputError(
            f"out = {str(out)!r}: not a result of drivetrain_jax; allowed is a new file or a result of drivetrain_jax"
        )
    return digest
