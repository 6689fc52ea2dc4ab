"""Labelled results, and the finished result: one netCDF4/HDF5 file that can be read without this package.

The writer uses h5py, because h5netcdf looks up every object for each of its properties: 54 ms for a small file instead of
20 ms of CPU time. https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html
"""

from __future__ import annotations

import io
import mmap
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import h5py
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.store import checksums
from drivetrain_jax.store.checksums import BROKEN, opened, unreadable
from drivetrain_jax.store.files import flush, move_into_place, naming

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"
# Long attributes, which would fill the display of a dataset, and the group of the file that holds them.
DETAILS, GROUP = frozenset({"numerics_detail"}), "provenance"


@dataclass(frozen=True)
class Entry:
    """One variable of a result. ``fill`` is the value for missing data."""

    dims: tuple[str, ...]
    values: np.ndarray
    attrs: Mapping[str, Any]
    fill: float | None = None


@dataclass(frozen=True)
class Labelled:
    """A result with its labels as plain data. Converting it to a Dataset needs xarray, writing a file does not.

    A Dataset lacks the attributes ``DETAILS``.
    """

    coords: Mapping[str, Entry]
    data: Mapping[str, Entry]
    attrs: Mapping[str, Any]

    @classmethod
    def build(
        cls,
        sweep_dims: Sequence[str],
        coordinates: Mapping[str, Entry],
        dimensions: Iterable[Dimension],
        results: Iterable[tuple[Variable, np.ndarray]],
        attrs: Mapping[str, str | float],
    ) -> Labelled:
        """The labelled ``results``.

        Every variable has the dimensions ``sweep_dims`` followed by its own. Coordinates are written for the sweep
        (``coordinates``) and for the ``dimensions`` that a result uses; each has ``units`` and ``long_name``. A dimension
        without values is numbered from 1.
        """
        results, coords = list(results), dict(coordinates)
        sizes = {d: n for v, values in results for d, n in zip(reversed(v.dims), reversed(values.shape), strict=False)}
        for d in dimensions:
            if d.name in sizes:
                about = {"units": d.units, "long_name": d.long_name}
                coords[d.name] = Entry((d.name,), np.asarray(d.labels(sizes[d.name])), about)
        data = {}
        for v, values in results:
            fill = np.nan if values.dtype.kind == "f" else None
            data[v.name] = Entry((*sweep_dims, *v.dims), values, _variable_attrs(v), fill)
        return cls(coords, data, attrs)

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the dimensions, those of the coordinates first. ``ValueError`` if two entries disagree."""
        sizes: dict[str, int] = {}
        for name, entry in {**self.coords, **self.data}.items():
            for dim, size in zip(entry.dims, entry.values.shape, strict=True):
                if sizes.setdefault(dim, size) != size:
                    raise ValueError(f"{name}: length {size} along {dim!r}, which has length {sizes[dim]}")
        return sizes

    def with_attrs(self, **attrs: Any) -> Labelled:
        """A copy with these attributes added or replaced."""
        return replace(self, attrs={**self.attrs, **attrs})

    def to_dataset(self) -> xr.Dataset:
        """The result as a Dataset."""
        import xarray as xr  # Local import: xarray and pandas take half a second

        data, coords = (
            {n: (e.dims, e.values, e.attrs) for n, e in entries.items()} for entries in (self.data, self.coords)
        )
        dataset = xr.Dataset(data, coords, {name: value for name, value in self.attrs.items() if name not in DETAILS})
        for name, entry in {**self.coords, **self.data}.items():
            dataset.variables[name].encoding["_FillValue"] = entry.fill
        return dataset


def _variable_attrs(variable: Variable) -> dict[str, Any]:
    """CF attributes; flag values have the type of the variable, as CF requires."""
    attrs: dict[str, Any] = {"units": variable.units, "long_name": variable.long_name}
    if ", " in variable.units:
        # CF allows one unit per variable.
        about = f"{variable.long_name} [{variable.units}]"
        attrs = {"units": "1", "long_name": about, "units_of_components": variable.units}
    if variable.flags:
        attrs["flag_values"] = np.arange(len(variable.flags), dtype=variable.dtype)
        attrs["flag_meanings"] = " ".join(flag.replace(" ", "_") for flag in variable.flags)
    if variable.lower is not None:
        attrs["valid_min"] = variable.lower
    return attrs


_MADE_BY = f"version=2,h5py={h5py.__version__},hdf5={h5py.version.hdf5_version}"
_NOT_A_VARIABLE = "This is a netCDF dimension but not a netCDF variable."
# The oldest format of HDF5 (1.10) whose metadata have checksums.
LIBVER = ("v110", "v110")
# Names of the complex types that netCDF readers know.
_COMPLEX = {"complex64": "_PFNC_FLOAT_COMPLEX_TYPE", "complex128": "_PFNC_DOUBLE_COMPLEX_TYPE"}


def _write(file: h5py.File, result: Labelled) -> dict[str, int]:
    """Write all of ``result`` but its data, for which space is reserved; returns the positions of the data.

    Empty variables get position 0. Scalars are written.
    """
    details = {name: value for name, value in result.attrs.items() if name in DETAILS}
    shown = {name: value for name, value in result.attrs.items() if name not in DETAILS}
    # Auxiliary coordinates, which a reader cannot find through the dimensions of a variable (CF, 5).
    sizes = result.sizes
    aside = {name: entry for name, entry in result.coords.items() if name not in sizes}
    listed = {"coordinates": " ".join(sorted(aside))} if aside else {}
    _set(file, {**shown, **listed, "_NCProperties": np.bytes_(_MADE_BY)})
    if details:
        _set(file.create_group(GROUP, track_order=True), details)
    for name, entry in result.coords.items():
        _create(file, name, entry, data=entry.values.astype(_type(entry.values), copy=False))
    scales = {dim: _make_scale(file, dim, number, size) for number, (dim, size) in enumerate(sizes.items())}
    for name, entry in aside.items():
        _link(cast(h5py.Dataset, file[name]), entry, scales)
    for kind in sorted({str(entry.values.dtype) for entry in result.data.values()} & _COMPLEX.keys()):
        file[_COMPLEX[kind]] = np.dtype(kind)
    places = {}
    for name, entry in result.data.items():
        # Contiguous, allocated early and never filled, so it can be memory-mapped.
        early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        variable = _create(file, name, entry, shape=entry.values.shape, dcpl=early, fill_time="never")
        _link(variable, entry, scales)
        if names := [n for n, c in aside.items() if {*c.dims} <= {*entry.dims}]:
            _set(variable, {"coordinates": " ".join(names)})
        if not entry.dims:
            variable[()] = entry.values  # HDF5 allocates a scalar when it is written.
        places[name] = variable.id.get_offset() or 0
    return places


def _create(file: h5py.File, name: str, entry: Entry, **options: Any) -> h5py.Dataset:
    """Create a variable with its attributes; ``options`` give its data or its shape."""
    options |= {"dtype": _type(entry.values), "fillvalue": entry.fill, **_growth(entry.values.shape)}
    variable = file.create_dataset(name, track_order=True, **options)
    if entry.fill is not None:
        _set(variable, {"_FillValue": entry.values.dtype.type(entry.fill)})
    _set(variable, entry.attrs)
    return variable


def _type(values: np.ndarray) -> np.dtype:
    """The type in the file; strings have variable length."""
    return h5py.string_dtype() if values.dtype.kind in "UO" else values.dtype


def _make_scale(file: h5py.File, dim: str, number: int, size: int) -> h5py.Dataset:
    """Make the coordinate ``dim`` a dimension, or create a dimension without coordinate."""
    if dim in file:
        scale, title = cast(h5py.Dataset, file[dim]), dim
        scale.attrs["_Netcdf4Coordinates"] = np.array([number], np.int32)
    else:
        scale = file.create_dataset(dim, (size,), ">f4", track_order=True, **_growth((size,)))
        title = f"{_NOT_A_VARIABLE}{size:10}"
    scale.attrs["_Netcdf4Dimid"] = np.int32(number)
    scale.make_scale(title)
    return scale


def _growth(shape: tuple[int, ...]) -> dict[str, tuple[int | None, ...]]:
    """The option ``maxshape`` of a variable: in netCDF a dimension of length 0 is unlimited."""
    return {} if all(shape) else {"maxshape": tuple(size or None for size in shape)}


def _link(variable: h5py.Dataset, entry: Entry, scales: Mapping[str, h5py.Dataset]) -> None:
    """Attach ``variable`` to its dimensions; ``scales`` are in the order of their numbers."""
    for axis, dim in enumerate(entry.dims):
        variable.dims[axis].attach_scale(scales[dim])
    if entry.dims:
        numbers = [list(scales).index(dim) for dim in entry.dims]
        variable.attrs["_Netcdf4Coordinates"] = np.array(numbers, np.int32)
        variable.attrs["_Netcdf4Dimid"] = np.int32(numbers[0])


def _set(owner: h5py.HLObject, attrs: Mapping[str, Any]) -> None:
    """Write attributes; netCDF stores a scalar number as an array of one."""
    for name, value in attrs.items():
        owner.attrs[name] = value if isinstance(value, str) else np.atleast_1d(value)


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
        # A finished file stays finished.
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def lay_out(self, template: Labelled) -> Mapping[str, np.ndarray]:
        """Reserve space for the data of ``template``, whose content is ignored (a broadcast zero takes no memory).

        Raises ``OSError`` if the disk lacks space, before anything is computed.
        """
        path, entries = self._temporary, [*template.coords.values(), *template.data.values()]
        with naming(path):
            # An empty file in memory. The image of an open one has a wrong checksum in HDF5 1.14.4.
            head = io.BytesIO()
            h5py.File(head, "w", track_order=True, libver=LIBVER).close()
            preface = self._preface.ljust(_USER_BLOCK, b"\0") if self._preface else b""
            # A pipe of this name would wait for a reader.
            path.unlink(missing_ok=True)
            path.write_bytes(preface + head.getvalue())
            # Space is reserved before anything is written, because HDF5 may crash the process on a full disk.
            labels = sum(len(str(value)) for value in template.attrs.values())
            _reserve(path, labels + sum(entry.values.nbytes + _LABELS for entry in entries))
            with h5py.File(path, "r+", libver=LIBVER) as file:
                places = _write(file, template)
                checksums.reserve(file)
            _reserve(path, path.stat().st_size)
            with open(path, "r+b") as file:
                mapped = mmap.mmap(file.fileno(), 0)
        data = {name: entry.values for name, entry in template.data.items()}
        return {n: np.ndarray(data[n].shape, data[n].dtype, mapped, at) for n, at in places.items()}

    def finish(self, path: Path, **attrs: str | float) -> None:
        """Change these attributes, add checksums, flush to disk, and move the file to ``path`` in one step."""
        with naming(self._temporary), ThreadPoolExecutor(1) as aside:
            # Start writing the mapped pages now; computing the checksums reads them meanwhile.
            written = aside.submit(flush, self._temporary)
            with h5py.File(self._temporary, "r+", libver=LIBVER) as file:
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


def attributes(path: Path) -> dict[str, Any]:
    """The global attributes of the result at ``path`` with its details as texts and numbers."""
    with opened(path) as file:
        # Older files have no group of details.
        details = file[GROUP].attrs.items() if GROUP in file else ()
        return {name: _plain(value) for name, value in (*details, *file.attrs.items())}


def damage(path: Path) -> str:
    """The damaged parts of the result at ``path`` by its checksums, in words; empty without damage."""
    changed = checksums.damaged(path)
    return "its checksums are gone" if changed is None else checksums.named(changed)


def map_variable(path: Path, name: str) -> np.ndarray:
    """One variable of the result at ``path``, as a memory map where its storage allows that."""
    with opened(path) as file:
        variable = file[name]
        if not isinstance(variable, h5py.Dataset):
            raise TypeError(f"{name} is a {type(variable).__name__.lower()}, not a variable")
        # The words of a file are references, which only HDF5 can follow.
        plain = variable.chunks is None and not variable.dtype.hasobject
        if plain and (offset := variable.id.get_offset()) is not None and variable.size:
            return np.memmap(path, variable.dtype, "r", offset, variable.shape)
        return variable[()]


def read_plain(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All variables and global attributes of the result at ``path`` as this package wrote them, without xarray."""
    with opened(path) as file:
        variables = {name: data for name, data in file.items() if isinstance(data, h5py.Dataset)}
        strings = {name for name, data in variables.items() if h5py.check_string_dtype(data.dtype)}
        arrays = {n: np.asarray((data.asstr() if n in strings else data)[()]) for n, data in variables.items()}
        return arrays, {name: _plain(value) for name, value in file.attrs.items()}


def _plain(value: Any) -> Any:
    """An attribute as text or number; netCDF stores a number as an array of one."""
    if isinstance(value, bytes):
        return value.decode()
    return value[0] if np.shape(value) == (1,) else value


def open_result(path: Path) -> xr.Dataset:
    """The result at ``path``, loaded into memory; ``InputError`` if it is missing or not readable."""
    import xarray as xr

    path = Path(os.path.expanduser(path))
    attributes(path)
    try:
        with xr.open_dataset(path, engine="h5netcdf", phony_dims="sort") as dataset:
            result = dataset.load()
    except (AttributeError, *BROKEN):
        raise unreadable(path) from None
    # Variables of a result share named dimensions.
    if "analysis" not in result.attrs or any(str(dim).startswith("phony_dim") for dim in result.dims):
        raise InputError(f"file = {str(path)!r}: not a result of drivetrain_jax; give one written by `drivetrain run`")
    return result
