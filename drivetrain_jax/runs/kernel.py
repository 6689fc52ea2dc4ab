"""Compile batches of points. All scenes of a process share the compiled kernels."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax import Array

from drivetrain_jax._programs import calls, compiled, program_identity
from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis import Analysis, Solver
from drivetrain_jax.analysis.numerics.kernels import compiler_options, on_cpu, options_for_few
from drivetrain_jax.analysis.numerics.lanes import with_lanes
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.scene import Problem, result_variables
from drivetrain_jax.systems import System

# LAPACK calls of XLA wait for their own thread pool, so two kernels with such calls can block each other forever (seen with
# jax 0.10.2 on two cores).
_LAPACK = threading.Lock()
# Without optimisation a kernel compiles some 4 s sooner and takes two to nine times as long. It serves jobs of up to this
# many predicted seconds, and of up to this number of points and this predicted cost (in units of the plan).
BRIEF, FEW, LIGHT = 0.03, 128, 3e4
# Kernels that a process keeps, of up to 40 MB each. Every list of fixed values and every path has its own.
_KEPT = 16
# GPU chunk size: 64 times the CPU size, at most 32,768.
_WIDER, _WIDEST = 64, 1 << 15


@dataclass(frozen=True)
class Kernel:
    """A solver compiled for chunks of ``chunk`` points; thread-safe."""

    compiled: Callable[..., dict[str, Array]]
    chunk: int
    variables: tuple[Variable, ...]
    turn: AbstractContextManager[object]

    def __call__(
        self, columns: Mapping[str, np.ndarray], numbers: Mapping[str, Any], effort: int
    ) -> dict[str, np.ndarray]:
        """Results of up to ``chunk`` points with the fixed ``numbers``, the points as first axis.

        A short chunk is padded with its last point.
        """
        count = len(next(iter(columns.values()))) if columns else self.chunk
        if count < self.chunk:
            columns = {name: np.pad(values, (0, self.chunk - count), mode="edge") for name, values in columns.items()}
        with self.turn:
            fixed = {name: np.float64(value) for name, value in numbers.items()}
            results = self.compiled(columns, fixed, np.int64(effort))
            results = {name: np.moveaxis(np.asarray(value), -1, 0)[:count] for name, value in results.items()}
        return {v.name: np.ascontiguousarray(results[v.name], dtype=v.dtype) for v in self.variables}


def _batch(
    solver: Solver, grid: Grid, chunk: int, variables: Sequence[Variable]
) -> tuple[Callable[..., dict[str, Array]], tuple[Any, ...]]:
    """The function of a whole chunk, and the kinds of its arguments: varying parameters, fixed numbers, effort."""
    dims = {v.name: len(v.dims) + (grid.path is not None) for v in variables}

    def batch(columns: Mapping[str, Any], numbers: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        solved = solver.solve(grid.bind(columns, numbers), effort)
        return {name: with_lanes(value, dims[name], chunk) for name, value in solved.items()}

    columns = {part.name: jax.ShapeDtypeStruct((chunk,), part.values.dtype) for part in grid.varying}
    numbers = {name: np.float64(value) for name, value in grid.numbers.items()}
    return batch, (columns, numbers, jax.ShapeDtypeStruct((), np.int64))


def result_shapes(problem: Problem, grid: Grid, solver: Solver) -> dict[str, tuple[int, ...]]:
    """The shape of every result at one point (or line), without compiling."""
    variables = result_variables(problem)
    batch, kinds = _batch(solver, grid, 1, variables)
    shapes = jax.eval_shape(batch, *kinds)
    return {v.name: shapes[v.name].shape[:-1] for v in variables}


def compile_kernel(
    solver: Solver, grid: Grid, chunk: int, variables: Sequence[Variable], few: bool = False, identity: str = ""
) -> Kernel:
    """Compile ``solver`` for chunks of ``chunk`` points of ``grid``; without optimisation for ``few`` points.

    For ``identity`` see :func:`~drivetrain_jax._programs.compiled`.

    Varying parameters, the ``numbers`` of the grid and the effort are arguments of the compiled code. Other fixed
    parameters, the values along a path and options are constants of it.
    """
    batch, kinds = _batch(solver, grid, chunk, variables)
    options = compiler_options(chunk, march=solver.march, short_loops=solver.short_loops)
    function = compiled(batch, kinds, options_for_few() if few else options, identity)
    return Kernel(function, chunk, tuple(variables), _LAPACK if calls(function, "lapack_") else nullcontext())


def for_device(solver: Solver) -> Solver:
    """``solver`` with the chunk size that suits the device of this process."""
    return solver if on_cpu() else replace(solver, chunk=max(solver.chunk, min(_WIDER * solver.chunk, _WIDEST)))


@dataclass(frozen=True)
class _Key:
    """The key of a kernel in the cache; the fields that do not compare follow from the others."""

    system: type[System]
    analysis: Analysis
    structure: tuple[Any, ...]
    is_named: bool = field(compare=False)
    variables: tuple[Variable, ...] = field(compare=False)
    grid: Grid = field(compare=False)
    solver: Solver = field(compare=False)


def kernel_of(problem: Problem, grid: Grid, solver: Solver, size: int, few: bool = False) -> Kernel:
    """The kernel of ``solver`` for chunks of ``size`` points of ``problem``, shared by all problems with the same key.

    For ``few`` see :func:`compile_kernel`.
    """
    # Varying parameters are arguments of the kernel, so the key keeps one value of each axis.
    axes = tuple(replace(part, values=part.values[:1], given=(), also=()) for part in grid.varying)
    request, numbers = problem.request, grid.numbers
    structure = (
        request.outputs,
        request.method,
        tuple(request.options.items()),
        tuple(numbers),
        tuple((name, grid.fixed.get(name)) for name in grid.parameters if name not in numbers),
        tuple((axis.name, axis.values.dtype) for axis in axes),
        None if grid.path is None else (grid.path.name, grid.path.values.tobytes()),
        solver.name,
    )
    variables = result_variables(problem)
    lean = replace(grid, axes=axes)
    key = _Key(problem.system, problem.analysis, structure, problem.is_named, variables, lean, solver)
    return _compiled(key, size, few)


@lru_cache(maxsize=_KEPT)
def _compiled(key: _Key, size: int, few: bool) -> Kernel:
    content = [key.structure, [[v.name, v.dims, v.dtype] for v in key.variables], size]
    identity = program_identity(key.system, key.analysis, repr(content)) if key.is_named else ""
    return compile_kernel(key.solver, key.grid, size, key.variables, few, identity)
