"""Damaged and tampered results, and scenes of every kind, read by commands: prints a JSON object for every one.

``mutations.py FOLDER SEED BYTES SEALED SCENES``: so many results with changed bytes, results that were tampered with and
sealed again, and scenes. The commands run in forks that begin anew every ``BATCH`` files.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "runs"))
sys.path.insert(0, str(Path(__file__).parents[2]))

import h5py
import numpy as np
import toy
from crashes import SCENES, fork, run
from harness import arrays
from hypothesis import HealthCheck, Phase, given, seed, settings

from drivetrain_jax.cli import main
from drivetrain_jax.runs import toml
from drivetrain_jax.store import checksums, gate
from tests.cli.test_fuzz import scenes

PATIENCE, BATCH = 60.0, 40
CHART = {
    "system": "cardan",
    "analysis": "floquet",
    "outputs": ["spectral_radius", "spectral_radius_error", "verdict"],
    "axes": {"beta": {"values": [0.1, 0.4, 0.9]}, "Omega": {"values": [0.5, 1.0, 1.1, 1.7]}},
    "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0},
    "options": {"method": "direct"},
}
# Scenes whose results are changed, and the commands that read them.
FILES = {
    "small": (["verify", "X"], ["plot", "X", "--out", "f.png"], ["status", "small.toml", "--out", "X"]),
    "chart": (["verify", "X"], ["plot", "X", "--out", "f.png"], ["run", "chart.toml", "--out", "X", "--quiet"]),
    "atlas": (["verify", "X"], ["query", "X", "beta=0.3", "--json"], ["status", "atlas.toml", "--out", "X"]),
}


def answer(words: list[str]) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(words)
        except SystemExit as stop:
            code = int(stop.code or 0)
    return code, said.getvalue()


def judged(words: list[str]) -> tuple[int, str]:
    """Exit code of a command, and what is not allowed about its end."""
    begin = time.process_time()
    try:
        code, said = answer(words)
    except BaseException:
        return 1, f"traceback: {words[0]}: {traceback.format_exc()[-300:]}"
    if time.process_time() - begin > PATIENCE / 2:
        return code, f"slow: {words[0]}: {time.process_time() - begin:.0f} s"
    lines = said.splitlines()
    good = code in (0, 2, 3) and len(lines) <= 2 and "Traceback" not in said
    return code, "" if good else f"exit {code}: {words[0]}: {said[-300:]}"


def changed_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to eight bytes; most of them at the ends, where the structure lies, and some pieces are cut or moved."""
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 8])):
        ends = (rng.randrange(min(6000, len(found))), len(found) - 1 - rng.randrange(min(8000, len(found))))
        at = rng.randrange(len(found)) if rng.random() < 0.3 else rng.choice(ends)
        found[at] = rng.choice([rng.randrange(256), 0, 255, found[at] ^ 1 << rng.randrange(8)])
    if rng.random() < 0.05:
        del found[rng.randrange(len(found)) :]
    return bytes(found)


def content(rng: random.Random) -> object:
    """Any attribute."""
    words: list[object] = ["", "x", "[1, 2", b"\xff\xfe", "y" * 5000, '{"a": 1}', "title = 3", "null"]
    numbers: list[object] = [0, -1, 1.5, float("nan"), True, 1j, 2**62]
    others = [np.zeros(0), np.zeros((2, 2)), np.arange(5), h5py.Empty("f8"), np.array([b"a", b"b"])]
    return rng.choice([*words, *numbers, *others])


