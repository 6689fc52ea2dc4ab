from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    """Register the toy system and its analyses under their names."""
    import toy

    from drivetrain_jax import systems

    monkeypatch.setitem(os.environ, "DRIVETRAIN_JAX_CACHE", "0")
    # A pickled job registers the class of its system.
    monkeypatch.setattr(systems, "_REGISTERED", dict(systems._REGISTERED))
    toy.names(monkeypatch.setattr)


@pytest.fixture
def small_blocks(monkeypatch):
    """Let even small scenes have several blocks."""
    import toy

    toy.small_blocks(monkeypatch.setattr)


@pytest.fixture
def grid_scene():
    """A scene that uses both solvers, with some failing points and a short last chunk."""
    return {
        "system": "toy",
        "analysis": "toy",
        "outputs": ["value", "wave", "sign", "effort_seen"],
        "axes": {"b": {"values": [1.0, 3.0, 2.0]}, "a": {"start": 0.0, "stop": 10.0, "num": 41}},
    }
