"""Cases of a test, some for `make test` and the others for `make validate`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def full_after(count: int, cases: Iterable[Any], *, several: bool = False) -> list[Any]:
    """The first ``count`` cases, and the others marked full; ``several`` if each case holds a value for every name."""
    cases = list(cases)
    others = (pytest.param(*(case if several else [case]), marks=pytest.mark.full) for case in cases[count:])
    return [*cases[:count], *others]


def but_full(cases: Iterable[str], *full: str) -> list[Any]:
    """All ``cases``, those named in ``full`` marked full."""
    return [pytest.param(case, marks=pytest.mark.full) if case in full else case for case in cases]
