"""Threads that are reused, because starting them takes as long as a small chunk."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache
def threads(count: int, name: str) -> ThreadPoolExecutor:
    """``count`` threads called ``name``, the same at every call; do not shut them down."""
    return ThreadPoolExecutor(count, thread_name_prefix=name, initializer=in_double_precision)


def in_double_precision() -> None:
    """Turn on double precision in this thread; jax contexts of the caller do not reach other threads."""
    import jax

    jax.enable_x64(True).__enter__()


if hasattr(os, "register_at_fork"):
    # A forked child has no threads.
    os.register_at_fork(after_in_child=threads.cache_clear)
