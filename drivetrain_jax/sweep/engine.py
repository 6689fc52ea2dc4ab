"""A scene made ready: solvers, plan and kernels, and the function that computes one chunk."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property

import numpy as np

from drivetrain_jax.sweep import compile_cache
from drivetrain_jax.sweep.assemble import result_variables
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
        self._kernels: dict[int, Future[Kernel]] = {}
        self._lock = threading.Lock()

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

    def ordered(self, numbers: Iterable[int]) -> list[Chunk]:
        """The chunks with these numbers, the costliest first."""
        costs = self.plan.costs
        return [self.plan.chunk(number) for number in sorted(numbers, key=lambda number: -costs[number])]

    def prepare(self, groups: Iterable[int]) -> None:
        """Begin to compile the kernels of these groups of the plan, side by side, without waiting for them."""
        compile_cache.enable()
        variables = result_variables(self.scene)
        with self._lock:
            missing = [index for index in groups if index not in self._kernels]
            pool = ThreadPoolExecutor(max(len(missing), 1), thread_name_prefix="compile")
            for index in missing:
                group = self.plan.groups[index]
                self._kernels[index] = pool.submit(compile_kernel, group.solver, self.grid, group.chunk, variables)
            pool.shutdown(wait=False)

    def compute_chunk(self, chunk: Chunk) -> Mapping[str, np.ndarray]:
        """Results of one chunk; may be called from several threads. Raises :class:`ChunkError`."""
        self.prepare([chunk.group])
        try:
            return self._kernels[chunk.group].result()(self.grid.columns(chunk.points), chunk.effort)
        except Exception as error:
            solver = self.plan.groups[chunk.group].solver.name
            raise ChunkError(f"chunk {chunk.number} ({solver}): {type(error).__name__}: {error}") from error
