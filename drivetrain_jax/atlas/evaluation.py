"""Values of an atlas at scattered points, by matrix products panel by panel.

Shapes are fixed, so that one compiled kernel serves all panels: blocks of points are padded, and so are the degrees of
smaller panels (with coefficients 0). The lanes are the last axis of every array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.atlas import interpolation
from drivetrain_jax.atlas.panels import Atlas, Panel, chebyshev, position

# Upper limit of the size of the first product of a block of scattered points.
_WORKING_SET = 1 << 22
# Points of a line that are evaluated at a time, and mean number of points per line above which lines save time.
_LINE, _SHARED = 1 << 10, 2


def values_at(
    atlas: Atlas, points: np.ndarray, solve: Callable[[np.ndarray], np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The functions of ``atlas`` at points ``(N, d)`` (parameters): values ``(N, m)`` and bounds ``(N,)``.

    A bound limits the norm of the error of the panel, without rounding at evaluation. Points in gaps or outside are solved
    by ``solve(points) -> values``, as in the construction, and have the bound 0; without ``solve`` they are NaN. Raises
    ``ValueError`` if there is neither a panel nor ``solve``.
    """
    points = np.asarray(points, float)
    x = atlas.to_coordinates(points)
    number = atlas.find(x)
    uncovered = number < 0
    direct = np.asarray(solve(points[uncovered]), float) if solve and uncovered.any() else None
    if not atlas.panels and direct is None:
        reasons = "; ".join(sorted({gap.reason for gap in atlas.gaps}))
        raise ValueError(f"atlas without a panel ({reasons}): allowed is one that covers some of its domain")
    size = atlas.panels[0].coefficients.shape[-1] if atlas.panels else direct.shape[1]  # pyright: ignore[reportOptionalMemberAccess]
    values, bounds = np.full((len(points), size), np.nan), np.full(len(points), np.nan)
    for k, panel in enumerate(atlas.panels):
        mine = number == k
        values[mine] = interpolation.evaluate(panel.coefficients, position(panel, x[mine]))
        bounds[mine] = panel.value_error
    if direct is not None:
        values[uncovered], bounds[uncovered] = direct, 0.0
    return values, bounds


def scattered(tensor: Array, weights: Sequence[Array]) -> Array:
    """Values ``(m, N)`` from ``tensor`` ``(n_1, m, n_2, ..., n_d)`` and T_j of each coordinate, ``(n_k, N)``."""
    n, m, *rest = tensor.shape
    values = (tensor.reshape(n, -1).T @ weights[0]).reshape(m, *rest, -1)
    for w in reversed(weights[1:]):
        values = jnp.sum(values * w, axis=-2)
    return values


def on_lines(panel: Panel, x: np.ndarray) -> np.ndarray:
    """Values ``(m, N)`` at points in coordinates ``(N, d)``, many of which share all coordinates but the last two.

    The tensor of the last two coordinates is made once for each combination of the others.
    """
    t, d = position(panel, x), x.shape[1]
    values = np.empty((panel.coefficients.shape[-1], len(x)))

    def fill(coefficients: np.ndarray, chosen: np.ndarray, k: int) -> None:
        if k < d - 2:
            for place in np.unique(t[chosen, k]):
                reduced = np.tensordot(chebyshev(place, len(coefficients)), coefficients, axes=(0, 0))
                fill(reduced, chosen[t[chosen, k] == place], k + 1)
            return
        first, second = coefficients.shape[:2]
        for part in np.array_split(chosen, -(-len(chosen) // _LINE)):
            rows = chebyshev(t[part, k], first) @ coefficients.reshape(first, -1)
            values[:, part] = np.einsum(
                "pnm,pn->mp", rows.reshape(len(part), second, -1), chebyshev(t[part, -1], second)
            )

    fill(panel.coefficients, np.arange(len(x)), 0)
    return values


def share_lines(x: np.ndarray) -> bool:
    """True if on average at least ``_SHARED`` of the points ``x`` share all coordinates but the last two."""
    return x.shape[1] > 2 and _SHARED * len(np.unique(x[:, :-2], axis=0)) <= len(x)


def block_size(atlas: Atlas) -> int:
    """Number of scattered points to evaluate at a time."""
    rest = max((int(np.prod(p.coefficients.shape[1:])) for p in atlas.panels), default=1)
    return int(2 ** np.clip(np.floor(np.log2(_WORKING_SET / rest)), 6, 10))


def common_degrees(panels: Sequence[Panel]) -> tuple[int, ...]:
    """The largest degrees among ``panels``."""
    return tuple(np.max([p.degrees for p in panels], axis=0))


def padded_tensor(panel: Panel, degrees: Sequence[int]) -> np.ndarray:
    """Coefficients as ``(n_1, m, n_2, ..., n_d)``, padded with zeros to ``degrees``."""
    fill = [(0, n - k) for n, k in zip(degrees, panel.degrees, strict=True)]
    return np.ascontiguousarray(np.moveaxis(np.pad(panel.coefficients, [*fill, (0, 0)]), -1, 1))


def point_weights(panel: Panel, x: np.ndarray, degrees: Sequence[int], size: int) -> list[np.ndarray]:
    """``weights`` of :func:`scattered` for points in coordinates ``(N, d)``, padded to ``size`` with the last one."""
    t = np.pad(position(panel, x), ((0, size - len(x)), (0, 0)), mode="edge")
    return [np.ascontiguousarray(chebyshev(t[:, k], n).T) for k, n in enumerate(degrees)]
