"""Open a result file for reading."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from drivetrain_jax._errors import InputError

# Exceptions of h5py for a damaged file structure.
BROKEN = (OSError, KeyError, ValueError, RuntimeError, TypeError, OverflowError, MemoryError)


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file at ``path``. Damage raises :class:`InputError`, found at the start or inside the context."""
    if not path.is_file():
        raise unreadable(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except BlockingIOError:
        message = f"file = {str(path)!r}: locked by another program; wait until that program closes it"
        raise InputError(message) from None
    except BROKEN as error:
        raise unreadable(path) from error


def unreadable(path: Path) -> InputError:
    """The error for a path that is not a readable file."""
    if path.suffix == ".parts":
        return InputError(f"file = {str(path)!r}: a folder of unfinished work; give {str(path.with_suffix(''))!r}")
    if (path / "zarr.json").is_file():
        return InputError(f"file = {str(path)!r}: a Zarr store; give the file that `drivetrain export` makes of it")
    what = (
        "not a readable netCDF4/HDF5 file" if path.is_file() else "is a folder" if path.is_dir() else "does not exist"
    )
    return InputError(f"file = {str(path)!r}: {what}; give a result written by `drivetrain run`")