def another(variable: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array of another shape, type or value."""
    flat = variable.reshape(-1)
    kinds: list[Callable[[], np.ndarray]] = [
        lambda: flat,
        lambda: variable[..., None],
        lambda: flat[:0],
        lambda: np.asarray(flat[0]),
        lambda: np.full(variable.shape, "x", object),
        lambda: np.zeros(variable.shape, rng.choice(["i1", "u8", "f4", "c16", "S3", "?"])),
        lambda: np.full(variable.shape, rng.choice([np.nan, np.inf, -1.0, 1e308])),
        lambda: np.full(variable.shape, rng.choice([-128, -1, 17, 127]), "i1"),
        lambda: variable[::-1],
    ]
    return rng.choice(kinds)()


def tamper(path: Path, rng: random.Random) -> None:
    """Change some objects and write fitting checksums."""
    with h5py.File(path, "r+") as file:
        for _ in range(rng.choice([1, 1, 2, 4])):
            names = [name for name in file if isinstance(file[name], h5py.Dataset)]
            if not names:
                break
            with contextlib.suppress(ValueError, TypeError, RuntimeError, KeyError, OSError, IndexError):
                alter(file, rng.choice(sorted(names)), rng)
        with contextlib.suppress(ValueError, TypeError, RuntimeError, KeyError, OSError):
            checksums.reserve(file)
            checksums.seal(file)


def alter(file: h5py.File, name: str, rng: random.Random) -> None:
    """One change of the variable ``name``, of its attributes or those of the file."""
    variable = file[name]
    owner = rng.choice([variable, file])
    does = rng.choice(
        ["values", "values", "delete", "attribute", "attribute", "no attribute", "group", "rename", "number"]
    )
    if does == "values":
        values, kept = another(variable[()], rng), dict(variable.attrs)
        del file[name]
        file.create_dataset(name, data=values, dtype=h5py.string_dtype() if values.dtype == object else None)
        for key, value in kept.items() if rng.random() < 0.7 else ():
            if key not in ("DIMENSION_LIST", "REFERENCE_LIST"):
                file[name].attrs[key] = value
    elif does == "delete":
        del file[name]
    elif does == "attribute" and len(owner.attrs):
        owner.attrs[rng.choice(sorted(owner.attrs))] = content(rng)
    elif does == "no attribute" and len(owner.attrs):
        del owner.attrs[rng.choice(sorted(owner.attrs))]
    elif does == "group":
        del file[name]
        file.create_group(name).attrs["a"] = content(rng)
    elif does == "rename":
        file.move(name, rng.choice(["value", "outcome", "verdict", "x", "spectral_radius"]))
    elif does == "number" and variable.shape and variable.size:
        variable[tuple(rng.randrange(n) for n in variable.shape)] = rng.choice([0, -1, 1, 99, -128])


def make(kind: str, index: int, seeds: str) -> None:
    """Make a result with changed bytes, or one that was tampered with, in a fork: HDF5 may fail to close it."""
    if pid := os.fork():
        os.waitpid(pid, 0)
        return
    try:
        rng = random.Random(f"{seeds} {kind} {index}")
        path = Path(f"x{index}.nc")
        shutil.copy(f"{base_of(kind, index, seeds)}.nc", path)
        if kind == "bytes":
            path.write_bytes(changed_bytes(path.read_bytes(), rng))
        else:
            tamper(path, rng)
    except (RuntimeError, OSError):
        pass
    finally:
        os._exit(0)


def base_of(kind: str, index: int, seeds: str) -> str:
    """The result that is changed."""
    return random.Random(f"base {seeds} {kind} {index}").choice(sorted(FILES))


def read(kind: str, index: int, seeds: str, references: dict[str, dict]) -> dict:
    """The record of one result."""
    base, path = base_of(kind, index, seeds), Path(f"x{index}.nc")
    commands = [[word.replace("X", str(path)) for word in words] for words in FILES[base]]
    found, wrong = [judged(words) for words in commands[:2]], 0
    if kind == "bytes" and 0 in (found[0][0], found[1][0]):
        wrong = int(visible(path) != references[base])
    kept = path.read_bytes()
    found.append(judged(commands[2]))
    problems = [text for _, text in found if text]
    if problems or wrong:
        Path(f"bad-{kind}-{index}.nc").write_bytes(kept)
    shutil.rmtree(f"{path}.parts", ignore_errors=True)
    path.unlink(missing_ok=True)
    return {"codes": [code for code, _ in found], "wrong": wrong, "problem": "; ".join(problems), "base": base}


def visible(path: Path) -> dict:
    """All that a reader sees of the variables."""
    try:
        return arrays(path)
    except (OSError, KeyError, ValueError, RuntimeError, TypeError):
        return {}


def some_scenes(count: int, number: int) -> Iterator[dict]:
    """Commands of random scenes."""
    made: list[dict] = []

    @seed(number)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(scenes())
    def collect(scene: dict) -> None:
        made.append(scene)

    collect()
    yield from made


def read_scene(index: int, scene: dict) -> dict:
    """The record of one scene: run, or refused with nothing written."""
    Path(f"x{index}.toml").write_text(toml.write(scene), errors="surrogatepass")
    code, problem = judged(["run", f"x{index}.toml", "--out", f"x{index}.nc", "--quiet"])
    left = [path.name for path in Path().glob(f"x{index}.nc*")]
    if code == 2 and left:
        problem = f"exit 2, and {left} is written"
    Path(f"x{index}.toml").unlink()
    for name in left:
        shutil.rmtree(name) if Path(name).is_dir() else Path(name).unlink()
    return {"codes": [code], "wrong": 0, "problem": problem, "base": toml.write(scene) if problem else ""}


class Scanner:
    """The scan of a file's structure in a fork of a process without threads: a new interpreter takes 30 times longer."""

    def __init__(self) -> None:
        (asked, self._ask), (self._answer, answered) = os.pipe(), os.pipe()
        if not os.fork():
            os.close(self._ask)
            with open(asked) as questions:
                for line in questions:
                    os.write(answered, (json.dumps(self._scanned(*json.loads(line))) + "\n").encode())
            os._exit(0)
        os.close(asked)
        self._answers = open(self._answer)

    def __call__(self, path: Path, seconds: float) -> str:
        """The answer of ``gate._scanned``."""
        os.write(self._ask, (json.dumps([os.path.abspath(path), seconds]) + "\n").encode())
        return json.loads(self._answers.readline())

    def _scanned(self, path: str, seconds: float) -> str:
        reader, writer = os.pipe()
        if not (pid := os.fork()):
            os.dup2(writer, 1)
            try:
                gate.main(path)
                sys.stdout.flush()
                os._exit(0)
            finally:
                os._exit(1)
        os.close(writer)
        with open(reader) as said:
            ready, _, _ = select.select([reader], [], [], seconds)
            if not ready:
                os.kill(pid, signal.SIGKILL)
            text = said.read() if ready else ""
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if not ready:
            return f"reading it takes longer than {seconds:.0f} s"
        return "reading it crashes HDF5" if code < 0 else text.strip() if code == 0 else ""


def batch(kind: str, tasks: list[tuple[int, dict]], work: Callable[[int, dict], dict]) -> Iterator[dict]:
    """Records of ``tasks`` from a fork; a death or a hang is the record of the task that was at work."""
    reader, writer = os.pipe()
    if not (pid := os.fork()):
        try:
            gate._scanned = Scanner()
            with open(writer, "w") as answers:
                for task in tasks:
                    print(json.dumps(work(*task)), file=answers, flush=True)
                peak = (
                    resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
                    resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
                )
                print(json.dumps({"memory": max(peak) / 1e6}), file=answers, flush=True)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    os.close(writer)
    left, memory = list(tasks), 0.0
    with open(reader) as answers:
        while True:
            ready, _, _ = select.select([reader], [], [], 3 * PATIENCE)
            line = answers.readline() if ready else ""
            if not line:
                break
            record = json.loads(line)
            if "memory" in record:
                memory = record["memory"]
                break
            left.pop(0)
            yield record | {"kind": kind}
    if left or not memory:
        os.kill(pid, signal.SIGKILL)
        yield {"kind": kind, "codes": [-9], "wrong": 0, "problem": f"crash or hang at {left[:1]}"[:500], "base": ""}
        yield from batch(kind, left[1:], work) if left[1:] else ()
    os.waitpid(pid, 0)
    yield {"kind": "memory", "memory": memory}


def prepare(folder: Path) -> dict[str, dict]:
    """Results that are changed, made in forks; what they show."""
    folder.mkdir(parents=True)
    os.environ["DRIVETRAIN_JAX_CACHE"] = str(folder.parent / "cache")
    os.environ["MPLBACKEND"] = "agg"
    toy.names()
    for name, content in (SCENES | {"chart": CHART}).items():
        (folder.parent / f"{name}.toml").write_text(toml.write(content))
        shutil.copy(folder.parent / f"{name}.toml", folder)
    os.chdir(folder)
    for name in FILES:
        (folder / "a" / "b").mkdir(parents=True, exist_ok=True)
        ended = fork(folder / "a" / "b", run(name, f"../../{name}.nc"), {})
        assert ended.code == 0, ended
    # Commands without jax, which may be forked; their imports serve all forks.
    for words in FILES["small"][:2]:
        answer([word.replace("X", "small.nc") for word in words])
    return {name: arrays(folder / f"{name}.nc") for name in FILES}


def mutations(folder: Path, number: int, counts: dict[str, int]) -> None:
    """All records."""
    references = prepare(folder)
    seeds = str(number)
    kinds: dict[str, tuple[list, Callable[[int, dict], dict]]] = {
        kind: ([(k, {}) for k in range(counts[kind])], lambda k, _, kind=kind: read(kind, k, seeds, references))
        for kind in ("bytes", "sealed")
    }
    kinds["scene"] = (list(enumerate(some_scenes(counts["scene"], number))) if counts["scene"] else [], read_scene)
    for kind, (tasks, work) in kinds.items():
        for start in range(0, len(tasks), BATCH):
            for index, _ in tasks[start : start + BATCH] if kind != "scene" else ():
                make(kind, index, seeds)
            for record in batch(kind, tasks[start : start + BATCH], work):
                print(json.dumps(record), flush=True)


if __name__ == "__main__":
    where, *numbers = sys.argv[1:6]
    mutations(Path(where), int(numbers[0]), dict(zip(("bytes", "sealed", "scene"), map(int, numbers[1:]), strict=True)))
