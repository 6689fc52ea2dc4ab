"""Unfinished work: the folder ``FILE.nc.parts/`` with files of finished chunks; incomplete files are ignored.

A part is one HDF5 image, made in memory and written at once. Its name contains the digest of its content. A damaged part is
detected on reading, and its chunks are computed again.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import get_ident
from typing import Any, cast

import h5py
import numpy as np
from filelock import FileLock, Timeout

from drivetrain_jax._errors import InputError
from drivetrain_jax.store.files import behind_link, read_regular, sync_folder, write_atomic

Arrays = Mapping[str, np.ndarray]


class Part:
    """Finished chunks: their numbers, point counts, results (points first), computing time in s, and optional ``points``.

    A part that has been read has the ``name`` of its file.
    """

    def __init__(
        self,
        chunks: Sequence[int],
        sizes: Sequence[int],
        results: Arrays,
        seconds: float,
        points: np.ndarray | None = None,
    ) -> None:
        self.chunks = np.asarray(chunks, np.int64)
        self.sizes = np.asarray(sizes, np.int64)
        self.results = results
        self.seconds = seconds
        self.points = points
        self.name = ""

    @property
    def nbytes(self) -> int:
        """Bytes of the results."""
        return sum(values.nbytes for values in self.results.values())

    def __iter__(self) -> Iterator[tuple[int, Arrays]]:
        """Yield number and results of each chunk."""
        stops = np.cumsum(self.sizes)
        for chunk, start, stop in zip(self.chunks, stops - self.sizes, stops, strict=True):
            yield int(chunk), {name: values[start:stop] for name, values in self.results.items()}

    def to_bytes(self) -> bytes:
        """The HDF5 image."""
        # A name per thread: HDF5 keeps one open file per name, and threads write at the same time.
        with h5py.File(f"part {get_ident()}", "w", driver="core", backing_store=False) as file:
            file["chunks"], file["sizes"] = self.chunks, self.sizes
            file.attrs["seconds"] = self.seconds
            if self.points is not None:
                file["points"] = self.points
            group = file.create_group("results")
            for name, values in self.results.items():
                group[name] = values
            file.flush()
            return file.id.get_file_image()

    @classmethod
    def from_bytes(cls, data: bytes) -> Part:
        """The part in an HDF5 image."""
        with cast(Any, h5py.File(io.BytesIO(data), "r")) as file:
            results = {name: values[()] for name, values in file["results"].items()}
            points = file["points"][()] if "points" in file else None
            return cls(file["chunks"][()], file["sizes"][()], results, float(file.attrs["seconds"]), points)


class PartsFolder:
    """The parts of the result ``out``. Writing needs an open folder (``open``, ``close``), reading does not."""

    def __init__(self, out: Path) -> None:
        # All links to a file share one folder, and so one lock.
        out = behind_link(out)
        self.out, self.path = out, out.parent / f"{out.name}.parts"
        # Path at which the result grows.
        self.result = self.path / "result.tmp"
        self._plan = self.path / "plan.json"
        self._lock: FileLock | None = None

    def plan(self) -> dict[str, Any]:
        """The plan of the parts; empty without a readable plan.

        It has the ``digest``, ``replaces`` (the digest of the result that the parts will replace), and more about the run.
        """
        try:
            content = json.loads(read_regular(self._plan))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def open(self) -> None:
        """Create and lock the folder, without a change of its content.

        Raises :class:`InputError` if another run has locked the folder, or if it cannot be created or locked.
        """
        file = self.path / "lock"
        while True:
            self._make()
            if os.path.lexists(file) and (file.is_symlink() or not file.is_file()):
                raise InputError(f"out = {str(file)!r}: allowed is a regular file; remove it")
            lock = FileLock(file, timeout=0)
            try:
                lock.acquire()
            except Timeout:
                raise InputError(f"out = {str(self.path)!r}: another run is working on it; wait or stop it") from None
            except FileNotFoundError:
                continue
            # Another run may have removed the folder between mkdir and lock.
            if os.path.exists(file):
                self._lock = lock
                return
            lock.release()

    def _make(self) -> None:
        try:
            self.path.mkdir(exist_ok=True)
            sync_folder(self.path.parent)
        except OSError as error:
            # A full disk may have space later.
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise
            text = f"out = {str(self.path)!r}: {error.strerror}; allowed is a path in a writable folder"
            raise InputError(text) from None

    def start(self, plan: Mapping[str, Any]) -> None:
        """Delete all parts and start those of ``plan``."""
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

    def holds_work(self) -> bool:
        """True if there is work to resume or to report; a run killed at its start leaves none.

        Raises :class:`InputError` if the folder is not readable.
        """
        try:
            return self._plan.exists() or any(self.path.glob("*.h5"))
        except PermissionError:
            text = f"out = {str(self.path)!r}: the folder is not readable; allowed is one that is"
            raise InputError(text) from None

    def discard(self, digest: str, written: int | None = None) -> None:
        """Delete the remains of the run that made ``digest``, if it was killed before it could delete them.

        Work of another scene, and work that will replace the result ``written`` at this time, stay.
        """
        plan = self.plan()
        replaces = (plan.get("replaces"), plan.get("replaces_written")) == (digest, written)
        if self.path.exists() and plan.get("digest") in (None, digest) and not replaces:
            # Readers can use the result even if the remains cannot be deleted.
            with suppress(InputError, OSError):
                self.open()
                self.close(remove=True)

    def write(self, part: Part) -> str:
        """Write finished chunks; returns the name of the file."""
        data = part.to_bytes()
        path = self.path / f"{int(part.chunks[0]):08d}-{_content_digest(data)}.h5"
        write_atomic(path, data, path.with_suffix(".tmp"))
        return path.name

    def read_one(self, name: str) -> Part | None:
        """The part of this name; None if it is damaged or gone."""
        return _read_intact(self.path / name)

    def count(self) -> int:
        """Number of parts, damaged ones included."""
        return sum(1 for _ in self.path.glob("*-*.h5"))

    def read(self, repair: bool = False) -> Iterator[Part]:
        """All intact parts. ``repair`` deletes damaged and incomplete ones (only while the folder is open)."""
        if repair:
            for path in set(self.path.glob("*.tmp")) - {self.result}:
                path.unlink(missing_ok=True)
        for path in sorted(self.path.glob("*-*.h5")):
            part = _read_intact(path)
            if part is not None:
                yield part
            elif repair:
                path.unlink(missing_ok=True)


def _read_intact(path: Path) -> Part | None:
    try:
        data = read_regular(path)
    except OSError:
        return None
    if _content_digest(data) != path.stem.partition("-")[2]:
        return None
    part = Part.from_bytes(data)
    part.name = path.name
    return part


def _content_digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
