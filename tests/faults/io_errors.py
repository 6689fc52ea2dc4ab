"""Runs of the toy system in one process while a system call on a file fails: prints a JSON object for every case."""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "runs"))

import toy

from drivetrain_jax.cli import main
from drivetrain_jax.runs import toml


def scene(count: int, n: int) -> dict:
    """A chart of 3 x ``count`` points."""
    axes = {"b": {"values": [1.0, 3.0, 2.0]}, "a": {"values": [k / 8 for k in range(count)]}}
    return {"system": "toy", "analysis": "toy", "outputs": ["value", "wave"], "axes": axes, "fixed": {"n": n}}


def command(words: list[str], **fault: object) -> dict:
    """Exit code and lines of a command while a fault is injected."""
    os.environ.update({f"FAULT_{name.upper()}": str(value) for name, value in fault.items()})
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = main(words)
    os.environ.pop("FAULT_CALL", None)
    return {"code": code, "lines": said.getvalue().splitlines()}


def cases(folder: Path, calls: list[list]) -> None:
    """Every case: a former result, a run that fails, the same run again."""
    for name, count, n in (("small", 40, 3), ("large", 60, 3), ("other", 40, 4)):
        (folder / f"{name}.toml").write_text(toml.write(scene(count, n)))
    command(["run", "small.toml", "--out", "s.zarr", "--store", "zarr", "--quiet"])
    first = command(["run", "small.toml", "--out", "first.nc", "--quiet"])
    assert first["code"] == 0, first
    former = Path("first.nc").read_bytes()
    for number, (kind, call, at, error) in enumerate(calls):
        out = folder / f"r{number}.nc"
        words = {
            "new": ["run", "small.toml", "--out", out.name, "--quiet"],
            "growing": ["run", "large.toml", "--out", out.name, "--quiet"],
            "fresh": ["run", "other.toml", "--out", out.name, "--quiet", "--fresh"],
            "export": ["export", "s.zarr", out.name],
        }[kind]
        if kind in ("growing", "fresh"):
            out.write_bytes(former)
        found = command(words, call=call, at=at, errno=error, path=f"{out.name}.parts/result.tmp", case=number)
        found["whole"] = out.read_bytes() == former if kind in ("growing", "fresh") else not out.exists()
        print(json.dumps(found | {"again": command(words)}), flush=True)


if __name__ == "__main__":
    os.environ["DRIVETRAIN_JAX_CACHE"] = "0"
    os.chdir(sys.argv[1])
    with pytest.MonkeyPatch.context() as patch:
        toy.names(patch.setattr)
        cases(Path(sys.argv[1]), json.loads(sys.argv[2]))
