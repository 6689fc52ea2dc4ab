"""What every command answers with: an exit code, and for wrong input one line on standard error."""

from __future__ import annotations

OK, WRONG_INPUT, INCOMPLETE, INTERRUPTED = 0, 2, 3, 130


def one_line(message: str) -> str:
    """``message`` as this command says it, without line breaks of its own."""
    return f"drivetrain: {' '.join(message.split())}\n"
