"""Batches as the last axis: functions of one point under ``jax.vmap``, and lanes in blocks."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from drivetrain_jax.analysis.numerics.kernels import FULL_WIDTH, on_cpu

Values = Mapping[str, Any]


def path_entry(values: Values, name: str) -> Any:
    """The values of the parameter ``name``, or of one entry of a list such as ``planet_angle[1]``."""
    match = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return values[match.group(1)][int(match.group(2))] if match else values[name]


def lane_count(values: Values, path: str = "") -> int:
    """Length of the arrays among ``values`` without the path axis; 1 without arrays."""
    along = path_entry(values, path) if path else None
    lengths = [np.shape(leaf)[0] for leaf in jax.tree.leaves(values) if np.ndim(leaf) and leaf is not along]
    return max(lengths, default=1)


def with_path(values: Values, path: str, lanes: int) -> tuple[dict[str, Any], int]:
    """``values`` for every point of the path and every lane, flattened in this order to one axis, and the path's length."""
    along = path_entry(values, path)
    length = np.shape(along)[0]

    def spread(leaf: Any) -> Any:
        if leaf is along:
            return jnp.repeat(jnp.asarray(leaf), lanes)
        return jnp.tile(leaf, length) if np.ndim(leaf) else leaf

    return jax.tree.map(spread, dict(values)), length


def in_blocks(
    function: Callable[[Any, int], Any],
    values: Any,
    lanes: int,
    size: int,
    mark: Callable[[Callable], Callable] = lambda function: function,
) -> Any:
    """``function(values, count)`` of ``lanes`` lanes in blocks of ``size``; its results have the lanes as last axis.

    Arrays among ``values`` with the lanes as last axis are cut into blocks; other values stay whole. ``size`` lanes fit into
    the caches of a core; an accelerator computes all lanes at once. ``mark`` marks the loop over the blocks; all values are
    then arrays of lanes.
    """
    leaves, tree = jax.tree.flatten(values)
    varying = [i for i, leaf in enumerate(leaves) if np.ndim(leaf) and np.shape(leaf)[-1] == lanes]
    if lanes <= size or not varying or not on_cpu():
        return mark(lambda values: function(values, lanes))(values)

    def part(columns: list[Array]) -> Any:
        block = list(leaves)
        for i, column in zip(varying, columns, strict=True):
            block[i] = column
        return function(jax.tree.unflatten(tree, block), size)

    cut = [blocks_first(jnp.asarray(leaves[i]), size) for i in varying]
    return jax.tree.map(lambda x: blocks_joined(x, lanes), mark(lambda columns: lax.map(part, columns))(cut))


