"""Properties of the machine of this process."""

from __future__ import annotations

import os
import platform
from functools import lru_cache
from pathlib import Path


@lru_cache
def _processor() -> dict[str, str]:
    """Name and instruction-set flags of the processor, if the system reports them."""
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
    """Architecture and instruction-set extensions; equal ones give equal compiled code."""
    return frozenset({platform.machine(), *_processor().get("flags", "").split()})


def usable_cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_memory() -> float:
    """Bytes of memory of the machine, infinite if the system does not report them."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def machine() -> str:
    """One line that describes the machine: processor, cores, system, Python."""
    name = _processor().get("name") or platform.processor() or platform.machine()
    system = f"{platform.system()} {platform.machine()}"
    return f"{name}, {usable_cores()} cores, {system}, Python {platform.python_version()}"
