"""What holds the package together: who imports what, double precision, and kernels that may run side by side."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from drivetrain_jax.analysis import Request, analysis_names, get_analysis
from drivetrain_jax.systems import get_system, system_names

ROOT = Path(__file__).parents[1]


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_imports_run_only_downwards():
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert " 0 broken" in done.stdout and " 0 kept" not in done.stdout


HEAVY = ("jax", "numpy", "scipy", "xarray", "diffrax", "matplotlib", "h5py")


@pytest.mark.parametrize("module", ["drivetrain_jax", "drivetrain_jax.cli"])
def test_import_is_light(module):
    assert python(f"import sys, {module}; print(sorted(set({HEAVY}) & set(sys.modules)))") == "[]"


@pytest.mark.parametrize(
    "module", ["drivetrain_jax.view", "drivetrain_jax.store.chunks", "drivetrain_jax.store.schema"]
)
def test_store_and_view_do_without_jax(module):
    assert python(f"import sys, {module}; print('jax' in sys.modules)") == "False"


COMPUTING = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for layer in ("systems", "analysis")
    for path in sorted((ROOT / "drivetrain_jax" / layer).glob("*.py"))
] + ["drivetrain_jax.sweep.kernel"]


def test_every_computing_module_works_in_double_precision():
    """Each alone and first, in a process of its own: forked from one that has loaded the libraries and computed nothing."""
    code = f"""
import importlib, os
import diffrax, jax, scipy.integrate, xarray
assert not jax.config.jax_enable_x64
for name in {COMPUTING}:
    child = os.fork()
    if child == 0:
        importlib.import_module(name)
        os._exit(0 if jax.config.jax_enable_x64 else 1)
    if os.waitpid(child, 0)[1]:
        print(name)
"""
    assert len(COMPUTING) > 10
    assert python(code) == ""


def solvers() -> list:
    """All solvers of all analyses of the package's systems, with an explicit and the implicit diffrax solver."""
    found = []
    for system in map(get_system, system_names()):
        for analysis in (get_analysis(name) for name in analysis_names() if name in system.models):
            outputs = tuple(v.name for v in analysis.variables)
            for method in set(analysis.methods) - {"auto"}:
                used = {p.name: p.default for p in analysis.options if p.name in analysis.methods[method]}
                for options in (used, used | {"solver": "Kvaerno5"}) if "solver" in used else (used,):
                    for solver in analysis.solvers(system, Request(outputs, method, options)):
                        found.append(pytest.param(system, analysis, solver, id=f"{system.name} {method} {solver.name}"))
    return sorted(found, key=lambda parameter: parameter.id)


@pytest.mark.parametrize(("system", "analysis", "solver"), solvers())
def test_kernels_do_not_call_lapack(system, analysis, solver):
    """Kernels that call it may not run side by side. Only diffrax's implicit solver needs to: the proof that it shows."""
    shape = (2,) if solver.broadcasts else ()
    values = {name: jax.ShapeDtypeStruct(shape, float) for name in system.models[analysis.name].parameters}
    lowered = jax.jit(solver.solve).lower(values, jax.ShapeDtypeStruct((), np.int64))
    assert ("lapack" in lowered.as_text().lower()) is ("Kvaerno5" in solver.name)
