"""Files that are either complete or absent."""

from __future__ import annotations

import errno
import math
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# First bytes of an atlas file, in a user block of HDF5, by which xarray finds the engine of this package. Readers of HDF5
# and netCDF skip the user block.
ATLAS_PREFACE = b"An atlas of drivetrain_jax, HDF5 from byte 512 on.\n"


# The error number inside a message of HDF5, which raises RuntimeError, KeyError or ValueError for a failed system call.
_ERRNO = re.compile(r"\berrno = (\d+)")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Raise an I/O error inside the context as ``OSError`` with its reason and ``path``, those inside HDF5 too."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
        number = _errno(error)
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error


def _errno(error: BaseException | None) -> int | None:
    """The number of the system call that failed in ``error``, or before it."""
    while error is not None:
        if found := _ERRNO.search(str(error)):
            return int(found.group(1))
        if isinstance(error, OSError) and error.errno:
            return error.errno
        error = error.__context__
    return None


def behind_link(path: Path) -> Path:
    """``path``, or the target of a link: renaming would replace the link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def read_regular(path: Path, most: float = math.inf) -> bytes:
    """The content of the regular file ``path``; ``OSError`` for a pipe, a device, or more than ``most`` bytes."""
    # Opening a pipe without this flag waits for a writer.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        if found.st_size > most:
            raise OSError(errno.EFBIG, f"larger than {most / 2**20:.0f} MB", str(path))
        return file.read()


def write_atomic(path: Path, data: bytes | memoryview, temporary: Path) -> None:
    """Write ``data`` to ``path``: to ``temporary`` (same file system), flushed to disk, then renamed.

    An existing file is replaced in one step or not at all.
    """
    # A pipe of this name would wait for a reader.
    temporary.unlink(missing_ok=True)
    try:
        with naming(temporary), open(temporary, "wb") as file:
            file.write(data)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    move_into_place(temporary, path)


def flush(path: Path) -> None:
    """Flush the whole file to disk, memory maps included."""
    with naming(path), open(path, "rb+") as file:
        os.fsync(file.fileno())


def move_into_place(temporary: Path, path: Path) -> None:
    """Flush the finished file ``temporary`` to disk and rename it to ``path``; delete it on failure."""
    try:
        flush(temporary)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def flush_tree(folder: Path) -> None:
    """Flush all files and folders below ``folder`` to disk, and ``folder`` itself."""
    for path, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(path, name))
        sync_folder(Path(path))


def move_folder(folder: Path, path: Path) -> None:
    """Rename the flushed ``folder`` to ``path``, which must not exist, and make the renaming durable."""
    folder.rename(path)
    for parent in {path.parent, folder.parent}:
        sync_folder(parent)


def sync_folder(folder: Path) -> None:
    """Make new names in ``folder`` durable; systems that cannot open a folder skip this."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)
