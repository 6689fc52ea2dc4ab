"""Exit codes, and the one-line messages on standard error."""

from __future__ import annotations

import os
import sys

from drivetrain_jax._errors import InputError

OK, WRONG_INPUT, INCOMPLETE, INTERRUPTED = 0, 2, 3, 130


def say(text: str) -> None:
    """Print ``text`` on standard output; if that fails (a full disk), raise :class:`InputError`."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        # The encoding of a terminal may lack characters of a title.
        sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        drop_output()
        raise InputError(f"standard output: {error.strerror}; allowed is one that can be written") from None


def drop_output() -> None:
    """Discard buffered output; otherwise Python would try to write it again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def one_line(message: str) -> str:
    """``message`` on one line, with the name of the command in front."""
    return f"drivetrain: {' '.join(message.split())}\n"


def backend_error() -> str | None:
    """The message if jax cannot use the machines that ``JAX_PLATFORMS`` names; None if it can."""
    wanted = os.environ.get("JAX_PLATFORMS")
    if not wanted or "jax" not in sys.modules:
        return None
    try:
        sys.modules["jax"].devices()
    # jax raises either, depending on the name.
    except (RuntimeError, AssertionError):
        return (
            f"JAX_PLATFORMS = {wanted!r}: jax cannot use it on this machine; allowed is cpu, or to unset the variable"
        )
    return None
