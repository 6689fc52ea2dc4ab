"""Cases of a test, some for `make test` and the others for `make validate`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def full_after(count: int, cases: Iterable[Any]) -> list[Any]:
    return [case if i < count else pytest.param(case, marks=pytest.mark.full) for i, case in enumerate(cases)]


def but_full(cases: Iterable[str], *full: str) -> list[Any]:
    return [pytest.param(case, marks=pytest.mark.full) if case in full else case for case in cases]
