"""Compile kernels for the CPU, in particular marches of many small operations.

XLA recomputes an intermediate value for every result that needs it, and calls a kernel for each result. A step of a
Runge-Kutta method is then computed several times, or costs more in calls than in arithmetic. :func:`stored` and
:func:`in_one_kernel` mark functions for the compiler. The marks change numbers only by rounding, and a compiler that does
not know a mark ignores it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from functools import cache, lru_cache, partial
from typing import Any, ParamSpec, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import Array
from jax.experimental.xla_metadata import set_xla_metadata

from drivetrain_jax._errors import InputError
from drivetrain_jax._machine import instruction_set

P = ParamSpec("P")
R = TypeVar("R")

# Numbers in a vector of AVX-512.
FULL_WIDTH = 8
# A call that is not inlined is not fused with its neighbours either, so its results are computed once and stored.
_APART = {"inlineable": "false"}
# One kernel for a call with its loops; by default XLA makes one only of loops over less than half a kilobyte.
_ONE_KERNEL = {**_APART, "xla_cpu_small_call": "true"}
# Operations that may be part of such a kernel. Sorting, scattering, library calls, and sums and maxima over an axis may not:
# XLA compiles these in another way.
_ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy cos cosh
    div eq erf erfc exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not
    or pow rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor
"""
_STRUCTURE = """
    broadcast_in_dim closed_call concatenate cond custom_jvp_call custom_vjp_call expand_dims iota jit pjit reshape scan
    slice squeeze transpose while
"""
_KNOWN = {*_ELEMENTWISE.split(), *_STRUCTURE.split()}


def on_cpu() -> bool:
    """True if this process computes on a CPU; an accelerator needs other batches and no marks."""
    return jax.default_backend() == "cpu"


def compiler_options(lanes: int = FULL_WIDTH, *, march: bool = False, short_loops: bool = False) -> dict[str, Any]:
    """Compiler options for full vector width; XLA's default is half of AVX-512, which is 1.6 times slower.

    With fewer ``lanes`` than a vector the width keeps its default: a march of four lanes would take tens of gigabytes to
    compile (jax 0.10.2). A ``march`` uses the older of two code generators, which compiles twice as fast and makes most
    marches no slower. Exceptions are charts, determinants, impacts and adaptive steps in lockstep, which would be up to
    twice as slow.

    Loops over some tens of lanes (``short_loops``) use a lower level of optimisation: the highest level unrolls them into
    scalar operations that do not fit into the cache. Marches of tangent vectors keep the highest level: with few lanes any
    other level needs tens of gigabytes to compile.
    """
    options: dict[str, Any] = {}
    if "avx512f" in instruction_set() and lanes >= FULL_WIDTH:
        options["xla_cpu_prefer_vector_width"] = 512
    if march:
        options["xla_cpu_use_fusion_emitters"] = False
    if short_loops:
        options["xla_backend_optimization_level"] = 1
    return _applicable(options)


