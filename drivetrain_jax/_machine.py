"""The machine of this process: its properties, its threads, and double precision."""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

# Pieces that are waiting, over the number of threads.
_AHEAD = 2

_Piece = TypeVar("_Piece")
_Done = TypeVar("_Done")


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


def in_threads(pieces: Iterable[_Piece], work: Callable[[_Piece], _Done]) -> Iterator[tuple[_Piece, _Done]]:
    """Yield every piece with ``work(piece)``, in order, computed on all cores; pieces are created on demand."""
    count = usable_cores()
    pool = threads(count, "piece")
    pending: deque[tuple[_Piece, Future[_Done]]] = deque()
    try:
        for piece in pieces:
            pending.append((piece, pool.submit(work, piece)))
            if len(pending) > _AHEAD * count:
                done, results = pending.popleft()
                yield done, results.result()
        while pending:
            done, results = pending.popleft()
            yield done, results.result()
    finally:
        for _, results in pending:
            results.cancel()


def in_double_precision() -> None:
    """Turn on double precision in this thread; contexts of the caller do not reach other threads."""
    sys.modules["jax"].enable_x64(True).__enter__()


if hasattr(os, "register_at_fork"):
    # A forked child has no threads.
    os.register_at_fork(after_in_child=threads.cache_clear)


def notebook() -> Any:
    """The display functions of IPython in the kernel of a notebook, else None; a terminal of IPython has no kernel."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return import_module("IPython.display") if getattr(shell, "kernel", None) is not None else None


def terminal() -> bool:
    """True if standard error is a terminal that can rewrite a line."""
    return bool(sys.stderr and sys.stderr.isatty()) and os.environ.get("TERM") != "dumb"


class StatusLine:
    """The last line of a terminal, or a cell of a notebook, whose text is replaced; a pipe gets nothing."""

    _shown: Any = None

    def write(self, text: str, part: float | None = None) -> None:
        """Replace the text; ``part`` adds a bar of this part of its length."""
        if not text and not self._shown:
            return
        if shell := notebook():
            bar = "" if part is None else f'<progress value="{part:.4f}" max="1"></progress> '
            if self._shown:
                self._shown.update(shell.HTML(bar + text))
            else:
                self._shown = shell.display(shell.HTML(bar + text), display_id=True)
        elif terminal():
            bar = "" if part is None else f"[{'#' * round(20 * part):-<20}] "
            # Local import: this package is imported in milliseconds.
            import shutil

            line = (bar + text)[: shutil.get_terminal_size().columns - 1]
            print(f"\r{line}\x1b[K", end="", file=sys.stderr, flush=True)
            self._shown = text


class CompilingLine:
    """Context in which a terminal or a notebook says that this process compiles, and for how long, after ``patience`` [s].

    Contexts of several threads share the line, which the end of the last one removes.
    """

    def __init__(self, patience: float = 2.0) -> None:
        self.patience, self._line = patience, StatusLine()
        self._lock, self._users, self._begin = threading.Lock(), 0, 0.0
        self._timer: threading.Timer | None = None

    def __enter__(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1 and (terminal() or notebook()):
                self._begin = time.monotonic()
                self._show_after(self.patience)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._timer is not None:
                self._timer.cancel()
                self._timer = None
                self._line.write("")
                self._line = StatusLine()

    def _show_after(self, seconds: float) -> None:
        self._timer = threading.Timer(seconds, self._show)
        self._timer.daemon = True
        self._timer.start()

    def _show(self) -> None:
        with self._lock:
            # None if the compilation has just ended.
            if self._timer is not None:
                self._line.write(f"compiling, {time.monotonic() - self._begin:.0f} s")
                self._show_after(1.0)


compiling = CompilingLine()


# Time [s] after a signal during which further signals are ignored.
_GRACE = 2.0


@contextmanager
def stop_on_signals(*numbers: signal.Signals) -> Iterator[Callable[[], None]]:
    """Raise ``KeyboardInterrupt`` on the signals ``numbers`` inside the context.

    Yields a function that raises it again after a signal, because a destructor or a C callback may swallow the first one;
    nothing is printed then. Further signals are ignored for two seconds, so that finished chunks are written.
    """
    caught: list[float] = []
    report_unraisable = sys.unraisablehook

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    def stop(*_: object) -> None:
        caught.append(time.monotonic())
        if len(caught) == 1 or caught[-1] - caught[0] > _GRACE:
            raise KeyboardInterrupt

    def report(swallowed: Any) -> None:
        if swallowed.exc_type is not KeyboardInterrupt:
            report_unraisable(swallowed)

    handlers = {number: signal.signal(number, stop) for number in numbers}
    sys.unraisablehook = report
    try:
        yield check
    finally:
        sys.unraisablehook = report_unraisable
        for number, handler in handlers.items():
            # A handler that Python did not set cannot be restored.
            signal.signal(number, handler or signal.SIG_DFL)
