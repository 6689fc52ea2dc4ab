"""What is predicted from parameters, before anything is computed, by functions in JAX."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError

# Points that are evaluated together: of few, and of many.
_FEW, _MANY = 32, 2048

Words = tuple[tuple[str, str], ...]
Columns = Mapping[str, Any]


def predicted(function: Callable[..., Array], given: tuple[Hashable, ...], columns: Columns) -> np.ndarray:
    """``function(*given, values)`` of every point, shape ``(..., N)``.

    ``columns`` are the values of N points: arrays of shape ``(N,)``, or what all points share; ``values`` are those of one.
    The function is compiled once for all numbers. Run operation by operation each of these would be compiled, which takes
    longer than a small scene does. It may raise :class:`InputError`.
    """
    words, numbers = split(columns)
    arrays = {name: np.asarray(value) for name, value in numbers.items()}
    varying = frozenset(name for name, value in arrays.items() if value.ndim)
    count = np.broadcast(*arrays.values()).size if arrays else 1
    together = _FEW if count <= _FEW else _MANY
    call = _compiled(function, given, words, varying, together)
    found = []
    for start in range(0, count, together):
        stop = min(start + together, count)
        fill = (0, together - (stop - start))
        block = {n: np.pad(x[start:stop], fill, mode="edge") if n in varying else x for n, x in arrays.items()}
        found.append(_called(call, block)[..., : stop - start])
    return np.concatenate(found, axis=-1)


def _called(call: Callable[[Columns], Array], block: Columns) -> np.ndarray:
    try:
        return np.asarray(call(block))
    except InputError as error:
        # Without the notes that jax adds to what passes through it.
        raise InputError(*error.args) from None


def split(columns: Columns) -> tuple[Words, dict[str, Any]]:
    """The words among values, and the numbers."""
    numbers = {name: value for name, value in columns.items() if not isinstance(value, str)}
    return tuple((name, value) for name, value in columns.items() if name not in numbers), numbers


@lru_cache(maxsize=32)
def _compiled(
    function: Callable[..., Array], given: tuple[Hashable, ...], words: Words, varying: frozenset[str], count: int
) -> Callable[[Columns], Array]:
    def one(own: Columns, shared: Columns) -> Array:
        return function(*given, {**dict(words), **shared, **own})

    def all_together(block: Columns) -> Array:
        own = {name: block[name] for name in varying}
        shared = {name: block[name] for name in block if name not in varying}
        return jax.vmap(one, (0, None), -1, axis_size=count)(own, shared)

    return jax.jit(all_together)
