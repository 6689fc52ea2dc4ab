"""Open HDF5 files, and compare checksums of a finished result: of each variable, and of the attributes of the file.

The checksums are computed once, when the file is complete. HDF5's own filter (fletcher32) needs chunked storage, which
cannot be memory-mapped, and does not cover attributes and labels.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._machine import usable_cores

ATTRIBUTE = "checksums"
# The name of the root group stands for the attributes of the file.
FILE = "/"
_BLOCK = 1 << 24
# Bytes above which threads save time: only hashing runs in parallel.
_LARGE = 1 << 22
# Attributes by which the netCDF library links dimensions and variables; the links are checked by name.
_LINKS = frozenset({"DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates"})


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


def reserve(file: h5py.File) -> None:
    """Reserve space for the checksums of everything in ``file``, so filling them in needs no disk space."""
    blank = json.dumps(dict.fromkeys([FILE, *_groups(file), *_variables(file)], "0" * 32))
    file.attrs.create(ATTRIBUTE, np.bytes_(blank))


def seal(file: h5py.File) -> None:
    """Write the checksums of the complete ``file``."""
    file.attrs.modify(ATTRIBUTE, np.bytes_(json.dumps(checksums(file))))


def checksums(file: h5py.File) -> dict[str, str]:
    """Checksums by name (blake2b, 128 bits) of each variable, and of the attributes of ``file`` and of its groups.

    The checksum of a variable includes its type, dimensions and attributes.
    """
    variables = _variables(file)
    if sum(variable.nbytes for variable in variables.values()) < _LARGE:
        digests = [_of_variable(variable) for variable in variables.values()]
    else:
        # Hashing releases the interpreter's lock.
        with ThreadPoolExecutor(min(usable_cores(), len(variables)), thread_name_prefix="hash") as pool:
            digests = list(pool.map(_of_variable, variables.values()))
    owners = {FILE: file, **_groups(file)}
    attributes = {name: _of_attributes(owner, {ATTRIBUTE}).hexdigest() for name, owner in owners.items()}
    return attributes | dict(zip(variables, digests, strict=True))


def damaged(path: Path) -> list[str] | None:
    """Names of the damaged variables (``/``: attributes) of the result at ``path``; None if it has no checksums.

    Raises :class:`InputError` if the file cannot be read.
    """
    with opened(path) as file:
        stored = file.attrs.get(ATTRIBUTE)
        if stored is None:
            return None
        wanted, present = _parsed(stored), checksums(file)
    return sorted(name for name in {*wanted, *present} if wanted.get(name) != present.get(name))


def refuse_damaged(path: Path, *, rewritten: bool = False) -> None:
    """Raise :class:`InputError` if ``path`` is a file whose checksums show damage.

    A copy that another program has written keeps the checksums as an attribute like any other, perhaps with other values.
    It is compared only if ``rewritten``.
    """
    if path.is_file() and (rewritten or not _rewritten(path)) and (changed := damaged(path)):
        what = f"damaged ({named(changed)})"
        raise InputError(f"file = {str(path)!r}: {what}; allowed is to restore it or to compute it again") from None


def _rewritten(path: Path) -> bool:
    """True if another program, such as h5netcdf, has written the file."""
    with opened(path) as file:
        maker = np.asarray(file.attrs.get("_NCProperties", b"")).tobytes()
    return bool(maker) and not maker.startswith(b"version=2,h5py=")


def named(names: list[str]) -> str:
    """The names from :func:`damaged` as text."""
    return ", ".join("attributes of the file" if name == FILE else name for name in names)


def _variables(file: h5py.File) -> dict[str, h5py.Dataset]:
    # A file may also contain the named type of its complex numbers.
    return {name: variable for name in sorted(file) if isinstance(variable := file[name], h5py.Dataset)}


def _groups(file: h5py.File) -> dict[str, h5py.Group]:
    return {name: group for name in sorted(file) if isinstance(group := file[name], h5py.Group)}


def _parsed(stored: Any) -> dict[str, str]:
    """The stored table of checksums; empty if it is damaged, so that nothing matches."""
    try:
        table = json.loads(stored)
    except (ValueError, TypeError):
        return {}
    return table if isinstance(table, dict) else {}


def _of_variable(variable: h5py.Dataset) -> str:
    state = _of_attributes(variable, _LINKS)
    dims = [scales[0].name if len(scales) else scales.label for scales in variable.dims]
    state.update(json.dumps([dims, variable.dtype.str, variable.shape, repr(variable.fillvalue)]).encode())
    for block in _blocks(variable):
        state.update(_bytes(block))
    return state.hexdigest()


def _blocks(variable: h5py.Dataset) -> Iterator[np.ndarray]:
    """Yield the values in blocks of some megabytes."""
    shape, size = variable.shape, variable.nbytes
    if not shape or 0 < size <= _BLOCK:
        yield np.asarray(variable[()])
        return
    rows = max(_BLOCK * shape[0] // max(size, 1), 1)
    for start in range(0, shape[0], rows):
        yield variable[start : start + rows]


def _of_attributes(owner: h5py.HLObject, apart: Collection[str]) -> hashlib.blake2b:
    """The hash state after all attributes of ``owner`` except ``apart``."""
    state, attributes = hashlib.blake2b(digest_size=16), owner.attrs
    for name in sorted(attributes):
        if name not in apart:
            value = np.asarray(attributes[name])
            state.update(json.dumps([name, value.dtype.str, value.shape]).encode())
            state.update(_bytes(value))
    return state


def _bytes(values: np.ndarray) -> memoryview | bytes:
    if values.dtype.kind == "O":
        return json.dumps(values.tolist(), default=repr).encode()
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
