"""A job: a scene resolved once into its route, solvers, blocks and kernels, which plans and computes blocks by chunks."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

import drivetrain_jax
from drivetrain_jax import _programs
from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax._machine import in_double_precision, threads, usable_cores, use_double_precision
from drivetrain_jax.analysis import OUTCOME, Outcome, Solver
from drivetrain_jax.runs.assemble import blank
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.kernel import BRIEF, FEW, LIGHT, Kernel, for_device, kernel_of
from drivetrain_jax.runs.scene import Problem, Scene, result_variables
from drivetrain_jax.store.files import digest
from drivetrain_jax.store.parts import Arrays, Shards

if TYPE_CHECKING:
    from drivetrain_jax.runs.work import Route

# Most kernels that are compiled in parallel.
_SIDE_BY_SIDE = 8


@dataclass(frozen=True)
class Block:
    """A box of the grid, the unit of computing, storing and resuming; ``some`` of its points if not all are computed."""

    number: int
    some: np.ndarray | None = None


class Job:
    """A problem and the route to its result. Blocks and kernels are created on first use.

    Its kernels keep their chunk size for few points if ``full_size``.
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
        # Before the first kernel, which the plan may need. The caller may have turned it off, or may have the choice.
        config: Any = jax.config
        if not config.jax_enable_x64:
            use_double_precision()
            if not config.jax_enable_x64:
                state = "jax_enable_x64 = False: set by the context of this call"
                raise InputError(f"{state}; expected jax.enable_x64(True)")
        _programs.enable(short=True)
        # An atlas has no grid.
        return tuple(
            for_device(solver) for solver in self.problem.solvers if not (solver.single and self.grid.size > 1)
        )

    @property
    def scene(self) -> Scene:
        """The scene of the job; jobs of the solves of an atlas have none."""
        assert isinstance(self.problem, Scene)
        return self.problem

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.problem, self.route, self._full_size, self.boxes)

    @cached_property
    def numerics(self) -> str:
        """Digest of code, versions and machine."""
        return digest(self.numerics_detail)

    @cached_property
    def numerics_detail(self) -> dict[str, Any]:
        """The entries whose digest is ``numerics``."""
        return _programs.numerics_of(self.problem.system, self.problem.analysis, self.route.name)

    @property
    def attrs(self) -> dict[str, str | float]:
        """Attributes that identify the result; effort and time are added at the end."""
        detail = json.dumps(self.numerics_detail)
        return {"digest": self.digest, "numerics": self.numerics, "numerics_detail": detail, "wall_time_s": 0.0}

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
        return make_plan(self.solvers, self.grid, self.points(block), self._longest)

    @cached_property
    def _longest(self) -> int | None:
        """Most points of a chunk, the same for all blocks: a longer chunk would be padded; None for a job of one block."""
        if self._full_size:
            return _MOST_POINTS
        return _PADDED * -(-int(np.diff(self._starts).max()) // _PADDED) if self.boxes.count > 1 else None

    @cached_property
    def _few(self) -> bool:
        """True if the whole grid is so cheap that its kernels are not worth optimising."""
        if self._full_size or self.boxes.count > 1:
            return False
        chunks = self.plan(Block(0))
        seconds = sum(chunk.effort * self.solvers[chunk.solver].seconds * chunk.size for chunk in chunks)
        brief = seconds * self.grid.path_length <= BRIEF
        return brief or (self.total <= FEW and sum(chunk.cost for chunk in chunks) <= LIGHT)

    def prepare(self, chunks: Sequence[Chunk]) -> None:
        """Start compiling the kernels of ``chunks`` in parallel, without waiting."""
        with self._lock:
            for index, size in {(chunk.solver, chunk.size): None for chunk in chunks}.keys() - self._kernels.keys():
                solver, pool = self.solvers[index], threads(_SIDE_BY_SIDE, "compile")
                few = solver.few or (self._few and not solver.lengthy)
                self._kernels[index, size] = pool.submit(kernel_of, self.problem, self.grid, solver, size, few)

    def compute(self, chunk: Chunk) -> Arrays:
        """Results of one chunk; thread-safe. Raises :class:`ChunkError`."""
        self.prepare([chunk])
        try:
            kernel = self._kernels[chunk.solver, chunk.size].result()
            results = kernel(self.grid.columns(chunk.points), self.grid.numbers, chunk.effort)
            # A fixed path parameter is not a dimension of the result.
            return {n: x[:, 0] for n, x in results.items()} if self.grid.path_is_fixed else results
        except InputError as error:
            # The error of a model or of an analysis, the same for all chunks.
            raise ChunkError(str(error)) from error
        except Exception as error:
            # XLA raises its own exception for lack of memory.
            passes = isinstance(error, (OSError, MemoryError)) or "RESOURCE_EXHAUSTED" in str(error)
            kind = RetryableError if passes else ChunkError
            raise kind(f"{self.solvers[chunk.solver].name}: {type(error).__name__}: {error}") from error

    def compute_block(self, block: Block) -> Arrays:
        """Results of one block, in this thread."""
        chunks = self.plan(block)
        return self.joined(block, chunks, list(map(self.compute, chunks)))

    def joined(self, block: Block, chunks: Sequence[Chunk], results: Sequence[Arrays]) -> Arrays:
        """The results of all ``chunks`` of a block in the order of its points; others have no value."""
        count, joined = len(self.points(block)), {}
        rows = np.concatenate([np.empty(0, np.int64), *(chunk.rows for chunk in chunks)])
        line, outer = (self.grid.path_length,) * (self.grid.path_position is not None), len(self.grid.result_shape)
        like = blank(self.problem, self.grid, results[0] if results else None)
        for variable in result_variables(self.problem):
            missing = Outcome.STEP_LIMIT if variable.name == OUTCOME.name else variable.missing
            shape = (count, *line, *like[variable.name].shape[outer:])
            values = np.empty(shape, variable.dtype) if rows.size == count else np.full(shape, missing, variable.dtype)
            if results:
                values[rows] = np.concatenate([part[variable.name] for part in results])
            joined[variable.name] = values
        return joined


def _restored(problem: Problem, route: Route, full_size: bool, boxes: Shards) -> Job:
    job = Job(problem, route, full_size=full_size)
    job.boxes = boxes
    return job


# A block: predicted work of one core in s, upper limits of its points and of the bytes of its results, and least number of
# full chunks, so that padding the last one costs little. Chunks of lengthy points need no such limit.
_SECONDS, _MOST_POINTS, _MOST_BYTES, _LEAST_CHUNKS = 2.0, 1 << 18, 1 << 28, 8
# Blocks of a run of a few seconds, so that Dask workers end together, and work in s below which a block is not divided.
_BLOCKS, _BRIEFEST = 16, 0.25
# Number of points from which the work of a block is predicted.
_SAMPLE = 1024
# Points whose effort is predicted together (small enough for the cache).
_PIECE = 1 << 15
# Effort and position of a point share one integer.
_MAX_EFFORT, _BITS = 2**31 - 1, 32
# Least number of chunks per solver in a small scene. A constant, because bits must not depend on the number of cores.
_MIN_CHUNKS = 2
# Points of the smallest chunk of more than one point, and predicted seconds of a chunk that is not divided: compiling
# another kernel takes longer. Chunks of a block have a multiple of these points, the widest vectors.
_LANES, _BRIEF, _PADDED = 16, 0.02, 8


@dataclass(frozen=True)
class Chunk:
    """Points for one call of a kernel: position of the solver, padded ``size``, largest ``effort``, and predicted ``cost``.

    ``rows`` are the positions of the ``points`` in their block.
    """

    solver: int
    size: int
    rows: np.ndarray
    points: np.ndarray
    effort: int
    cost: float


def block_size(solvers: Sequence[Solver], grid: Grid) -> int:
    """Number of points of a block (lines along the path, if there is one); depends on grid and solvers alone."""
    sample = np.unique(np.linspace(0, grid.size - 1, min(grid.size, _SAMPLE)).astype(np.int64))
    choice, effort = _cheapest(solvers, grid, sample)
    seconds = float(np.mean(effort * np.array([*(solver.seconds for solver in solvers), 0.0])[choice]))
    seconds *= grid.path_length
    lines = max(min(_MOST_POINTS, _MOST_BYTES // max(grid.result_bytes, 1)) // grid.path_length, 1)
    chunk = max(solver.chunk for solver in solvers)
    least = max(solver.chunk * (1 if solver.lengthy else _LEAST_CHUNKS) for solver in solvers)
    work = min(_SECONDS, max(seconds * grid.size / _BLOCKS, _BRIEFEST))
    wanted = math.ceil(work / seconds) if seconds > work / lines else lines
    return min(max(wanted - wanted % chunk, least), lines)


def make_plan(
    solvers: Sequence[Solver], grid: Grid, points: np.ndarray, longest: int | None = None
) -> tuple[Chunk, ...]:
    """Chunks of ``points``, each by the solver of the smallest predicted cost; the most expensive chunk comes first.

    Points of infinite predicted cost belong to no chunk. Chunks of few points are smaller, unless they have the solver's
    size up to ``longest``; so those of several blocks need no further kernels.
    """
    pieces = [points[start : start + _PIECE] for start in range(0, len(points), _PIECE)]
    if len(pieces) > 1:
        with ThreadPoolExecutor(min(usable_cores(), len(pieces)), "plan", initializer=in_double_precision) as pool:
            predicted = list(pool.map(lambda piece: _cheapest(solvers, grid, piece), pieces))
    else:
        predicted = [_cheapest(solvers, grid, points)]
    choice, effort = (np.concatenate(column) for column in zip(*predicted, strict=True))
    chunks: list[Chunk] = []
    for index, solver in enumerate(solvers):
        rows = np.flatnonzero(choice == index)
        if not rows.size:
            continue
        # Effort and position in one integer: sorting it is the fastest way to sort by both.
        keys = ((_MAX_EFFORT - effort[rows]) << _BITS) | rows
        keys.sort()
        rows = keys & ((1 << _BITS) - 1)
        size = min(solver.chunk, longest) if longest else chunk_size(solver, rows.size, int(effort[rows[0]]))
        for start in range(0, rows.size, size):
            part = rows[start : start + size]
            most = int(effort[part[0]])
            chunks.append(Chunk(index, size, part, points[part], most, most * solver.unit_cost * size))
    return tuple(sorted(chunks, key=lambda chunk: -chunk.cost))


def chunk_size(solver: Solver, count: int, effort: int = 1) -> int:
    """Points per chunk for ``count`` points of at most this ``effort``; fewer in small scenes, to give all cores work.

    Sizes are 1, 16, that of the solver and powers of two between them where a chunk takes long, so that another count
    seldom needs another kernel. Lengthy points may also have the sizes 2 to 8.
    """
    if count > _LANES and effort * solver.seconds * solver.chunk < _BRIEF:
        return solver.chunk
    share = count if count <= _LANES else -(-count // _MIN_CHUNKS)
    least = 1 if solver.lengthy or count == 1 else _LANES
    return min(solver.chunk, max(least, 1 << (share - 1).bit_length()))


def mean_cost(solvers: Sequence[Solver], grid: Grid, points: np.ndarray) -> float:
    """Mean predicted cost of these points, in units of the plan; points that no solver can compute cost nothing."""
    choice, effort = _cheapest(solvers, grid, points)
    unit = np.array([*(solver.unit_cost for solver in solvers), 0.0])
    return float(np.mean(effort * unit[choice]))


def _cheapest(solvers: Sequence[Solver], grid: Grid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position of the cheapest solver (-1 if all costs are infinite) and its effort, for each of ``points``."""
    columns = grid.arrays(points)
    best, effort, cost = np.full(points.shape, -1), np.zeros(points.shape), np.full(points.shape, np.inf)
    for index, solver in enumerate(solvers):
        needed = np.broadcast_to(np.asarray(solver.effort(columns), float), points.shape)
        with np.errstate(over="ignore"):
            own_cost = needed * solver.unit_cost
        # False for a cost of NaN or infinity.
        less = own_cost < cost
        best[less], cost, effort = index, np.where(less, own_cost, cost), np.where(less, needed, effort)
    return best, np.ceil(np.clip(effort, 0, _MAX_EFFORT)).astype(np.int64)


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
            # They are no numbers of the computation, but the result has them as labels and attributes.
            "parts": list(getattr(scene, "parts", ())),
            "data": dict(getattr(scene, "data", {})),
            "solvers": [[solver.name, solver.chunk, solver.unit_cost] for solver in solvers],
            "version": drivetrain_jax.__version__,
            "numerics": numerics,
        }
    )
