"""A job: a scene resolved once into its route, solvers, plan and kernels, which computes single chunks."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Iterator, Mapping, Set
from concurrent.futures import Future
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import jax
import numpy as np

from drivetrain_jax import _compile_cache
from drivetrain_jax._errors import ChunkError, InputError, RetryableError
from drivetrain_jax._precision import use_double_precision
from drivetrain_jax._threads import threads
from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.identity import numerics_of, scene_digest
from drivetrain_jax.runs.kernel import Kernel, for_device, is_small, kernel_of
from drivetrain_jax.runs.plan import Chunk, Plan, make_plan
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.scene import Problem, Scene
from drivetrain_jax.store.provenance import digest

if TYPE_CHECKING:
    from drivetrain_jax.runs.growing import NotReusable, ReusableResult, ReusedPoints
    from drivetrain_jax.runs.work import Progress, Work
    from drivetrain_jax.store.chunks import Part
    from drivetrain_jax.store.schema import Labelled

# Most kernels that are compiled in parallel.
_SIDE_BY_SIDE = 8


class Route(Protocol):
    """The way from a job to its result, chosen once by :func:`~drivetrain_jax.runs.resolve.resolve`."""

    # Name of the route; a part of the digest, because the route affects the bits.
    name: str
    # True if points are solved one by one, so that partial results can be opened, reused and written.
    is_pointwise: bool = False

    def total(self, job: Job, done: int) -> int:
        """Number of all results, given that ``done`` of them exist."""
        return done

    def bytes_needed(self, job: Job, on_disk: bool) -> int:
        """Least memory of a run; 0 if it cannot be predicted."""
        return 0

    def progress(self, job: Job) -> Progress:
        """The counts before a run."""
        ...

    def counts(self, part: Part) -> bool:
        """True if the chunks of a part count as done."""
        return True

    def rearranged(self, job: Job, path: Path) -> list[str]:
        """Names of the variables of the result at ``path`` whose layout differs from that of the job."""
        return []

    def common_points(self, job: Job, path: Path) -> ReusableResult | NotReusable | None:
        """Points of the job in the result at ``path``, the reason why it has none, or None for a result without points."""
        return None

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The result."""
        ...

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the result to ``out``, growing at ``temporary``."""
        ...


class Job:
    """A problem and the route to its result. Plan and kernels are created on first use.

    ``points`` restricts the plan to these points of the grid; for ``full_size`` see :func:`make_plan`. Jobs are equal if
    they have the same digest. A pickled job lacks ``points``: it only computes given chunks.
    """

    def __init__(
        self, problem: Problem, route: Route, points: np.ndarray | None = None, *, full_size: bool = False
    ) -> None:
        self.problem, self.route = problem, route
        self._points, self._full_size = points, full_size
        self._kernels: dict[tuple[int, int], Future[Kernel]] = {}
        self._lock = threading.Lock()
        # The part of the plan for one block, with chunks numbered from 0, made without the rest of the plan.
        self.block_plan = lru_cache(maxsize=4)(self._block_plan)

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
        return _restored, (self.problem, self.route, self._full_size)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Job) and other.digest == self.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def only(self, points: np.ndarray) -> Job:
        """The job restricted to these points of the grid."""
        return Job(self.problem, self.route, points, full_size=self._full_size)

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

    @property
    def digest(self) -> str:
        """Digest of everything that affects the result."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        return scene_digest(self.problem, self.solvers, self.numerics)

    @cached_property
    def plan(self) -> Plan:
        """Solver and chunk of every point."""
        return make_plan(self.solvers, self.grid, self._points, full_size=self._full_size)

    def _block_plan(self, block: int) -> Plan:
        full_size = self._full_size or self.grid.shards.count > 1
        return make_plan(self.solvers, self.grid, np.arange(*self.grid.block(block)), full_size=full_size)

    @cached_property
    def _small(self) -> bool:
        def plan() -> Plan:
            return self.plan if self._points is None else make_plan(self.solvers, self.grid)

        return not self._full_size and is_small(self.grid, plan)

    @property
    def total(self) -> int:
        """Number of results; every point of a path counts."""
        return (self.grid.size if self._points is None else len(self._points)) * self.grid.path_length

    @property
    def unsolvable(self) -> int:
        """Number of points that no solver can compute; they have no value."""
        return self.total - self.plan.size * self.grid.path_length

    def ordered(self, numbers: Iterable[int]) -> Iterator[Chunk]:
        """Yield the chunks with these numbers in the order of computation, each created on demand."""
        return iter(_Chunks(self.plan, self.plan.ordered(numbers)))

    def prepare(self, kernels: Set[tuple[int, int]]) -> None:
        """Start compiling kernels (position of the solver, chunk size) in parallel, without waiting."""
        with self._lock:
            missing = kernels - self._kernels.keys()
            if not missing:
                return
            pool = threads(_SIDE_BY_SIDE, "compile")
            for index, size in missing:
                solver = self.solvers[index]
                few = self._small and not solver.lengthy
                self._kernels[index, size] = pool.submit(kernel_of, self.problem, self.grid, solver, size, few)

    def compute(self, chunk: Chunk) -> Mapping[str, np.ndarray]:
        """Results of one chunk; thread-safe. Raises :class:`ChunkError`."""
        self.prepare({(chunk.solver, chunk.size)})
        try:
            kernel = self._kernels[chunk.solver, chunk.size].result()
            return kernel(self.grid.columns(chunk.points), self.grid.numbers, chunk.effort)
        except InputError as error:
            # The error of a model or of an analysis, the same for all chunks.
            raise ChunkError(str(error)) from error
        except Exception as error:
            solver = self.solvers[chunk.solver].name
            kind = RetryableError if _is_retryable(error) else ChunkError
            raise kind(f"chunk {chunk.number} ({solver}): {type(error).__name__}: {error}") from error


class _Chunks:
    """Chunks of a plan, created one by one; iterators over them have a length hint."""

    def __init__(self, plan: Plan, numbers: np.ndarray) -> None:
        self._plan, self._numbers = plan, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, position: int) -> Chunk:
        return self._plan.chunk(self._numbers[position])


def _restored(problem: Problem, route: Route, full_size: bool) -> Job:
    return Job(problem, route, full_size=full_size)


def _check_double_precision() -> None:
    """Turn on double precision in jax again, unless the caller has the choice."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        use_double_precision()
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError("jax_enable_x64 = False: set by the context of this call; allowed is jax.enable_x64(True)")


def _is_retryable(error: Exception) -> bool:
    # XLA raises its own exception for lack of memory.
    return isinstance(error, (OSError, MemoryError)) or "RESOURCE_EXHAUSTED" in str(error)
