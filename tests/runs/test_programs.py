"""Stored kernels: later processes neither trace nor compile, and no damaged or foreign kernel is used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivetrain_jax._programs import program_identity
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems.planetary import Planetary

# Prints the results of two points and the number of compilations.
POINT = """
import jax
import drivetrain_jax as dt
compiled = []
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
for k_sp in (4e8, 4.5e8):
    scene = {"system": "planetary", "analysis": "modes", "fixed": {"k_sp": k_sp}}
    print(dt.run(scene).natural_frequency.values.tobytes().hex())
print(compiled.count("/jax/core/compile/backend_compile_duration"))
"""
CALLBACK = """
import jax, jax.numpy as jnp, numpy as np
from drivetrain_jax import _programs
from drivetrain_jax.runs import kernel
_programs.enable(short=True)
def called(x):
    return jax.pure_callback(lambda v: np.asarray(v) + 1, jax.ShapeDtypeStruct((3,), x.dtype), x)
kinds = (jax.ShapeDtypeStruct((3,), np.float64),)
print(_programs.compiled(called, kinds, {}, "name")(jnp.zeros(3)))
"""


def lines(script, folder, *arguments):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["DRIVETRAIN_JAX_CACHE"] = str(folder)
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def stored(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("programs/*"))


@pytest.mark.full
def test_a_later_process_traces_nothing_and_gets_the_same_bits(tmp_path):
    first = lines(POINT, tmp_path)
    assert first[-1] == "1" and len(stored(tmp_path)) == 1
    assert lines(POINT, tmp_path) == [*first[:-1], "0"]
    # JAX's own cache still has the kernel, but its copy cannot be stored again.
    stored(tmp_path)[0].unlink()
    assert lines(POINT, tmp_path) == first and lines(POINT, tmp_path) == [*first[:-1], "0"]
    # Without a cache nothing is stored, and the bits are the same.
    assert lines(POINT, "0") == first


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param("cut", marks=pytest.mark.full),
        pytest.param("bit", marks=pytest.mark.full),
        pytest.param("empty", marks=pytest.mark.full),
    ],
)
def test_a_damaged_program_is_replaced(tmp_path, damage):
    first = lines(POINT, tmp_path)
    (file,) = stored(tmp_path)
    data = file.read_bytes()
    changed = bytearray(data)
    changed[len(data) // 2] ^= 8
    file.write_bytes({"cut": data[:-100], "bit": bytes(changed), "empty": b""}[damage])
    assert lines(POINT, tmp_path) == first and lines(POINT, tmp_path) == [*first[:-1], "0"]


@pytest.mark.full
def test_a_program_that_calls_python_is_not_stored(tmp_path):
    assert lines(CALLBACK, tmp_path) == ["[1.", "1.", "1.]"] and stored(tmp_path) == []


def test_identity_follows_the_content_and_the_code(monkeypatch):
    analysis = load_scene({"system": "planetary", "analysis": "modes"}).analysis
    one, other = (program_identity(Planetary, analysis, content) for content in ("a", "b"))
    assert one and other and one != other
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert program_identity(Planetary, analysis, "a") != one
    monkeypatch.setattr("drivetrain_jax._programs._packages", lambda *_: {"elsewhere"})
    assert program_identity(Planetary, analysis, "a") == ""


# Sweeps two functions of one name, and prints what they give.
FUNCTION = """
import sys
import drivetrain_jax as dt
factor = float(sys.argv[1])
print(dt.sweep(lambda point: {"y": factor * point["a"]}, {"a": 1.0}, over={"a": [1.0, 2.0]}).y.values.tolist())
"""


@pytest.mark.full
def test_functions_of_a_user_are_not_stored(tmp_path):
    """Two processes sweep functions of one name and one file."""
    assert lines(FUNCTION, tmp_path, "2") == ["[2.0,", "4.0]"] and stored(tmp_path) == []
    assert lines(FUNCTION, tmp_path, "3") == ["[3.0,", "6.0]"]


# Packages that would take half of the time of an answer.
HEAVY = {"diffrax", "scipy", "xarray", "pandas", "matplotlib", "dask", "pint"}
# Runs a command; prints the numbers of compilations, of kernels traced for JAX's own cache and of traced charts, and
# the imported packages.
COMMAND = """
import sys
from types import SimpleNamespace
from drivetrain_jax.cli import main
import jax
events, traced, chart = [], [], SimpleNamespace(_curves=None)
if sys.argv[1] == "plot":
    import drivetrain_jax.runs.atlas_chart as chart
trace = chart._curves
chart._curves = lambda *a: traced.append(1) or trace(*a)
WATCHED = "/jax/core/compile/backend_compile_duration", "/jax/compilation_cache/cache_retrieval_time_sec"
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: event in WATCHED and events.append(event))
stdout, sys.stdout = sys.stdout, sys.stderr
assert main(sys.argv[1:]) == 0
compiled, found = map(events.count, WATCHED)
print(compiled - found, found, len(traced), *sys.modules, file=stdout)
"""
SHAFT = ["zeta=0.001", "alpha=1", "mu=1", "gamma=100"]


def test_answers_import_nothing_heavy():
    code = """if True:
        import sys
        import drivetrain_jax.runs.atlas_answers, drivetrain_jax.runs.point
        from drivetrain_jax.systems.cardan import Cardan
        Cardan(beta=0.3, Omega=1.0, zeta=0.0, alpha=1.0, mu=1.0, gamma=1.0).floquet_model()
        print(*sys.modules)"""
    assert not HEAVY & set(lines(code, "0"))


@pytest.mark.full
def test_a_second_answer_neither_compiles_nor_imports_much(tmp_path):
    scene = Path(__file__).parents[2] / "sweeps" / "cardan_atlas.toml"
    file, figures = str(tmp_path / "atlas.nc"), [str(tmp_path / f"{i}.png") for i in range(3)]
    small = ["axes.beta.stop=0.2", "axes.Omega.start=1.0", "axes.Omega.stop=1.2"]
    lines(COMMAND, tmp_path, "run", str(scene), "--out", file, *(word for each in small for word in ("--set", each)))
    point = ["point", "cardan", "floquet", "beta=0.1", "Omega=1.1", *SHAFT]
    for command in (point, ["query", file, "beta=0.1", "Omega=1.1"]):
        assert int(lines(COMMAND, tmp_path, *command)[0]) > 0
        compiled, small, _, *modules = lines(COMMAND, tmp_path, *command)
        # The gradient by the data of a question is six programs of one operation each, 60 ms in all.
        assert compiled == "0" and int(small) <= 10 and not HEAVY & set(modules)
    assert lines(COMMAND, tmp_path, "plot", file, "--out", figures[0])[2] == "1"
    # The curves of a read-only atlas are kept as well, but not those of another part of it.
    Path(file).chmod(0o444)
    compiled, small, traced, *_ = lines(COMMAND, tmp_path, "plot", file, "--out", figures[1])
    assert (compiled, traced) == ("0", "0") and int(small) <= 3
    assert Path(figures[0]).read_bytes() == Path(figures[1]).read_bytes()
    assert lines(COMMAND, tmp_path, "plot", file, "--part", "beta=0.1:0.2", "--out", figures[2])[2] == "1"
