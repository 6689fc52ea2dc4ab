"""From a monodromy matrix to Floquet multipliers, a certified spectral radius and a verdict.

The bound rests on the characteristic polynomial p(z) = det(z I - Z). Let its coefficients be wrong by at most
``delta_k``, so that the true polynomial differs from the computed one by at most eps(z) = sum_k delta_k |z|^(n-k).
By Rouche's theorem a circle on which |p| > eps encloses as many true as computed multipliers. Two families of circles
bracket the spectral radius rho of the true matrix:

- about the origin with radius rho + r: with s_i the multiplier nearest to z and d_i = rho + r - |s_i| <= |z - s_i|,
  |p(z)| >= min_i d_i prod_(j != i) max(d_j, |s_i - s_j|/2), where |s_i - s_j| - d_i may replace half the gap if d_i is
  below 1/32 of the smallest one (the product then grows with |z - s_i|). No true multiplier lies further out;
- about the dominant multiplier s_1 with radius r, where |p(z)| >= r prod_(j != 1) ||s_1 - s_j| - r|: a true multiplier
  lies inside.

Near a double multiplier (the edge of every tongue) the bound is of the size of the square root of the coefficients' error.

Without damping a multiplier s has the partner 1/conj(s). If the circle about s holds no other multiplier, and its
reflection at the unit circle meets no other circle, s is its own partner: it lies on the unit circle and is simple.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import matmul, square_sum

VERDICTS = ("stable", "unstable", "undecided")

# Radii of the circles relative to the spectral radius: four per decade from rounding up to 10, 1 % below powers of ten so
# that a bound can meet a decimal tolerance.
_LADDER = 0.99 * 10.0 ** (np.arange(-64, 5) / 4)


def characteristic_polynomial(z: Array) -> tuple[Array, Array]:
    """Coefficients a_1..a_n of det(s I - Z) = s^n + a_1 s^(n-1) + ... and the sizes of their slopes, each ``(n, ...)``.

    By the recursion of Faddeev and Le Verrier, N_k = Z N_(k-1) + a_k I, where ``-N_(k-1)^T`` is the derivative of a_k by the
    entries of Z. Its size is ``|N_(k-1)|/sqrt(n)``, 1 for the trace.
    """
    n = z.shape[0]
    unit = np.eye(n).reshape(n, n, *(1,) * (z.ndim - 2))
    power, coefficients, slopes = z, [], [jnp.ones(z.shape[2:])]
    for k in range(1, n + 1):
        a = -sum(power[i, i] for i in range(n)) / k
        coefficients.append(a)
        if k < n:
            slopes.append(jnp.sqrt(square_sum(power + a * unit) / n))
            power = matmul(z, power) + a * z
    return jnp.stack(coefficients), jnp.stack(slopes)


def characteristic_coefficients(z: Array) -> Array:
    """Coefficients a_1..a_n of det(s I - Z) = s^n + a_1 s^(n-1) + ..., ``(n, n, ...) -> (n, ...)``."""
    return characteristic_polynomial(z)[0]


def root_scale(coefficients: Array) -> Array:
    """Lower bound of the largest modulus of the roots: max_k (|a_k| / binomial(n, k))^(1/k), ``(n, ...) -> (...)``."""
    n = coefficients.shape[0]
    roots = {1: lambda x: x, 2: jnp.sqrt, 3: jnp.cbrt, 4: lambda x: jnp.sqrt(jnp.sqrt(x))}
    terms = [jnp.abs(coefficients[k - 1]) / math.comb(n, k) for k in range(1, n + 1)]
    return reduce(jnp.maximum, (roots.get(k, lambda x, k=k: x ** (1 / k))(x) for k, x in enumerate(terms, 1)))


def sort_multipliers(real: Array, imaginary: Array) -> Array:
    """The multipliers ``real + i imaginary`` by falling modulus, ``(n, ...) -> (n, ...)`` complex.

    Multipliers whose moduli agree to 1e-9 are in rising order of the argument, so that rounding never swaps a conjugate
    pair.
    """
    modulus = jnp.hypot(real, imaginary)
    rank = jnp.round(-modulus / jnp.max(modulus, axis=0), 9)
    order = jnp.lexsort((jnp.arctan2(imaginary, real), rank), axis=0)
    return jnp.take_along_axis(real + 1j * imaginary, order, axis=0)


def spectral_radius_bound(real: Array, imaginary: Array, error: Array) -> Array:
    """Bound of the error of ``rho``, the largest modulus of the multipliers ``real + i imaginary``, ``(n, ...) -> (...)``.

    ``error`` bounds the errors of the coefficients a_k in units of rho^k. The result is at least four roundings of rho,
    and inf if no circle of the ladder is certified.
    """
    n = real.shape[0]
    modulus = jnp.hypot(real, imaginary)
    rho = jnp.max(modulus, axis=0)
    modulus, x, y = modulus / rho, real / rho, imaginary / rho

    def eps(r: Array) -> Array:
        # Both circles lie within |z| <= 1 + r, where sum_k error |z|^(n-k) <= n error (1 + r)^(n-1).
        return n * error * (1 + r) ** (n - 1)

    radius = jnp.maximum(_circle_around_all(modulus, x, y, eps), _circle_around_largest(modulus, x, y, eps))
    return rho * (radius + 4 * np.finfo(float).eps)


def _circle_around_all(modulus: Array, x: Array, y: Array, eps: Callable[[Array], Array]) -> Array:
    """Smallest r of the ladder such that ``|z| <= 1 + r`` holds all zeros; multipliers ``x + i y`` are in units of rho."""
    n, ladder = len(x), jnp.asarray(_LADDER)
    gap = jnp.hypot(x[:, None] - x, y[:, None] - y)
    closest = jnp.stack([jnp.min(jnp.delete(gap[i], i, axis=0), axis=0, initial=jnp.inf) for i in range(n)])

    def outside(r: Array) -> Array:
        reach = 1 + r - modulus
        margin = jnp.where((reach < closest / 32)[:, None], gap - reach[:, None], gap / 2)
        products = [
            reach[i] * math.prod(jnp.maximum(reach[j], margin[i, j]) for j in range(n) if j != i) for i in range(n)
        ]
        return jnp.min(jnp.stack(products), axis=0) > eps(r)

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        # The condition is monotone in r: bisect for the first radius that meets it.
        low, high = bracket
        middle = (low + high) // 2
        met = outside(ladder[middle])
        return jnp.where(met, low, middle), jnp.where(met, middle, high)

    first = jnp.full(modulus.shape[1:], -1), jnp.full(modulus.shape[1:], ladder.size)
    rung = jax.lax.fori_loop(0, math.ceil(math.log2(ladder.size)) + 1, halve, first)[1]
    return jnp.where(rung < ladder.size, ladder[jnp.minimum(rung, ladder.size - 1)], jnp.inf)


def _circle_around_largest(modulus: Array, x: Array, y: Array, eps: Callable[[Array], Array]) -> Array:
    """Smallest r of the ladder such that a zero lies within r of the largest multiplier."""
    n = len(x)
    x1, y1, top = x[0], y[0], modulus[0]
    for j in range(1, n):
        larger = modulus[j] > top
        x1, y1, top = (jnp.where(larger, new, old) for new, old in ((x[j], x1), (y[j], y1), (modulus[j], top)))
    return _circle_around(jnp.hypot(x - x1, y - y1), eps)


def _circle_around(distances: Array, eps: Callable[[Array], Array]) -> Array:
    """Smallest r of the ladder such that the circle of this radius about a multiplier holds as many zeros as multipliers.

    ``distances`` ``(n, ...)`` of all multipliers from it contain the 0 of its own, so the product over all of them has the
    factor r.
    """
    n, ladder = len(distances), jnp.asarray(_LADDER)

    def descend(k: int, inner: Array) -> Array:
        r = ladder[ladder.size - 1 - k]
        return jnp.where(math.prod(jnp.abs(distances[j] - r) for j in range(n)) > eps(r), r, inner)

    return jax.lax.fori_loop(0, ladder.size, descend, jnp.full(distances.shape[1:], jnp.inf))


def multiplier_errors(real: Array, imaginary: Array, error: Array) -> Array:
    """Bound of the error of each multiplier ``real + i imaginary``, ``(n, ...) -> (n, ...)``; inf if nothing is known.

    ``error`` as in :func:`spectral_radius_bound`.
    """
    n = len(real)
    rho = jnp.max(jnp.hypot(real, imaginary), axis=0)
    distances = jnp.hypot(real[:, None] - real, imaginary[:, None] - imaginary) / rho
    # All circles of use lie within |z| <= 1 + r, as those of the spectral radius.
    radius = _circle_around(distances, lambda r: n * error * (1 + r) ** (n - 1))
    return rho * (radius + 4 * np.finfo(float).eps)


def all_on_the_circle(real: Array, imaginary: Array, error: Array, scale: Array) -> Array:
    """True if all multipliers ``scale (real + i imaginary)`` without damping are simple and on the unit circle, ``(...)``.

    ``error`` as in :func:`spectral_radius_bound`.
    """
    n = len(real)
    modulus = jnp.hypot(real, imaginary)
    radius = multiplier_errors(real, imaginary, error)
    gaps = jnp.hypot(real[:, None] - real, imaginary[:, None] - imaginary)
    gaps = jnp.where(jnp.eye(n, dtype=bool).reshape(n, n, *(1,) * (real.ndim - 1)), jnp.inf, gaps)
    # Four radii about a multiplier at the unit circle contain the reflection of its circle if that is below 0.1.
    apart = (scale * radius < 0.1) & jnp.all(gaps > 4 * radius[:, None] + radius, axis=1)
    return jnp.all(apart & (jnp.abs(scale * modulus - 1) <= scale * radius), axis=0)


def verdict(rho: Array, error: Array) -> Array:
    """0 stable, 1 unstable, 2 undecided: the interval ``rho +- error`` contains 1, or either is not a number."""
    return jnp.where(rho + error < 1, 0, jnp.where(rho - error > 1, 1, 2)).astype(jnp.int8)
