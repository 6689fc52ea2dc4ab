"""``make faults``: commands of toy scenes that die, or fail, at one system call after the other; writes docs/reliability.md.

``crashes.py [--every N] [--seed N] [KIND ...]`` injects one of N faults, under ``calls.c``, which it compiles. The commands
run in forks of one process, which imports jax once and computes nothing.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import gc
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "runs"))

import h5py
import numpy as np
import toy
import xarray
from page import write

from drivetrain_jax.cli import main
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.output import status
from drivetrain_jax.store.files import now

PATIENCE = 60.0
# Allowed exit codes of a command whose system call fails.
ALLOWED = (0, 2, 3)
ATLAS = {
    "system": "cardan",
    "analysis": "atlas",
    "axes": {"beta": {"start": 0.1, "stop": 0.5}},
    "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "Omega": 1.3, "gamma": 100.0},
}


def scene(count: int, n: int) -> dict:
    """A chart of 3 x ``count`` points for both solvers, in several blocks."""
    axes = {"b": {"values": [1.0, 3.0, 2.0]}, "a": {"values": [k / 8 for k in range(count)]}}
    return {"system": "toy", "analysis": "toy", "outputs": ["value"], "axes": axes, "fixed": {"n": n}}


SCENES = {"small": scene(14, 3), "large": scene(20, 3), "other": scene(14, 4), "atlas": ATLAS}
STORE = ["--store", "zarr"]
# Modules that the commands import late, and that start no thread.
MODULES = ("matplotlib.pyplot", "xarray", "zarr", "h5netcdf", "diffrax", "drivetrain_jax.systems.cardan")
MODULES += ("drivetrain_jax.runs.run", "drivetrain_jax.runs.assemble", "drivetrain_jax.invariants")
MODULES += ("drivetrain_jax.analysis.floquet.propagator", "drivetrain_jax.analysis.atlas")


def run(name: str, out: str, *more: str) -> list[str]:
    """The command that runs a scene."""
    return ["run", f"../../{name}.toml", "--out", out, "--quiet", *more]


# What lies there before, the command, and how often a command before is killed half-way.
KINDS: dict[str, tuple[list[list[str]], list[str], bool]] = {
    "new run": ([], run("small", "r.nc"), False),
    "resumed run": ([run("small", "r.nc")], run("small", "r.nc"), True),
    "growth": ([run("small", "r.nc")], run("large", "r.nc"), False),
    "replacement": ([run("other", "r.nc")], run("small", "r.nc", "--fresh"), False),
    "export": ([run("small", "s.zarr", *STORE)], ["export", "s.zarr", "r.nc"], False),
    "Zarr run": ([], run("small", "r.zarr", *STORE), False),
    "resumed Zarr run": ([run("small", "r.zarr", *STORE)], run("small", "r.zarr", *STORE), True),
    "replacement of a Zarr store": ([run("other", "r.zarr", *STORE)], run("small", "r.zarr", *STORE, "--fresh"), False),
    "atlas": ([], run("atlas", "r.nc"), False),
}
# Every kind of fault: the error number of calls.c, and whether unflushed writes are lost.
FAULTS = {"kill": (0, False), "power cut": (0, True), "torn write": (-1, False)}
FAULTS |= {"I/O error": (errno.EIO, False), "full disk": (errno.ENOSPC, False)}


@dataclass
class Ended:
    """The end of a fork: the exit code of the command or minus the signal, its lines, and the result of ``look``."""

    code: int
    lines: list[str]
    calls: int
    seen: dict


def fork(
    folder: Path, words: list[str], fault: dict[str, object], look: Callable[[], dict] = dict, then: Sequence[str] = ()
) -> Ended:
    """Run ``look``, the command, and the command ``then`` if it succeeds, in a fork that works in ``folder``."""
    said, (reader, writer) = folder.parent / "said", os.pipe()
    if not (pid := os.fork()):
        try:
            os.chdir(folder)
            handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number in (1, 2):
                os.dup2(handle, number)
            seen = look()
            os.environ.update({f"FAULT_{name.upper()}": str(value) for name, value in fault.items()})
            code = main(words) or (main(then) if then else 0)
            os.environ.pop("FAULT_CALL", None)
            seen["calls"] = getattr(ctypes.CDLL(None), "fault_count", int)()
            sys.stderr.flush()
            os.write(writer, json.dumps(seen | {"code": code}).encode())
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(1)
    os.close(writer)
    answered, _, _ = select.select([reader], [], [], PATIENCE)
    data = os.read(reader, 1 << 16) if answered else b""
    os.close(reader)
    if not answered:
        os.kill(pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    seen = json.loads(data) if data else {}
    lines = said.read_text(errors="replace").splitlines() + ([] if answered else ["hangs"])
    return Ended(seen.get("code", code), lines, seen.get("calls", 0), seen)


class Workshop:
    """A folder with what lies there before every command, and what an undisturbed command makes of it."""

    def __init__(self, folder: Path, kind: str) -> None:
        before, self.words, partial = KINDS[kind]
        self.folder, self.out = folder / "work", "r.zarr" if "Zarr" in kind else "r.nc"
        self.template, self.flushed = folder / "template", folder / "flushed"
        self.template.mkdir(parents=True)
        for words in before:
            calls = fork(self.template, words, self.fault(case="count", path=str(self.template))).calls
            if partial:
                shutil.rmtree(self.template)
                self.template.mkdir()
                at = self.fault(case="half", path=str(self.template), at=calls // 2, errno=0)
                assert fork(self.template, words, at).code == -signal.SIGKILL
        self.name = words[1] if (words := self.words)[0] == "run" else ""
        self.former = self.values(self.template)
        self.lay()
        ended = fork(self.folder, self.words, self.fault(case="undisturbed"))
        assert ended.code == 0 and ended.calls > 10, ended
        self.calls, self.reference = ended.calls, self.values(self.folder)
        assert self.reference

    def fault(self, **more: object) -> dict[str, object]:
        """The variables of calls.c."""
        return {"call": "*", "path": str(self.folder), "flushed": str(self.flushed)} | more

    def lay(self) -> None:
        """Lay out the files again; all of them are on the disk."""
        for folder in (self.folder, self.flushed):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.template, self.folder)
        self.flushed.mkdir()
        for path in self.files():
            shutil.copy(path, self.flushed / str(path.stat().st_ino))

    def files(self) -> list[Path]:
        """All files of the folder."""
        return [path for path in self.folder.rglob("*") if path.is_file()]

    def cut(self) -> None:
        """Give every file the content of its last flush."""
        for path in self.files():
            kept = self.flushed / str(path.stat().st_ino)
            path.write_bytes(kept.read_bytes() if kept.exists() else b"")

    def values(self, folder: Path) -> dict[str, object]:
        """The bits of the result in ``folder``; empty without a result."""
        path = folder / self.out
        if path.is_file():
            with h5py.File(path) as file:
                variables = {name: each for name, each in file.items() if isinstance(each, h5py.Dataset)}
                return {
                    n: (str(x.dtype), x.shape, np.asarray(x[()]).astype(str).tolist()) for n, x in variables.items()
                }
        # Files of the store except checksums, which cover times.
        files = [
            file for file in path.rglob("*") if file.parent.name != path.name and "c" in file.parts and file.is_file()
        ]
        return {name: file.read_bytes() for file in files if "checksums" not in (name := str(file.relative_to(path)))}

    def whole(self) -> str:
        """Judge what readers see after a fault: nothing, the former result or the new one."""
        path = self.folder / self.out
        if not path.exists() or self.values(self.folder) in (self.former, self.reference):
            return ""
        return "a damaged result has the name of a whole one"

    def state(self) -> dict:
        """Finished points, in the fork before the command."""
        if not self.name:
            return {"done": 0}
        found = status(self.name, self.out)
        return {"done": 0 if found.state == "stale" or "--fresh" in self.words else found.done, "total": found.total}


def counts(lines: list[str]) -> dict[str, int]:
    """The numbers of the last line."""
    found = [line for line in lines if line.startswith("points: total")]
    return (
        {key: int(value) for key, _, value in (word.partition("=") for word in found[-1].split()[1:])} if found else {}
    )


def inject(shop: Workshop, name: str, at: int, rng: random.Random) -> dict:
    """One injection, sometimes a kill of the resumed command, and the command again; returns the record."""
    number, lost = FAULTS[name]
    shop.lay()
    first = fork(shop.folder, shop.words, shop.fault(case="fault", at=at, errno=number))
    problems = judged(first, number, lost)
    if lost:
        shop.cut()
    problems.append(shop.whole())
    words, verify = shop.words, ["verify", shop.out]
    if twice := rng.random() < 0.25:
        second = fork(shop.folder, words, shop.fault(case="twice", at=rng.randint(1, shop.calls), errno=0))
        # An export that has ended well is not repeated: its file is not new.
        words, verify = (verify, []) if second.code == 0 and not shop.name else (words, verify)
    again = fork(shop.folder, words, {}, shop.state, verify)
    if again.code != 0:
        problems.append(f"the same command or verify ends with {again.code}: {' | '.join(again.lines[-2:])}")
    found, before = counts(again.lines), again.seen.get("done", 0)
    values = shop.values(shop.folder)
    wrong = sum(values.get(key) != shop.reference.get(key) for key in {*values, *shop.reference})
    if (shop.folder / f"{shop.out}.parts").exists():
        problems.append("the folder of parts is still there")
    missed = max(before - found.get("reused", 0), 0)
    text = "; ".join(filter(None, problems))
    return {"code": first.code, "lost": missed, "wrong": wrong, "twice": twice, "problem": text}


def judged(ended: Ended, number: int, lost: bool) -> list[str]:
    """The problems of the end of a command with a fault."""
    if any("Traceback" in line for line in ended.lines):
        return ["traceback: " + " | ".join(ended.lines[-3:])]
    if number <= 0:
        return [] if ended.code in (-signal.SIGKILL, 0) else [f"exit {ended.code}: {' | '.join(ended.lines[-2:])}"]
    short = len(ended.lines) <= 2 and ended.lines[-1:] != ["hangs"]
    return [] if ended.code in ALLOWED and short else [f"exit {ended.code}: {' | '.join(ended.lines[-3:])}"]


def prepare(folder: Path) -> None:
    """Scenes, toys, small blocks, and modules of all forks: none of them starts a thread."""
    for module in MODULES:
        import_module(module)
    # A data set imports the kinds of arrays that it may hold.
    xarray.Dataset({"a": ("x", [1.0])}, {"x": [1.0]})
    for name, content in SCENES.items():
        (folder / f"{name}.toml").write_text(toml.write(content))
    os.environ["DRIVETRAIN_JAX_CACHE"] = str(folder.parent / "cache")
    toy.names()
    toy.small_blocks()
    # Collections in a fork would copy the pages of all these objects.
    gc.freeze()


def places(calls: int, every: int, rng: random.Random) -> list[tuple[str, int]]:
    """Faults and numbers of calls: kills and power cuts at one of ``every`` calls, the others at a quarter of those."""
    found = []
    for name in FAULTS:
        rate = every if name in ("kill", "power cut") else 4 * every
        found += [(name, at) for at in rng.sample(range(1, calls + 1), -(-calls // rate))]
    return found


def crashes(folder: Path, seed: int, every: int, kinds: Sequence[str]) -> list[dict]:
    """The records of all injections; problems are reported at once."""
    rng, records = random.Random(seed), []
    folder.mkdir(parents=True)
    prepare(folder)
    for kind in kinds or KINDS:
        shop = Workshop(folder / kind.replace(" ", "-"), kind)
        for name, at in places(shop.calls, every, rng):
            record = inject(shop, name, at, rng) | {"kind": kind, "fault": name, "at": at}
            records.append(record)
            if record["problem"] or record["wrong"]:
                sys.stderr.write(json.dumps(record) + "\n")
        sys.stderr.write(f"{kind}: {sum(record['kind'] == kind for record in records)} injections\n")
    return records


def table(records: list[dict]) -> str:
    """The table of docs/reliability.md."""
    lines = [f"| command | {' | '.join(FAULTS)} | killed twice | points lost | wrong | other problems |"]
    lines.append("| --- " * (len(FAULTS) + 5) + "|")
    for kind in [*dict.fromkeys(record["kind"] for record in records), "**all**"]:
        own = [record for record in records if kind in (record["kind"], "**all**")]
        counts = [sum(record["fault"] == name for record in own) for name in FAULTS]
        sums = [
            sum(bool(r["problem"]) if key == "problem" else r[key] for r in own)
            for key in ("twice", "lost", "wrong", "problem")
        ]
        lines.append(f"| {kind} | {' | '.join(map(str, counts + sums))} |")
    return f"{len(records)} faults, {now()[:10]}.\n\n" + "\n".join(lines)


def main_of_forks() -> int:
    """Inject faults, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 20))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        if "FAULT_LIBRARY" not in os.environ:
            library = str(Path(folder) / "calls.so")
            source = str(Path(__file__).with_name("calls.c"))
            subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
            environment = os.environ | {"LD_PRELOAD": library, "FAULT_LIBRARY": library}
            # Forks compile quickly.
            environment["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
            return subprocess.run([sys.executable, *sys.argv], env=environment, check=False).returncode
        records = crashes(Path(folder) / "faults", options.seed, options.every, options.kinds)
    if not options.kinds and options.every == 1:
        write("faults", table(records))
    sys.stdout.write(table(records) + "\n")
    return any(record["problem"] or record["wrong"] for record in records)


if __name__ == "__main__":
    sys.exit(main_of_forks())
