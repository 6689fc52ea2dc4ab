"""Digests of everything that affects the bits of a result. Only work with the same digest may be resumed."""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax

import drivetrain_jax
from drivetrain_jax._machine import instruction_set
from drivetrain_jax.analysis import Analysis, Solver
from drivetrain_jax.runs.scene import Problem
from drivetrain_jax.store.provenance import digest, source_digest, versions
from drivetrain_jax.systems import System

PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
_ROOT = Path(drivetrain_jax.__file__).parent
# Folders and files of this package that compute numbers, and the files in these folders that only read results.
_FOLDERS = ("systems", "analysis", "atlas")
_ENGINE = ("atlas_choice", "job", "kernel", "over", "plan", "point_grid", "rounds", "through_atlas")
_FILES = ("_quantities", "resonances", "store/shards", *(f"runs/{name}" for name in _ENGINE))
_READER = "figure.py"


def numerics_of(system: type[System], analysis: Analysis, route: str) -> dict[str, Any]:
    """Everything that affects the bits: route, numeric code, package versions, and instruction set.

    The code includes this package, and the packages of the system and of the analysis.
    """
    sources = dict(_own_sources())
    for file in _files(system, analysis):
        sources |= _sources_of(_package_of(file)) if file else {}
    return {
        "route": route,
        "sources": sources,
        "versions": versions(PACKAGES),
        "x64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
        "backend": jax.default_backend(),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "instructions": " ".join(sorted(instruction_set())),
    }


def program_identity(system: type[System], analysis: Analysis, content: object) -> str:
    """Digest of everything that affects a program; empty for code outside of this package.

    Such code may depend on more than its files, such as the arguments of a script.
    """
    if not all(file and _package_of(file) == _ROOT for file in _files(system, analysis)):
        return ""
    return digest([numerics_of(system, analysis, ""), system.name, analysis.name, drivetrain_jax.__version__, content])


def _files(system: type[System], analysis: Analysis) -> list[Path | None]:
    """Files of the code of a system and of an analysis."""
    found: list[Path | None] = []
    for function in (analysis.model(system).build, analysis.solvers):
        # A partial, or a wrapper around a method, has no source of its own.
        file = inspect.getsourcefile(inspect.unwrap(getattr(function, "func", function)))
        found.append(Path(file) if file else None)
    return found


# Cached: later edits of the files do not change the imported code.
@cache
def _own_sources() -> dict[str, str]:
    """Digests of the numeric code of this package, by folder or file."""
    parts = {f"{name}.py": [_ROOT / f"{name}.py"] for name in _FILES}
    for path in sorted(path for name in _FOLDERS for path in (_ROOT / name).rglob("*.py")):
        if path.name != _READER:
            parts.setdefault(path.parent.relative_to(_ROOT).as_posix(), []).append(path)
    return {part: source_digest({path.name: path for path in paths}) for part, paths in parts.items()}


@cache
def _sources_of(package: Path) -> dict[str, str]:
    """Digest of a package (a folder or one file) by its name; empty for this package."""
    if package == _ROOT or not package.exists():
        return {}
    files = package.rglob("*.py") if package.is_dir() else [package]
    return {package.name: source_digest({path.relative_to(package.parent).as_posix(): path for path in files})}


def _package_of(path: Path) -> Path:
    """The outermost package that contains a source file, or the file itself without one."""
    while (path.parent / "__init__.py").is_file():
        path = path.parent
    return path


def scene_content(scene: Problem) -> dict[str, Any]:
    """The content of a scene without its title."""
    request = scene.request
    return {
        "system": scene.system.name,
        "analysis": scene.analysis.name,
        "outputs": request.outputs,
        "method": request.method,
        "options": dict(request.options),
        "axes": [
            [part.name, part.parameter.units, part.values]
            for axis in scene.axes
            for part in (*axis.given, *axis.together)
        ],
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
