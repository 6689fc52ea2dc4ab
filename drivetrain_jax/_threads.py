"""Threads that outlive the work that they are made for: to start them takes as long as a small chunk of it."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache
def threads(count: int, name: str) -> ThreadPoolExecutor:
    """``count`` threads called ``name``, the same at every call; not to be shut down."""
    return ThreadPoolExecutor(count, thread_name_prefix=name, initializer=in_double_precision)


def in_double_precision() -> None:
    """Turn on double precision for this thread: a context of the caller does not reach the threads that work for him."""
    import jax

    jax.enable_x64(True).__enter__()


if hasattr(os, "register_at_fork"):
    # A child has none of them.
    os.register_at_fork(after_in_child=threads.cache_clear)