def blocks_first(leaf: Array, size: int) -> Array:
    """``leaf`` with its last axis cut into blocks of ``size``, the first axis; the last lane fills the last block."""
    count = -(-leaf.shape[-1] // size)
    return jnp.moveaxis(_padded(leaf, count * size).reshape(*leaf.shape[:-1], count, size), -2, 0)


def blocks_joined(blocks: Array, lanes: int) -> Array:
    """``lanes`` lanes as last axis, from blocks as first axis."""
    whole = jnp.moveaxis(blocks, 0, -2)
    return whole.reshape(*whole.shape[:-2], -1)[..., :lanes]


def _padded(array: Array, lanes: int) -> Array:
    """``array`` with its last lane repeated up to ``lanes``."""
    widths = [(0, 0)] * (array.ndim - 1) + [(0, lanes - array.shape[-1])]
    return jnp.pad(array, widths, mode="edge")


class Constants:
    """A hashable pytree, for the arguments of a traced function that are no traced arrays."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        self.leaves, structure = jax.tree.flatten(tree)
        content = [(x.shape, x.tobytes()) if isinstance(x, np.ndarray) else x for x in self.leaves]
        self._content = (*content, structure)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constants) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


def lanes_last(
    function: Callable[[Any, Any, Any], Any],
    constants: Constants,
    varying: Any,
    shared: Any,
    size: int | None = None,
    expected: int = 1,
) -> Any:
    """``function(constants, varying, shared)`` of one point; under ``jax.vmap``, even nested, one call for all lanes.

    ``function`` has the lanes as an additional last axis of every array in ``varying`` and of its results. Values common to
    all lanes have a last axis of length 1; numbers have none. ``shared`` applies to all lanes: different integers become
    their maximum, other values an array of lanes. With ``size``, ``function`` runs on blocks of this number of lanes, once
    traced for equal ``constants``. A single point, and a batch that fits into one vector, are computed as a whole.
    A cached trace of ``function`` for the ``expected`` number of lanes serves the single point, which jax traces before it
    batches.
    """
    at_once = partial(_at_once, function, constants)

    @custom_vmap
    def call(varying: Any, shared: Any) -> Any:
        lanes = max(x.shape[-1] for x in jax.tree.leaves(varying))
        if lanes >= expected:
            return at_once(varying, shared, size and (1 if lanes == 1 else size))
        # A single point is padded to the expected batch, because it would need another trace.
        whole = jax.tree.map(lambda x: _padded(x, expected) if x.shape[-1] == lanes else x, varying)
        return jax.tree.map(lambda x: x[..., :lanes], at_once(whole, shared, size))

    @call.def_vmap
    def rule(batch: int, batched: Any, varying: Any, shared: Any) -> Any:
        if not any(jax.tree.leaves(batched)):
            results = call(varying, shared)
            return results, jax.tree.map(lambda _: False, results)
        if not batch:
            return _empty(call, batched, varying, shared)
        lanes = max(x.shape[-1] for x in jax.tree.leaves(varying))
        merged = jax.tree.map(partial(_merged, batch, lanes), varying, batched[0])
        common = jax.tree.map(partial(_common, batch, lanes), shared, batched[1])
        few = batch * lanes <= FULL_WIDTH
        results = at_once(merged, common, size and FULL_WIDTH) if few else call(merged, common)
        parted = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], batch, lanes), -2, 0), results)
        return parted, jax.tree.map(lambda _: True, results)

    results = call(jax.tree.map(lambda x: jnp.asarray(x)[..., None], varying), shared)
    return jax.tree.map(lambda x: x[..., 0], results)


def _empty(call: Callable[[Any, Any], Any], batched: Any, varying: Any, shared: Any) -> tuple[Any, Any]:
    """The results of no points, for the rule of ``jax.vmap``."""

    def one(x: Array, batched: bool) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(x.shape[batched:], x.dtype)

    results = jax.eval_shape(
        call, *(jax.tree.map(one, x, flags) for x, flags in zip((varying, shared), batched, strict=True))
    )
    return jax.tree.map(lambda x: jnp.zeros((0, *x.shape), x.dtype), results), jax.tree.map(lambda _: True, results)


def _at_once(
    function: Callable[[Any, Any, Any], Any], constants: Constants, varying: Any, shared: Any, size: int | None
) -> Any:
    """The results of all lanes, ``size`` of them at a time if given."""
    lanes = max(x.shape[-1] for x in jax.tree.leaves(varying))
    arrays = jax.tree.map(lambda x: x[0] if x.shape == (1,) and lanes > 1 else x, varying), shared
    if size is None or not on_cpu():
        return function(constants, *arrays)
    full = max(lanes, size)
    arrays = jax.tree.map(lambda x: _padded(x, full) if x.ndim and x.shape[-1] == lanes else x, arrays)
    results = in_blocks(lambda block, _: traced_once(function, constants, *block), arrays, full, size)
    return jax.tree.map(lambda x: x[..., :lanes], results)


def _merged(batch: int, lanes: int, x: Array, batched: bool) -> Array:
    """A varying array with the batch merged into the lanes; the batch is its first axis if it has its ``batched`` values."""
    if batched:
        x = jnp.broadcast_to(x, (*x.shape[:-1], lanes))
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], batch * lanes)
    return x if x.shape[-1] == 1 else jnp.tile(x, batch)


def _common(batch: int, lanes: int, x: Array, batched: bool) -> Array:
    """A shared value for the whole batch: the maximum of different integers, or an array of lanes of other values."""
    if batched and jnp.issubdtype(x.dtype, jnp.integer):
        return jnp.max(x)
    if batched:
        return jnp.broadcast_to(x if x.ndim > 1 else x[:, None], (batch, lanes)).reshape(-1)
    return x if jnp.ndim(x) == 0 else jnp.tile(x, batch)


def traced_once(function: Callable[[Any, Any, Any], Any], constants: Constants, varying: Any, shared: Any) -> Any:
    """``function(constants, varying, shared)`` by a cached trace; jax caches no traces across transformations."""
    leaves, tree = jax.tree.flatten((varying, shared))
    leaves = [jnp.asarray(x) for x in leaves]
    kinds = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves)
    closed, results = _trace(function, constants, tree, kinds)
    return jax.tree.unflatten(results, jaxpr_as_fun(closed)(*leaves))


@lru_cache(maxsize=64)
def _trace(
    function: Callable[[Any, Any, Any], Any], constants: Constants, tree: Any, kinds: tuple[jax.ShapeDtypeStruct, ...]
) -> tuple[ClosedJaxpr, Any]:
    traced = jax.make_jaxpr(lambda *x: function(constants, *jax.tree.unflatten(tree, x)), return_shape=True)
    closed, shapes = traced(*kinds)
    return closed, jax.tree.structure(shapes)


def over_lanes(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """``function(values, effort)`` of one point as a function of lanes, with the lanes as last axis of its results.

    JAX arrays among ``values`` hold one number for each lane. All other ``values``, NumPy arrays included, apply to all
    lanes. Without arrays there is no axis of lanes.
    """

    def all_lanes(values: Any, effort: Any) -> Any:
        arrays, rest = eqx.partition(dict(values), lambda x: isinstance(x, jax.Array) and x.ndim > 0)
        if not jax.tree.leaves(arrays):
            return function(values, effort)
        return jax.vmap(lambda point: function(eqx.combine(point, rest), effort), 0, -1)(arrays)

    return all_lanes


def by_rows(function: Callable[[Any], Any], rows: Any) -> Any:
    """``function`` of every entry along the first axis of ``rows``.

    Entries are computed one by one, so that intermediate values stay in the caches; on an accelerator all at once.
    """
    return lax.map(function, rows) if on_cpu() else jax.vmap(function)(rows)


def evaluated_once(certain: Array, function: Callable[[], Any]) -> Any:
    """``function()``, computed once and kept in memory.

    XLA for CPUs would otherwise compute it again for every entry of every array that depends on it. Fusion does not cross a
    conditional. ``certain`` is a condition that always holds, which the compiler does not know. Results may rely on the
    single evaluation, which the marks of :mod:`~drivetrain_jax.analysis.numerics.kernels` do not guarantee.
    """
    shapes = jax.eval_shape(function)
    return lax.cond(certain, function, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))


def with_lanes(result: Array, dims: int, lanes: int) -> Array:
    """``result`` with the lanes as last axis, also if it does not depend on the varying parameters."""
    result = jnp.asarray(result)
    result = result if result.ndim > dims else result[..., None]
    return jnp.broadcast_to(result, (*result.shape[:-1], lanes))


@jax.custom_jvp
def moved_in_time(state: Array, rate: Array, late: Array) -> Array:
    """``state``, at a time that is ``late`` = 0 after the end of an integration, with the derivative by this time.

    A requested time at which an integration already stands takes no step, although the time moves with the parameters.
    """
    return state


@moved_in_time.defjvp
def _moved_in_time(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    return primals[0], tangents[0] + primals[1] * tangents[2]
