"""The finished result: one netCDF4/HDF5 file that can be read without this package."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.store import checksums, netcdf
from drivetrain_jax.store.files import flush, move_into_place, naming
from drivetrain_jax.store.netcdf import BROKEN, GROUP, Labelled, opened, unreadable

if TYPE_CHECKING:
    import xarray as xr

# Upper limit of the bytes of a variable's attributes.
_LABELS = 1 << 16
# Bytes of the user block in front of HDF5 that holds a preface: the smallest size that HDF5 allows.
_USER_BLOCK = 512


class ResultFile:
    """A result that grows on disk next to its final path, so memory does not grow with it.

    ``lay_out`` returns its data variables as arrays mapped from the file ``temporary``, to be filled in any order.
    ``finish`` moves the file into place; leaving the context without it deletes the file. A ``preface`` precedes HDF5.
    """

    def __init__(self, temporary: Path, preface: bytes = b"") -> None:
        self._temporary, self._preface = temporary, preface

    def __enter__(self) -> ResultFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._temporary.unlink(missing_ok=True)

    def lay_out(self, template: Labelled) -> Mapping[str, np.ndarray]:
        """Reserve space for the data of ``template``, whose content is ignored (a broadcast zero takes no memory).

        Raises ``OSError`` if the disk lacks space, before anything is computed.
        """
        with naming(self._temporary):
            places = _write_frame(template, self._temporary, self._preface)
            with open(self._temporary, "r+b") as file:
                mapped = mmap.mmap(file.fileno(), 0)
        data = {name: entry.values for name, entry in template.data.items()}
        return {n: np.ndarray(data[n].shape, data[n].dtype, mapped, at) for n, at in places.items()}

    def finish(self, path: Path, **attrs: str | float) -> None:
        """Change these attributes, add checksums, flush to disk, and move the file to ``path`` in one step."""
        with naming(self._temporary), ThreadPoolExecutor(1) as aside:
            # Start writing the mapped pages now; computing the checksums reads them meanwhile.
            written = aside.submit(flush, self._temporary)
            with h5py.File(self._temporary, "r+", libver=netcdf.LIBVER) as file:
                for name, value in attrs.items():
                    file.attrs.modify(name, value)
                checksums.seal(file)
            written.result()
        move_into_place(self._temporary, path)


def write_result(result: Labelled, path: Path, temporary: Path, preface: bytes = b"") -> None:
    """Write ``result`` to ``temporary``, and move it to ``path`` in one step. A full disk leaves ``path`` unchanged."""
    with ResultFile(temporary, preface) as file:
        for name, array in file.lay_out(result).items():
            array[...] = result.data[name].values
        file.finish(path)


def _write_frame(template: Labelled, path: Path, preface: bytes) -> Mapping[str, int]:
    """Write everything except the data, whose contiguous space stays blank; returns the positions of the data.

    The head is built in memory with reserved space for later additions, because HDF5 may crash the process on a full disk.
    """
    head = (preface.ljust(_USER_BLOCK, b"\0") if preface else b"") + netcdf.head(template)
    # A pipe of this name would wait for a reader.
    path.unlink(missing_ok=True)
    path.write_bytes(head)
    _reserve(path, len(head) + sum(entry.values.nbytes + _LABELS for entry in template.data.values()))
    with h5py.File(path, "r+", libver=netcdf.LIBVER) as file:
        places = netcdf.add_data(file, template)
        checksums.reserve(file)
    _reserve(path, path.stat().st_size)
    return places


def _reserve(path: Path, size: int) -> None:
    """Reserve ``size`` bytes on disk; systems without this call report a full disk during writing."""
    if not hasattr(os, "posix_fallocate"):
        return
    handle = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(handle, 0, size)
    finally:
        os.close(handle)


def release(arrays: Iterable[np.ndarray]) -> None:
    """Release the pages of the memory map of ``arrays``, if any; written values stay in the file."""
    for mapped in {array.base for array in arrays if isinstance(array.base, mmap.mmap)}:  # pyright: ignore[reportUnhashable]
        if hasattr(mmap, "MADV_DONTNEED"):
            mapped.madvise(mmap.MADV_DONTNEED)


def read_attributes(path: Path) -> dict[str, Any]:
    """The global attributes of the result at ``path`` with its details as texts and numbers.

    Raises :class:`InputError` if the file is not readable.
    """
    with opened(path) as file:
        # Older files have no group of details.
        details = file[GROUP].attrs.items() if GROUP in file else ()
        return {name: _plain(value) for name, value in (*details, *file.attrs.items())}


def read_attribute(path: Path, name: str) -> Any:
    """One of :func:`read_attributes`, None if it is missing, without reading the others."""
    with opened(path) as file:
        holds = file[GROUP] if name not in file.attrs and GROUP in file else file
        return _plain(holds.attrs.get(name))


def layout(path: Path) -> dict[str, tuple[np.dtype, tuple[int, ...]]]:
    """Types and shapes of all variables of the result at ``path``."""
    with opened(path) as file:
        return {name: (each.dtype, each.shape) for name, each in file.items() if isinstance(each, h5py.Dataset)}


def read_variable(path: Path, name: str) -> np.ndarray:
    """One variable of the result at ``path``, without loading the others; ``InputError`` if it cannot be read."""
    with opened(path) as file:
        return _variable(file, name)[()]


def _variable(file: h5py.File, name: str) -> h5py.Dataset:
    variable = file[name]
    if not isinstance(variable, h5py.Dataset):
        raise TypeError(f"{name} is a {type(variable).__name__.lower()}, not a variable")
    return variable


def map_variable(path: Path, name: str) -> np.ndarray:
    """Like :func:`read_variable`, but as a memory map where the storage of the variable allows that."""
    with opened(path) as file:
        variable = _variable(file, name)
        # The words of a file are references, which only HDF5 can follow.
        plain = variable.chunks is None and not variable.dtype.hasobject
        if plain and (offset := variable.id.get_offset()) is not None and variable.size:
            return np.memmap(path, variable.dtype, "r", offset, variable.shape)
    return read_variable(path, name)


def read_plain(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All variables and global attributes of the result at ``path`` as this package wrote them, without xarray.

    Raises :class:`InputError` if the file is not readable.
    """
    with opened(path) as file:
        variables = {name: each for name, each in file.items() if isinstance(each, h5py.Dataset)}
        strings = {name for name, each in variables.items() if h5py.check_string_dtype(each.dtype)}
        arrays = {n: np.asarray((each.asstr() if n in strings else each)[()]) for n, each in variables.items()}
        return arrays, {name: _plain(value) for name, value in file.attrs.items()}


def _plain(value: Any) -> Any:
    """An attribute as text or number; netCDF stores a number as an array of one."""
    if isinstance(value, bytes):
        return value.decode()
    return value[0] if np.shape(value) == (1,) else value


def open_result(path: Path) -> xr.Dataset:
    """The result at ``path``, loaded into memory; ``InputError`` if it is missing or not readable."""
    import xarray as xr

    path = path.expanduser()
    if not path.exists():
        raise InputError(f"file = {str(path)!r}: does not exist; give a result written by `drivetrain run`")
    read_attribute(path, "digest")
    try:
        with xr.open_dataset(path, engine="h5netcdf", phony_dims="sort") as dataset:
            result = dataset.load()
    except (AttributeError, *BROKEN):
        raise unreadable(path) from None
    # Variables of a result share named dimensions.
    if "analysis" not in result.attrs or any(str(dim).startswith("phony_dim") for dim in result.dims):
        raise InputError(f"file = {str(path)!r}: not a result of drivetrain_jax; give one written by `drivetrain run`")
    return result
