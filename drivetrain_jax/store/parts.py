"""Blocks of a sweep: their boxes, a file of each finished one, and the folder ``FILE.nc.parts/`` with plan and lock."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from drivetrain_jax._errors import InputError
from drivetrain_jax.store.files import behind_link, sync_folder, write_atomic

Arrays = Mapping[str, np.ndarray]


class PartsFolder:
    """The folder beside the result ``out``. Changing it needs an open folder (``open``, ``close``), reading does not.

    Each finished block is a file with the digest of its bytes in its name; damaged ones do not count. Workers receive the
    folder, which they must see under the same name.
    """

    def __init__(self, out: Path) -> None:
        # All links to a file share one folder, and so one lock.
        out = behind_link(out)
        self.out, self.path = out, out.parent / f"{out.name}.parts"
        # The name by which workers find the folder.
        self.place = os.path.abspath(self.path)
        # Path at which the result grows.
        self.result = self.path / "result.tmp"
        self._plan = self.path / "plan.json"
        self._lock: FileLock | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return PartsFolder, (Path(os.path.abspath(self.out)),)

    def numbers(self) -> list[int]:
        """Numbers of the blocks that have a file, damaged ones included."""
        return sorted({int(path.name[:8]) for path in self.path.glob("*-*.npz")})

    def write(self, number: int, results: Arrays) -> None:
        """Store the results of a block."""
        file = io.BytesIO()
        np.savez(file, **results)  # pyright: ignore[reportArgumentType]
        data = file.getbuffer()
        path = self.path / f"{number:08d}-{blake2b(data, digest_size=16).hexdigest()}.npz"
        write_atomic(path, data, path.with_suffix(f".{os.getpid()}.tmp"))

    def read(self, number: int) -> Arrays | None:
        """The results of a block; None if it is missing or damaged."""
        for path in self.path.glob(f"{number:08d}-*.npz"):
            # Content with the digest of its name may still be no archive, for which NumPy raises exceptions of many kinds.
            with suppress(Exception):
                data = path.read_bytes()
                if blake2b(data, digest_size=16).hexdigest() == path.stem.partition("-")[2]:
                    with np.load(io.BytesIO(data)) as file:
                        return dict(file)
        return None

    def plan(self) -> dict[str, Any]:
        """The plan of the blocks; empty without a readable plan.

        It has the ``digest``, ``replaces`` (the digest of the result that the blocks will replace), and more about the run.
        """
        try:
            content = json.loads(self._plan.read_bytes())
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def holds_work(self) -> bool:
        """True if there is work to resume or to report; a run killed at its start leaves none."""
        return bool(self.plan())

    def open(self) -> None:
        """Create and lock the folder, without a change of its content.

        Raises :class:`InputError` if another run has locked the folder, or if it cannot be created or locked.
        """
        file = self.path / "lock"
        while self._lock is None:
            try:
                self.path.mkdir(exist_ok=True)
                sync_folder(self.path.parent)
            except OSError as error:
                # A full disk may have space later.
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise
                raise self._error(f"{error.strerror}; expected a path in a writable folder") from None
            lock = FileLock(file, timeout=0)
            try:
                lock.acquire()
            except Timeout:
                raise self._error("another run is working on it; wait or stop it") from None
            except FileNotFoundError:
                continue
            except PermissionError:
                raise self._error("not writable; move it away") from None
            # Another run may have removed the folder between mkdir and lock.
            if os.path.exists(file):
                self._lock = lock
            else:
                lock.release()

    def _error(self, text: str) -> InputError:
        return InputError(f"out = {str(self.path)!r}: {text}")

    def start(self, plan: Mapping[str, Any]) -> None:
        """Delete all blocks and start those of ``plan``."""
        self._plan.unlink(missing_ok=True)
        for entry in self.path.iterdir():
            if entry.is_dir():
                shutil.rmtree(entry)
            elif entry.name != "lock":
                entry.unlink()
        write_atomic(self._plan, json.dumps(dict(plan)).encode(), self.path / "plan.tmp")

    def close(self, remove: bool = False) -> None:
        """Unlock the folder, or delete it with its content."""
        if self._lock is None:
            return
        if remove:
            shutil.rmtree(self.path, ignore_errors=True)
        self._lock.release()
        self._lock = None


Place = tuple[slice, ...]


@dataclass(frozen=True)
class Shards:
    """The shards of a sweep of this ``shape``, numbered in C order; the last shard along an axis may be shorter.

    A shard has ``lengths`` along the axes. Its points are consecutive in C order; a path axis is whole.
    """

    shape: tuple[int, ...]
    lengths: tuple[int, ...]

    @classmethod
    def of(cls, shape: tuple[int, ...], path: int | None, most: int) -> Shards:
        """Shards of up to ``most`` points, or of lines along axis number ``path``."""
        room, lengths = most, []
        for axis in reversed(range(len(shape))):
            size = shape[axis]
            lengths.insert(0, size if axis == path else min(size, room))
            room = room if axis == path else max(1, room // size)
        return cls(shape, tuple(lengths))

    @property
    def _counts(self) -> tuple[int, ...]:
        return tuple(-(-size // length) for size, length in zip(self.shape, self.lengths, strict=True))

    @property
    def count(self) -> int:
        """Number of shards."""
        return math.prod(self._counts)

    def place(self, shard: int) -> Place:
        """The box of the sweep that a shard covers."""
        at = np.unravel_index(shard, self._counts) if self.shape else ()
        starts = [int(i) * length for i, length in zip(at, self.lengths, strict=True)]
        return tuple(slice(a, min(a + n, size)) for a, n, size in zip(starts, self.lengths, self.shape, strict=True))

    def starts(self, path: int | None) -> np.ndarray:
        """Number of the first point of every shard, and of all points; with a ``path`` axis these are lines along it."""
        boxes = ([part.stop - part.start for part in self.place(shard)] for shard in range(self.count))
        return np.cumsum([0, *(math.prod(box) // (1 if path is None else box[path]) for box in boxes)])
