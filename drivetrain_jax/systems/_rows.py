"""Matrices as nested tuples of entries; an entry that vanishes identically is the integer ``0``."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

Rows = tuple[tuple[Any, ...], ...]


def dense(rows: Rows) -> Array:
    """The matrix of ``rows`` as an array, ``(n, n, ...)``."""
    shape = jnp.broadcast_shapes(*(jnp.shape(entry) for row in rows for entry in row))
    return jnp.stack([jnp.stack([jnp.broadcast_to(entry, shape) for entry in row]) for row in rows])
