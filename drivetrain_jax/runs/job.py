"""A job: a scene resolved once into its route, solvers, blocks and kernels, which computes chunks and blocks."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from drivetrain_jax import _compile_cache
from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax._precision import use_double_precision
from drivetrain_jax._threads import threads
from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.assemble import dimension_sizes, missing_value
from drivetrain_jax.runs.identity import numerics_of, scene_digest
from drivetrain_jax.runs.kernel import FEW, LIGHT, Kernel, for_device, kernel_of
from drivetrain_jax.runs.plan import Chunk, block_size, make_plan
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import Problem, Scene, result_variables
from drivetrain_jax.store.provenance import digest
from drivetrain_jax.store.shards import Shards

if TYPE_CHECKING:
    from drivetrain_jax.runs.work import Route

# Most kernels that are compiled in parallel.
_SIDE_BY_SIDE = 8

Results = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Block:
    """A box of the grid, the unit of computing, storing and resuming; ``some`` of its points if not all are computed."""

    number: int
    some: np.ndarray | None = None


class Job:
    """A problem and the route to its result. Blocks and kernels are created on first use.

    Its kernels keep their chunk size for few points if ``full_size``. Jobs are equal if they have the same digest.
    """

    def __init__(self, problem: Problem, route: Route, *, full_size: bool = False) -> None:
        self.problem, self.route = problem, route
        self._full_size = full_size
        self._kernels: dict[tuple[int, int], Future[Kernel]] = {}
        self._lock = threading.Lock()

    @cached_property
    def grid(self) -> Grid:
        """The points."""
        return Grid.of(self.problem)

    @cached_property
    def solvers(self) -> tuple[Solver, ...]:
        """The solvers that a plan chooses from."""
        # Before the first kernel, which the plan may need.
        _check_double_precision()
        _compile_cache.enable(short=True)
        return tuple(map(for_device, self.problem.solvers))

    @property
    def scene(self) -> Scene:
        """The scene of the job; jobs of the solves of an atlas have none."""
        assert isinstance(self.problem, Scene)
        return self.problem

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.problem, self.route, self._full_size, self.boxes)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Job) and other.digest == self.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @cached_property
    def numerics(self) -> str:
        """Digest of code, versions and machine."""
        return digest(self.numerics_detail)

    @cached_property
    def numerics_detail(self) -> dict[str, Any]:
        """The entries whose digest is ``numerics``."""
        return numerics_of(self.problem.system, self.problem.analysis, self.route.name)

    @property
    def numerics_attrs(self) -> dict[str, str]:
        """``numerics`` and ``numerics_detail`` as attributes of a result or plan."""
        return {"numerics": self.numerics, "numerics_detail": json.dumps(self.numerics_detail)}

    @property
    def attrs(self) -> dict[str, str | float]:
        """Attributes that identify the result; effort and time are added at the end."""
        return {"digest": self.digest, **self.numerics_attrs, "wall_time_s": 0.0}

    @cached_property
    def digest(self) -> str:
        """Digest of everything that affects the result."""
        return scene_digest(self.problem, self.solvers, self.numerics)

    @property
    def total(self) -> int:
        """Number of results; every point of a path counts."""
        return self.grid.size * self.grid.path_length

    @cached_property
    def boxes(self) -> Shards:
        """The boxes of the blocks."""
        grid = self.grid
        return Shards.of(grid.result_shape, grid.path_position, block_size(self.solvers, grid))

    @cached_property
    def _starts(self) -> np.ndarray:
        return self.boxes.starts(self.grid.path_position)

    def blocks(self, points: np.ndarray | None = None) -> Iterator[Block]:
        """Yield all blocks, or those with some of these (rising) ``points`` of the grid, restricted to them."""
        ends = None if points is None else np.searchsorted(points, self._starts)
        for number in range(self.boxes.count):
            if ends is None or points is None:
                yield Block(number)
            elif ends[number] < ends[number + 1]:
                yield Block(number, points[ends[number] : ends[number + 1]])

    def points(self, block: Block) -> np.ndarray:
        """Numbers of the points of a block."""
        return np.arange(*self._starts[block.number : block.number + 2]) if block.some is None else block.some

    def plan(self, block: Block) -> tuple[Chunk, ...]:
        """The chunks of a block."""
        full_size = self._full_size or self.boxes.count > 1
        return make_plan(self.solvers, self.grid, self.points(block), full_size=full_size)

    @cached_property
    def _few(self) -> bool:
        """True if the whole grid is so cheap that its kernels are not worth optimising."""
        if self._full_size or self.total > FEW or self.boxes.count > 1:
            return False
        return sum(chunk.cost for chunk in self.plan(Block(0))) <= LIGHT

    def prepare(self, chunks: Sequence[Chunk]) -> None:
        """Start compiling the kernels of ``chunks`` in parallel, without waiting."""
        with self._lock:
            for index, size in {(chunk.solver, chunk.size): None for chunk in chunks}.keys() - self._kernels.keys():
                solver, pool = self.solvers[index], threads(_SIDE_BY_SIDE, "compile")
                few = self._few and not solver.lengthy
                self._kernels[index, size] = pool.submit(kernel_of, self.problem, self.grid, solver, size, few)

    def compute(self, chunk: Chunk) -> Results:
        """Results of one chunk; thread-safe. Raises :class:`ChunkError`."""
        self.prepare([chunk])
        try:
            kernel = self._kernels[chunk.solver, chunk.size].result()
            return kernel(self.grid.columns(chunk.points), self.grid.numbers, chunk.effort)
        except InputError as error:
            # The error of a model or of an analysis, the same for all chunks.
            raise ChunkError(str(error)) from error
        except Exception as error:
            # XLA raises its own exception for lack of memory.
            passes = isinstance(error, (OSError, MemoryError)) or "RESOURCE_EXHAUSTED" in str(error)
            kind = RetryableError if passes else ChunkError
            raise kind(f"{self.solvers[chunk.solver].name}: {type(error).__name__}: {error}") from error

    def compute_block(self, block: Block) -> Results:
        """Results of one block, in this thread."""
        chunks = self.plan(block)
        return self.joined(block, chunks, list(map(self.compute, chunks)))

    def joined(self, block: Block, chunks: Sequence[Chunk], results: Sequence[Results]) -> Results:
        """The results of all ``chunks`` of a block in the order of its points; others have no value."""
        count = len(self.points(block))
        rows = np.concatenate([np.empty(0, np.int64), *(chunk.rows for chunk in chunks)])
        shapes = {name: values.shape[1:] for name, values in results[0].items()} if results else self._shapes
        found = {}
        for variable in result_variables(self.problem):
            shape, blank = (count, *shapes[variable.name]), missing_value(variable)
            values = np.empty(shape, variable.dtype) if rows.size == count else np.full(shape, blank, variable.dtype)
            if results:
                values[rows] = np.concatenate([each[variable.name] for each in results])
            found[variable.name] = values
        return found

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the results of a point or line, without computing one."""
        sizes, line = dimension_sizes(self.problem, self.grid), (self.grid.path_length,) * (self.grid.path is not None)
        return {v.name: (*line, *(sizes[dim] for dim in v.dims)) for v in result_variables(self.problem)}


def _restored(problem: Problem, route: Route, full_size: bool, boxes: Shards) -> Job:
    job = Job(problem, route, full_size=full_size)
    job.boxes = boxes
    return job


def _check_double_precision() -> None:
    """Turn on double precision in jax again, unless the caller has the choice."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        use_double_precision()
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError("jax_enable_x64 = False: set by the context of this call; allowed is jax.enable_x64(True)")
