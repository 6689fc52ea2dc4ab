"""Files that are either complete or absent."""

from __future__ import annotations

import os
from pathlib import Path

# First bytes of the file of an atlas, in a user block of HDF5: xarray then finds the engine that evaluates it. Every reader
# of HDF5 and netCDF looks for the file behind it.
ATLAS_PREFACE = b"An atlas of drivetrain_jax, HDF5 from byte 512 on.\n"


def behind_link(path: Path) -> Path:
    """``path``, or the file that it links to: renaming over the link would replace that instead."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def write_atomic(path: Path, data: bytes | memoryview, temporary: Path) -> None:
    """Put ``data`` at ``path``: written to ``temporary`` (same file system), flushed to the disk, then renamed.

    An existing file is replaced at once or not at all, whatever happens meanwhile.
    """
    try:
        with open(temporary, "wb") as file:
            file.write(data)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    move_into_place(temporary, path)


def flush(path: Path) -> None:
    """Return when all of the file, what was written into maps of it included, is on the disk."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def move_into_place(temporary: Path, path: Path) -> None:
    """Flush the finished file ``temporary`` to the disk and rename it to ``path``; on failure it is deleted."""
    try:
        flush(temporary)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make the renaming durable; systems that cannot open a folder do without."""
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
