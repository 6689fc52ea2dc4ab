"""Exceptions that a caller can handle, the values in their messages, and suggestions of similar names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


class InputError(ValueError):
    """Raised for wrong input; the message is one line with the field, the value and what is allowed."""


class ChunkError(RuntimeError):
    """Raised for a failed computation; the message names the chunk and the reason."""


class RetryableError(ChunkError):
    """Raised for a cause that may vanish: too little memory, a full disk, a dead worker or scheduler."""


# Most characters of a value that a message repeats.
_SHOWN = 60
# Shortest part of a name that stands for it, less one.
_PART = 4


def clipped(text: str) -> str:
    """``text``, shortened if it is too long for a message."""
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def shown(value: Any) -> str:
    """The text of a given value in a message."""
    return clipped(" ".join(repr(value).split("\n")))


def counted(count: int, one: str, many: str) -> str:
    """``1 value``, ``2 values``."""
    return f"{count} {one if count == 1 else many}"


def written(value: Any, digits: int = 10) -> str:
    """A parameter's value as text: up to ten ``digits``, a list in brackets."""
    if isinstance(value, tuple):
        return "[" + ", ".join(written(entry, digits) for entry in value) + "]"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """``(did you mean X?)`` for a similar name, else empty."""
    import difflib

    allowed = list(allowed)
    # Compare without case: "Beta" is nearer to beta than to zeta.
    same = [other for other in allowed if other.lower() == name.lower()]
    match = same or difflib.get_close_matches(name, allowed, n=1)
    # "radius" is less than half of spectral_radius.
    match = match or [other for other in allowed if len(name) > _PART and name.lower() in other.lower()]
    return f" (did you mean {match[0]}?)" if match else ""


def meant(name: str, parameters: Iterable[Any]) -> str:
    """``(did you mean X?)`` for the parameters with a similar name, else for those whose meaning or unit is ``name``."""
    known, words = list(parameters), name.lower().replace("_", " ")
    if guess := did_you_mean(name, [parameter.name for parameter in known]):
        return guess
    alike = [p.name for p in known if words == p.units or (len(words) > 2 and words in p.long_name.lower())]
    return f" (did you mean {' or '.join(alike[:4])}?)" if alike else ""


def nearest(name: str, allowed: Iterable[str]) -> str:
    """``(did you mean X?); expected A, B, ...``"""
    allowed = list(allowed)
    return f"{did_you_mean(name, allowed)}; expected {', '.join(allowed) if allowed else 'none'}"
