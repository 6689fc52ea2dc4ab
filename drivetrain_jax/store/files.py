"""Files that are either complete or absent, and the provenance of numbers: versions, time, digests."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

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
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Installed versions by package name."""
    return {package: _version(package) for package in packages}


# Cached: reading the metadata of a package takes a millisecond.
_version = lru_cache(maxsize=None)(version)


def now() -> str:
    """Present time, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def command() -> str:
    """The program that runs, with its arguments."""
    program = Path(sys.argv[0]).name
    # A prompt or ``python -c`` has no program name, and in a notebook the program is the kernel, not the user's command.
    if program in ("", "-", "-c") or program.startswith("ipykernel"):
        return "notebook" if program.startswith("ipykernel") else "python"
    # A file stores UTF-8, and names of files may be other bytes.
    return shlex.join([program, *sys.argv[1:]]).encode(errors="backslashreplace").decode()


def source_digest(files: Mapping[str, Path]) -> str:
    """Digest of source files under the given names, independent of their location."""
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(files):
        content = files[name].read_bytes()
        state.update(f"{name}\0{len(content)}\0".encode())
        state.update(content)
    return state.hexdigest()


def digest(content: object) -> str:
    """Digest of nested mappings, lists, strings, numbers and NumPy arrays; independent of the order of keys."""
    state = hashlib.blake2b(digest_size=16)

    def replace_array(value: object) -> object:
        if isinstance(value, np.ndarray):
            state.update(f"{value.dtype.str}{value.shape}".encode())
            state.update(np.ascontiguousarray(value).tobytes())
            return "array"
        raise TypeError(f"no digest of {type(value).__name__}")

    state.update(json.dumps(content, sort_keys=True, default=replace_array).encode())
    return state.hexdigest()
