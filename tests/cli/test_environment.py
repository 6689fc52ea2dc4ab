"""Variables of the environment that point the command to what the machine does not have."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.sizes import full_after

POINT = ["point", "cardan", "floquet", "beta=.4", "Omega=1.2", "zeta=.001", "alpha=1", "mu=1", "gamma=100"]
SCENE = """
system = "tripod"
analysis = "parameters"
outputs = ["parametric_excitation"]
fixed = { element = "input", zeta = 0.0016 }
axes.beta = { values = [0.1, 0.2, 0.3] }
"""


def drivetrain(*words, **variables):
    command = [sys.executable, "-m", "drivetrain_jax.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | variables)


@pytest.mark.parametrize("name", full_after(1, ["rocm", "rubbish"]))
def test_a_platform_that_is_not_there_is_one_line(name):
    done = drivetrain(*POINT, JAX_PLATFORMS=name)
    assert done.returncode == 2 and done.stdout == ""
    said = f"JAX_PLATFORMS = '{name}': jax cannot use it on this machine; set cpu, or unset the variable"
    assert done.stderr == f"drivetrain: {said}\n"


@pytest.mark.full
def test_figures_need_no_window_system(tmp_path):
    (tmp_path / "s.toml").write_text(SCENE)
    result, figure = str(tmp_path / "r.nc"), tmp_path / "f.png"
    assert drivetrain("run", str(tmp_path / "s.toml"), "--out", result).returncode == 0
    assert drivetrain("plot", result, "--out", str(figure), MPLBACKEND="nothing").returncode == 0
    assert figure.read_bytes().startswith(b"\x89PNG")
