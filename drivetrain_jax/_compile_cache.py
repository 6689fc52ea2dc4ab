"""Cache of compiled code on disk, shared by the processes of a user."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import jax
from filelock import FileLock, Timeout

from drivetrain_jax._machine import instruction_set

_VARIABLE = "DRIVETRAIN_JAX_CACHE"
_MAX_BYTES = 1 << 29
# With a limit of size jax reads a date for each entry whenever it keeps a program: 7 us an entry.
_MAX_ENTRIES = 1000


def enable(*, short: bool = False) -> None:
    """Turn on jax's compilation cache. ``DRIVETRAIN_JAX_CACHE=0`` turns it off; any other value names its folder.

    A cache that the user has configured stays unchanged. Without a writable folder there is no cache. With ``short``
    programs that compile in less than a second are kept too; until then the user's own small programs are not.
    """
    wanted = os.environ.get(_VARIABLE, "")
    folder = _folder(wanted)
    used = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if wanted == "0" or (used and used != str(folder)):
        return
    if not used:
        if not _writable(folder):
            return
        _prune(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if short:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def programs() -> Path | None:
    """The folder of stored programs; None without a cache, or with one that the user has configured."""
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    wanted = os.environ.get(_VARIABLE, "")
    return Path(folder) / "programs" if wanted != "0" and folder == str(_folder(wanted)) else None


def _folder(wanted: str) -> Path:
    """One folder per instruction set and jax version, because compiled code is not portable."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = Path(wanted) if wanted else base / "drivetrain_jax"
    content = " ".join((*sorted(instruction_set()), jax.__version__))
    return root / hashlib.blake2b(content.encode(), digest_size=16).hexdigest()


def _prune(folder: Path) -> None:
    """Remove entries without a date, with which jax stores no further program, and of too many those used longest ago."""
    entries = {path.name.removesuffix("-cache") for path in folder.glob("*-cache")}
    dates = {path.name.removesuffix("-atime"): path for path in folder.glob("*-atime")}
    surplus = entries - dates.keys()
    try:
        if len(entries) > _MAX_ENTRIES:
            by_use = sorted(entries & dates.keys(), key=lambda key: dates[key].stat().st_mtime_ns)
            surplus |= set(by_use[: -_MAX_ENTRIES // 2])
        if surplus:
            # The lock of jax's own cache.
            with FileLock(folder / ".lockfile", timeout=0):
                for key in surplus:
                    (folder / f"{key}-cache").unlink(missing_ok=True)
                    (folder / f"{key}-atime").unlink(missing_ok=True)
    except (OSError, Timeout):
        return


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
