"""Handle Ctrl-C and SIGTERM: a run stops in order, other commands end at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

# Time [s] after a signal during which further signals are ignored, so that finished chunks are written.
_GRACE = 2.0


def leave_on_interrupt(code: int) -> None:
    """End the process with the exit ``code`` as soon as Ctrl-C is pressed.

    Python itself would raise ``KeyboardInterrupt`` between its own instructions only, and a compilation takes many seconds.
    An import or a destructor might also turn it into a traceback.
    """
    signal.signal(signal.SIGINT, lambda *_: os._exit(code))
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def watch() -> None:
        while signal.SIGINT not in os.read(reader, 64):
            pass
        os._exit(code)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], None]]:
    """Raise ``KeyboardInterrupt`` on Ctrl-C and SIGTERM inside the context.

    Yields a function that raises it again after a signal, because a destructor or a C callback may swallow the first
    one. The traceback that Python prints in that case is hidden. Further signals are ignored for two seconds, so that
    finished chunks are written, and :func:`leave_on_interrupt` has no effect.
    """
    waker = signal.set_wakeup_fd(-1)
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
        signal.set_wakeup_fd(waker)
        for number, handler in handlers.items():
            # The handler was not set by Python, so it cannot be restored.
            signal.signal(number, handler or signal.SIG_DFL)
        # After a signal the hook stays, to hide errors of unfinished work.
        if not caught:
            sys.unraisablehook = before
