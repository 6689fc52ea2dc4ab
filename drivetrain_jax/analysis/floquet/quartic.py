"""Spectral radius and its error in closed form for four states and a reversor, enough for most cells of a chart.

With Phi = [[A, B], [C, D]] in 2 x 2 blocks and the reversor X = [[0, I], [I, 0]],

    Z = X Phi^T X Phi = [[S, U], [V, S^T]],  S = D^T A + B^T C,  U = D^T B + B^T D,  V = C^T A + A^T C,

and det(sigma I - Z) = sigma^4 - e1 sigma^3 + e2 sigma^2 - e3 sigma + d splits into two real quadratics
sigma^2 - t_i sigma + m_i^2 with m_(1,2) = kappa exp(+-u), kappa = d^(1/4); w = sinh(u)^2 is a root >= 0 of a cubic. All
functions broadcast; a matrix is a nested list of arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import stored

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


def _less_product(factor: Array, a: Matrix, b: Matrix, c: Matrix) -> Matrix:
    """``factor a - b c``."""
    size = range(len(a))
    return [[factor * a[i][j] - sum(b[i][k] * c[k][j] for k in size) for j in size] for i in size]


def _norm(a: Matrix) -> Array:
    return jnp.sqrt(sum(x**2 for row in a for x in row))


Three = tuple[Array, Array, Array]


def invariants(phi: Blocks, error: Array | float = 0.0) -> tuple[Three, Three, Three]:
    """``e1, e2, e3`` by principal minors, and bounds of their changes by rounding and by an ``error`` of Phi (its norm).

    By their derivatives the coefficients change by at most ``2 |Phi G_k| error`` to first order, with ``G_1 = I``,
    ``G_2 = e1 I - Z`` and ``G_3 = e2 I - G_2 Z``. Terms of higher order are bounded by powers of the norms.
    """
    a, b, c, d = phi
    s = _sum(transposed_product(d, a), transposed_product(b, c))
    upper, lower = transposed_product(d, b), transposed_product(c, a)
    u11, u12, u22 = 2 * upper[0][0], upper[0][1] + upper[1][0], 2 * upper[1][1]
    v11, v12, v22 = 2 * lower[0][0], lower[0][1] + lower[1][0], 2 * lower[1][1]
    (s11, s12), (s21, s22) = s
    e1 = 2 * (s11 + s22)
    e2 = 2 * determinant(s) + s11**2 - u11 * v11 + s22**2 - u22 * v22 + 2 * (s11 * s22 - u12 * v12)
    # Principal minors without the first or the second row; by the reversor the other two minors have the same values.
    first = s22 * (s11 * s22 - s12 * s21) - u12 * (v12 * s22 - v22 * s21) + u22 * (v12 * s12 - v22 * s11)
    second = s11 * (s11 * s22 - s12 * s21) - u11 * (v11 * s22 - v12 * s21) + u12 * (v11 * s12 - v12 * s11)
    size = sum(square_norm(block) for block in phi)
    z = jnp.sqrt(2 * square_norm(s) + u11**2 + 2 * u12**2 + u22**2 + v11**2 + 2 * v12**2 + v22**2)
    rounding = _ROUNDINGS * EPS * size
    whole = [[*a[0], *b[0]], [*a[1], *b[1]], [*c[0], *d[0]], [*c[1], *d[1]]]
    matrix = [[s11, s12, u11, u12], [s21, s22, u12, u22], [v11, v12, s11, s21], [v12, v22, s12, s22]]
    second_slope = _less_product(e1, whole, whole, matrix)
    slopes = _norm(second_slope), _norm(_less_product(e2, whole, second_slope, matrix))
    changed = (2 * jnp.sqrt(size) + error) * error
    changes = (changed, 2 * slopes[0] * error + 4 * changed**2, 2 * slopes[1] * error + 10 * (z + changed) * changed**2)
    return (e1, e2, 2 * (first + second)), (rounding, rounding * z, rounding * z**2), changes  # pyright: ignore[reportReturnType]


def with_determinant(e: Sequence[Array] | Array, errors: Sequence[Array] | Array, log_d: Array) -> Coefficients:
    """The coefficients from ``e1, e2, e3``, bounds of their errors, and log d."""
    # Computed once, because every power of it would need an exponential.
    kappa = stored(jnp.exp)(log_d / 4)
    return Coefficients(*e, kappa, (*errors, 8 * EPS * (1 + jnp.abs(log_d)) * kappa**4))  # pyright: ignore[reportCallIssue]


def coefficients(phi: Blocks, log_d: Array, error: Array | float) -> Coefficients:
    """Characteristic coefficients of ``phi``, which has an ``error`` of at most this norm."""
    e, rounding, changes = invariants(phi, error)
    return with_determinant(e, [a + b for a, b in zip(rounding, changes, strict=True)], log_d)


def _cubic_root(p2: Array, p1: Array, p0: Array) -> Array:
    """A root >= 0 of w^3 + p2 w^2 + p1 w + p0, p0 <= 0.

    Newton's method from a start from which it converges monotonically: from 0 if the inflection lies to the right of it
    and above the axis (concave in between), else from an upper bound of the roots (convex to its left).
    """
    bend = -p2 / 3
    concave = (bend > 0) & (((bend + p2) * bend + p1) * bend + p0 > 0)
    # Where w >= 1/4, w^2 <= m2 w + m1 - 4 p0 with the magnitudes m of negative coefficients. Another Newton step costs less
    # than the square root or the quotient of a tighter bound.
    m2, m1 = jnp.maximum(-p2, 0.0), jnp.maximum(-p1, 0.0)
    bound = jnp.maximum((m2 + jnp.sqrt(m2**2 + 4 * (m1 - 4 * p0))) / 2, 0.25)
    # If p2 > 0, the quadratic without w^3 bounds the root as well.
    root = jnp.sqrt(jnp.maximum(p1**2 - 4 * p2 * p0, 0.0))
    top, bottom = jnp.where(p1 > 0, -2 * p0, root - p1), jnp.where(p1 > 0, p1 + root, 2 * p2)
    bound = jnp.where((p2 > 0) & (top < bound * bottom), top / bottom, bound)

    def step(_: int, w: Array) -> Array:
        value, slope = ((w + p2) * w + p1) * w + p0, (3 * w + 2 * p2) * w + p1
        return jnp.where(slope > 0, jnp.maximum(w - value / slope, 0.0), w)

    # Unrolled, each step would repeat all earlier ones in the compiled code.
    return jax.lax.fori_loop(0, _NEWTON_STEPS, step, jnp.where(concave, 0.0, bound))


class _Factor(NamedTuple):
    """sigma^2 - t sigma + m^2 with ``half = t/2`` and ``gap`` half the distance of its roots, real or not."""

    half: Array
    m: Array
    gap: Array
    real: Array

    @property
    def large(self) -> Array:
        """The larger modulus of the two roots."""
        return jnp.where(self.real, jnp.abs(self.half) + self.gap, self.m)

    @property
    def small(self) -> Array:
        """The smaller modulus of two real roots."""
        return jnp.abs(self.half) - self.gap

    def difference(self, other: _Factor) -> tuple[Array, Array]:
        """``slope, offset``: at a root sigma of this factor the ``other`` factor has the value slope sigma + offset."""
        return 2 * (self.half - other.half), (other.m - self.m) * (other.m + self.m)

    def where(self, condition: Array, other: _Factor) -> _Factor:
        """This factor where ``condition`` holds, else the other."""
        return _Factor(*(jnp.where(condition, a, b) for a, b in zip(self, other, strict=True)))


def factors(c: Coefficients) -> tuple[_Factor, _Factor]:
    """The two real quadratics."""
    a, b, g = stored(_monic)(c.e1, c.e2, c.e3, c.kappa)
    plus, minus, e = (a + g) ** 2 / 4, (a - g) ** 2 / 4, 4 * b - 8
    w = _cubic_root((16 - e) / 16, (plus - minus - e) / 16, -minus / 16)
    one, two = (stored(_factor)(*pair) for pair in stored(_pairs)(a, b, g, w, c.kappa))
    return one, two


def farthest(split: tuple[_Factor, _Factor], centre: Array | float) -> Array:
    """The largest distance of the four roots from ``centre``."""
    squares = []
    for factor in split:
        away = jnp.abs(factor.half - centre)
        squares.append(jnp.where(factor.real, (away + factor.gap) ** 2, away**2 + factor.gap**2))
    return jnp.sqrt(jnp.maximum(*squares))


def _monic(e1: Array, e2: Array, e3: Array, kappa: Array) -> tuple[Array, Array, Array]:
    inverse = 1 / kappa
    return e1 * inverse, e2 * inverse**2, e3 * inverse**3


def _pairs(a: Array, b: Array, g: Array, w: Array, kappa: Array) -> tuple[tuple[Array, Array], ...]:
    """Sum and modulus of the roots of both quadratics, the sum in units of the modulus."""
    cosh, sinh = jnp.sqrt(1 + w), jnp.sqrt(w)
    total = (a + g) / (2 * cosh)
    # a - g = 2 sinh(u) (p1 - p2) as well: of the two formulas for the difference use the one with the larger divisor.
    difference = jnp.sqrt(jnp.maximum(total**2 - 4 * (b - 2 * (1 + 2 * w)), 0.0))
    quotient = (a - g) / (2 * jnp.where(sinh > 0, sinh, 1.0))
    difference = jnp.where(sinh > difference, quotient, jnp.where(a < g, -difference, difference))
    growth = cosh + sinh
    return ((total + difference) / 2, kappa * growth), ((total - difference) / 2, kappa / growth)


def _factor(p: Array, m: Array) -> _Factor:
    # p^2/4 - 1 as a product: exact where two roots meet.
    radicand = (p / 2 - 1) * (p / 2 + 1)
    return _Factor(m * p / 2, m, m * jnp.sqrt(jnp.abs(radicand)), radicand >= 0)


def _unexplained(c: Coefficients, one: _Factor, two: _Factor) -> tuple[Array, ...]:
    """``errors`` plus the residual of the product of the factors."""
    t1, t2, m1, m2 = 2 * one.half, 2 * two.half, one.m**2, two.m**2
    misses = (c.e1 - (t1 + t2), c.e2 - (m1 + m2 + t1 * t2), c.e3 - (t1 * m2 + t2 * m1), 0.0)
    return tuple(jnp.abs(miss) + error for miss, error in zip(misses, c.errors, strict=True))


def _square_at_pair(factor: _Factor, slope: Array, offset: Array) -> Array:
    """``|slope sigma + offset|^2`` at the complex roots of a factor."""
    return (slope * factor.half + offset) ** 2 + (slope * factor.gap) ** 2


def _at_real(factor: _Factor, modulus: Array, slope: Array, offset: Array) -> Array:
    """``|slope sigma + offset|`` at the real root of this modulus."""
    return jnp.abs(jnp.where(factor.half < 0, -slope, slope) * modulus + offset)


def spectral_radius(c: Coefficients, split: tuple[_Factor, _Factor] | None = None) -> tuple[Array, Array, Array]:
    """``rho``, a bound of its error, and True where the bound is much wider than necessary or not a number.

    ``split`` are the :func:`factors` of ``c``, if known.

    The bound uses Smith's discs. With eps(sigma) = sum_k error_k |sigma|^(4-k), the true multipliers lie in the union of
    discs about the computed multipliers s_i with radius 4 eps(s_i)/prod_(j != i) |s_i - s_j|; each connected part has as
    many multipliers as centres. If the dominant disc, or pair of discs, lies further out than the others, its radius bounds
    the error.
    """
    one, two = split or factors(c)
    errors = _unexplained(c, one, two)
    first = one.large >= two.large
    top, other = one.where(first, two), two.where(first, one)
    rho, m = top.large, other.large
    # For all four discs: eps grows with the modulus.
    eps = 2 * (((errors[0] * rho + errors[1]) * rho + errors[2]) * rho + errors[3])
    slope, offset = top.difference(other)
    at_top = jnp.where(top.real, _at_real(top, rho, slope, offset), jnp.sqrt(_square_at_pair(top, slope, offset)))
    radius = eps / (top.gap * at_top)
    lower = rho - radius
    # The other discs lie further in if eps/(gap value) < lower - modulus.
    room, sibling, least = (lower - m) * other.gap, (lower - top.small) * top.gap, (lower - other.small) * other.gap
    pair = (room > 0) & (eps**2 < room**2 * _square_at_pair(other, slope, offset))
    real = (eps < room * _at_real(other, m, slope, offset)) & (
        eps < least * _at_real(other, other.small, slope, offset)
    )
    alone = jnp.where(other.real, real, pair)
    alone &= ~top.real | (eps < sibling * _at_real(top, top.small, slope, offset))
    error = jnp.where(alone, radius + 4 * EPS * rho, jnp.inf)
    # A double multiplier cannot be bounded better than by the root of the coefficients' own errors.
    bound = ((c.errors[0] * rho + c.errors[1]) * rho + c.errors[2]) * rho + c.errors[3]
    return rho, error, ~((error * rho) ** 2 < 0.01 * bound)


def nothing_crosses(c: Coefficients, log_d: Array) -> Array:
    """True if no polynomial within the errors has a root on the unit circle, so that all have as many roots inside it.

    None of p(1), p(-1) and g = 1 + d - e2 + e1^2/4 - w^2/4, w = (e1 + e1 d - 2 e3)/(1 - d), may vanish. The equation g = 0
    is equivalent to p = (sigma^2 - P sigma + 1)(sigma^2 - Q sigma + d) with w = P - Q.
    """
    e1, e2, e3, d = c.e1, c.e2, c.e3, jnp.exp(log_d)
    d1, d2, d3, dd = c.errors
    missing = -jnp.expm1(log_d)
    w, dw = (e1 + e1 * d - 2 * e3) / missing, ((1 + d) * d1 + 2 * d3) / missing
    rounding = 8 * EPS * (1 + jnp.abs(e1) + jnp.abs(e2) + jnp.abs(e3) + d + e1**2 + w**2)
    even, odd, every = 1 + e2 + d, e1 + e3, d1 + d2 + d3 + dd + rounding
    real = (jnp.abs(even - odd) > every) & (jnp.abs(even + odd) > every)
    error = d2 + dd + (jnp.abs(e1) + d1 / 2) * d1 / 2 + (jnp.abs(w) + dw / 2) * dw / 2 + rounding
    return real & (jnp.abs(1 + d - e2 + e1**2 / 4 - w**2 / 4) > error) & (missing > 0)
