"""Ctrl-C and a scheduler's SIGTERM while a scene is computed."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

# Seconds that are left to what was stopped, to write down what is finished: further signals do not cut it short.
_GRACE = 2.0


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], None]]:
    """Ctrl-C and a scheduler's SIGTERM raise ``KeyboardInterrupt``, and the function that it gives does so again.

    The second time is for an exception that a destructor or a C callback has swallowed. What these say of it, and of what
    it left half made, is not shown. An impatient second signal is ignored while what is finished is written down.
    """
    caught: list[float] = []
    before = sys.unraisablehook

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    def stop(number: int, frame: object) -> None:
        del number, frame
        caught.append(time.monotonic())
        if len(caught) == 1 or caught[-1] - caught[0] > _GRACE:
            raise KeyboardInterrupt

    def hook(unraisable: Any) -> None:
        if not caught:
            before(unraisable)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    sys.unraisablehook = hook
    try:
        yield check
    finally:
        # After a signal the process is about to end, and what was left half made ends with it.
        if not caught:
            sys.unraisablehook = before
