"""Programs of kernels on disk, so that a later process traces nothing: it only compiles, or finds the compiled code."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
from jax import export

from drivetrain_jax.runs import compile_cache
from drivetrain_jax.store.files import write_atomic

# Number of programs that are kept; one takes some 200 kB.
_MOST = 256
_DIGEST = 16


def lowered(function: Callable[..., Any], kinds: tuple[Any, ...], identity: str) -> jax.stages.Lowered:
    """``function`` lowered for arguments of these ``kinds``.

    ``identity`` is a digest of everything that the program depends on; an empty one keeps nothing on disk.
    """
    folder = compile_cache.programs() if identity else None
    if folder is None:
        return jax.jit(function).lower(*kinds)
    path = folder / identity
    program = _read(path)
    if program is None:
        try:
            program = export.export(jax.jit(function))(*kinds)
            _write(path, bytes(program.serialize()))
        except (NotImplementedError, ValueError):
            # A call of Python code, or of a library whose interface may change, cannot be stored. An error of the function
            # itself is raised again here.
            return jax.jit(function).lower(*kinds)
    return jax.jit(program.call).lower(*kinds)


def _read(path: Path) -> export.Exported | None:
    """The program at ``path``; None if there is none, or if it is damaged."""
    with suppress(OSError, ValueError, TypeError):
        data = path.read_bytes()
        if hashlib.blake2b(data[_DIGEST:], digest_size=_DIGEST).digest() == data[:_DIGEST]:
            path.touch()
            return export.deserialize(bytearray(data[_DIGEST:]))
    return None


def _write(path: Path, data: bytes) -> None:
    """Store a program, and delete those that have not been used for the longest time. A full disk is no error."""
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, exist_ok=True)
        content = hashlib.blake2b(data, digest_size=_DIGEST).digest() + data
        write_atomic(path, content, path.with_name(f"{path.name}.{os.getpid()}.tmp"))
        programs = sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime)
        for file in programs[:-_MOST]:
            file.unlink(missing_ok=True)
