"""Real faults, injected into real runs at random moments: what the fault suite does to ``drivetrain run``."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drivetrain_jax.runs import toml
from drivetrain_jax.runs.status import Status, status

ROOT = Path(__file__).parents[2]
_MARK = "DRIVETRAIN_FAULT_RUN"
PATIENCE = 300.0


def scene(points: int) -> dict:
    """A chart of about this many points that takes some seconds."""
    side = max(int(points**0.5), 2)
    axes = {"delta": {"start": 0.1, "stop": 20.0, "num": side}, "epsilon": {"start": 0.0, "stop": 2.0, "num": side}}
    outputs = ["spectral_radius", "spectral_radius_error", "verdict"]
    options = {"method": "direct", "rtol": 1e-9}
    return {"system": "light", "analysis": "floquet", "outputs": outputs, "axes": axes, "options": options}


def install(folder: Path) -> str:
    """Make the system ``light`` an installed package; returns the path that Python needs for it."""
    info = folder / "light-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: light\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[drivetrain_jax.systems]\nlight = light:Light\n")
    shutil.copy(Path(__file__).with_name("light.py"), folder)
    sys.path.insert(0, str(folder))
    return os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])


@dataclass
class Ended:
    """How a run ended: exit code, and its lines on standard error."""

    code: int
    lines: list[str]

    def counts(self) -> dict[str, int]:
        """The numbers of the last line."""
        words = self.lines[-1].split()[1:] if self.lines and self.lines[-1].startswith("points:") else []
        return {key: int(value) for key, _, value in (word.partition("=") for word in words)}


class Run:
    """One ``drivetrain run`` in a process of its own, and whatever it starts."""

    def __init__(
        self,
        bench: Bench,
        out: Path,
        options: Sequence[str] = (),
        env: Mapping[str, str] | None = None,
        before: Sequence[str] = (),
    ) -> None:
        """``before`` is a command that runs the rest of its arguments."""
        self.mark = uuid.uuid4().hex
        command = [*before, sys.executable, "-m", "drivetrain_jax.cli", "run", str(bench.scene_file), "--out", str(out)]
        environment = bench.environment | dict(env or {}) | {_MARK: self.mark}
        self.process = subprocess.Popen(
            [*command, "--quiet", *options], env=environment, stderr=subprocess.PIPE, text=True, cwd=ROOT
        )

    def end(self) -> Ended:
        """Wait for it."""
        text = self.process.communicate(timeout=PATIENCE)[1]
        return Ended(self.process.returncode, text.splitlines())

    def others(self) -> list[int]:
        """Processes that it has started and that live."""
        return [pid for pid in marked(self.mark) if pid != self.process.pid]


def marked(mark: str) -> list[int]:
    """Living processes whose environment carries ``mark``."""
    needle, found = f"{_MARK}={mark}".encode(), []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            if state not in "ZX" and needle in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
        except OSError:
            continue
    return found


@dataclass
class Bench:
    """Where faults are injected: a scene, how long it takes undisturbed, and what comes out."""

    folder: Path
    points: int
    seed: int = 1
    environment: dict[str, str] = field(init=False)
    scene_file: Path = field(init=False)

    def __post_init__(self) -> None:
        self.scene = scene(self.points)
        self.scene_file = self.folder / "scene.toml"
        self.scene_file.write_text(toml.write(self.scene))
        # One compilation for all runs.
        cache = str(self.folder / "cache")
        self.environment = os.environ | {"DRIVETRAIN_JAX_CACHE": cache, "PYTHONPATH": install(self.folder / "packages")}
        self.rng = np.random.default_rng(self.seed)
        self._runs: list[Run] = []
        self.reference = self.folder / "reference.nc"
        self.run(self.reference).end()
        begin = time.monotonic()
        run = self.run(self.reference, ["--fresh"])
        at_work(run, self.reference)
        self.starting = time.monotonic() - begin
        assert run.end().code == 0
        self.duration = time.monotonic() - begin
        self.arrays = arrays(self.reference)

    def run(self, out: Path, options: Sequence[str] = (), **how: Any) -> Run:
        """Start a run into ``out``."""
        self._runs.append(run := Run(self, out, options, **how))
        return run

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        """End what still runs when the suite is stopped."""
        for run in self._runs:
            settle(run, 0.0)

    def place(self) -> Path:
        """A new output in a folder of its own."""
        folder = self.folder / uuid.uuid4().hex[:8]
        folder.mkdir()
        return folder / "r.nc"

    def moment(self) -> float:
        """A random time (s) from the beginning of the work, as long as an undisturbed run works."""
        return float(self.rng.uniform(0.0, 1.0) * (self.duration - self.starting))

    def status(self, out: Path) -> Status:
        """What ``drivetrain status`` says of ``out``."""
        return status(self.scene, out)

    def wrong(self, out: Path) -> int:
        """How many variables of ``out`` differ from those of the undisturbed run, in a bit, a label or their encoding."""
        found = arrays(out)
        names = {*found, *self.arrays}
        return sum(found.get(name) != self.arrays.get(name) for name in names)


def bits(values: np.ndarray) -> bytes:
    """The bits of an array, the characters of words."""
    return str(np.asarray(values).tolist()).encode() if np.asarray(values).dtype.kind == "O" else values.tobytes()


def arrays(path: Path) -> dict[str, tuple]:
    """Bits, labels and encoding of all variables of a file."""
    with h5py.File(path, "r") as file:
        return {
            name: (
                bits(variable[()]),
                variable.dtype.str,
                variable.shape,
                variable.chunks,
                variable.compression,
                str({k: v for k, v in variable.attrs.items() if k not in ("DIMENSION_LIST", "REFERENCE_LIST")}),
            )
            for name, variable in ((n, file[n]) for n in file)
            if isinstance(variable, h5py.Dataset)
        }


@dataclass
class Record:
    """One injection: when, whether the run was still at work, how it ended, and what the resumed one made of it."""

    kind: str
    moment: float
    hit: bool
    code: int
    reused: int
    computed: int
    lost: int
    wrong: int
    orphans: int
    problem: str = ""


def at_work(run: Run, out: Path) -> bool:
    """Wait until a run has begun its work on ``out``; false if it has ended before."""
    plan = out.with_name(out.name + ".parts") / "plan.json"
    while not plan.exists():
        if run.process.poll() is not None:
            return False
        time.sleep(0.01)
    return True


def wait(seconds: float, run: Run, out: Path) -> bool:
    """Wait until the moment has come; false if the run has ended before."""
    if not at_work(run, out):
        return False
    try:
        run.process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        return True
    return False


def settle(run: Run, seconds: float = 20.0) -> int:
    """How many processes outlive a run that has ended."""
    deadline = time.monotonic() + seconds
    while (left := marked(run.mark)) and time.monotonic() < deadline:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return len(left)


def resume(
    bench: Bench,
    kind: str,
    out: Path,
    moment: float,
    hit: bool,
    ended: Ended,
    orphans: int,
    options: Sequence[str] = (),
    allowed: Callable[[Ended], bool] = lambda _: True,
) -> Record:
    """Run again after a fault and judge the outcome."""
    done = bench.status(out).done
    again = bench.run(out, options)
    finished = again.end()
    orphans += settle(again)
    counts = finished.counts()
    problems = []
    if any("Traceback" in line for line in ended.lines + finished.lines):
        problems.append("traceback")
    if not allowed(ended):
        problems.append(f"exit code {ended.code}: {' | '.join(ended.lines[-2:])}")
    if finished.code != 0:
        problems.append(f"resume ended with {finished.code}: {' | '.join(finished.lines[-2:])}")
    if out.with_name(out.name + ".parts").exists():
        problems.append("the folder of parts is still there")
    # A run that is told to start anew gives up what is there.
    lost = 0 if "--fresh" in options else max(done - counts.get("reused", 0), 0)
    wrong = bench.wrong(out) if out.is_file() else len(bench.arrays)
    reused, computed = counts.get("reused", 0), counts.get("computed", 0)
    if reused + computed != bench.status(out).total:
        problems.append("counts do not add up")
    return Record(kind, moment, hit, ended.code, reused, computed, lost, wrong, orphans, "; ".join(problems))
