"""Files that are either complete or absent."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# First bytes of an atlas file, in a user block of HDF5, by which xarray finds the engine of this package. Readers of HDF5
# and netCDF skip the user block.
ATLAS_PREFACE = b"An atlas of drivetrain_jax, HDF5 from byte 512 on.\n"


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Raise an I/O error inside the context as ``OSError`` with ``path``, those of HDF5, which have other types, too."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        if isinstance(error, OSError) and error.errno:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise OSError(f"{path}: {error}") from error


def behind_link(path: Path) -> Path:
    """``path``, or the target of a link: renaming would replace the link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


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
