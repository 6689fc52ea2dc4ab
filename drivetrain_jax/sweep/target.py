"""What lies at the path of a result: nothing, unfinished work, the result itself, or something else."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME
from drivetrain_jax.store.chunks import PartsFolder
from drivetrain_jax.store.consolidate import read_attribute, read_variable
from drivetrain_jax.sweep.assemble import failures


class Target:
    """The result file ``out`` and the folder of its parts, seen by a scene with this ``digest``.

    ``state`` is ``absent``, ``partial``, ``complete`` or ``stale`` (a result or parts of another scene or version).
    Raises :class:`InputError` if nothing can be written there, or if a file there is not a result of this package.
    """

    def __init__(self, out: Path, digest: str) -> None:
        _check_place(out)
        self.out = out
        self.parts = PartsFolder(out)
        if self.parts.path.exists() and not self.parts.path.is_dir():
            raise InputError(
                f"out = {str(out)!r}: {str(self.parts.path)!r} is in the way; allowed is to move that file away"
            )
        self.digest = digest
        self.present = _digest_of(out)

    @cached_property
    def state(self) -> str:
        """See the class."""
        if self.present == self.digest:
            return "complete"
        if self.parts.holds_work():
            # Parts that are to replace another result belong to that one alone.
            return "partial" if self.parts.plan() == self.plan else "stale"
        return "absent" if self.present is None else "stale"

    @property
    def plan(self) -> dict[str, str | None]:
        """What parts written now belong to."""
        return {"digest": self.digest, "replaces": self.present}

    @property
    def obstacle(self) -> str:
        """What makes it stale."""
        return "a result" if self.present is not None else "unfinished work"

    @property
    def failed(self) -> int:
        """Number of points without a value in the complete result."""
        return failures(read_variable(self.out, OUTCOME.name))


def _check_place(out: Path) -> None:
    folder = out.parent
    if not folder.is_dir():
        raise InputError(
            f"out = {str(out)!r}: the folder {str(folder)!r} does not exist; allowed is a file in an existing folder"
        )
    if out.is_dir():
        raise InputError(f"out = {str(out)!r}: is a folder; allowed is the path of a file")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(
            f"out = {str(out)!r}: the folder {str(folder)!r} is not writable; allowed is a file in a writable folder"
        )


def _digest_of(out: Path) -> str | None:
    """Digest of the result at ``out``, None if there is no file."""
    if not out.exists():
        return None
    digest = read_attribute(out, "digest")
    if not isinstance(digest, str):
        raise InputError(f"out = {str(out)!r}: not a result of drivetrain_jax; allowed is a new file or such a result")
    return digest
