"""What every command answers with: an exit code, and for wrong input one line on standard error."""

from __future__ import annotations

import os
import sys

from drivetrain_jax._errors import InputError

OK, WRONG_INPUT, INCOMPLETE, INTERRUPTED = 0, 2, 3, 130


def say(text: str) -> None:
    """``text`` on standard output; one that takes no more (a full disk) is wrong input."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        # A terminal may lack letters that a title has.
        sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        drop_output()
        raise InputError(f"standard output: {error.strerror}; allowed is one that can be written") from None


def drop_output() -> None:
    """What is still on its way to standard output goes nowhere: at its end Python would try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def one_line(message: str) -> str:
    """``message`` as this command says it, without line breaks of its own."""
    return f"drivetrain: {' '.join(message.split())}\n"
