"""The only way to read a result file: damage or malice in its structure can hang or crash the HDF5 library.

A new process first reads the structure of the file, with a limit of time: every object against what a result may contain,
every attribute, and all values that are not stored in one block. It is asked once for each state of a file.
"""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from drivetrain_jax._errors import ChunkError, InputError

# Exceptions of h5py for a damaged file structure.
BROKEN = (OSError, KeyError, ValueError, RuntimeError, TypeError, OverflowError, MemoryError)
# Limit of time in s, and bytes that may take one more second each.
_PATIENCE, _BYTES_PER_SECOND = 10.0, 1 << 25
# Most objects of a file, most attributes of an object, and most dimensions of a variable.
_OBJECTS, _ATTRIBUTES, _RANK = 10_000, 1_000, 32
# Rows that are read at a time.
_ROWS = 1 << 12
# Most bytes of values per byte of the file: the best ratio of deflate. Dimensions without coordinates store nothing.
_RATIO, _FREE = 1100, 1 << 30
# Filters that HDF5 itself has: deflate, shuffle, fletcher32, szip, nbit, scale-offset. Others are code loaded from plugins.
_FILTERS = frozenset({1, 2, 3, 4, 5, 6})
# States of files that have passed, the number of them that are remembered, and states that this process has written.
_passed: dict[tuple[int, ...], None] = {}
_written: set[tuple[int, ...]] = set()
_REMEMBERED = 4096
# What HDF5 says of a file that another program has open for writing.
_LOCKED = "unable to lock file"
_SCAN = "import sys; sys.path[:] = sys.argv[2:]; from drivetrain_jax.store import gate; gate.main(sys.argv[1])"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file at ``path``. Damage raises :class:`InputError`, found at the start or inside the context."""
    _admit(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except BlockingIOError as error:
        raise unreadable(path, _LOCKED) from error
    except BROKEN as error:
        raise unreadable(path, "") from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise any error inside the context as :class:`InputError`, unless this process has written the file at ``path``.

    Checksums show only that a file is as it was sealed. Content that no result has makes readers fail in any way.
    """
    try:
        foreign = _state(os.stat(path)) not in _written
    except OSError:
        foreign = False
    with warnings.catch_warnings():
        if foreign:
            # Warnings about such content would only precede the error.
            warnings.simplefilter("ignore")
        try:
            yield
        except (InputError, ChunkError, MemoryError, BrokenPipeError):
            raise
        except Exception as error:
            if not foreign:
                raise
            text = " ".join(str(error).split())[:200]
            what = f"its content does not fit a result of drivetrain_jax ({type(error).__name__}: {text})"
            raise InputError(f"file = {str(path)!r}: {what}; give a result written by `drivetrain run`") from error


def trust(path: Path) -> None:
    """Remember that this process has written the file at ``path``."""
    with suppress(OSError):
        state = _state(os.stat(path))
        _remember(state)
        _written.add(state)


def unreadable(path: Path, reason: str) -> InputError:
    """The error for a path that is not a readable file."""
    if path.suffix == ".parts":
        return InputError(f"file = {str(path)!r}: a folder of unfinished work; give {str(path.with_suffix(''))!r}")
    if (path / "zarr.json").is_file():
        return InputError(f"file = {str(path)!r}: a Zarr store; give the file that `drivetrain export` makes of it")
    if _LOCKED in reason:
        return InputError(f"file = {str(path)!r}: locked by another program; wait until that program closes it")
    what = "is a folder" if path.is_dir() else "not a readable netCDF4/HDF5 file"
    more = f", or damaged in its structure ({reason})" if reason else ""
    return InputError(f"file = {str(path)!r}: {what}{more}; give a result written by `drivetrain run`")


def _admit(path: Path) -> None:
    """Raise :class:`InputError` unless ``path`` is a regular file whose structure can be read."""
    try:
        found = os.stat(path)
    except OSError as error:
        raise unreadable(path, error.strerror or "") from None
    if not stat.S_ISREG(found.st_mode):
        raise unreadable(path, "" if path.is_dir() else "not a regular file")
    if _state(found) in _passed:
        return
    if not h5py.is_hdf5(path):
        raise unreadable(path, "")
    if reason := _scanned(path, _PATIENCE + found.st_size / _BYTES_PER_SECOND):
        raise unreadable(path, reason)
    _remember(_state(found))


def _state(found: os.stat_result) -> tuple[int, ...]:
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _remember(state: tuple[int, ...]) -> None:
    _passed[state] = None
    if len(_passed) > _REMEMBERED:
        del _passed[next(iter(_passed))]


