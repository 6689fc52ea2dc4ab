"""The machine of this process: its properties, its threads, and double precision."""

from __future__ import annotations

import os
import platform
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path


@lru_cache
def _processor() -> dict[str, str]:
    """Name and instruction-set flags of the processor, if the system reports them."""
    wanted = {"model name": "name", "flags": "flags", "Features": "flags"}
    fields: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() in wanted:
                fields.setdefault(wanted[key.strip()], value.strip())
    except OSError:
        pass
    return fields


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


def use_double_precision() -> None:
    """Turn on double precision in jax, or in the jax that this process will import, unless it is left to the caller.

    The package calls this at its import, because its first computation may be inside a function that jax is tracing.
    """
    if os.environ.get("DRIVETRAIN_JAX_ENABLE_X64") == "0":
        return
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        os.environ["JAX_ENABLE_X64"] = "1"


@lru_cache
def threads(count: int, name: str) -> ThreadPoolExecutor:
    """``count`` threads called ``name``, the same at every call, as starting them takes as long as a small chunk.

    Do not shut them down.
    """
    return ThreadPoolExecutor(count, thread_name_prefix=name, initializer=in_double_precision)


def in_double_precision() -> None:
    """Turn on double precision in this thread; contexts of the caller do not reach other threads."""
    sys.modules["jax"].enable_x64(True).__enter__()


if hasattr(os, "register_at_fork"):
    # A forked child has no threads.
    os.register_at_fork(after_in_child=threads.cache_clear)
