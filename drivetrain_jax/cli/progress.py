"""Progress on standard error: points done, rate and time left of a run; elapsed time of other commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    from drivetrain_jax.runs.run import Progress


@contextmanager
def progress_line() -> Iterator[Callable[[Progress], None]]:
    """Show a progress bar; yields the function that updates it. Its length is the predicted cost of the finished points."""
    columns = (
        BarColumn(),
        TextColumn("{task.fields[counts]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    bar = Bar(*columns, console=Console(stderr=True))
    task = bar.add_task("", total=None, counts="compiling")
    begin = time.monotonic()

    def report(progress: Progress) -> None:
        # Started at the first report, because wrong input must print a single line.
        bar.start()
        done = progress.computed + progress.reused
        rate = progress.computed / max(time.monotonic() - begin, 1e-9)
        counts = f"{done}/{progress.total} {progress.kind}, {rate:.3g}/s" if progress.cost or done else "compiling"
        bar.update(task, total=progress.total_cost, completed=progress.cost, counts=counts + progress.exceptions)

    try:
        yield report
    except InputError:
        # Remove the bar if the run fails on wrong input, such as a scheduler that does not answer.
        bar.live.transient = True
        bar.live.stop()
        raise
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def working_on(text: str) -> Iterator[None]:
    """Show a moving sign, ``text`` and the time on standard error, and remove them at the end."""
    columns = SpinnerColumn("line"), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    console = Console(stderr=True)
    if not console.is_interactive:
        yield
        return
    # Ctrl-C ends the process at once, and nothing would show a hidden cursor again.
    console.show_cursor = lambda show=True: False
    # Answers must go to standard output even while the sign is shown.
    with Bar(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False) as bar:
        bar.add_task(text, total=None)
        yield
