"""The progress of a run in a notebook: a bar of HTML, which every front end of Jupyter shows."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from drivetrain_jax.runs.work import Progress, Report

# Seconds before a bar appears, and between its updates.
_PATIENCE, _STEP = 0.5, 0.2


@contextmanager
def shown_progress(report: Report | None) -> Iterator[Report | None]:
    """Yield ``report``; if it is None in a notebook, yield a report that shows a bar in the running cell."""
    if report is not None or not _in_notebook():
        yield report
        return
    bar = _Bar()
    try:
        yield bar
    finally:
        bar.finish()


def _in_notebook() -> bool:
    """True in a kernel of Jupyter, false in a script or a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


class _Bar:
    """A bar with points done, rate and time; a run of less than ``_PATIENCE`` shows none."""

    def __init__(self) -> None:
        self._begin = self._shown = time.monotonic()
        self._last: Progress | None = None
        self._display: Any = None

    def __call__(self, progress: Progress) -> None:
        self._last, now = progress, time.monotonic()
        if now - (self._shown if self._display else self._begin + _PATIENCE - _STEP) >= _STEP:
            self._show()

    def finish(self) -> None:
        """Show the last state, if there is a bar."""
        if self._display:
            self._show()

    def _show(self) -> None:
        shell: Any = import_module("IPython.display")
        self._shown = time.monotonic()
        content = shell.HTML(_html(self._last, self._shown - self._begin))  # pyright: ignore[reportArgumentType]
        if self._display:
            self._display.update(content)
        else:
            self._display = shell.display(content, display_id=True)


def _html(progress: Progress, seconds: float) -> str:
    done = progress.computed + progress.reused
    # The cost grows evenly in time; points are counted if it is unknown.
    part, whole = (progress.cost, progress.total_cost) if progress.total_cost else (done, max(progress.total, 1))
    rate = progress.computed / max(seconds, 1e-9)
    text = f"{done}/{progress.total} {progress.kind}, {rate:.3g}/s, {seconds:.0f} s{progress.exceptions}"
    return f'<progress value="{part / whole:.4f}" max="1"></progress> {text}'
