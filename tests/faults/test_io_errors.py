"""A system call that fails inside HDF5: exit 3, one line with path and reason, finished points and former result kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from attacks import library

pytest.importorskip("zarr")
pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shutil.which("cc") is None, reason="faults are injected by a C library"
)

HERE = Path(__file__).parent
EIO, ENOSPC = errno.EIO, errno.ENOSPC
CALLS = [("write", at) for at in (1, 2, 3, 6, 9)] + [("read", at) for at in (1, 3, 6, 12, 20)]
CALLS += [("ftruncate", 1), ("fsync", 1)]
CASES = [("new", *call, EIO) for call in CALLS]
CASES += [(kind, *call, ENOSPC) for kind in ("growing", "fresh", "export") for call in (("write", 3), ("read", 6))]
CASES += [("growing", "ftruncate", 1, EIO), ("export", "fsync", 1, EIO)]


def counts(line):
    return {key: int(value) for key, _, value in (word.partition("=") for word in line.split()[1:])}


@pytest.mark.full
def test_an_io_error_inside_hdf5_is_one_line_and_costs_nothing(tmp_path):
    environment = os.environ | {"LD_PRELOAD": str(library(tmp_path))}
    command = [sys.executable, str(HERE / "io_errors.py"), str(tmp_path), json.dumps(CASES)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=HERE.parents[1])
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(records) == len(CASES) and done.returncode == 0, done.stderr[-2000:]
    for number, (case, found) in enumerate(zip(CASES, records, strict=True)):
        kind, *_, error = case
        assert (found["code"], len(found["lines"]), found["whole"]) == (3, 1 if kind == "export" else 2, True), (
            case,
            found,
        )
        for part in (os.strerror(error), f"r{number}.nc.parts/result.tmp"):
            assert part in found["lines"][0], (case, found)
        assert found["again"]["code"] == 0, (case, found)
        if kind != "export":
            before, after = counts(found["lines"][-1]), counts(found["again"]["lines"][-1])
            kept = before["computed"] if kind != "growing" else 120
            assert after["reused"] >= kept > 0, (case, found)
