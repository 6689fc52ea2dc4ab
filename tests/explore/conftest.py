"""Atlases of one to four parameters, and the programs that run the modules of the page."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax import systems
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves
from tests.atlases import atlas_file

BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
SPEED = {"start": 0.4, "stop": 2.0}
SCENES: dict[str, dict[str, Any]] = {
    "one": {"axes": {"Omega": SPEED}, "fixed": {"beta": 0.6}},
    "two": {"axes": {"beta": {"start": -0.2, "stop": 1.4}, "Omega": {"start": 0.2, "stop": 2.0}}},
    "three": {"axes": {"beta": {"start": 0.0, "stop": 1.0}, "Omega": SPEED, "zeta": {"start": 0.0, "stop": 0.02}}},
    "four": {
        "axes": {
            "beta": {"start": 0.0, "stop": 0.8},
            "Omega": {"start": 0.8, "stop": 1.8},
            "mu": {"start": 0.8, "stop": 1.3},
            "alpha": {"start": 0.5, "stop": 2.0},
        },
        "options": {"rtol": 1e-7},
    },
    "mathieu": {
        "system": "mathieu",
        "axes": {"q": {"start": 0.0, "stop": 1.0}, "Omega": {"start": 0.5, "stop": 2.0}},
        "fixed": {"zeta": 0.01},
    },
}
SCENES["undamped"] = SCENES["mathieu"] | {"fixed": {"zeta": 0.0}}
NODE = shutil.which("node")
SCRIPT = Path(__file__).parent / "ask.mjs"


class Mathieu(System):
    """x'' + 2 zeta x'/Omega + (1 + 2 q cos(2 tau)) x/Omega^2 = 0: two states, no reversor, no coordinates of its own."""

    name = "mathieu"
    title = "Mathieu's oscillator"

    q: float = parameter("1", "depth of the excitation", lower=0.0)
    Omega: float = parameter("1", "speed", lower=0.0, open_lower=True)
    zeta: float = parameter("1", "damping ratio", lower=0.0)

    def rows(self, tau):
        stiffness = (1 + 2 * self.q * jnp.cos(2 * tau)) / self.Omega**2
        return (0, 1.0), (-stiffness, -2 * self.zeta / self.Omega)

    def log_determinant(self):
        return -2 * math.pi * self.zeta / self.Omega

    @serves("atlas")
    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, math.pi, log_determinant=self.log_determinant)
        return FloquetModel(natural=form, reduced=form)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Register the system of this folder for each test; a fixture of the session would leave it to the next folder."""
    monkeypatch.setitem(systems._REGISTERED, "mathieu", Mathieu)


@pytest.fixture(scope="session")
def atlases(tmp_path_factory):
    """A function of a name of `SCENES`: the atlas, computed once. Files stand in ``folder`` under their names."""
    found, folder = {}, tmp_path_factory.mktemp("atlases")

    def atlas(name: str):
        if name not in found:
            scene = {"system": "cardan", "analysis": "atlas", "title": f"atlas {name}", **SCENES[name]}
            cardan = scene["system"] == "cardan"
            fixed = {n: v for n, v in BASE.items() if n not in scene["axes"]} if cardan else {}
            scene |= {"fixed": fixed | scene.get("fixed", {})}
            if cardan:
                shutil.copy(atlas_file(scene), folder / f"{name}.nc")
            else:
                dt.run(scene, out=folder / f"{name}.nc")
            found[name] = dt.open_atlas(folder / f"{name}.nc")
        return found[name]

    atlas.folder = folder  # pyright: ignore[reportFunctionMemberAccess]
    return atlas


def node(*arguments: Any) -> Any:
    """The answer of ``ask.mjs``, from JSON; skips the test without Node."""
    if NODE is None:
        pytest.skip("no node on this machine: the modules of the page are tested where there is one")
    done = subprocess.run([NODE, str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def columns(atlas, points: np.ndarray) -> dict[str, np.ndarray]:
    """Results of Python at points ``(N, d)``; points in gaps are not solved."""
    names = atlas.parameters
    found = atlas.arrays(dict(zip(names, points.T, strict=True)), zipped=True, solve=False)
    return {name: np.asarray(values) for name, values in found.items()}
