"""Where numbers come from: versions, machine, and digests of sources and of whatever else decides them."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Installed versions by package name."""
    return {package: _version(package) for package in packages}


# Reading the metadata of a package takes a millisecond.
_version = lru_cache(maxsize=None)(version)


@lru_cache
def _processor() -> dict[str, str]:
    """Name and instruction-set flags of the processor, as far as the system tells."""
    wanted = {"model name": "name", "flags": "flags", "Features": "flags"}
    found: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() in wanted:
                found.setdefault(wanted[key.strip()], value.strip())
    except OSError:
        pass
    return found


def instruction_set() -> frozenset[str]:
    """Architecture and instruction-set extensions: two machines that agree in them compile to the same code."""
    return frozenset({platform.machine(), *_processor().get("flags", "").split()})


def usable_cores() -> int:
    """Number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_memory() -> float:
    """Bytes of memory of the machine, infinite if the system does not tell."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def machine() -> str:
    """One line that describes the machine: processor, cores, system, Python."""
    name = _processor().get("name") or platform.processor() or platform.machine()
    system = f"{platform.system()} {platform.machine()}"
    return f"{name}, {usable_cores()} cores, {system}, Python {platform.python_version()}"


def now() -> str:
    """Present time, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def source_digest(files: Mapping[str, Path]) -> str:
    """Digest of source files under the names that they are given here, independent of where they lie."""
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(files):
        content = files[name].read_bytes()
        state.update(f"{name}\0{len(content)}\0".encode())
        state.update(content)
    return state.hexdigest()


def digest(content: object) -> str:
    """Digest of nested mappings, lists, strings, numbers and NumPy arrays; the order of keys does not matter."""
    state = hashlib.blake2b(digest_size=16)

    def replace_array(value: object) -> object:
        if isinstance(value, np.ndarray):
            state.update(f"{value.dtype.str}{value.shape}".encode())
            state.update(np.ascontiguousarray(value).tobytes())
            return "array"
        raise TypeError(f"no digest of {type(value).__name__}")

    state.update(json.dumps(content, sort_keys=True, default=replace_array).encode())
    return state.hexdigest()
