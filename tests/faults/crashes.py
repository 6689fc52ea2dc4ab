"""``make faults``: kills, failing writes and damaged bytes at random places of toy scenes; writes docs/reliability.md.

``crashes.py [--each N] [--seed N] [KIND ...]`` injects N faults of every sort into every command. The commands run in forks
of one process, which imports jax once and computes nothing. Workers that die are in tests/runs/test_executor.py, sequences
of faults in tests/runs/test_resume_machine.py.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
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

from drivetrain_jax.cli import main, quiet_hdf5
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.output import status
from drivetrain_jax.store.files import now

# Seconds until a command counts as hanging.
PATIENCE = 300.0
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


# The commands before, and the command.
KINDS: dict[str, tuple[list[list[str]], list[str]]] = {
    "new run": ([], run("small", "r.nc")),
    "growth": ([run("small", "r.nc")], run("large", "r.nc")),
    "replacement": ([run("other", "r.nc")], run("small", "r.nc", "--fresh")),
    "export": ([run("small", "s.zarr", *STORE)], ["export", "s.zarr", "r.nc"]),
    "Zarr run": ([], run("small", "r.zarr", *STORE)),
    "replacement of a Zarr store": ([run("other", "r.zarr", *STORE)], run("small", "r.zarr", *STORE, "--fresh")),
    "atlas": ([], run("atlas", "r.nc")),
}
FAULTS = ("kill", "failing write", "damaged block", "damaged result")


@dataclass
class Ended:
    """The end of a fork: the exit code of the command or minus the signal, its lines, and the result of ``look``."""

    code: int
    lines: list[str]
    seen: dict
    seconds: float


def fork(
    folder: Path,
    *commands: list[str],
    look: Callable[[], dict] = dict,
    limit: int = 0,
    kill: tuple[str, float] = ("", PATIENCE),
) -> Ended:
    """Run ``look`` and the commands, up to the first that fails, in a fork that works in ``folder``.

    No file may have more than ``limit`` bytes, if given. ``kill`` is a pattern of paths and the time in seconds after the
    first of these exists at which the fork is killed.
    """
    said, (reader, writer) = folder.parent / "said", os.pipe()
    if not (pid := os.fork()):
        try:
            os.chdir(folder)
            handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number in (1, 2):
                os.dup2(handle, number)
            seen = look()
            if limit:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            code = next((code for words in commands if (code := main(words))), 0)
            os.write(writer, json.dumps(seen | {"code": code}).encode())
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(1)
    os.close(writer)
    begin = time.monotonic()
    pattern, delay = kill
    while pattern and not any(folder.glob(pattern)) and not select.select([reader], [], [], 5e-4)[0]:
        pass
    after = time.monotonic()
    answered = bool(select.select([reader], [], [], delay)[0])
    data = os.read(reader, 1 << 16) if answered else b""
    os.close(reader)
    if not answered:
        os.kill(pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    seen = json.loads(data) if data else {}
    lines = said.read_text(errors="replace").splitlines() + (["hangs"] if delay == PATIENCE and not answered else [])
    return Ended(seen.get("code", code), lines, seen, time.monotonic() - (after if pattern else begin))


class Workshop:
    """A folder with what lies there before every command, and what an undisturbed command makes of it."""

    def __init__(self, folder: Path, kind: str) -> None:
        before, self.words = KINDS[kind]
        self.folder, self.template, self.done = folder / "work", folder / "template", folder / "done"
        self.out = "r.zarr" if "Zarr" in kind else "r.nc"
        self.is_run = self.words[0] == "run"
        self.template.mkdir(parents=True)
        assert not before or fork(self.template, *before).code == 0
        self.former = self.values(self.template)
        self.lay()
        ended = fork(self.folder, self.words, kill=(self.pattern, PATIENCE))
        assert ended.code == 0, ended
        self.seconds, self.reference = ended.seconds, self.values(self.folder)
        shutil.copytree(self.folder, self.done)
        assert self.reference

    @property
    def pattern(self) -> str:
        """Paths of the first files of the command."""
        return f"{self.out}.parts/*" if self.is_run else f"{self.out}*"

    def lay(self, template: Path | None = None) -> None:
        """Lay out the files again."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(template or self.template, self.folder)

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

    def state(self) -> dict:
        """Finished points, in the fork before the command."""
        if not self.is_run or "--fresh" in self.words:
            return {"done": 0}
        found = status(self.words[1], self.out)
        return {"done": 0 if found.state == "stale" else found.done}

    def damage(self, rng: random.Random, pattern: str) -> None:
        """Change a byte of a random file of this pattern."""
        path = rng.choice(sorted(x for x in self.folder.glob(pattern) if x.is_file() and x.stat().st_size))
        data = bytearray(path.read_bytes())
        data[rng.randrange(len(data))] ^= rng.randrange(1, 256)
        path.write_bytes(data)


