"""Predictions from parameters before a computation, by functions in JAX."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.numerics.kernels import options_for_few

# Points per evaluation, for few points and for many.
_FEW, _MANY = 32, 2048

Words = tuple[tuple[str, str], ...]
Columns = Mapping[str, Any]


def predicted(function: Callable[..., Array], given: tuple[Hashable, ...], columns: Columns) -> np.ndarray:
    """``function(*given, values)`` of every point, shape ``(..., N)``.

    ``columns`` are the values of N points: numbers as arrays of shape ``(N,)`` or one number for all points, words, and
    tuples of numbers. ``values`` are the values of one point. The function is compiled once as a whole: compiling its
    operations one by one would take longer than a small scene. ``function`` may raise :class:`InputError`.
    """
    words, numbers = split(columns)
    count = count_of(columns)
    together = _FEW if count <= _FEW else _MANY
    call = _compiled(function, given, words, together)
    found = []
    for start in range(0, count, together):
        size = min(together, count - start)
        # The last block is padded with its last point.
        places = np.minimum(np.arange(start, start + together), count - 1)
        found.append(_called(call, taken(numbers, places))[..., :size])
    return np.concatenate(found, axis=-1)


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


def _called(call: Callable[[Columns], Array], block: Columns) -> np.ndarray:
    try:
        return np.asarray(call(block))
    except InputError as error:
        # Drop the notes that jax adds to an exception.
        raise InputError(*error.args) from None


@lru_cache(maxsize=32)
def _compiled(
    function: Callable[..., Array], given: tuple[Hashable, ...], words: Words, count: int
) -> Callable[[Columns], Array]:
    def one(numbers: Columns) -> Array:
        return function(*given, {**dict(words), **numbers})

    options = options_for_few() if count == _FEW else {}
    return jax.jit(jax.vmap(one, 0, -1, axis_size=count), compiler_options=options)
