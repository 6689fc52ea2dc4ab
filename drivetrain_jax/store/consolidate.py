"""The finished result: one netCDF4/HDF5 file, written whole, read without anything of this package."""

from __future__ import annotations

from pathlib import Path

import h5py
import xarray as xr

from drivetrain_jax._errors import InputError
from drivetrain_jax.store.files import write_atomic


def write_result(dataset: xr.Dataset, path: Path, temporary: Path) -> None:
    """Write ``dataset`` to ``path`` in one step; ``temporary`` is where it grows. A full disk leaves ``path`` alone.

    The file is made in memory first: HDF5 may crash the process when a disk fills up under it.
    """
    write_atomic(path, dataset.to_netcdf(None, engine="h5netcdf"), temporary)


def read_attribute(path: Path, name: str) -> str | None:
    """A global attribute of the result at ``path``, None if it lacks it; ``InputError`` if the file is not readable."""
    try:
        with h5py.File(path, "r") as file:
            value = file.attrs.get(name)
    except OSError:
        raise _unreadable(path) from None
    return value.decode() if isinstance(value, bytes) else value


def open_result(path: Path) -> xr.Dataset:
    """The result at ``path``, loaded; ``InputError`` if there is none or it cannot be read."""
    if not path.exists():
        raise InputError(f"file = {str(path)!r}: does not exist; give a result written by `drivetrain run`")
    read_attribute(path, "digest")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as dataset:
            return dataset.load()
    except (OSError, ValueError, KeyError):
        raise _unreadable(path) from None


def _unreadable(path: Path) -> InputError:
    return InputError(
        f"file = {str(path)!r}: not a readable netCDF4/HDF5 file; give a result written by `drivetrain run`"
    )
