from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "runs"))


@pytest.fixture
def toys(monkeypatch):
    """Register the toy system and its analyses under their names."""
    import toy

    monkeypatch.setitem(os.environ, "DRIVETRAIN_JAX_CACHE", "0")
    toy.names(monkeypatch.setattr)
