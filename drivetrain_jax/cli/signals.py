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
    """Ctrl-C and a scheduler's SIGTERM raise ``KeyboardInterrupt`` until the context is left.

    It gives a function that raises it once more after a signal, for a destructor or a C callback may have swallowed the
    first; the traceback that Python prints in that case is not shown. For two seconds further signals are ignored, so that
    what is finished can be written down.
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

    handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    sys.unraisablehook = hook
    try:
        yield check
    finally:
        for number, handler in handlers.items():
            # Not one of Python's own: nothing that could be set again.
            signal.signal(number, handler or signal.SIG_DFL)
        # After a signal the process is about to end, and what was left half made ends with it.
        if not caught:
            sys.unraisablehook = before
