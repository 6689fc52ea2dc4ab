"""A propagator as the product of those over equal parts of its span.

A part turns through a part of the phase, so it takes far fewer nodes than the whole: the parts are interpolated first, and
the panels of the whole take their nodes from the product. Solves give the parts at no further cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import accumulate

import numpy as np

from drivetrain_jax.atlas import interpolation
from drivetrain_jax.atlas.panels import Atlas, Panel, grid_positions, position
from drivetrain_jax.atlas.quantity import Quantity

# Of the errors that the product may have the parts take this share, by an estimate, and by comparison of the product itself
# the next. Coefficients are not asked for beyond a part of the tolerance, nor below rounding, relative to the norm of all.
_SHARE, _MEASURED, _SHARPEST, _ROUNDING = 0.1, 0.4, 4e-4, 2e-13


def parts_quantity(whole: Quantity, count: int, tolerance: float) -> Quantity:
    """Propagators over ``count`` parts, one after the other, for panels to ``tolerance`` of the ``whole``.

    ``dPhi = sum_k L_k dP_k R_k`` with the products ``L_k``, ``R_k`` of the parts after and before, where errors without a
    preferred direction grow by ``|L_k| |R_k|/n`` in the mean (Frobenius norms): this decides what coefficients may be left
    out. At single points the error of the product is compared.
    """

    def scale(values: np.ndarray) -> np.ndarray:
        parts = _matrices(values, count)
        n = parts.shape[1]
        identity = np.broadcast_to(np.eye(n)[..., None], parts[0].shape)
        before = [identity, *accumulate(parts, _followed_by)]
        after = [identity, *accumulate(reversed(parts), _times)]
        growth = np.mean([_squares(after[count - 1 - k]) * _squares(before[k]) for k in range(count)], axis=0) / n**2
        finest = max(_ROUNDING / tolerance, _SHARPEST) * np.sqrt(np.sum(values**2, axis=1))
        return np.maximum(_SHARE * whole.scale(_entries(before[-1])) / np.sqrt(growth), finest)

    def relative_error(fitted: np.ndarray, exact: np.ndarray) -> np.ndarray:
        right = product(exact, count)
        return whole.relative_error(product(fitted, count), right, whole.scale(right)) / _MEASURED

    return Quantity(count * whole.size, scale, relative=relative_error)


def product(values: np.ndarray, count: int) -> np.ndarray:
    """The propagators ``(N, n n)`` whose ``count`` parts are ``values`` ``(N, count n n)``."""
    return _entries(reduce(_followed_by, _matrices(values, count)))


def _matrices(values: np.ndarray, count: int) -> np.ndarray:
    """Parts as ``(count, n, n, N)``: the points last, so that the loops over them are the innermost."""
    n = math.isqrt(values.shape[1] // count)
    return np.ascontiguousarray(values.T).reshape(count, n, n, -1)


def _entries(matrices: np.ndarray) -> np.ndarray:
    """``(n, n, N)`` as ``(N, n n)``."""
    return np.ascontiguousarray(matrices.reshape(-1, matrices.shape[-1]).T)


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ijp,jkp->ikp", a, b)


def _followed_by(product: np.ndarray, part: np.ndarray) -> np.ndarray:
    return _times(part, product)


def _squares(matrices: np.ndarray) -> np.ndarray:
    return np.einsum("ijp,ijp->p", matrices, matrices)


class Product:
    """Propagators from an atlas of their ``count`` parts, as a source of nodes."""

    def __init__(self, parts: Atlas, count: int) -> None:
        self._parts, self._count = parts, count

    def at(self, x: np.ndarray) -> np.ndarray:
        """Propagators at points ``(N, d)`` in coordinates, all in the box of one panel."""
        panel = self._panel(x.mean(axis=0))
        return product(interpolation.evaluate(panel.coefficients, position(panel, x)), self._count)

    def on_grid(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        """The same at all points of a grid, in C order, from its ``axes``."""
        panel = self._panel(np.array([axis.mean() for axis in axes]))
        t = grid_positions(panel, axes)
        size = panel.coefficients.shape[-1] // self._count
        n = math.isqrt(size)
        parts = (
            interpolation.on_grid(panel.coefficients[..., k * size : (k + 1) * size], t).reshape(n, n, -1)
            for k in range(self._count)
        )
        return _entries(reduce(_followed_by, parts))

    def _panel(self, x: np.ndarray) -> Panel:
        return self._parts.panels[int(self._parts.find(x[None])[0])]
