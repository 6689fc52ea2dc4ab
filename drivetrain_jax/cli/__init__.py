"""The command ``drivetrain``. Each command imports its own modules, so ``--help`` is fast."""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from collections.abc import Sequence

from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax.cli.arguments import parser
from drivetrain_jax.cli.replies import (
    INCOMPLETE,
    INTERRUPTED,
    OK,
    WRONG_INPUT,
    backend_error,
    drop_output,
    one_line,
)

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 2 wrong input, 3 incomplete and resumable, 130 interrupted."""
    if arguments is None:
        # Collect garbage rarely: the default takes a third of a second and frees little, as most objects live until the end.
        gc.set_threshold(50_000)
        # Figures are written to files, so a window system of the user's choice is not needed, and may be missing.
        os.environ["MPLBACKEND"] = "agg"
        # A warning of a value, without the line of code that found it.
        warnings.formatwarning = lambda message, *_, **__: one_line(f"warning: {message}")
        # Ctrl-C ends a command at once, also during a compilation; ``run`` has a handler of its own.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # The parent process has closed this stream, so no one reads its output.
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
    except (RuntimeError, AssertionError):
        if (text := backend_error()) is None:
            raise
        sys.stderr.write(one_line(text))
        return WRONG_INPUT
    except BrokenPipeError:
        # The reader has closed standard output (``drivetrain list | head``): exit without a message.
        drop_output()
        return OK
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if arguments is None:
            # Skip Python's garbage collection at exit, which takes a third of a second.
            gc.freeze()
