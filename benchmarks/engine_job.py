"""The package as a contender: a scene on its engine, compiled beforehand, without files."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from threading import Lock
from typing import Any

import numpy as np

Results = dict[str, np.ndarray]
# Locks by kernel: one thread compiles a kernel, and others that need it wait.
_COMPILING: defaultdict[str, Lock] = defaultdict(Lock)


def columns_scene(
    system: str, analysis: str, outputs: list[str], columns: Mapping[str, np.ndarray], **rest: Any
) -> dict[str, Any]:
    """A scene of listed points; ``rest``: ``fixed``, ``options``."""
    points = {name: np.asarray(column).tolist() for name, column in columns.items()}
    return {"system": system, "analysis": analysis, "outputs": outputs, "points": points, **rest}


def engine_job(scene: Mapping[str, Any], threads: int = 1, spent: np.ndarray | None = None) -> Callable[[], Results]:
    """A function that computes every point of ``scene`` as ``dt.run`` does, with ``threads``; results by name, points first.

    This call compiles the kernels, unless another scene of the process shares them. ``spent`` takes the seconds of each
    point: those of its chunk, divided evenly.
    """
    from drivetrain_jax.runs.kernel import kernel_of
    from drivetrain_jax.runs.resolve import resolve
    from drivetrain_jax.runs.scene import load_scene
    from drivetrain_jax.runs.work import run_threads

    engine = resolve(load_scene(dict(scene)))
    grid = engine.grid
    chunks = [chunk for block in engine.blocks() for chunk in engine.plan(block)]
    kinds = sorted({(chunk.solver, chunk.size) for chunk in chunks})
    shape = {key: sorted(value) if key == "points" else value for key, value in scene.items()}
    with _COMPILING[repr((shape, [(engine.solvers[index].name, size) for index, size in kinds]))]:
        kernels = {kind: kernel_of(engine.scene, grid, engine.solvers[kind[0]], kind[1]) for kind in kinds}

    def work(chunk: Any) -> Mapping[str, np.ndarray]:
        columns, begin = grid.columns(chunk.points), time.perf_counter()
        values = kernels[chunk.solver, chunk.size](columns, grid.numbers, chunk.effort)
        if spent is not None:
            spent[chunk.points] = (time.perf_counter() - begin) / chunk.points.size
        return values

    def job() -> Results:
        found: Results = {}
        for chunk, values in run_threads(chunks, work, threads):
            for name, array in values.items():
                if name not in found:
                    found[name] = np.full((grid.size, *array.shape[1:]), np.nan if array.dtype.kind in "fc" else 0)
                    found[name] = found[name].astype(array.dtype)
                found[name][chunk.points] = array
        return found

    return job


def told(outcome: np.ndarray) -> str:
    """The names of the outcomes other than success, by which the package reports failures."""
    from drivetrain_jax.analysis import Outcome

    return ", ".join(Outcome(code).name.lower() for code in np.unique(outcome) if code)
