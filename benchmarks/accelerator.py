"""Points a second on an accelerator and on all cores of the same machine, and the difference of the two results.

    python -m benchmarks.accelerator      # results/accelerator.csv; needs a jax with the accelerator's plugin

The scenes, one per system, are timed from the scene to the result in memory. For each of the two devices a process of
its own runs every scene once, which compiles (``first_s``), and three times more; rates are medians of these three.
Differences are relative to the largest value of a result. Lyapunov spectra have none, because their trajectories
separate. The atlas is left out: its kernel compiles for 3 minutes on a GPU.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.measure import parser, results_folder, write_csv
from tests.oracles.cardan_reference import BASE_CASE

_REPEATS = 3
_NOT_COMPARED = ("verdict", "lyapunov_spectrum")
_GEAR = {"planet_angle": [0.0, math.pi / 2, math.pi, 3 * math.pi / 2]}
_SHAFT = {"length": [0.07, 0.59, 0.25], "EI": [64427.0, 22157.0, 8350.0], "rhoA": [15.3, 2.81, 5.51], "k_D": 2e7}
_RATTLE = {"B0": 0.05, "B1": 0.03, "b": math.pi / 18, "c": 0.05, "alpha": 0.25, "k": 1.0, "I": 1.0}
_TRIPOD = {"element": "input", "beta": math.radians(9), "chi_n": 0.0026, "excitation_frequency": 3066.5}


def scenes(quick: bool) -> dict[str, dict[str, Any]]:
    """The scenes by name."""

    def scene(what: str, outputs: list[str], axes: Mapping[str, Any], fixed: Mapping[str, Any], **options: Any) -> Any:
        system, analysis = what.split()
        ranges = {name: {"start": a, "stop": b, "num": n // 10 if quick else n} for name, (a, b, n) in axes.items()}
        names = {"system": system, "analysis": analysis, "outputs": outputs}
        return names | {"axes": ranges, "fixed": dict(fixed), "options": options}

    return {
        "cardan, chart direct": scene("cardan floquet", ["spectral_radius", "verdict"],
                                      {"beta": (0, 1.4, 866), "Omega": (0.1, 2, 1155)}, BASE_CASE,
                                      method="direct", rtol=1e-9),
        "planetary, natural frequencies": scene("planetary modes", ["natural_frequency"],
                                                {"k_sp": (1e8, 1e9, 200_000)}, _GEAR),
        "bicardan, critical speeds": scene("bicardan critical_speeds", ["natural_frequency"],
                                            {"k_A": (1e6, 1e9, 200_000)}, _SHAFT),
        "rattle, steady state": scene("rattle steady_state", ["u_max", "u_min"], {"omega": (0.3, 1.5, 8192)}, _RATTLE),
        "tripod, Lyapunov spectrum": scene("tripod lyapunov", ["lyapunov_spectrum"], {"zeta": (0.01, 0.02, 1024)}, _TRIPOD,
                                           max_time=512 / 3066.5, steps=24),
    }  # fmt: skip


def measure(folder: Path, quick: bool) -> None:
    """Run all scenes in this process; seconds and the name of the device go to ``folder``/times.json, results to .npz."""
    import jax

    import drivetrain_jax as dt

    if jax.default_backend() == "cpu" and os.environ.get("JAX_PLATFORMS") != "cpu":
        sys.exit("accelerator: jax finds none")
    measured: dict[str, Any] = {"device": jax.devices()[0].device_kind}
    for number, (name, scene) in enumerate(scenes(quick).items()):
        seconds = []
        for _ in range(_REPEATS + 1):
            start = time.perf_counter()
            results = dt.run(scene)
            seconds.append(time.perf_counter() - start)
        np.savez(folder / f"{number}.npz", **{output: results[output].values for output in scene["outputs"]})
        measured[name] = {"points": results["outcome"].size, "first_s": seconds[0], "seconds": median(seconds[1:])}
        print(f"{measured['device']}: {name} {seconds[0]:.1f} s, then {measured[name]['seconds']:.3g} s", flush=True)
    (folder / "times.json").write_text(json.dumps(measured))


def difference(first: Path, second: Path) -> float:
    """The largest difference of two result files, relative to the largest value of each result; NaN if none is compared."""
    with np.load(first) as a, np.load(second) as b:
        compared = (name for name in a.files if name not in _NOT_COMPARED)
        return max((float(np.nanmax(np.abs(a[n] - b[n])) / np.nanmax(np.abs(a[n]))) for n in compared), default=np.nan)


def row(number: int, name: str, measured: Sequence[dict[str, Any]], folders: Sequence[Path]) -> dict[str, Any]:
    """A line of accelerator.csv, from times and results of the accelerator and of the cores."""
    device, cores = (one[name] for one in measured)
    return {
        "scene": name, "points": cores["points"], "cores_per_s": cores["points"] / cores["seconds"],
        "accelerator_per_s": device["points"] / device["seconds"], "times": cores["seconds"] / device["seconds"],
        "first_s": device["first_s"], "difference": difference(*(folder / f"{number}.npz" for folder in folders)),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print and write; on a machine without an accelerator only print a message."""
    options = parser(__doc__)
    options.add_argument("--measure", type=Path, help="only run the scenes, in this process")
    chosen = options.parse_args(argv)
    if chosen.measure:
        return measure(chosen.measure, chosen.quick)
    with tempfile.TemporaryDirectory() as place:
        folders, measured = [], []
        for name, settings in (("accelerator", {}), ("cores", {"JAX_PLATFORMS": "cpu"})):
            folders.append(Path(place, name))
            folders[-1].mkdir()
            words = [sys.executable, "-m", "benchmarks.accelerator", "--measure", str(folders[-1])]
            done = subprocess.run(words + ["--quick"] * chosen.quick, check=False, env=os.environ | settings)
            if done.returncode:
                sys.exit(done.returncode)
            measured.append(json.loads((folders[-1] / "times.json").read_text()))
        rows = [row(i, name, measured, folders) for i, name in enumerate(scenes(chosen.quick))]
    note = f"{measured[0]['device']}; from scene to result in memory, compiled before; first_s with compilation"
    write_csv(results_folder(chosen) / "accelerator.csv", rows, [note])


if __name__ == "__main__":
    main()
