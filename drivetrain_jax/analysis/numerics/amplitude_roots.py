"""Stationary amplitudes of one-term approximations: all amplitudes at a frequency, and those of a slow sweep.

Both closed-form approximations of a forced oscillator end in one equation for the amplitude A of the fundamental,
``residual(A, omega) = 0``. The residual is negative at A = 0 and positive for large A. The averaged amplitude grows where
the residual is negative and falls where it is positive: the first, third, ... root is stable, every second root a saddle.
Arrays have the batch as their trailing axes ``(...)``.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

_HALVINGS = 60


def refined(omega: np.ndarray, largest: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rising frequencies that contain ``omega``, and the position of each entry of ``omega`` in them.

    Steps are at most the fraction ``largest`` of the frequency, with at most ``most`` parts of one interval.
    """
    rising = np.unique(omega)
    ratio = np.log(rising[1:] / rising[:-1])
    parts = np.clip(np.ceil(ratio / largest), 1, most).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(rising[:-1], rising[1:], parts, strict=True)]
    fine = np.concatenate([*pieces, rising[-1:]])
    return fine, np.searchsorted(fine, omega)


def bisect(function: Callable[[Array], Array], low: Array, high: Array, halvings: int = _HALVINGS) -> Array:
    """The point between ``low`` and ``high`` at which ``function`` becomes positive."""

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        above = function(middle) > 0
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    low, high = jax.lax.fori_loop(0, halvings, halve, (low, high))
    return (low + high) / 2


def sign_changes(positive: Array, count: int) -> Array:
    """Mask ``(count, K - 1, ...)`` of the interval with the n-th change of sign along the first axis."""
    return first_marks(positive[1:] != positive[:-1], count)


def first_marks(marks: Array, count: int) -> Array:
    """The first ``count`` of the ``marks`` (K, ...) along the first axis, one per row: ``(count, K, ...)``."""
    rank = jnp.cumsum(marks, axis=0)
    number = jnp.arange(1, count + 1).reshape(count, *(1,) * marks.ndim)
    return marks & (rank == number)


def take(mask: Array, values: Array, missing: float = np.nan) -> Array:
    """The entry of ``values`` (K, ...) that each row of ``mask`` (n, K, ...) marks; ``missing`` where it marks none."""
    picked = jnp.sum(jnp.where(mask, values, 0.0), axis=1)
    return jnp.where(jnp.any(mask, axis=1), picked, missing)


def follow(roots: Array) -> Array:
    """Indices of the roots of a sweep up and a sweep down, ``(L, K, ...) -> (L, 2, ...)``.

    ``roots`` rise along K and are padded with infinity; frequencies rise along L. A sweep starts from rest. Between folds
    the number of roots is constant, and the sweep keeps its position among them, even on steep branches. At the first
    frequency past a fold the amplitude changes like the averaged motion: to the next root above if the residual at the old
    amplitude is negative, to the next root below if it is positive.
    """
    size = roots.shape[1]

    def move(state: tuple[Array, Array, Array], at: Array) -> tuple[tuple[Array, Array, Array], Array]:
        amplitude, place, before = state
        below = jnp.sum(at < amplitude, axis=0)
        number = jnp.sum(jnp.isfinite(at), axis=0)
        index = jnp.where(number == before, place, jnp.minimum(2 * (below // 2), size - 1))
        reached = jnp.take_along_axis(at, index[None], axis=0)[0]
        return (jnp.where(jnp.isfinite(reached), reached, amplitude), index, number), index

    nowhere = jnp.zeros_like(jnp.sum(jnp.isfinite(roots[0]), axis=0))
    rest = (jnp.zeros_like(roots[0, 0]), nowhere, nowhere)
    up = jax.lax.scan(move, rest, roots)[1]
    down = jax.lax.scan(move, rest, roots, reverse=True)[1]
    return jnp.stack([up, down], axis=1)
