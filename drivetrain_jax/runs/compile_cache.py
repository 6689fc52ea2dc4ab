"""Compiled code kept between processes, in a folder of the user."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import jax

from drivetrain_jax._machine import instruction_set
from drivetrain_jax.store.provenance import digest

_VARIABLE = "DRIVETRAIN_JAX_CACHE"
_MAX_BYTES = 1 << 29


def enable() -> None:
    """Let jax keep compiled code. ``DRIVETRAIN_JAX_CACHE=0`` turns it off, any other value is the folder to use.

    A cache that the user has set up in jax is left alone; a folder that cannot be written means no cache.
    """
    wanted = os.environ.get(_VARIABLE, "")
    if wanted == "0" or jax.config.jax_compilation_cache_dir:
        return
    folder = _folder(wanted)
    if not _writable(folder):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _folder(wanted: str) -> Path:
    """One folder per instruction set and jax version: code of another machine may not run here."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = Path(wanted) if wanted else base / "drivetrain_jax"
    return root / digest([sorted(instruction_set()), jax.__version__])


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Compiled code is executed: a folder of another user is not trusted.
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