def options_for_few() -> dict[str, Any]:
    """Compiler options without optimisation, for kernels of milliseconds; longer kernels would run several times as long."""
    return _applicable({"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})


def _applicable(options: Mapping[str, Any]) -> dict[str, Any]:
    if not on_cpu():
        return {}
    return {option: value for option, value in options.items() if compiler_knows(option, value)}


@cache
def compiler_knows(option: str, value: Any) -> bool:
    """True if XLA accepts an option. A release of jaxlib may remove an option; kernels are then slower, but still compile.

    For jaxlib 0.10 the result is known without a trial, which takes as long as a small compilation.
    """
    if jaxlib.__version__.startswith("0.10."):  # pyright: ignore[reportPrivateImportUsage]
        return True
    try:
        jax.jit(lambda: jnp.zeros(())).lower().compile({option: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def stored(function: Callable[P, R]) -> Callable[P, R]:
    """``function`` with its results computed once for all uses."""
    return _marked(function, _APART)


def in_one_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """``function`` with its loops as a single kernel, for batches that fit into the innermost cache.

    The function must pass :func:`suits_one_kernel`.
    """
    if not on_cpu():
        return function

    def call(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        flat = jax.make_jaxpr(lambda *x: function(*jax.tree.unflatten(tree, x)), return_shape=True)
        closed, shapes = flat(*leaves)
        values = jnp.bool_(True), [jnp.asarray(x) for x in (*closed.consts, *leaves)]
        results = _marked(partial(_using_all, closed), _ONE_KERNEL)(*jax.lax.optimization_barrier(values))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return call


def _using_all(closed: Any, certain: Array, values: list[Array]) -> list[Array]:
    """Results of ``closed`` for its captured values and its arguments, computed so that all inputs are read.

    XLA aborts the process for a kernel with unused inputs (jax 0.10.2), for example the time of a march whose field does
    not depend on it, or all inputs of a march without steps. The compiler must therefore know neither the values nor that
    ``certain`` is true.
    """
    captured = len(closed.consts)
    first, *others = jax.core.eval_jaxpr(closed.jaxpr, values[:captured], *values[captured:])
    read = sum(jnp.ravel(x)[0].astype(first.dtype) for x in values if x.size)
    return [jnp.where(certain, first, read), *others]


def any_lane(flags: Array) -> Array:
    """True if any of ``flags`` ``(lanes,)`` is, by slices: a reduction cannot be part of a kernel."""
    while len(flags) > 1:
        half = len(flags) // 2
        folded = flags[:half] | flags[half : 2 * half]
        flags = folded if len(flags) % 2 == 0 else jnp.concatenate([folded[:-1], folded[-1:] | flags[-1:]])
    return flags[0]


def suits_one_kernel(function: Callable[..., Any], *arguments: Any) -> bool:
    """True if all operations of ``function`` on ``arguments`` may be part of a single kernel."""
    return all(name in _KNOWN for name in _operations(jax.make_jaxpr(function)(*arguments).jaxpr))


def _marked(function: Callable, marks: dict[str, str]) -> Callable:
    if not on_cpu():
        return function

    def unmarked(*arguments: Any) -> Any:
        with set_xla_metadata(**dict.fromkeys(marks)):
            return function(*arguments)

    def marked(*arguments: Any) -> Any:
        with set_xla_metadata(**marks):
            return jax.jit(unmarked)(*arguments)

    return marked


def _operations(jaxpr: Any) -> Iterator[str]:
    """Names of all operations, including those of nested functions."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from _operations(inner)


# Predictions from parameters before a computation, by functions in JAX.

# Points per evaluation, for few points and for many.
_FEW, _MANY = 32, 2048

Words = tuple[tuple[str, str], ...]
Columns = Mapping[str, Any]


def predicted(function: Callable[..., Array], constants: tuple[Hashable, ...], columns: Columns) -> np.ndarray:
    """``function(*given, values)`` of every point, shape ``(..., N)``.

    ``columns`` are the values of N points: numbers as arrays of shape ``(N,)`` or one number for all points, words, and
    tuples of numbers. ``values`` are the values of one point. The function is compiled once as a whole: compiling its
    operations one by one would take longer than a small scene. ``function`` may raise :class:`InputError`.
    """
    words, numbers = split(columns)
    count = count_of(columns)
    together = _FEW if count <= _FEW else _MANY
    call = _compiled(function, constants, words, together)
    blocks = []
    for start in range(0, count, together):
        size = min(together, count - start)
        # The last block is padded with its last point.
        places = np.minimum(np.arange(start, start + together), count - 1)
        try:
            blocks.append(np.asarray(call(taken(numbers, places)))[..., :size])
        except InputError as error:
            # Drop the notes that jax adds to an exception.
            raise InputError(*error.args) from None
    return np.concatenate(blocks, axis=-1)


def count_of(columns: Columns) -> int:
    """The number of points."""
    return max((np.size(leaf) for leaf in jax.tree.leaves(split(columns)[1])), default=1)


def taken(columns: Columns, places: np.ndarray) -> Columns:
    """The values of the points at ``places``."""

    def at_places(leaf: Any) -> Any:
        return leaf if isinstance(leaf, str) else np.broadcast_to(leaf, count)[places]

    count = count_of(columns)
    return jax.tree.map(at_places, columns)


def split(columns: Columns) -> tuple[Words, dict[str, Any]]:
    """The words and the numbers among the values."""
    numbers = {name: value for name, value in columns.items() if not isinstance(value, str)}
    return tuple((name, value) for name, value in columns.items() if name not in numbers), numbers


@lru_cache(maxsize=32)
def _compiled(
    function: Callable[..., Array], constants: tuple[Hashable, ...], words: Words, count: int
) -> Callable[[Columns], Array]:
    def one(numbers: Columns) -> Array:
        return function(*constants, {**dict(words), **numbers})

    options = options_for_few() if count == _FEW else {}
    return jax.jit(jax.vmap(one, 0, -1, axis_size=count), compiler_options=options)
