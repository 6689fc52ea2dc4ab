"""Limits of time and memory of a test process: a newcomer's computer has 8 GB, and `make test` runs two of them."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from pathlib import Path

import pytest

# Growth that a compilation leaves behind, and resident memory above which compiled code is dropped, in bytes.
GROWTH, LIMIT = 200 << 20, 1 << 30
_after_trim = 0


def pytest_configure(config):
    """`make test` compiles without optimisation, in half of the time; `make validate` compiles as users do."""
    if config.getoption("markexpr") == "not full":
        os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")


@pytest.fixture(autouse=True, scope="session")
def no_stored_programs():
    """A test that replaces code must not leave its program to later runs; processes that tests start do store programs."""
    from drivetrain_jax import _compile_cache

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_compile_cache, "programs", lambda: None)
        yield


def resident() -> int:
    """Resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def trim() -> None:
    """Return free memory to the system: the allocator keeps what the compiler used, 700 MB after a large kernel."""
    global _after_trim
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    _after_trim = resident()


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_teardown(item, nextitem):
    try:
        return (yield)
    finally:
        if resident() > _after_trim + GROWTH:
            trim()
        last = nextitem is None or nextitem.path != item.path
        if last and resident() > LIMIT and (jax := sys.modules.get("jax")):
            jax.clear_caches()
            trim()
