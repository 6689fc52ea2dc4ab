"""From a monodromy matrix to Floquet multipliers, a certified spectral radius and a verdict.

The bound rests on the characteristic polynomial p(z) = det(z I - Z). Let its coefficients be wrong by so little that the
true polynomial differs from the computed one by at most eps(z) = sum_k delta_k |z - c|^(n-k), where the centre c is the
mean of the multipliers: a cluster of them loses little then, although its coefficients about 0 are ill-conditioned. On a
circle of radius r about a multiplier s_i, |p(z)| >= prod_j ||s_i - s_j| - r|. If this exceeds the largest eps(z), no root
crosses the circle while the computed polynomial is deformed into the true one (Rouche). So each multiplier is within the
smallest such radius r_i of its true value, and rho lies between |s_1| - r_1, for the largest multiplier, and
max_i |s_i| + r_i. Near a double multiplier (the edge of every tongue) r_i is of the size of the square root of delta.

Without damping a multiplier s has the partner 1/conj(s). If the circle about s holds no other multiplier, and its
reflection at the unit circle meets no other circle, s is its own partner: it lies on the unit circle and is simple.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, matmul, product, square_sum

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Factored

VERDICTS = ("stable", "unstable", "undecided")

# Radii of the circles relative to the spectral radius: four per decade from 10 down to rounding, 1 % below powers of ten so
# that a bound can meet a decimal tolerance.
_LARGEST, _STEP, _COUNT = 9.9, 10**-0.25, 69
# Ratio of moduli below which multipliers belong to different blocks, and roundings of a factor in units of eps.
_APART, _ROUNDINGS = 1e-6, 16.0
# Size of rounding in the coupling of blocks that have converged, and a margin for their coupling three periods before.
_SEPARATE, _COUPLING = 1e-12, 1e6


def characteristic_polynomial(z: Array) -> tuple[Array, Array]:
    """Coefficients a_1..a_n of det(s I - Z) = s^n + a_1 s^(n-1) + ... and the sizes of their slopes, each ``(n, ...)``.

    By the recursion of Faddeev and Le Verrier, N_k = Z N_(k-1) + a_k I, where ``-N_(k-1)^T`` is the derivative of a_k by the
    entries of Z. Its size is ``|N_(k-1)|/sqrt(n)``, 1 for the trace.
    """
    n, axes = len(z), (1,) * (z.ndim - 2)
    unit, number = np.eye(n).reshape(n, n, *axes), np.arange(1, n + 1).reshape(n, *axes)

    def onward(k: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        power, coefficients, slopes = state
        a = -sum(power[i, i] for i in range(n)) / k
        following = power + a * unit
        slopes = jnp.where(number == k + 1, jnp.sqrt(square_sum(following) / n), slopes)
        return product(z, following), jnp.where(number == k, a, coefficients), slopes

    start = z, jnp.zeros_like(z[0]), jnp.ones_like(z[0])
    return jax.lax.fori_loop(1, n + 1, onward, start)[1:]


def characteristic_coefficients(z: Array) -> Array:
    """Coefficients a_1..a_n of det(s I - Z) = s^n + a_1 s^(n-1) + ..., ``(n, n, ...) -> (n, ...)``."""
    return characteristic_polynomial(z)[0]


def root(x: Array, k: int) -> Array:
    """The ``k``-th root of ``x``; powers cost more than square roots."""
    roots = {1: lambda x: x, 2: jnp.sqrt, 3: jnp.cbrt, 4: lambda x: jnp.sqrt(jnp.sqrt(x))}
    return roots.get(k, lambda x: x ** (1 / k))(x)


def root_scale(coefficients: Array) -> Array:
    """Lower bound of the largest modulus of the roots: max_k (|a_k| / binomial(n, k))^(1/k), ``(n, ...) -> (...)``."""
    n = len(coefficients)
    return reduce(jnp.maximum, (root(jnp.abs(coefficients[k - 1]) / math.comb(n, k), k) for k in range(1, n + 1)))


def sort_multipliers(real: Array, imaginary: Array) -> Array:
    """The multipliers ``real + i imaginary`` by falling modulus, ``(n, ...) -> (n, ...)`` complex.

    Multipliers whose moduli agree to 1e-9 are in rising order of the argument, so that rounding never swaps a conjugate
    pair.
    """
    modulus = jnp.hypot(real, imaginary)
    rank = jnp.round(-modulus / jnp.max(modulus, axis=0), 9)
    order = jnp.lexsort((jnp.arctan2(imaginary, real), rank), axis=0)
    return jnp.take_along_axis(real + 1j * imaginary, order, axis=0)


def over_first(operation: Callable[[Array, Array], Array], x: Array) -> Array:
    """``operation`` of all entries along the first axis; unlike a reduction it may be part of a kernel."""
    return reduce(operation, (x[i] for i in range(len(x))))


class PolynomialError(NamedTuple):
    """det(s I - Z) is wrong by at most ``sum_k sizes[k-1] |s - centre|^(n-k)``; ``sizes`` is ``(n, ...)``."""

    sizes: Array
    centre: Array | float = 0.0

    def bound(self, distance: Array) -> Array:
        """The bound at a ``distance`` from the centre, which has the axes of the lanes last."""
        return reduce(lambda total, size: total * distance + size, self.sizes, jnp.zeros_like(distance))

    def lanes(self, chosen: Array) -> PolynomialError:
        """The errors of some lanes."""
        return PolynomialError(self.sizes[..., chosen], jnp.broadcast_to(self.centre, self.sizes.shape[1:])[chosen])


def spectral_radius_bound(real: Array, imaginary: Array, error: PolynomialError) -> Array:
    """Bound of the error of ``rho``, the largest modulus of the multipliers ``real + i imaginary``, ``(n, ...) -> (...)``.

    It is at least four roundings of rho, and inf if no circle of the ladder is certified.
    """
    modulus, radii = jnp.hypot(real, imaginary), multiplier_errors(real, imaginary, error)
    rho = over_first(jnp.maximum, modulus)
    inwards = over_first(jnp.minimum, jnp.where(modulus == rho, radii, jnp.inf))
    return jnp.maximum(over_first(jnp.maximum, radii - (rho - modulus)), inwards)


def multiplier_errors(real: Array, imaginary: Array, error: PolynomialError, counted: Array | bool = True) -> Array:
    """Bound of the error of each multiplier ``real + i imaginary``, ``(n, ...) -> (n, ...)``; inf if nothing is known.

    Multipliers that are not ``counted`` ``(n, ...)`` are exactly 0.
    """
    rho = over_first(jnp.maximum, jnp.hypot(real, imaginary))
    distances = jnp.hypot(real[:, None] - real, imaginary[:, None] - imaginary) / rho
    reach = jnp.hypot(real - error.centre, imaginary) / rho
    scaled = PolynomialError(jnp.stack([size / rho**k for k, size in enumerate(error.sizes, 1)]))

    def descend(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        r, radii = state
        # The distance of a multiplier from itself is 0, so each product has the factor r.
        product = over_first(jnp.multiply, jnp.where(counted, jnp.abs(distances - r), 1.0))
        return r * _STEP, jnp.where(product > scaled.bound(reach + r), r, radii)

    start = jnp.asarray(_LARGEST), jnp.full_like(real, jnp.inf)
    return rho * (jax.lax.fori_loop(0, _COUNT, descend, start)[1] + 4 * np.finfo(float).eps)


def graded_multipliers(factored: Factored) -> tuple[Array, Array, Array]:
    """Multipliers in falling order of size, as ``exp(logs) sigma``, with bounds of the errors of sigma, ``(n, ...)`` each.

    Multipliers whose sizes are within a factor of ``1/_APART`` are those of one diagonal block. Its characteristic
    polynomial is wrong by the difference between both numbers of panels, by rounding, and by what couples it to others.
    """
    logs, turn = factored.logs[1], factored.turn[1]
    n, axes = len(logs), (1,) * (logs.ndim - 1)
    place = np.arange(n).reshape(n, *axes)
    group = [jnp.zeros_like(logs[0])]
    for i in range(1, n):
        group.append(group[-1] + (logs[i - 1] - logs[i] > -math.log(_APART)))
    group = jnp.stack(group)
    # The block of each multiplier, as a matrix of its own: axes are row, column, number of the multiplier, lanes.
    member = (group[:, None] == group).astype(float)
    scale = over_first(jnp.maximum, jnp.where(member > 0, logs[:, None], -jnp.inf))
    inside = member[:, None] * member

    def blocks(k: int) -> Array:
        sizes = jnp.exp(jnp.minimum(factored.logs[k][:, None] - scale, -math.log(_APART)))
        left = factored.turn[k][:, :, None] * inside * sizes
        return matmul(left, factored.upper[k][:, :, None] * inside)

    coarse, fine = blocks(0), blocks(1)
    norm = jnp.sqrt(square_sum(fine))
    real, imaginary = eigenvalues(fine)
    sigma = sort_multipliers(real, imaginary)
    rho = jnp.abs(sigma[0])
    # What couples a block to larger ones falls in each period by the ratio of their moduli.
    ratio = jnp.exp(3 * jnp.minimum(logs[:, None] - logs, 0.0))
    leak = jnp.where(jnp.abs(turn) > _SEPARATE, jnp.inf, _COUPLING * ratio)
    leak = jnp.where((place[:, None] > place) & (member == 0), leak, 0.0)
    coupled = over_first(jnp.add, jnp.swapaxes(leak, 0, 1))
    separate = np.finfo(float).eps * _ROUNDINGS * factored.rounding[1] + coupled
    relative = over_first(jnp.maximum, member * separate[:, None])
    changes = jnp.abs(characteristic_coefficients(coarse) - characteristic_coefficients(fine))
    powers = jnp.arange(1, n + 1).reshape(n, *(1,) * rho.ndim)
    error = over_first(jnp.maximum, changes / rho**powers + n * relative * (norm / rho) ** powers)
    counted = (powers <= over_first(jnp.add, member))[:, None]
    errors = multiplier_errors(sigma.real, sigma.imag, PolynomialError(error * rho**powers), counted)
    first = sum((group[j] < group).astype(int) for j in range(n))
    chosen = (place - first)[None]
    sigma, errors = (jnp.take_along_axis(x, chosen, axis=0)[0] for x in (sigma, errors))
    return scale, sigma, errors


def all_on_the_circle(real: Array, imaginary: Array, error: PolynomialError, scale: Array) -> Array:
    """True if all multipliers ``scale (real + i imaginary)`` without damping are simple and on the unit circle."""
    radius = multiplier_errors(real, imaginary, error)
    gaps = jnp.hypot(real[:, None] - real, imaginary[:, None] - imaginary)
    # Four radii about a multiplier at the unit circle contain the reflection of its circle if that is below 0.1.
    itself = jnp.eye(len(real), dtype=bool).reshape(len(real), len(real), *(1,) * (real.ndim - 1))
    apart = itself | (gaps > 4 * radius + radius[:, None])
    on_circle = (scale * radius < 0.1) & (jnp.abs(scale * jnp.hypot(real, imaginary) - 1) <= scale * radius)
    return over_first(jnp.logical_and, on_circle & over_first(jnp.logical_and, apart))


def verdict(rho: Array, error: Array) -> Array:
    """0 stable, 1 unstable, 2 undecided: the interval ``rho +- error`` contains 1, or either is not a number."""
    return jnp.where(rho + error < 1, 0, jnp.where(rho - error > 1, 1, 2)).astype(jnp.int8)
