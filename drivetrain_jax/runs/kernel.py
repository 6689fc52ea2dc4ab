"""Compile batches of points. All scenes of a process share the compiled kernels, and later processes load them from disk."""

from __future__ import annotations

import hashlib
import os
import pickle
import secrets
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import serialize_executable

from drivetrain_jax import _compile_cache
from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis import Analysis, Solver, get_analysis
from drivetrain_jax.analysis.numerics.kernels import compiler_options, on_cpu, options_for_few
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.identity import program_identity
from drivetrain_jax.runs.scene import Problem, find_system, result_variables
from drivetrain_jax.store.files import digest, write_atomic
from drivetrain_jax.systems import System

_LAPACK = threading.Lock()
# Up to this number of points and this predicted cost (in units of the plan), computing takes less time than optimising the
# kernels.
FEW, LIGHT = 128, 3e4
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
            results = {
                name: np.asarray(value)
                for name, value in self.compiled(columns, _arrays(numbers), np.int64(effort)).items()
            }
        arrays = {}
        for variable in self.variables:
            values = results[variable.name]
            values = np.moveaxis(values, -1, 0)
            arrays[variable.name] = np.ascontiguousarray(values[:count], dtype=variable.dtype)
        return arrays


def _batch(
    solver: Solver, grid: Grid, chunk: int, variables: Sequence[Variable]
) -> tuple[Callable[..., dict[str, Array]], tuple[Any, ...]]:
    """The function of a whole chunk, and the kinds of its arguments: varying parameters, fixed numbers, effort."""
    own = {v.name: len(v.dims) + (grid.path is not None) for v in variables}

    def batch(columns: Mapping[str, Any], numbers: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        # A result that does not depend on the varying parameters has no lanes yet.
        solved = solver.solve(grid.bind(columns, numbers), effort)
        results = {name: jnp.asarray(value) for name, value in solved.items()}
        spread = {n: v if v.ndim > own[n] else v[..., None] for n, v in results.items()}
        return {n: jnp.broadcast_to(v, (*v.shape[:-1], chunk)) for n, v in spread.items()}

    columns = {part.name: jax.ShapeDtypeStruct((chunk,), part.values.dtype) for part in grid.varying}
    return batch, (columns, _arrays(grid.numbers), jax.ShapeDtypeStruct((), np.int64))


def _arrays(numbers: Mapping[str, float]) -> dict[str, np.float64]:
    return {name: np.float64(value) for name, value in numbers.items()}


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

    For ``identity`` see :func:`~drivetrain_jax.runs.kernel.compiled`.

    Varying parameters, the ``numbers`` of the grid and the effort are arguments of the compiled code. Other fixed
    parameters, the values along a path and options are constants of it.
    """
    batch, kinds = _batch(solver, grid, chunk, variables)
    options = compiler_options(chunk, march=solver.march, short_loops=solver.short_loops)
    function = compiled(batch, kinds, options_for_few() if few else options, identity)
    return Kernel(function, chunk, tuple(variables), _turn(function))


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


def _turn(kernel: jax.stages.Compiled) -> AbstractContextManager[object]:
    """The lock that a call needs.

    LAPACK calls of XLA wait for their own thread pool, so two such kernels can block each other forever (seen with jax
    0.10.2 on two cores).
    """
    return _LAPACK if calls(kernel, "lapack_") else nullcontext()


# Number of files that are kept; one takes some 300 kB.
_MOST, _DIGEST = 256, 16
# Errors of a kernel that cannot be stored, or of a file that is missing, damaged or of no use here.
_UNUSABLE = (OSError, ValueError, TypeError, KeyError, AttributeError, NotImplementedError, pickle.PickleError)
_UNUSABLE += (jax.errors.JaxRuntimeError,)


def compiled(
    function: Callable[..., Any], kinds: tuple[Any, ...], options: Mapping[str, Any], identity: str
) -> jax.stages.Compiled:
    """``function`` compiled with ``options`` of the compiler for arguments of these ``kinds``.

    ``identity`` is a digest of everything else that the kernel depends on; an empty one keeps nothing on disk.
    """
    name = digest([identity, dict(options)]) if identity and _compile_cache.programs() else ""
    with suppress(*_UNUSABLE):
        has_lapack, *parts = _read(name)
        if has_lapack:
            # JAX loads LAPACK, which takes a quarter of a second, when it lowers the first call.
            jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
        return serialize_executable.deserialize_and_load(*parts, execution_devices=jax.devices()[:1])
    named = lambda *arguments: function(*arguments)  # noqa: E731
    # A new name for what is stored: JAX's own cache returns kernels that cannot be stored again (jax 0.10.2).
    named.__name__ = f"kernel_{secrets.token_hex(8)}"
    kernel = jax.jit(named if name else function).lower(*kinds).compile(dict(options))
    # A call of Python code cannot be stored.
    if name and not (calls(kernel, "xla_ffi_python") or calls(kernel, "xla_python")):
        with suppress(*_UNUSABLE):
            _write(name, (calls(kernel, "lapack_"), *serialize_executable.serialize(kernel)))
    return kernel


def kept(system: type[System], kernel: Any, options: Mapping[str, Any], name: str) -> Callable[..., Any]:
    """``kernel``, a function of ``jax.jit`` with these ``options`` of the compiler, with its compiled code on disk.

    Without a cache, and for a system of another package, it is ``kernel`` itself.
    """
    if _compile_cache.programs() is None or find_system(system.name) is not system:
        return kernel
    identity = program_identity(system, get_analysis("floquet").for_system(system), name)
    return _Kept(kernel, tuple(options.items()), identity) if identity else kernel


@lru_cache(maxsize=64)
class _Kept:
    """A kernel that is compiled by :func:`compiled`, once for all arguments of the same kinds."""

    def __init__(self, kernel: Any, options: tuple[tuple[str, Any], ...], identity: str) -> None:
        self._kernel, self._options, self._identity = kernel, dict(options), identity
        self._compiled: dict[str, jax.stages.Compiled] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        """The results of the kernel."""
        arguments = jax.tree.map(np.asarray, arguments)
        leaves, tree = jax.tree.flatten(arguments)
        kinds = digest([self._identity, str(tree), [(x.shape, x.dtype.str) for x in leaves]])
        with self._lock:
            if kinds not in self._compiled:
                self._compiled[kinds] = compiled(self._kernel.__wrapped__, arguments, self._options, kinds)
        return self._compiled[kinds](*arguments)


def calls(kernel: jax.stages.Compiled, target: str) -> bool:
    """True if ``kernel`` calls a library function whose name begins with ``target``."""
    return f'custom_call_target="{target}' in (kernel.as_text() or "")


def remembered(compute: Callable[[], Any], identity: str) -> Any:
    """``compute()``, stored on disk under ``identity``, as kernels are."""
    with suppress(*_UNUSABLE):
        return _read(identity)
    found = compute()
    _write(identity, found)
    return found


def _read(name: str) -> Any:
    """A stored object; ``OSError`` or ``ValueError`` if there is none, or a damaged one.

    The folder belongs to the user alone, and what it holds is executed anyway.
    """
    folder = _compile_cache.programs()
    if not name or folder is None:
        raise FileNotFoundError(name)
    data = (folder / name).read_bytes()
    if hashlib.blake2b(data[_DIGEST:], digest_size=_DIGEST).digest() != data[:_DIGEST]:
        raise ValueError(f"{name}: damaged")
    (folder / name).touch()
    return pickle.loads(zlib.decompress(data[_DIGEST:]))


def _write(name: str, content: Any) -> None:
    """Store an object, and delete those that have not been used for the longest time. A full disk is no error."""
    folder = _compile_cache.programs()
    if not name or folder is None:
        return
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        data = zlib.compress(pickle.dumps(content), 1)
        data = hashlib.blake2b(data, digest_size=_DIGEST).digest() + data
        write_atomic(folder / name, data, folder / f"{name}.{os.getpid()}.tmp")
        for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime)[:-_MOST]:
            file.unlink(missing_ok=True)
