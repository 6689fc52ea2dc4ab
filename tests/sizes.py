"""Cases of a test of which `make test` runs the first, and `make validate` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def full_after(count: int, cases: Iterable[Any]) -> list[Any]:
    return [case if i < count else pytest.param(case, marks=pytest.mark.full) for i, case in enumerate(cases)]
