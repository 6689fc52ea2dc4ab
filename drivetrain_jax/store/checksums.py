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
        return InputError(f"file = {str(path)!r}: a Zarr store; use xarray.open_zarr, or `drivetrain export`")
    # A pipe exists, and is no file.
    exists = "is a folder" if path.is_dir() else "not a readable netCDF4/HDF5 file"
    what = exists if path.exists() else "does not exist"
    return InputError(f"file = {str(path)!r}: {what}; give a result written by `drivetrain run`")


def reserve(file: h5py.File) -> None:
    """Reserve space for the checksums of everything in ``file``, so filling them in needs no disk space."""
    blank = json.dumps(dict.fromkeys([FILE, *_members(file, h5py.Group), *_members(file, h5py.Dataset)], "0" * 32))
    file.attrs.create(ATTRIBUTE, np.bytes_(blank))


def seal(file: h5py.File) -> None:
    """Write the checksums of the complete ``file``."""
    file.attrs.modify(ATTRIBUTE, np.bytes_(json.dumps(checksums(file))))


def checksums(file: h5py.File) -> dict[str, str]:
    """Checksums by name (blake2b, 128 bits) of each variable, and of the attributes of ``file`` and of its groups.

    The checksum of a variable includes its type, dimensions and attributes.
    """
    variables, owners = _members(file, h5py.Dataset), {FILE: file, **_members(file, h5py.Group)}
    # Hashing releases the interpreter's lock.
    large = sum(variable.nbytes for variable in variables.values()) >= _LARGE
    with ThreadPoolExecutor(min(usable_cores(), len(variables)) if large else 1, thread_name_prefix="hash") as pool:
        digests = [*(pool.map if large else map)(_of_variable, variables.values())]
    attributes = {name: _of_attributes(owner, {ATTRIBUTE}).hexdigest() for name, owner in owners.items()}
    return attributes | dict(zip(variables, digests, strict=True))


def damaged(path: Path) -> list[str] | None:
    """Names of the damaged variables (``/``: attributes) of the result at ``path``; None if it has no checksums."""
    with opened(path) as file:
        stored = file.attrs.get(ATTRIBUTE)
        if stored is None:
            return None
        try:
            wanted = dict(json.loads(stored))
        except (ValueError, TypeError):
            # A damaged table: nothing matches.
            wanted = {}
        present = checksums(file)
    return sorted(name for name in {*wanted, *present} if wanted.get(name) != present.get(name))


def refuse_damaged(path: Path, *, rewritten: bool = False) -> None:
    """Raise :class:`InputError` if ``path`` is a file whose checksums show damage.

    A copy that another program, such as h5netcdf, has written keeps the checksums as an attribute like any other, perhaps
    with other values. It is compared only if ``rewritten``.
    """
    if not path.is_file():
        return
    with opened(path) as file:
        maker = np.asarray(file.attrs.get("_NCProperties", b"")).tobytes()
    ours = not maker or maker.startswith(b"version=2,h5py=")
    if (rewritten or ours) and (changed := damaged(path)):
        what = f"damaged ({named(changed)})"
        raise InputError(f"file = {str(path)!r}: {what}; restore it or compute it again") from None


def named(names: list[str]) -> str:
    """The names from :func:`damaged` as text."""
    return ", ".join("attributes of the file" if name == FILE else name for name in names)


def _members(file: h5py.File, kind: type[Any]) -> dict[str, Any]:
    """The variables or groups of a file, which may also contain the named type of its complex numbers."""
    return {name: member for name in sorted(file) if isinstance(member := file[name], kind)}


def _of_variable(variable: h5py.Dataset) -> str:
    state = _of_attributes(variable, _LINKS)
    dims = [scales[0].name if len(scales) else scales.label for scales in variable.dims]
    state.update(json.dumps([dims, variable.dtype.str, variable.shape, repr(variable.fillvalue)]).encode())
    # In blocks of some megabytes; whole variables if they are scalar, empty or small.
    count = variable.shape[0] if variable.shape else 1
    rows = max(_BLOCK * count // max(variable.nbytes, 1), 1)
    for start in range(0, count, rows) if rows < count else [None]:
        state.update(_bytes(np.asarray(variable[()] if start is None else variable[start : start + rows])))
    return state.hexdigest()


def _of_attributes(owner: h5py.HLObject, apart: Collection[str]) -> hashlib.blake2b:
    """The hash state after all attributes of ``owner`` except ``apart``."""
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(set(owner.attrs) - {*apart}):
        value = np.asarray(owner.attrs[name])
        state.update(json.dumps([name, value.dtype.str, value.shape]).encode())
        state.update(_bytes(value))
    return state


def _bytes(values: np.ndarray) -> memoryview | bytes:
    if values.dtype.kind == "O":
        return json.dumps(values.tolist(), default=repr).encode()
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
