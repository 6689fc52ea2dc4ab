"""Faults of what is stored, and of the clock: functions from a bench to the record of one injection."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

from harness import Bench, Ended, Record, resume, settle
from injections import stopped_by, strike


def corrupted(bench: Bench, kind: str, damage: Callable[[bytearray, Bench], bytearray]) -> Record:
    """A part is damaged after a kill: its chunks are computed again."""
    # Early: a part may have to be waited for, and the run has to be at work still.
    out, moment = bench.place(), bench.moment() / 2
    run = bench.run(out)
    folder = out.with_name(out.name + ".parts")

    def kill() -> None:
        while run.process.poll() is None and not any(folder.glob("*-*.h5")):
            time.sleep(0.01)
        run.process.kill()

    hit = strike(run, out, moment, kill)
    ended = run.end()
    settle(run)
    parts = sorted(folder.glob("*-*.h5"))
    for part in parts[:: max(len(parts) // 3, 1)]:
        part.write_bytes(damage(bytearray(part.read_bytes()), bench))
    return resume(bench, kind, out, moment, hit and bool(parts), ended, 0, (), stopped_by(signal.SIGKILL))


def flip(data: bytearray, bench: Bench) -> bytearray:
    """One bit."""
    data[bench.rng.integers(len(data))] ^= 1 << int(bench.rng.integers(8))
    return data


def cut(data: bytearray, bench: Bench) -> bytearray:
    """The end is missing."""
    return data[: bench.rng.integers(len(data))]


def damaged_result(bench: Bench, kind: str) -> Record:
    """One bit of the finished file: ``verify`` finds it, or nothing that a reader sees has changed."""
    out = bench.place()
    out.write_bytes(flip(bytearray(bench.reference.read_bytes()), bench))
    command = [sys.executable, "-m", "drivetrain_jax.cli", "verify", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=bench.environment)
    found = done.returncode == 2 and len(done.stderr.splitlines()) == 1
    try:
        same = not bench.wrong(out)
    except (OSError, RuntimeError, ValueError, KeyError):
        same = False
    record = (
        resume(bench, kind, out, 0.0, True, Ended(done.returncode, done.stderr.splitlines()), 0, ["--fresh"])
        if (found and "not a readable" not in done.stderr)
        else Record(kind, 0.0, True, done.returncode, 0, 0, 0, 0, 0)
    )
    record.problem += "" if found or same else "not found"
    return record


CLOCK = """
import os, random, time
_jump = random.Random(int(os.environ["CLOCK_SEED"]))
_time, _time_ns = time.time, time.time_ns
def _offset():
    return _jump.choice([-1, 1]) * _jump.choice([0, 3600, 86400, 3e8])
time.time = lambda: _time() + _offset()
time.time_ns = lambda: _time_ns() + int(_offset() * 1e9)
"""


def clock(bench: Bench, kind: str) -> Record:
    """The system's clock jumps by up to ten years, both ways, at every look; the run is killed and resumed under it."""
    out, moment = bench.place(), bench.moment()
    site = out.parent / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(CLOCK)
    path = os.pathsep.join([str(site), bench.environment["PYTHONPATH"]])
    run = bench.run(out, env={"PYTHONPATH": path, "CLOCK_SEED": str(bench.rng.integers(1 << 30))})
    hit = strike(run, out, moment, run.process.kill)
    ended = run.end()
    settle(run)
    for file in out.parent.rglob("*"):
        os.utime(file, times=(when := float(bench.rng.choice([0.0, 4e9])), when))
    return resume(bench, kind, out, moment, hit, ended, 0, (), stopped_by(signal.SIGKILL))
