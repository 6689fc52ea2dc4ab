"""Batches as the last axis: counting the lanes of a set of parameters, and working through them in parts."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from drivetrain_jax.analysis.numerics.kernels import on_cpu

Values = Mapping[str, Any]


def path_entry(values: Values, name: str) -> Any:
    """The values of the parameter ``name``, or of one entry of a list, ``planet_angle[1]``."""
    match = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return values[match.group(1)][int(match.group(2))] if match else values[name]


def lane_count(values: Values, path: str = "") -> int:
    """Length of the arrays among ``values``, 1 if there are none; the path axis, if there is one, does not count."""
    along = path_entry(values, path) if path else None
    lengths = [np.shape(leaf)[0] for leaf in jax.tree.leaves(values) if np.ndim(leaf) and leaf is not along]
    return max(lengths, default=1)


def with_path(values: Values, path: str, lanes: int) -> tuple[dict[str, Any], int]:
    """``values`` for every point of the path times every lane, in this order flattened to one axis; length of the
    path."""
    along = path_entry(values, path)
    length = np.shape(along)[0]

    def spread(leaf: Any) -> Any:
        if leaf is along:
            return jnp.repeat(jnp.asarray(leaf), lanes)
        return jnp.tile(leaf, length) if np.ndim(leaf) else leaf

    return jax.tree.map(spread, dict(values)), length


def in_blocks(function: Callable[[dict[str, Any], int], Any], values: Values, lanes: int, size: int) -> Any:
    """``function(values, count)`` of ``lanes`` lanes, ``size`` at a time; its results have the lanes as last axis.

    The arrays among ``values`` are cut; numbers stay the constants that they are. The caches of a core are what ``size`` is
    for: an accelerator does all lanes at once.
    """
    count = -(-lanes // size)
    leaves, tree = jax.tree.flatten(dict(values))
    varying = [i for i, leaf in enumerate(leaves) if np.ndim(leaf)]
    if count == 1 or not varying or not on_cpu():
        return function(dict(values), lanes)

    def part(columns: list[Array]) -> Any:
        own = list(leaves)
        for i, column in zip(varying, columns, strict=True):
            own[i] = column
        return function(jax.tree.unflatten(tree, own), size)

    columns = [jnp.pad(leaves[i], (0, count * size - lanes), mode="edge").reshape(count, size) for i in varying]

    def join(result: Array) -> Array:
        whole = jnp.moveaxis(result, 0, -2)
        return whole.reshape(*whole.shape[:-2], count * size)[..., :lanes]

    return jax.tree.map(join, lax.map(part, columns))


def by_rows(function: Callable[[Any], Any], rows: Any) -> Any:
    """``function`` of every entry along the first axis of ``rows``, one after the other, so that what it makes on the way
    stays in the caches; on an accelerator all at once."""
    return lax.map(function, rows) if on_cpu() else jax.vmap(function)(rows)


def evaluated_once(certain: Array, function: Callable[[], Any]) -> Any:
    """``function()``, computed once and kept in memory, where XLA for CPUs would compute it again for every entry of
    every array that depends on it: a conditional is a border that fusion does not cross.

    ``certain`` is a condition that holds whenever it is evaluated, but is not known to the compiler. Results may rely on
    the single evaluation, which the marks of :mod:`~drivetrain_jax.analysis.numerics.kernels` do not promise.
    """
    shapes = jax.eval_shape(function)
    return lax.cond(certain, function, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))