def _scanned(path: Path, seconds: float) -> str:
    """The reason why a process cannot read the structure of the file; empty if it can, or if no process can start."""
    package = str(Path(__file__).parents[2])
    command = [sys.executable, "-I", "-c", _SCAN, os.path.abspath(path), package, *filter(None, sys.path)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("HDF5_", "COVERAGE_"))}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, env=environment, check=False)
    except subprocess.TimeoutExpired:
        return f"reading it takes longer than {seconds:.0f} s"
    except (OSError, ValueError, TypeError):
        return ""
    if done.returncode == 0:
        return done.stdout.strip()
    return "reading it crashes HDF5" if done.returncode < 0 else ""


def main(path: str) -> None:
    """Print the reason why the file at ``path`` is no result, if there is one."""
    try:
        with h5py.File(path, "r") as file:
            _Scan(os.path.getsize(path)).group(file)
    except BROKEN as error:
        sys.stdout.write(" ".join(str(error).split())[:200] or type(error).__name__)


class _Scan:
    """Reads the structure of a file of this ``size``; raises ``ValueError`` for what a result does not contain."""

    def __init__(self, size: int) -> None:
        self._size, self._left = size, _RATIO * size + _FREE
        self._seen = set[Any]()

    def group(self, group: h5py.Group) -> None:
        """Read a group and everything in it."""
        self._attributes(group)
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name!r} is a link to elsewhere")
            found: Any = group[name]
            key = h5py.h5o.get_info(found.id).addr  # pyright: ignore[reportAttributeAccessIssue]
            if key in self._seen:
                continue
            self._seen.add(key)
            if len(self._seen) > _OBJECTS:
                raise ValueError(f"more than {_OBJECTS} objects")
            if isinstance(found, h5py.Group):
                self.group(found)
            elif isinstance(found, h5py.Dataset):
                self._variable(str(name), found)

    def _variable(self, name: str, variable: h5py.Dataset) -> None:
        if variable.ndim > _RANK or variable.is_virtual or variable.external:
            raise ValueError(f"{name!r} has its values in another file")
        kept: Any = variable.id.get_create_plist()
        filters = {kept.get_filter(k)[0] for k in range(kept.get_nfilters())}
        if filters - _FILTERS:
            raise ValueError(f"{name!r} needs the filter {min(filters - _FILTERS)} of a plugin")
        self._left -= variable.nbytes
        if self._left < 0 or variable.id.get_storage_size() > self._size:
            raise ValueError(f"{name!r} claims {variable.nbytes:.3g} bytes in a file of {self._size}")
        offset = variable.id.get_offset()
        if offset is not None and offset + variable.nbytes > self._size:
            raise ValueError(f"{name!r} lies behind the end of the file")
        self._attributes(variable)
        if variable.ndim and not _has_right_links(variable):
            raise ValueError(f"{name!r} names its dimensions by attributes of another type")
        for axis in range(variable.ndim):
            if h5py.h5ds.get_num_scales(variable.id, axis):
                h5py.h5ds.iterate(variable.id, axis, lambda _: None, 0)
        # Numbers in one block need no structure to be found.
        if variable.id.get_storage_size() and (variable.dtype.kind == "O" or offset is None):
            for start in range(0, len(variable), _ROWS) if variable.shape else ():
                variable[start : start + _ROWS]
            if not variable.shape:
                variable[()]

    def _attributes(self, owner: h5py.HLObject) -> None:
        if len(owner.attrs) > _ATTRIBUTES:
            raise ValueError(f"{owner.name!r} has more than {_ATTRIBUTES} attributes")
        for name in owner.attrs:
            if owner.attrs.get_id(name).get_storage_size() > self._size:
                raise ValueError(f"the attribute {name!r} of {owner.name!r} is larger than the file")
            owner.attrs[name]


def _has_right_links(variable: h5py.Dataset) -> bool:
    """True if scales and labels of the dimensions have the type and shape that HDF5 takes for granted."""
    for name in {"DIMENSION_LIST", "DIMENSION_LABELS"} & set(variable.attrs):
        found = variable.attrs.get_id(name)
        if name == "DIMENSION_LIST":
            entry = h5py.check_vlen_dtype(found.dtype)
            linked = entry is not None and h5py.check_ref_dtype(entry) is h5py.Reference
        else:
            text = h5py.check_string_dtype(found.dtype)
            linked = text is not None and text.length is None
        if not linked or found.shape != (variable.ndim,):
            return False
    return True
