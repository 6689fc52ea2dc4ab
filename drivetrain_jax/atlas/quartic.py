"""Spectral radius and its error in closed form for four states and a reversor: all that a chart needs of most cells.

With Phi = [[A, B], [C, D]] in 2 x 2 blocks and the reversor X = [[0, I], [I, 0]],

    Z = X Phi^T X Phi = [[S, U], [V, S^T]],  S = D^T A + B^T C,  U = D^T B + B^T D,  V = C^T A + A^T C,

and det(sigma I - Z) = sigma^4 - e1 sigma^3 + e2 sigma^2 - e3 sigma + d splits into two real quadratics
sigma^2 - t_i sigma + m_i^2 with m_(1,2) = kappa exp(+-u), kappa = d^(1/4); w = sinh(u)^2 is a root >= 0 of a cubic. All
functions broadcast; a matrix is a nested list of arrays.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

Matrix = list[list[Array]]

EPS = float(np.finfo(float).eps)
_NEWTON_STEPS = 9
# Roundings in a coefficient, in units of eps times its natural size.
_ROUNDINGS = 16.0


class Blocks(NamedTuple):
    """The 2 x 2 blocks of Phi."""

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix


class Coefficients(NamedTuple):
    """``e1, e2, e3`` and ``kappa = d^(1/4)`` of the characteristic polynomial, and bounds ``errors`` of e1, e2, e3, d."""

    e1: Array
    e2: Array
    e3: Array
    kappa: Array
    errors: tuple[Array, Array, Array, Array]


def blocks(phi: Array) -> Blocks:
    """Blocks of ``phi``, its 16 entries by rows as leading axis."""
    rows = [[phi[4 * i + j] for j in range(4)] for i in range(4)]
    part = {(i, j): [row[2 * j : 2 * j + 2] for row in rows[2 * i : 2 * i + 2]] for i in (0, 1) for j in (0, 1)}
    return Blocks(part[0, 0], part[0, 1], part[1, 0], part[1, 1])


def transposed_product(a: Matrix, b: Matrix) -> Matrix:
    """``a^T b``."""
    return [[a[0][i] * b[0][j] + a[1][i] * b[1][j] for j in (0, 1)] for i in (0, 1)]


def determinant(a: Matrix) -> Array:
    """Determinant of a 2 x 2 matrix."""
    return a[0][0] * a[1][1] - a[0][1] * a[1][0]


def square_norm(a: Matrix) -> Array:
    """Sum of squares of a 2 x 2 matrix."""
    return a[0][0] ** 2 + a[0][1] ** 2 + a[1][0] ** 2 + a[1][1] ** 2


def _sum(a: Matrix, b: Matrix) -> Matrix:
    return [[a[i][j] + b[i][j] for j in (0, 1)] for i in (0, 1)]


def coefficients(phi: Blocks, log_d: Array, derived_error: Array) -> Coefficients:
    """Characteristic coefficients by principal minors; ``derived_error`` ``(3, ...)`` is that of the interpolation."""
    a, b, c, d = phi
    s = _sum(transposed_product(d, a), transposed_product(b, c))
    upper, lower = transposed_product(d, b), transposed_product(c, a)
    u11, u12, u22 = 2 * upper[0][0], upper[0][1] + upper[1][0], 2 * upper[1][1]
    v11, v12, v22 = 2 * lower[0][0], lower[0][1] + lower[1][0], 2 * lower[1][1]
    (s11, s12), (s21, s22) = s
    e1 = 2 * (s11 + s22)
    e2 = 2 * determinant(s) + s11**2 - u11 * v11 + s22**2 - u22 * v22 + 2 * (s11 * s22 - u12 * v12)
    # Principal minors without the first or the second row; the reversor makes the other two equal to them.
    first = s22 * (s11 * s22 - s12 * s21) - u12 * (v12 * s22 - v22 * s21) + u22 * (v12 * s12 - v22 * s11)
    second = s11 * (s11 * s22 - s12 * s21) - u11 * (v11 * s22 - v12 * s21) + u12 * (v11 * s12 - v12 * s11)
    e3 = 2 * (first + second)
    size = sum(square_norm(block) for block in phi)
    z = jnp.sqrt(2 * square_norm(s) + u11**2 + 2 * u12**2 + u22**2 + v11**2 + 2 * v12**2 + v22**2)
    rounding = _ROUNDINGS * EPS * size
    errors = tuple(derived_error[k] + rounding * z**k for k in range(3))
    kappa = jnp.exp(log_d / 4)
    return Coefficients(e1, e2, e3, kappa, (*errors, 8 * EPS * (1 + jnp.abs(log_d)) * kappa**4))


def _cubic_root(p2: Array, p1: Array, p0: Array) -> Array:
    """A root >= 0 of w^3 + p2 w^2 + p1 w + p0, p0 <= 0.

    Newton's method from a start from which it converges monotonically: from 0 if the inflection lies to the right of it
    and above the axis (concave in between), else from an upper bound of the roots (convex to its left).
    """
    bend = -p2 / 3
    concave = (bend > 0) & (((bend + p2) * bend + p1) * bend + p0 > 0)
    # Where w >= s, w^2 <= m2 w + m1 - p0/s with the magnitudes m of negative coefficients; if p2 > 0, w^3 may be left out.
    m2, m1 = jnp.maximum(-p2, 0.0), jnp.maximum(-p1, 0.0)
    s = jnp.maximum(jnp.maximum(m2, jnp.sqrt(m1)), 0.25)
    bound = jnp.maximum((m2 + jnp.sqrt(m2**2 + 4 * (m1 - p0 / s))) / 2, s)
    root = jnp.sqrt(jnp.maximum(p1**2 - 4 * p2 * p0, 0.0))
    top, bottom = jnp.where(p1 > 0, -2 * p0, root - p1), jnp.where(p1 > 0, p1 + root, 2 * p2)
    bound = jnp.where((p2 > 0) & (top < bound * bottom), top / bottom, bound)
    w = jnp.where(concave, 0.0, bound)
    for _ in range(_NEWTON_STEPS):
        value, slope = ((w + p2) * w + p1) * w + p0, (3 * w + 2 * p2) * w + p1
        w = jnp.where(slope > 0, jnp.maximum(w - value / slope, 0.0), w)
    return w


class _Factor(NamedTuple):
    """sigma^2 - t sigma + m^2 with ``half = t/2`` and ``gap`` half the distance of its roots, real or not."""

    half: Array
    m: Array
    gap: Array
    real: Array

    @property
    def moduli(self) -> tuple[Array, Array]:
        """Moduli of the two roots, the larger first."""
        large = jnp.where(self.real, jnp.abs(self.half) + self.gap, self.m)
        return large, self.m * (self.m / large)

    def values_of(self, other: _Factor) -> tuple[Array, Array]:
        """Modulus of the other factor at the two roots."""
        slope, offset = 2 * (self.half - other.half), (other.m - self.m) * (other.m + self.m)
        large, small = self.moduli
        sign = jnp.where(self.half < 0, -1.0, 1.0)
        at_pair = jnp.sqrt((slope * self.half + offset) ** 2 + (slope * self.gap) ** 2)
        real = (jnp.abs(slope * sign * x + offset) for x in (large, small))
        return tuple(jnp.where(self.real, value, at_pair) for value in real)


def factors(c: Coefficients) -> tuple[_Factor, _Factor]:
    """The two real quadratics."""
    kappa, inverse = c.kappa, 1 / c.kappa
    a, b, g = c.e1 * inverse, c.e2 * inverse**2, c.e3 * inverse**3
    plus, minus, e = (a + g) ** 2 / 4, (a - g) ** 2 / 4, 4 * b - 8
    w = _cubic_root((16 - e) / 16, (plus - minus - e) / 16, -minus / 16)
    cosh, sinh = jnp.sqrt(1 + w), jnp.sqrt(w)
    total = (a + g) / (2 * cosh)
    # a - g = 2 sinh(u) (p1 - p2) as well: of the two ways to the difference the one that divides by the larger number.
    difference = jnp.sqrt(jnp.maximum(total**2 - 4 * (b - 2 * (1 + 2 * w)), 0.0))
    quotient = (a - g) / (2 * jnp.where(sinh > 0, sinh, 1.0))
    difference = jnp.where(sinh > difference, quotient, jnp.where(a < g, -difference, difference))
    growth = cosh + sinh

    def factor(p: Array, m: Array) -> _Factor:
        # p^2/4 - 1 as a product: exact where two roots meet.
        radicand = (p / 2 - 1) * (p / 2 + 1)
        return _Factor(m * p / 2, m, m * jnp.sqrt(jnp.abs(radicand)), radicand >= 0)

    return factor((total + difference) / 2, kappa * growth), factor((total - difference) / 2, kappa / growth)


def _unexplained(c: Coefficients, one: _Factor, two: _Factor) -> tuple[Array, ...]:
    """``errors`` plus what the product of the factors misses."""
    t1, t2, m1, m2 = 2 * one.half, 2 * two.half, one.m**2, two.m**2
    misses = (c.e1 - (t1 + t2), c.e2 - (m1 + m2 + t1 * t2), c.e3 - (t1 * m2 + t2 * m1), 0.0)
    return tuple(jnp.abs(miss) + error for miss, error in zip(misses, c.errors, strict=True))


def spectral_radius(c: Coefficients) -> tuple[Array, Array, Array]:
    """``rho``, a bound of its error, and whether the bound is much wider than it need be (or not a number).

    Smith's discs: with eps(sigma) = sum_k error_k |sigma|^(4-k), the true multipliers lie in the union of the discs about
    the computed ones s_i with radius 4 eps(s_i)/prod_(j != i) |s_i - s_j|, in each connected part as many as centres.
    """
    one, two = factors(c)
    errors = _unexplained(c, one, two)
    moduli, radii = [], []
    for factor, other in ((one, two), (two, one)):
        for modulus, value in zip(factor.moduli, factor.values_of(other), strict=True):
            eps = ((errors[0] * modulus + errors[1]) * modulus + errors[2]) * modulus + errors[3]
            moduli.append(modulus)
            radii.append(2 * eps / (factor.gap * value))
    rho = jnp.maximum(moduli[0], moduli[2])
    upper = reduce(jnp.maximum, (m + r for m, r in zip(moduli, radii, strict=True)))
    first = moduli[0] >= moduli[2]
    lower = jnp.where(first, moduli[0] - radii[0], moduli[2] - radii[2])
    # The dominant disc (with its mirror image) must lie apart from the others to hold a multiplier of its own.
    sibling = jnp.where(first, one.real & (moduli[1] + radii[1] >= lower), two.real & (moduli[3] + radii[3] >= lower))
    others = jnp.where(first, *(jnp.maximum(moduli[k] + radii[k], moduli[k + 1] + radii[k + 1]) for k in (2, 0)))
    error = jnp.where(sibling | (others >= lower), jnp.inf, jnp.maximum(upper - rho, rho - lower) + 4 * EPS * rho)
    # A double multiplier cannot be bounded better than by the root of the coefficients' own errors.
    given = ((c.errors[0] * rho + c.errors[1]) * rho + c.errors[2]) * rho + c.errors[3]
    return rho, error, ~(error**2 < 0.01 * given / rho**2)
