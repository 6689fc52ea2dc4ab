"""Stability without damping, where stable multipliers lie exactly on the unit circle.

If Phi = [[A, B], [C, D]] is symplectic, (sigma + 1/sigma)/2 = 1 + 2 m with the eigenvalues m of M = B^T C, and
det M = det B det C, det(I + M) = det A det D. All multipliers lie on the unit circle, apart from each other, if and only
if m_1 != m_2 are real with -1 < m < 0: then every motion stays bounded. At the tip of a tongue the products of the
determinants vanish to second order. The signs of the four single determinants are therefore used: each is known wherever
the determinant exceeds its own error.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet.quartic import EPS, Blocks, determinant, square_norm, transposed_product


def _sign(value: Array, error: Array) -> Array:
    """The sign -1 or 1 where it is certain, else 0."""
    return jnp.where(value > error, 1, jnp.where(value < -error, -1, 0))


def verdict(phi: Blocks, value_error: Array) -> Array:
    """0 stable, 1 unstable, 2 undecided for a symplectic Phi whose error has at most the norm ``value_error``."""
    size = jnp.sqrt(sum(square_norm(block) for block in phi))
    delta = value_error + 8 * EPS * size

    def sign(block: list[list[Array]]) -> Array:
        norm = jnp.sqrt(square_norm(block))
        return _sign(determinant(block), delta * (norm + delta))

    a, b, c, d = (sign(block) for block in phi)
    at_one, at_minus_one = b * c, a * d
    m = transposed_product(phi.b, phi.c)
    trace, spread = m[0][0] + m[1][1], m[0][0] - m[1][1]
    m_error = delta * (jnp.sqrt(square_norm(phi.b)) + jnp.sqrt(square_norm(phi.c)) + delta)
    m_norm = jnp.sqrt(square_norm(m))
    pair = _sign(spread**2 + 4 * m[0][1] * m[1][0], 8 * m_error * (m_norm + m_error) + 16 * EPS * m_norm**2)
    # If both real m have one sign, and both 1 + m have one sign, the mean of m shows which signs these are.
    inside = _sign(-trace, 2 * m_error) * _sign(2 + trace, 2 * m_error)
    stable = (at_one > 0) & (at_minus_one > 0) & (pair > 0) & (inside > 0)
    unstable = (at_one < 0) | (at_minus_one < 0) | (pair < 0)
    outside = (at_one > 0) & (at_minus_one > 0) & (pair > 0) & (inside < 0)
    return jnp.where(stable, 0, jnp.where(unstable | outside, 1, 2)).astype(jnp.int8)
