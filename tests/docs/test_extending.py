"""The package that docs/extending.md writes: its files are taken from the page, installed, and its commands are run."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from drivetrain_jax.store.consolidate import open_result

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text()
OFFLINE = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target"]
# All commands in one process, which imports and compiles once; the folder it runs in is not on its path.
SEVERAL = "import sys; from drivetrain_jax.cli import main; sys.exit(any(main(eval(line)) for line in sys.argv[1:]))"


SYSTEM, ANALYSIS = PAGE.split("## A new analysis")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


def executed(text: str, folder: Path) -> tuple[Path, str, Callable[..., str]]:
    """The folder with the files of ``text``, installed, the output of its commands, and Python where these are installed."""
    project, installed = folder / "project", folder / "installed"
    project.mkdir()
    for content in [*blocks(text, "python"), *blocks(text, "toml")]:
        (project / re.match(r"# (\S+)\n", content)[1]).write_text(content)

    def python(*arguments: str, **variables: str) -> str:
        paths = os.pathsep.join([str(installed), str(ROOT)])
        environment = {**os.environ, "PYTHONPATH": paths, "DRIVETRAIN_JAX_CACHE": str(folder / "cache"), **variables}
        done = subprocess.run(
            [sys.executable, *arguments], cwd=project, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    install, *commands, test = [
        shlex.split(line) for line in re.findall(r"^\$ (.*)$", "".join(blocks(text, "console")), re.M)
    ]
    assert (install, test[0]) == (["pip", "install", "."], "python") and {c[0] for c in commands} == {"drivetrain"}
    python("-m", *install, *OFFLINE, str(installed))
    answers = python("-c", SEVERAL, *(repr(command[1:]) for command in commands), PYTHONSAFEPATH="1")
    return project, answers + python(*test[1:]), python


def test_the_page_is_true(tmp_path):
    project, answers, python = executed(SYSTEM, tmp_path)
    assert "angle of both joints" in answers
    assert "points: total=4331 computed=4331 reused=0 failed=0" in answers
    assert "2 passed" in answers

    chart = open_result(project / "chart.nc")
    unstable = chart["verdict"] == 1
    at_one = unstable.sel(Omega=1.0, method="nearest")
    # The tip at beta = 0.1412, between two rows; and nothing unstable far from the predicted speeds.
    assert chart["beta"].values[at_one.values.argmax()] == pytest.approx(0.16)
    assert not unstable.sel(Omega=slice(1.75, 2.0)).any() and 0.1 < float(unstable.mean()) < 0.3
    assert json.loads(chart.attrs["roles"])["speed"] == "Omega"
    predicted = "import drivetrain_jax as dt; print(dt.open_result('chart.nc').drivetrain.resonances().values.tolist())"
    assert python("-c", predicted).strip() == str([1.0, 1 / 2, 1 / 3])
    assert (project / "chart.png").stat().st_size > 20_000


def test_a_new_analysis_serves_the_systems_of_the_package(tmp_path):
    project, answers, _ = executed(ANALYSIS, tmp_path)
    assert "Analysis settling: settling time" in answers and "remaining share" in answers
    assert "points: total=8 computed=8 reused=0 failed=0" in answers
    assert "0 <= settling_periods: holds at 8 points" in answers and "2 passed" in answers
    assert "settling_periods < 1e9: holds at 8 points" in answers
    assert open_result(project / "decay.nc")["settling_periods"].attrs["units"] == "1"
    assert (project / "decay.png").stat().st_size > 5_000
