"""The wheel works without a checkout: it brings the scenes, which run by name, and its type annotations."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import xarray as xr
import yaml

import drivetrain_jax
from drivetrain_jax.cli import main

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = drivetrain_jax.__version__
SCENES = {path.name for path in (ROOT / "sweeps").glob("*.toml")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built without network from a copy of what is in the repository."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in ("drivetrain_jax", "sweeps"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, source / folder, symlinks=True, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", str(out), str(source)], check=True, capture_output=True, timeout=300)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The wheel's files in a folder of their own."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def drivetrain(installed, cwd, *words):
    """The command with the wheel's package, run in ``cwd``."""
    code = "import sys, drivetrain_jax.cli as cli; print(cli.__file__, flush=True); sys.exit(cli.main(sys.argv[1:]))"
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.stdout.startswith(str(installed)), done.stderr
    return done


def test_the_wheel_holds_the_scenes_and_the_marker_of_types(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {Path(name).name for name in names if name.startswith("drivetrain_jax/sweeps/")} == SCENES
    assert "drivetrain_jax/py.typed" in names
    assert {Path(name).parts[0] for name in names} == {"drivetrain_jax", f"drivetrain_jax-{VERSION}.dist-info"}


def test_every_module_is_in_the_wheel(wheel):
    endings = (".py", ".js", ".css", ".html")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.endswith(endings)}
    files = [path for path in (ROOT / "drivetrain_jax").rglob("*") if path.suffix in endings]
    assert held == {str(path.relative_to(ROOT)) for path in files} and len(files) > 100


def test_scenes_run_by_name_in_an_empty_folder(installed, tmp_path):
    done = drivetrain(installed, tmp_path, "run", "tripod_fig9", "--out", "q.nc", "--set", "axes.beta.num=3", "--quiet")
    assert (done.returncode, done.stderr) == (0, "points: total=3 computed=3 reused=0 failed=0\n")
    assert xr.load_dataset(tmp_path / "q.nc", engine="h5netcdf").sizes == {"beta": 3}
    listed = drivetrain(installed, tmp_path, "list").stdout
    assert all(f"  {Path(name).stem} " in listed for name in SCENES)


def test_a_file_of_this_folder_is_preferred(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(["status", "quickstart", "--out", "q.nc"]) == 0
    assert capfd.readouterr().out == "absent: 0 of 30200 points done, 0 without a value\n"
    Path("quickstart").write_text("system = 5")
    assert main(["status", "quickstart", "--out", "q.nc"]) == 2 and "system = 5" in capfd.readouterr().err


def test_a_name_that_is_nearly_one_is_helped(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(["status", "quikstart", "--out", "q.nc"]) == 2
    hint = "No such file or directory; give the path of a scene file, or a name of `drivetrain list`"
    assert capfd.readouterr().err == f"drivetrain: scene = 'quikstart': {hint} (did you mean quickstart?)\n"


def test_every_version_is_the_same():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == VERSION and citation["license"] == PROJECT["license"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]
    assert f"## {VERSION} " in (ROOT / "CHANGELOG.md").read_text()


def test_hooks_and_make_use_the_same_tools():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    lint = (ROOT / "Makefile").read_text().split("\nlint:")[1].split("\n\n")[0]
    for hook in hooks:
        words = hook["entry"].replace(".venv/bin/", "$(BIN)/").replace(" --force-exclude", "")
        assert words in lint
