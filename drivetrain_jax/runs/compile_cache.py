"""Compiled code kept between processes, in a folder of the user.

jax keeps what XLA compiles, but traces and lowers a function before it finds that. Kernels are therefore kept whole as well.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
from jax.experimental import serialize_executable

from drivetrain_jax._machine import instruction_set
from drivetrain_jax.store.provenance import digest

_VARIABLE = "DRIVETRAIN_JAX_CACHE"
# Limit of either kind: what was not used for longest goes first.
_MAX_BYTES = 1 << 29
_CHECKSUM_BYTES = 16


def enable() -> None:
    """Turn on jax's compilation cache. ``DRIVETRAIN_JAX_CACHE=0`` turns it off; any other value names its folder.

    A cache that the user has configured stays unchanged. Without a writable folder there is no cache.
    """
    wanted = os.environ.get(_VARIABLE, "")
    if wanted == "0" or jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    folder = _folder(wanted)
    if not _writable(folder):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def load(key: str) -> Any | None:
    """The compiled function that was kept under ``key``; None if there is none that is intact."""
    path = _path(key)
    if path is None:
        return None
    try:
        content = path.read_bytes()
        checksum, body = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
        if checksum != _checksum(body):
            return None
        os.utime(path)
        return serialize_executable.deserialize_and_load(*pickle.loads(body))
    except (OSError, ValueError, pickle.UnpicklingError, jax.errors.JaxRuntimeError):
        return None


def keep(key: str, compiled: Any) -> None:
    """Keep a compiled function under ``key``, if this is possible."""
    path = _path(key)
    if path is None:
        return
    # Functions that call back into Python cannot be kept.
    with suppress(OSError, ValueError, TypeError, pickle.PicklingError, jax.errors.JaxRuntimeError):
        body = pickle.dumps(serialize_executable.serialize(compiled))
        path.parent.mkdir(mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(_checksum(body) + body)
        os.replace(file.name, path)
        _shrink(path.parent)


def _path(key: str) -> Path | None:
    """The file of a kernel, in a folder next to jax's own files; None if nothing is kept."""
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    own = folder is not None and Path(folder) == _folder(os.environ.get(_VARIABLE, ""))
    return Path(f"{folder}-kernels", key) if own else None


def _checksum(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()


def _shrink(folder: Path) -> None:
    entries = sorted(((file.stat(), file) for file in folder.iterdir()), key=lambda entry: -entry[0].st_mtime)
    total = 0
    for state, file in entries:
        total += state.st_size
        if total > _MAX_BYTES:
            file.unlink(missing_ok=True)


def _folder(wanted: str) -> Path:
    """One folder per instruction set and jax version, because compiled code is not portable."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = Path(wanted) if wanted else base / "drivetrain_jax"
    return root / digest([sorted(instruction_set()), jax.__version__])


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Compiled code is executed, so a folder of another user is not trusted.
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
