"""Progress of a run on standard error: points done, rate and time left."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    from drivetrain_jax.runs.run import Progress


@contextmanager
def progress_line() -> Iterator[Callable[[Progress], None]]:
    """A bar that the yielded function moves. It grows with the predicted cost, so the time left is a fair guess."""
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
        # Not before the first report: wrong input is answered with a single line.
        bar.start()
        done = progress.computed + progress.reused
        rate = progress.computed / max(time.monotonic() - begin, 1e-9)
        counts = f"{done}/{progress.total} {progress.kind}, {rate:.3g}/s" if progress.cost or done else "compiling"
        failed = f", {progress.failed} failed" if progress.failed else ""
        bar.update(task, total=progress.total_cost, completed=progress.cost, counts=counts + failed)

    try:
        yield report
    except InputError:
        # Wrong input that only the work brings to light, such as a scheduler that does not answer: no bar beside its line.
        bar.live.transient = True
        bar.live.stop()
        raise
    finally:
        if bar.live.is_started:
            bar.stop()
