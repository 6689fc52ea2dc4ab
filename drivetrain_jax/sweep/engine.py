"""A scene made ready: solvers, plan and kernels, and the function that computes one chunk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property

import numpy as np

from drivetrain_jax._quantities import Variable
from drivetrain_jax.sweep import compile_cache
from drivetrain_jax.sweep.assemble import result_variables
from drivetrain_jax.sweep.executor import run_threads
from drivetrain_jax.sweep.grid import Grid
from drivetrain_jax.sweep.identity import numerics, scene_digest
from drivetrain_jax.sweep.kernel import Kernel, compile_kernel
from drivetrain_jax.sweep.plan import Chunk, Plan, make_plan
from drivetrain_jax.sweep.scene import Scene


class ChunkError(RuntimeError):
    """A chunk could not be computed; the message names it and the reason."""


class Engine:
    """Computes the chunks of one scene. Everything costly is made on first use."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.grid = Grid.of(scene)
        self.solvers = scene.analysis.solvers(scene.system, scene.request)

    @cached_property
    def numerics(self) -> str:
        """Digest of the code and the machine that compute."""
        return numerics(self.scene)

    @cached_property
    def digest(self) -> str:
        """Digest of everything that decides the result."""
        return scene_digest(self.scene, self.solvers, self.numerics)

    @cached_property
    def plan(self) -> Plan:
        """Solver and chunk of every point."""
        return make_plan(self.solvers, self.grid)

    @property
    def total(self) -> int:
        """Number of points, those along a path counted one by one."""
        return self.grid.size * self.grid.path_length

    def compute(self, numbers: Iterable[int], workers: int) -> Iterator[tuple[Chunk, Mapping[str, np.ndarray]]]:
        """Results of the chunks with these numbers, the costliest first; each as soon as it is there."""
        costs = self.plan.costs
        ordered = sorted(numbers, key=lambda number: -costs[number])
        kernels = self._compile({self.plan.chunk(number).group for number in ordered})

        def work(chunk: Chunk) -> dict[str, np.ndarray]:
            try:
                return kernels[chunk.group].result()(self.grid.columns(chunk.points), chunk.effort)
            except Exception as error:
                solver = self.plan.groups[chunk.group].solver.name
                raise ChunkError(f"chunk {chunk.number} ({solver}): {type(error).__name__}: {error}") from error

        yield from run_threads(map(self.plan.chunk, ordered), work, workers)

    def _compile(self, groups: set[int]) -> dict[int, Future[Kernel]]:
        """Compile the kernels of ``groups`` side by side, without waiting for them."""
        compile_cache.enable()
        variables: tuple[Variable, ...] = result_variables(self.scene)
        pool = ThreadPoolExecutor(max(len(groups), 1), thread_name_prefix="compile")
        try:
            planned = {index: self.plan.groups[index] for index in groups}
            return {i: pool.submit(compile_kernel, g.solver, self.grid, g.chunk, variables) for i, g in planned.items()}
        finally:
            pool.shutdown(wait=False)
