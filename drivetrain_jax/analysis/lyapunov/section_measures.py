"""Measures of a Poincare section: its period in strobes, and its distance from a smooth torus."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

import drivetrain_jax.systems  # noqa: F401  double precision

# Number of last strobes of a section that are compared with earlier ones.
_WINDOW = 64
# Harmonics of a clock in the fit of a torus, and iterations of the fit.
HARMONICS = 64
_ITERATIONS = 30


def period_multiple(section: Array, tolerance: Array, longest: int) -> Array:
    """Smallest p <= ``longest`` with |y(k) - y(k - p)| within ``tolerance`` of the largest |y|; 0 if there is none.

    ``section`` has shape ``(T, n, ...)`` with T >= longest + 64; the comparison runs over the last 64 strobes. p is the
    number of distinct points of a periodic motion. All components share one scale, because a component may vanish at the
    strobes. Leading axes of ``tolerance`` before the batch axes are kept, with one result for each entry.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    scale = jnp.where(scale > 0, scale, 1.0)
    end = section[-_WINDOW:] / scale

    def distance(p: Array) -> Array:
        start = section.shape[0] - _WINDOW - p
        earlier = jax.lax.dynamic_slice_in_dim(section, start, _WINDOW) / scale
        return jnp.max(jnp.abs(end - earlier), axis=(0, 1))

    def earliest(found: Array, p: Array) -> tuple[Array, None]:
        close = distance(p) <= tolerance
        return jnp.where((found == 0) & close, p, found), None

    none = jnp.zeros(jnp.broadcast_shapes(jnp.shape(tolerance), section.shape[2:]), jnp.int64)
    return jax.lax.scan(earliest, none, jnp.arange(1, longest + 1))[0]


def torus_residual(section: Array, angle: Array | None) -> Array:
    """Largest distance of the section from a smooth closed curve over ``angle``, over the largest |y|, ``(n, ...)``.

    ``section`` has shape ``(T, n, ...)``, ``angle`` ``(T, ...)`` is in rad. The curve is the best-fitting trigonometric
    polynomial of degree ``HARMONICS``, found by conjugate gradients on the normal equations; for a short section this is the
    fit with the smallest coefficients. Without an angle the curve is a point, the mean.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    scale = jnp.where(scale > 0, scale, 1.0)
    target = section / scale
    target = target - jnp.mean(target, axis=0)
    if angle is None:
        return jnp.max(jnp.abs(target), axis=0)
    turn = (jnp.cos(angle)[:, None], jnp.sin(angle)[:, None])
    return jnp.max(jnp.abs(target - _smooth(target, turn)), axis=0)


def _smooth(target: Array, turn: tuple[Array, Array]) -> Array:
    """Values of the best fit at the strobes."""

    def curve(coefficients: Array) -> Array:
        def add(carry: tuple, pair: Array) -> tuple:
            total, c, s = carry
            total = total + pair[0] * c + pair[1] * s
            return (total, c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]), None

        constant, pairs = coefficients[0, 0], coefficients[1:]
        start = (jnp.zeros_like(target) + constant, jnp.zeros_like(target) + turn[0], jnp.zeros_like(target) + turn[1])
        return jax.lax.scan(add, start, pairs)[0][0]

    def moments(values: Array) -> Array:
        def take(carry: tuple, _: None) -> tuple:
            c, s = carry
            pair = jnp.stack([jnp.mean(values * c, axis=0), jnp.mean(values * s, axis=0)])
            return (c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]), pair

        ones = jnp.ones_like(turn[0])
        return jax.lax.scan(take, (ones, 0 * ones), None, length=HARMONICS + 1)[1]

    right = moments(target)
    zero = jnp.zeros_like(right)
    size = jnp.sum(right**2, axis=(0, 1))

    def iterate(_: int, carry: tuple) -> tuple:
        x, r, p, rr = carry
        image = moments(curve(p))
        step = jnp.where(rr > 1e-34 * size, rr / jnp.sum(p * image, axis=(0, 1)), 0.0)
        x, r = x + step * p, r - step * image
        new = jnp.sum(r**2, axis=(0, 1))
        return x, r, r + jnp.where(rr > 0, new / rr, 0.0) * p, new

    solution = jax.lax.fori_loop(0, _ITERATIONS, iterate, (zero, right, right, size))[0]
    return curve(solution)
