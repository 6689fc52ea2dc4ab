"""Digests of everything that affects the bits of a result. Only work with the same digest may be resumed."""

from __future__ import annotations

import ast
import inspect
import os
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax

import drivetrain_jax
from drivetrain_jax._machine import instruction_set
from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.scene import Problem
from drivetrain_jax.store.provenance import digest, source_digest, versions

PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
_ROOT = Path(drivetrain_jax.__file__).parent
_ENGINE = ("runs/grid.py", "runs/plan.py", "runs/kernel.py")
# A source file of points that are evaluated from an atlas, and of no others.
EVALUATES_ATLAS = "runs/through_atlas.py"
ATLAS_SOURCES: tuple[str, ...] = ("atlas/floquet.py", "runs/atlas_choice.py", "runs/rounds.py", EVALUATES_ATLAS)
# Packages whose sources affect the numbers.
_NUMERIC = ("drivetrain_jax._quantities", "drivetrain_jax.systems", "drivetrain_jax.analysis", "drivetrain_jax.atlas")


def numerics_of(scene: Problem, sources: Sequence[str]) -> dict[str, Any]:
    """The sources that this scene runs (``sources`` are those of its route), the package versions, and the instruction
    set: all that affects the bits. Sources of other systems and analyses are not included."""
    starts = [_ROOT / name for name in (*_ENGINE, *sources)]
    for function in (scene.analysis.model(scene.system).build, scene.analysis.solvers):
        # Neither a partial nor what is wrapped around a method has a source of its own.
        starts.append(Path(inspect.getsourcefile(inspect.unwrap(getattr(function, "func", function))) or ""))
    return {
        "sources": {name: _source_digest(name, path) for name, path in _sources(tuple(starts))},
        "versions": versions(PACKAGES),
        "x64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
        "backend": jax.default_backend(),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "instructions": " ".join(sorted(instruction_set())),
    }


# The code that runs is the one that was there when it was imported, not one that is edited since.
@cache
def _source_digest(name: str, path: Path) -> str:
    return source_digest({name: path})


@cache
def _sources(starts: tuple[Path, ...]) -> tuple[tuple[str, Path], ...]:
    """The files ``starts`` and all numeric code that they import, by name."""
    return tuple(sorted((_label(path), path) for path in _imported(starts)))


def _label(path: Path) -> str:
    return path.relative_to(_ROOT if _ROOT in path.parents else _home(path)).as_posix()


@cache
def _home(path: Path) -> Path:
    """The folder that contains the package of a source file."""
    folder = path.parent
    while (folder / "__init__.py").is_file():
        folder = folder.parent
    return folder


def _imported(starts: Sequence[Path]) -> set[Path]:
    """The source files ``starts`` and everything they import from their own packages and the numeric ones."""
    found: set[Path] = set()
    waiting = [path for path in starts if path.is_file()]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [file for name in _imports(path) for file in _files(name, path)]
    return found


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """Dotted names that a source file imports; ``from x import y`` gives ``x.y``."""
    package = path.relative_to(_home(path)).parts[:-1]
    names: list[str] = []
    for node in _statements(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*above, *filter(None, [node.module])))
            names += [f"{module}.{alias.name}" for alias in node.names]
    return (*names, ".".join(package)) if package else tuple(names)


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements within ``node``. Visiting expressions too would take twice as long as parsing."""
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, block, ()):
            yield inner
            yield from _statements(inner)


@cache
def _files(name: str, importer: Path) -> list[Path]:
    """Modules that importing the dotted ``name`` runs: numeric code of this package, or code of the package of
    ``importer``."""
    home, parts, first = _home(importer), name.split("."), 0
    if parts[0] == drivetrain_jax.__name__:
        if not any(name == package or name.startswith(package + ".") for package in _NUMERIC):
            return []
        home, first = _ROOT.parent, 1
    elif parts[0] != importer.relative_to(home).with_suffix("").parts[0]:
        return []
    stems = [home.joinpath(*parts[: k + 1]) for k in range(first, len(parts))]
    return [file for stem in stems for file in (stem.with_suffix(".py"), stem / "__init__.py") if file.is_file()]


def scene_content(scene: Problem) -> dict[str, Any]:
    """The content of a scene without its title."""
    request = scene.request
    return {
        "system": scene.system.name,
        "analysis": scene.analysis.name,
        "outputs": request.outputs,
        "method": request.method,
        "options": dict(request.options),
        "axes": [[axis.name, axis.values] for axis in scene.axes],
        "zipped": scene.zipped,
        "fixed": dict(scene.fixed),
    }


def scene_digest(scene: Problem, solvers: Sequence[Solver], numerics: str) -> str:
    """Digest of scene (without title), chunk sizes, package version and numerics."""
    return digest(
        scene_content(scene)
        | {
            "solvers": [[solver.name, solver.chunk, solver.unit_cost] for solver in solvers],
            "version": drivetrain_jax.__version__,
            "numerics": numerics,
        }
    )
