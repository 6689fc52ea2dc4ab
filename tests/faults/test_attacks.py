"""The short form of the attacks in forks: some crashes at system calls, some damaged files. ``make faults`` runs all."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import attacks

pytest.importorskip("zarr")
pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shutil.which("cc") is None, reason="faults are injected by a C library"
)
SEED = 1


@pytest.mark.full
@pytest.mark.parametrize("kind", ["new run", "replacement", "export", "Zarr run"])
def test_a_crash_at_a_system_call_loses_nothing(tmp_path, kind):
    found = attacks.crashes(tmp_path, SEED, every={"Zarr run": 64, "export": 1}.get(kind, 24), shares=1, kinds=[kind])
    assert attacks.bad(found) == []
    assert {record["fault"] for record in found} == {"kill", "power cut", "torn write", "I/O error", "full disk"}
    assert all(record["calls"] > 25 for record in found)


@pytest.mark.full
def test_damaged_files_and_scenes_are_refused_in_one_line(tmp_path):
    found = attacks.files(tmp_path, SEED, {"bytes": 12, "sealed": 12, "scene": 6}, shares=1)
    assert attacks.bad(found) == []
    codes = {
        kind: {code for record in found if record["kind"] == kind for code in record["codes"]} for kind in attacks.FILES
    }
    assert 2 in codes["bytes"] and {0, 2} == codes["sealed"] | {2} and len(found) == 33
