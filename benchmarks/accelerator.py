"""Points a second on an accelerator and on all cores of the same machine, and the difference of the two results.

    python -m benchmarks.accelerator      # results/accelerator.csv; needs a jax with the accelerator's plugin

The scenes are like those of benchmarks.batches, one per system, and are timed from the scene to the result in memory.
For each of the two devices a process of its own runs every scene once, which compiles (``first_s``), and three times more;
rates are medians of these three. Differences are relative to the largest value of a result. Lyapunov spectra have none,
because their trajectories separate. The atlas is left out: its kernel compiles for 3 minutes on a GPU.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.batches_scenes import FOUR, cells, gears, motion, rattle, shafts
from benchmarks.timing import median, parser, results_folder, table, write_csv

_REPEATS = 3
_NOT_COMPARED = ("verdict", "lyapunov_spectrum")


def scenes(quick: bool) -> dict[str, dict[str, Any]]:
    """The scenes by name."""
    few = 100 if quick else 1
    return {
        "cardan, chart direct": cells(1_000_000 // few),
        "planetary, natural frequencies": gears(FOUR, 200_000 // few),
        "bicardan, critical speeds": shafts(200_000 // few),
        "rattle, steady state": rattle(("u_max", "u_min"), 8192 // few),
        "tripod, Lyapunov spectrum": motion(
            "lyapunov", ("lyapunov_spectrum",), 1024 // few, max_time=512 / 3066.5, steps=24
        ),
    }


def measure(folder: Path, quick: bool) -> None:
    """Run all scenes in this process; seconds and the name of the device go to ``folder``/times.json, results to .npz."""
    import jax

    import drivetrain_jax as dt

    if jax.default_backend() == "cpu" and os.environ.get("JAX_PLATFORMS") != "cpu":
        sys.exit("accelerator: jax finds none")
    told: dict[str, Any] = {"device": jax.devices()[0].device_kind}
    for number, (name, scene) in enumerate(scenes(quick).items()):
        seconds = []
        for _ in range(_REPEATS + 1):
            start = time.perf_counter()
            found = dt.run(scene)
            seconds.append(time.perf_counter() - start)
        np.savez(folder / f"{number}.npz", **{output: found[output].values for output in scene["outputs"]})
        told[name] = {"points": found["outcome"].size, "first_s": seconds[0], "seconds": median(seconds[1:])}
        print(f"{told['device']}: {name} {seconds[0]:.1f} s, then {told[name]['seconds']:.3g} s", flush=True)
    (folder / "times.json").write_text(json.dumps(told))


def difference(first: Path, second: Path) -> float:
    """The largest difference of two result files, relative to the largest value of each result; NaN if none is compared."""
    with np.load(first) as a, np.load(second) as b:
        compared = (name for name in a.files if name not in _NOT_COMPARED)
        return max((float(np.nanmax(np.abs(a[n] - b[n])) / np.nanmax(np.abs(a[n]))) for n in compared), default=np.nan)


def row(number: int, name: str, told: Sequence[dict[str, Any]], folders: Sequence[Path]) -> dict[str, Any]:
    """A line of accelerator.csv, from times and results of the accelerator and of the cores."""
    device, cores = (one[name] for one in told)
    return {
        "scene": name,
        "points": cores["points"],
        "cores_per_s": cores["points"] / cores["seconds"],
        "accelerator_per_s": device["points"] / device["seconds"],
        "times": cores["seconds"] / device["seconds"],
        "first_s": device["first_s"],
        "difference": difference(*(folder / f"{number}.npz" for folder in folders)),
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print and write; on a machine without an accelerator only print a message."""
    options = parser(__doc__)
    options.add_argument("--measure", type=Path, help="only run the scenes, in this process")
    chosen = options.parse_args(argv)
    if chosen.measure:
        return measure(chosen.measure, chosen.quick)
    with tempfile.TemporaryDirectory() as place:
        folders, told = [], []
        for name, own in (("accelerator", {}), ("cores", {"JAX_PLATFORMS": "cpu"})):
            folders.append(Path(place, name))
            folders[-1].mkdir()
            words = [sys.executable, "-m", "benchmarks.accelerator", "--measure", str(folders[-1])]
            done = subprocess.run(words + ["--quick"] * chosen.quick, check=False, env=dict(os.environ) | own)
            if done.returncode:
                sys.exit(done.returncode)
            told.append(json.loads((folders[-1] / "times.json").read_text()))
        rows = [row(i, name, told, folders) for i, name in enumerate(scenes(chosen.quick))]
    notes = [f"{told[0]['device']}; from scene to result in memory, compiled before; first_s with compilation"]
    write_csv(results_folder(chosen) / "accelerator.csv", rows, notes)
    print(table(rows))


if __name__ == "__main__":
    main()
