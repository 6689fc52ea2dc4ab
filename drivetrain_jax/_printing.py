"""Text of modules with the values of their numbers; Equinox prints arrays without values."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.core


def printed(tree: Any) -> str:
    """The text of ``tree``, with values for arrays of one number and shapes for other arrays."""
    return eqx.tree_pformat(jax.tree.map(_number, tree))


def _number(leaf: Any) -> Any:
    single = isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer) and leaf.ndim == 0
    return leaf.item() if single else leaf
