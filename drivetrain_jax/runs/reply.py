"""An answer of a point or an atlas: the same as text, as JSON, and as sentences of a report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, repr=False)
class Reply:
    """An answer as ``lines`` of text, the first being the heading, and as plain numbers, words and lists (``data``)."""

    lines: Sequence[str]
    data: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The answer as ``print`` shows it."""
        return "\n".join(self.lines)

    def __str__(self) -> str:
        return self.text

    # A notebook shows what `print` does.
    __repr__ = __str__

    def to_json(self) -> str:
        """``data`` as one JSON object; numbers that are not finite become null."""
        return json.dumps(plain(self.data), allow_nan=False)

    def sentences(self) -> list[str]:
        """The lines below the heading as sentences."""
        return [f"{line.strip()[:1].upper()}{line.strip()[1:]}." for line in self.lines[1:]]


def plain(value: Any) -> Any:
    """``value`` in the types of JSON; complex numbers as ``real`` and ``imag``, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, (str, bool)):
        return value
    if np.iscomplexobj(value):
        return {"real": plain(np.real(value)), "imag": plain(np.imag(value))}
    if np.ndim(value):
        return [plain(entry) for entry in value]
    return np.asarray(value).item() if np.isfinite(value) else None