def inject(shop: Workshop, name: str, rng: random.Random) -> dict:
    """One fault, and the command again; returns the record."""
    shop.lay(shop.done if name == "damaged result" else None)
    problems: list[str] = []
    if name == "damaged result":
        shop.damage(rng, f"{shop.out}/**/*" if "zarr" in shop.out else shop.out)
        first = fork(shop.folder, ["verify", shop.out])
        problems += judged(first, (0, 2))
        words = [*(word for word in shop.words if word != "--fresh"), *["--fresh"] * (first.code != 0)]
    elif name == "failing write":
        first = fork(shop.folder, shop.words, limit=rng.randrange(512, 16_384))
        problems += judged(first, (0, 2, 3))
        words = shop.words
    else:
        first = fork(shop.folder, shop.words, kill=(shop.pattern, rng.uniform(0, 1.1) * shop.seconds))
        problems += judged(first, (0, -signal.SIGKILL))
        if name == "damaged block" and any((shop.folder / f"{shop.out}.parts").glob("*.npz")):
            shop.damage(rng, f"{shop.out}.parts/*.npz")
        words = shop.words
    values = {} if name == "damaged result" else shop.values(shop.folder)
    if values not in ({}, shop.former, shop.reference):
        problems.append("a damaged result has the name of a whole one")
    if not shop.is_run and values == shop.reference:
        # An export that has ended is not repeated, because its file is not new.
        return {"lost": 0, "wrong": 0, "problem": "; ".join(problems)}
    again = fork(shop.folder, words, ["verify", shop.out], look=dict if name == "damaged result" else shop.state)
    if name == "damaged result" and again.code == 2 and len(again.lines) == 1:
        # A file that is no result any more is not replaced.
        return {"lost": 0, "wrong": 0, "problem": "; ".join(problems)}
    problems += judged(again, (0,))
    values = shop.values(shop.folder)
    wrong = sum(values.get(key) != shop.reference.get(key) for key in {*values, *shop.reference})
    if (shop.folder / f"{shop.out}.parts").exists():
        problems.append("the folder of parts is still there")
    lost = 0 if name == "damaged result" else max(again.seen.get("done", 0) - reused(again.lines), 0)
    return {"lost": lost, "wrong": wrong, "problem": "; ".join(problems)}


def judged(ended: Ended, allowed: Sequence[int]) -> list[str]:
    """The problems of the end of a command."""
    bad = ended.code not in allowed or ended.lines[-1:] == ["hangs"] or any("Traceback" in x for x in ended.lines)
    return [f"exit {ended.code}: {' | '.join(ended.lines[-3:])}"] if bad else []


def reused(lines: list[str]) -> int:
    """The number of reused points in the last line of counts."""
    found = [line for line in lines if line.startswith("points: total")]
    return int(dict(word.split("=") for word in found[-1].split()[1:])["reused"]) if found else 0


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
    quiet_hdf5()
    # Collections in a fork would copy the pages of all these objects.
    gc.freeze()


def table(records: list[dict]) -> str:
    """The table of docs/reliability.md."""
    lines = [f"| command | {' | '.join(FAULTS)} | points lost | wrong | other problems |"]
    lines.append("| --- " * (len(FAULTS) + 4) + "|")
    for kind in [*dict.fromkeys(record["kind"] for record in records), "**all**"]:
        own = [record for record in records if kind in (record["kind"], "**all**")]
        counts = [sum(record["fault"] == name for record in own) for name in FAULTS]
        sums = [sum(record[key] for record in own) for key in ("lost", "wrong")]
        counts += [*sums, sum(bool(record["problem"]) for record in own)]
        lines.append(f"| {kind} | {' | '.join(map(str, counts))} |")
    return f"{len(records)} faults, {now()[:10]}.\n\n" + "\n".join(lines)


def main_of_forks() -> int:
    """Inject faults, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*")
    parser.add_argument("--each", type=int, default=10)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 20))
    options = parser.parse_args()
    # Forks compile quickly.
    os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
    rng, records = random.Random(options.seed), []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        place = Path(folder) / "faults"
        place.mkdir()
        prepare(place)
        for kind in options.kinds or KINDS:
            shop = Workshop(place / kind.replace(" ", "-"), kind)
            # The result of an export is no other file than that of a run.
            for name in FAULTS[: None if shop.is_run else -1] * options.each:
                record = inject(shop, name, rng) | {"kind": kind, "fault": name}
                records.append(record)
                if record["problem"] or record["wrong"]:
                    sys.stderr.write(json.dumps(record) + "\n")
    if not options.kinds:
        write("faults", table(records))
    sys.stdout.write(table(records) + "\n")
    return any(record["problem"] or record["wrong"] for record in records)


if __name__ == "__main__":
    sys.exit(main_of_forks())
