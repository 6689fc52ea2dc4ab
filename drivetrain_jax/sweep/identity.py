"""What decides every bit of a result: the scene and the numerics. Only work with the same digest may be resumed."""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence
from pathlib import Path

import jax

import drivetrain_jax
from drivetrain_jax.analysis import Solver
from drivetrain_jax.store.provenance import digest, instruction_set, source_digest, versions
from drivetrain_jax.sweep.scene import Scene

PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
_ROOT = Path(drivetrain_jax.__file__).parent
_SOURCES = ("_quantities.py", "systems/*.py", "analysis/*.py", "sweep/grid.py", "sweep/plan.py", "sweep/kernel.py")


def numerics(scene: Scene) -> str:
    """Digest of the code and of the machine's instruction set; versions of everything that computes included."""
    files = {p.relative_to(_ROOT).as_posix(): p for pattern in _SOURCES for p in sorted(_ROOT.glob(pattern))}
    # A system or an analysis of another package brings its own source.
    for function in (scene.system.models[scene.analysis.name].build, scene.analysis.solvers):
        source = Path(inspect.getsourcefile(function) or "")
        if source.is_file() and _ROOT not in source.parents:
            files[source.name] = source
    return digest(
        {
            "sources": source_digest(files),
            "versions": versions(PACKAGES),
            "x64": bool(jax.config.jax_enable_x64),
            "backend": jax.default_backend(),
            "flags": os.environ.get("XLA_FLAGS", ""),
            "instructions": sorted(instruction_set()),
        }
    )


def scene_digest(scene: Scene, solvers: Sequence[Solver], numerics: str) -> str:
    """Digest of what is computed: scene (not its title), sizes of chunks, package version, numerics."""
    request = scene.request
    return digest(
        {
            "system": scene.system.name,
            "analysis": scene.analysis.name,
            "outputs": request.outputs,
            "method": request.method,
            "options": dict(request.options),
            "axes": [[axis.name, axis.values] for axis in scene.axes],
            "zipped": scene.zipped,
            "fixed": dict(scene.fixed),
            "solvers": [[solver.name, solver.chunk, solver.unit_cost] for solver in solvers],
            "version": drivetrain_jax.__version__,
            "numerics": numerics,
        }
    )
