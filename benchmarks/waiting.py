"""CPU seconds of the commands that a person waits for, in a new process each.

    python -m benchmarks.waiting          # results/waiting.csv

The first process finds no compiled code. The later ones find what it left, and take other values: nothing that they compute
was computed before.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.measure import parser, results_folder, write_csv
from drivetrain_jax.runs import toml
from tests.oracles.cardan_reference import BASE_CASE

SCENES = Path(__file__).resolve().parents[1] / "sweeps"
# Wanted CPU seconds of a later process, and of the first one where it has an aim of its own.
AIMS = {
    "point, stability": (1.2, None),
    "point, forced motion": (2.0, 5.0),
    "query of an atlas": (1.0, None),
    "plot of an atlas": (3.0, None),
    "run of a chart": (2.5, None),
    "run of a rattle response": (3.0, None),
    "chart and its figure": (4.0, None),
}


def commands(folder: Path, turn: int) -> dict[str, list[list[str]]]:
    """The commands of every line in this turn; ``turn`` changes their values."""
    shaft = [f"{name}={value}" for name, value in (BASE_CASE | {"beta": 0.3 + 0.01 * turn, "Omega": 1.2}).items()]
    atlas = str(folder / "atlas.nc")
    chart, response, first = (str(folder / f"{name}{turn}.nc") for name in ("chart", "response", "first"))
    quickstart, gears = (_changed(folder, turn, *change) for change in _CHANGES)
    return {
        "point, stability": [["point", "cardan", "floquet", *shaft]],
        "point, forced motion": [["point", "cardan", "forced", *shaft]],
        "query of an atlas": [["query", atlas, f"beta={0.3 + 0.01 * turn}", "Omega=1.2"]],
        "plot of an atlas": [["plot", atlas, "--out", str(folder / f"atlas{turn}.png")]],
        "run of a chart": [["run", quickstart, "--out", chart]],
        "run of a rattle response": [["run", gears, "--out", response]],
        "chart and its figure": [
            ["run", str(SCENES / "quickstart.toml"), "--out", first],
            ["plot", first, "--out", str(folder / f"first{turn}.png")],
        ],
    }


_CHANGES = (("quickstart", "zeta", 0.001, 1e-4), ("rattle_fig3", "B1", 0.03, 1e-3))


def _changed(folder: Path, turn: int, name: str, parameter: str, value: float, step: float) -> str:
    scene = tomllib.loads((SCENES / f"{name}.toml").read_text())
    path = folder / f"{name}{turn}.toml"
    path.write_text(toml.write(scene | {"fixed": scene["fixed"] | {parameter: value + (turn + 1) * step}}))
    return str(path)


def spent(lines: Sequence[Sequence[str]], cache: Path) -> tuple[float, float]:
    """CPU and wall-clock seconds of commands of the package, one after the other."""
    cpu, begin = 0.0, time.perf_counter()
    for words in lines:
        process = subprocess.Popen(
            [sys.executable, "-m", "drivetrain_jax.cli", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        )  # fmt: skip
        _, code, usage = os.wait4(process.pid, 0)
        if code:
            raise RuntimeError(f"{' '.join(words)}: exit code {os.waitstatus_to_exitcode(code)}")
        cpu += usage.ru_utime + usage.ru_stime
    return cpu, time.perf_counter() - begin


def measure(folder: Path, repeats: int) -> list[dict[str, Any]]:
    """A row for every command: the first process, then medians of ``repeats`` later ones, in turns."""
    spent([["run", str(SCENES / "cardan_atlas.toml"), "--out", str(folder / "atlas.nc")]], folder / "atlas cache")
    turns = [
        {name: spent(lines, folder / name) for name, lines in commands(folder, turn).items()}
        for turn in range(repeats + 1)
    ]
    rows = []
    for name, (aim, first_aim) in AIMS.items():
        (first, _), *later = (turn[name] for turn in turns)
        cpu, wall = map(median, zip(*later, strict=True))
        row = {"command": name, "first_cpu_s": first, "first_aim_s": first_aim or ""}
        rows.append(row | {"cpu_s": cpu, "aim_s": aim, "wall_s": wall})
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all commands and write the file."""
    options = parser(__doc__).parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), 1 if options.quick else 5)
    note = "CPU seconds of a process, its start included; first: without compiled code; later: medians of processes with it"
    write_csv(results_folder(options) / "waiting.csv", rows, [note])


if __name__ == "__main__":
    main()
