"""The short form of the fault suite: one injection of the commonest kinds. ``make faults`` runs all of them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from harness import Bench
from kinds import KINDS

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="faults are injected through /proc")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    found, modules = list(sys.path), set(sys.modules)
    yield Bench(tmp_path_factory.mktemp("faults"), points=40_000, seed=3)
    # The system that it installs is not one of the package for other tests.
    sys.path[:] = found
    for name in {"light"} & (set(sys.modules) - modules):
        del sys.modules[name]


@pytest.mark.full
@pytest.mark.parametrize("kind", [name for name, _, _, short in KINDS if short])
def test_nothing_is_lost_and_nothing_is_wrong(bench, kind):
    function = next(function for name, function, _, _ in KINDS if name == kind)
    record = function(bench, kind)
    assert (record.problem, record.lost, record.wrong, record.orphans) == ("", 0, 0, 0), record


def test_the_suite_is_large_enough():
    assert sum(count for _, _, count, _ in KINDS) >= 30
