"""The cache of compiled code on disk, for sweeps and for calls of analyses."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.sizes import full_after

SWEEP = """
from drivetrain_jax import _programs
import jax
_programs.enable(short=True)
print(jax.config.jax_compilation_cache_dir)
jax.jit(lambda x: x + 1)(1.0)
"""
CALL = """
import jax
import drivetrain_jax as dt
gear = dt.Planetary()
dt.modes(gear, outputs=["natural_frequency"])
jax.jit(lambda gear: dt.modes(gear, outputs=["natural_frequency"]).natural_frequency)(gear)
print(jax.config.jax_compilation_cache_dir)
"""
TINY = """
def tiny(x):
    return x + 1

jax.jit(tiny)(1.0)
"""
OWN = (
    *("DRIVETRAIN_JAX_CACHE", "XDG_CACHE_HOME", "JAX_ENABLE_X64"),
    *("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"),
)


def folder_used(script: str, **environment: str) -> str:
    keep = {k: v for k, v in os.environ.items() if k not in OWN}
    done = subprocess.run(
        [sys.executable, "-c", script], env=keep | environment, capture_output=True, text=True, check=True
    )
    assert not done.stderr
    return done.stdout.strip()


def test_compiled_code_is_kept_in_a_private_folder(tmp_path):
    folder = folder_used(SWEEP, XDG_CACHE_HOME=str(tmp_path))
    assert folder.startswith(str(tmp_path / "drivetrain_jax")) and len(os.listdir(folder)) > 0
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700


@pytest.mark.parametrize("setting", full_after(1, ["0", "a file"]))
def test_cache_is_off_by_setting_or_without_a_folder(tmp_path, setting):
    if setting == "a file":
        (tmp_path / "file").touch()
        setting = str(tmp_path / "file")
    assert folder_used(SWEEP, DRIVETRAIN_JAX_CACHE=setting, XDG_CACHE_HOME=str(tmp_path)) == "None"


@pytest.mark.full
def test_calls_compile_once_for_all_processes(tmp_path):
    def entries() -> dict[str, int]:
        stored = [*Path(folder).glob("*-cache"), *Path(folder, "programs").iterdir()]
        return {x.name: x.stat().st_size for x in stored}

    every = {"XDG_CACHE_HOME": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    folder = folder_used(CALL, **every)
    first = entries()
    assert len(os.listdir(Path(folder, "programs"))) == 1 and any("lambda" in name for name in first)
    assert folder_used(CALL, **every) == folder and entries() == first


@pytest.mark.full
def test_calls_leave_a_cache_of_the_user_and_short_programs_alone(tmp_path):
    own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own"), "XDG_CACHE_HOME": str(tmp_path)}
    assert folder_used(CALL, **own) == str(tmp_path / "own")
    del own["JAX_COMPILATION_CACHE_DIR"]
    folder = folder_used(CALL + TINY, **own)
    assert not any("tiny" in name for name in os.listdir(folder))


def test_the_oldest_entries_are_removed(tmp_path):
    folder = Path(folder_used(SWEEP, XDG_CACHE_HOME=str(tmp_path)))
    for n in range(1001):
        path = folder / f"old{n}-cache"
        path.write_bytes(bytes(8))
        os.utime(path, (n, n))
    (own,) = (path.name for path in folder.iterdir() if not path.name.startswith("old"))
    folder_used(SWEEP, XDG_CACHE_HOME=str(tmp_path))
    after = {path.name for path in folder.iterdir() if path.is_file()}
    assert len(after) == 1000 and own in after and "old2-cache" in after and "old1-cache" not in after
