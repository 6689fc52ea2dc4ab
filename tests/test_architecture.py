"""Structure of the package: imports, and kernels that may run side by side."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from drivetrain_jax._rules import BUILT_IN
from drivetrain_jax.analysis import analysis_names, get_analysis
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems import get_system, system_names

ROOT = Path(__file__).parents[1]


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def _sources() -> dict[str, Path]:
    """Every module of the package and of the benchmarks by its dotted name."""
    files = [path for top in ("drivetrain_jax", "benchmarks") for path in sorted((ROOT / top).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def _runtime(node: ast.AST) -> Iterator[ast.AST]:
    """Everything within ``node``, also inside functions, without what only type checkers see."""
    for inner in ast.iter_child_nodes(node):
        if not (isinstance(inner, ast.If) and "TYPE_CHECKING" in ast.unparse(inner.test)):
            yield inner
            yield from _runtime(inner)


def _imported_names(name: str, path: Path) -> Iterator[str]:
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in _runtime(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*above, *filter(None, [node.module])])
            yield from (f"{module}.{alias.name}" for alias in node.names)


def test_no_files_import_each_other():
    """Strongly connected components of the graph of all imports have size one."""
    sources, graph = _sources(), {}
    for name, path in sources.items():
        graph[name] = set()
        for target in _imported_names(name, path):
            while target and target not in sources:
                target = target.rpartition(".")[0]
            graph[name] |= {target} - {"", name}
    names = list(graph)
    rows = [(names.index(name), names.index(target)) for name, targets in graph.items() for target in targets]
    edges = csr_matrix((np.ones(len(rows)), np.array(rows).T), (len(names), len(names)))
    _, labels = connected_components(edges, connection="strong")
    assert len(names) > 100 and len(rows) > 500
    cycles = [[name for name, label in zip(names, labels, strict=True) if label == k] for k in np.unique(labels)]
    assert [cycle for cycle in cycles if len(cycle) > 1] == []


def test_every_analysis_of_the_package_has_a_record():
    assert set(BUILT_IN) == set(analysis_names())


HEAVY = ("jax", "numpy", "scipy", "xarray", "diffrax", "matplotlib", "h5py")


@pytest.mark.parametrize("module", ["drivetrain_jax", "drivetrain_jax.cli"])
def test_import_is_light(module):
    assert python(f"import sys, {module}; print(sorted(set({HEAVY}) & set(sys.modules)))") == "[]"


@pytest.mark.parametrize("module", ["_rules", "invariants", "view.charts"])
def test_a_module_that_imports_xarray_may_be_the_first(module):
    """The first import of xarray registers the accessor, which imports modules of figures."""
    assert python(f"import drivetrain_jax.{module}, xarray; print(hasattr(xarray.Dataset, 'drivetrain'))") == "True"


def scenes() -> dict[tuple[str, str], dict]:
    """The first scene of ``sweeps/`` for every analysis of every system of the package, with its default results."""
    found: dict[tuple[str, str], dict] = {}
    for path in sorted((ROOT / "sweeps").glob("*.toml")):
        scene = tomllib.loads(path.read_text())
        scene.pop("outputs", None)
        found.setdefault((scene["system"], scene["analysis"]), scene)
    return found


def methods() -> list:
    """Every method of these scenes' analyses, and the implicit diffrax solver besides the default one."""
    found = []
    for (system, analysis), scene in scenes().items():
        offered = get_analysis(analysis).for_system(get_system(system))
        for method, used in offered.methods.items():
            given = {name: value for name, value in scene.get("options", {}).items() if name in used}
            variants = (
                [given, given | {"solver": "Kvaerno5"}] if analysis == "floquet" and "solver" in used else [given]
            )
            lacking = {"auto", *offered.lacks(get_system(system))}
            for options in variants if method not in lacking else []:
                label = f"{system} {analysis} {method} {options.get('solver', '')}".strip()
                found.append((label, scene | {"options": options | {"method": method}}))
    return found


def test_every_analysis_of_every_system_has_a_scene():
    assert set(scenes()) == {(s, a) for s in system_names() for a in get_system(s).models if a in analysis_names()}


# Methods that decompose matrices.
SHORT = ("tripod floquet direct", "planetary modes", "bicardan critical_speeds")


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(scene, id=name, marks=[pytest.mark.full] * (not name.startswith(SHORT)))
        for name, scene in methods()
    ],
)
def test_kernels_do_not_call_lapack(scene):
    """Kernels that call it may not run side by side. Only diffrax's implicit solver needs to: the proof that it shows."""
    engine = resolve(load_scene(scene))
    for solver in engine.solvers:
        columns = {axis.name: jax.ShapeDtypeStruct((2,), axis.values.dtype) for axis in engine.grid.axes}
        traced = jax.jit(lambda columns, effort, solve=solver.solve: solve(engine.grid.bind(columns), effort))
        lowered = traced.lower(columns, jax.ShapeDtypeStruct((), np.int64))
        assert ("lapack" in lowered.as_text().lower()) is ("Kvaerno5" in solver.name)


@pytest.mark.parametrize("name", analysis_names())
def test_every_method_says_what_it_is(name):
    analysis = get_analysis(name)
    assert analysis.method_titles.keys() == analysis.methods.keys()


@pytest.mark.parametrize("name", analysis_names())
def test_every_integer_option_ends_where_kernels_can_count(name):
    """Beyond, a motion was not waited for at all, and labels did not fit into memory."""
    for option in get_analysis(name).options:
        assert not option.integer or option.upper < 2**31 or option.name == "seed"


@pytest.mark.parametrize("name", analysis_names())
def test_every_duration_ends_where_kernels_can_count(name):
    """Beyond, nothing came back, and counts of strobes overflowed."""
    for option in get_analysis(name).options:
        assert option.units != "s" or option.upper <= 1e9
