"""The command ``drivetrain``. Thin: every command imports what it needs, so that ``--help`` is instant."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Sequence

from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax.cli.arguments import parser
from drivetrain_jax.cli.replies import INCOMPLETE, INTERRUPTED, OK, WRONG_INPUT, drop_output, one_line

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (0 done, 2 wrong input, 3 incomplete and resumable, 130 interrupted)."""
    if arguments is None:
        # Most objects are needed until the end: usual garbage collection takes a third of a second and frees little.
        gc.set_threshold(50_000)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # Closed by whoever started the process, who wants no answer.
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    options = parser().parse_args(arguments)
    try:
        return options.command(options)
    except InputError as error:
        sys.stderr.write(one_line(str(error)))
        return WRONG_INPUT
    except ChunkError as error:
        sys.stderr.write(one_line(str(error)))
        return INCOMPLETE
    except BrokenPipeError:
        # The reader of our output has gone (``drivetrain list | head``): nobody is left to tell.
        drop_output()
        return OK
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if arguments is None:
            # The process ends now, and what it has done is done: a signal could only spoil its way out.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
            # The garbage collection that Python ends with would take another third of a second.
            gc.freeze()
