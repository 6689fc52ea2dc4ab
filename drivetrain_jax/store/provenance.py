"""Provenance of numbers: versions, time, and digests of sources and inputs."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np


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
    return shlex.join([program, *sys.argv[1:]])


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
