"""Monodromy matrix of a linear periodic system with a bound of its error, from two propagators.

With a scheme of order p, r times as many steps reduce the error by ``r^p``: the error of the finer propagator is the
difference over ``r^p - 1``. The bound is four times that error, measured on the matrix and on the coefficients of its
characteristic polynomial about the mean multiplier; both count, because either may vanish by accident. The determinant is
compared with Liouville's exact value; schemes that keep the determinant without damping need another check of a missed
oscillation (``Propagator.undamped``). All functions broadcast over a trailing batch, and may be part of a kernel.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.floquet.multipliers import (
    PolynomialError,
    characteristic_coefficients,
    characteristic_polynomial,
    root,
    root_scale,
)
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.analysis.numerics.linear_algebra import product, square_sum

# Rounding of the entries of A, in units of the last place. A search for the worst points showed that half is too little.
_ENTRIES = 16


class Propagator(NamedTuple):
    """``Phi = exp(log_scale) matrix``, shape ``(n, n, ...)``.

    ``growth`` is the size at the end T of errors that were made on the way, each as large as the propagator at its time: the
    root mean square of ``|Phi(T, t)| |Phi(t, 0)|``, in units of ``exp(log_scale)``. It may exceed ``|Phi(T, 0)|`` by many
    powers of ten. ``terms`` ``(n, n, ...)`` are the sizes of the terms whose sum is ``matrix``. ``stiffness`` is the largest
    rate times the span, ``decay`` is ``-log det Phi``, and ``squared`` its ratio to the decay that counts as strong, 0 for
    first-order equations.
    ``undamped`` is the logarithm of the size that the fastest decaying mode may keep, because the scheme damps it too
    little, and infinite where an oscillation is too fast for the steps.
    """

    matrix: Array
    log_scale: Array
    growth: Any = 0.0
    terms: Any = 0.0
    stiffness: Any = 0.0
    decay: Any = 0.0
    squared: Any = 0.0
    undamped: Any = -np.inf

    def in_units_of(self, log_scale: Array) -> Propagator:
        """The same with another ``log_scale``."""
        factor = jnp.exp(self.log_scale - log_scale)
        matrix, growth, terms = (factor * x for x in (self.matrix, self.growth, self.terms))
        return self._replace(matrix=matrix, log_scale=log_scale, growth=growth, terms=terms)


class Monodromy(NamedTuple):
    """``Z = exp(log_scale) matrix`` (up to similarity), ``(n, n, ...)``.

    ``error`` is that of the characteristic polynomial of ``matrix``. ``met`` is true if the error of the matrix, relative to
    its spectral radius, is within the target or the limit of rounding. ``residual`` is det Z
    minus its exact value (Liouville) in units of the n-th power of a lower bound of the spectral radius; 0 if the exact
    value is not known. ``change`` is the error of ``matrix`` entry by entry, with a safety factor of four: the distance of
    the finer result from the limit extrapolated from both results, or None without a second result. ``scales`` ``(n, ...)``
    are units of the states in which rows and columns of ``matrix`` have similar sizes, or None if they have.
    """

    matrix: Array
    log_scale: Array
    error: PolynomialError
    met: Array
    residual: Array
    change: Array | None = None
    truncation: Array | None = None
    scales: Array | None = None

    @property
    def balanced(self) -> Array:
        """``matrix`` in the units ``scales``: its eigenvalues are less wrong by rounding."""
        return self.matrix if self.scales is None else _scaled(self.matrix, self.scales)


def unknown(n: int) -> Monodromy:
    """The matrix of one point before any solution."""
    zero, none, bound = jnp.zeros(()), jnp.zeros((n, n)), jnp.full(n, jnp.inf)
    return Monodromy(none, zero, PolynomialError(bound, zero), jnp.array(False), zero, none, zero, jnp.ones(n))


def assemble(ends: Array | None, phi: Array) -> Array:
    """The monodromy matrix, up to similarity, from the propagator over the span: ``Phi``, or ``R0 Phi^T R1 Phi``."""
    if ends is None:
        return phi
    start, end = ends.reshape(*ends.shape[:3], *(ends.shape[3:] or (1,) * (phi.ndim - 2)))
    return product(start, product(jnp.swapaxes(phi, 0, 1), product(end, phi)))


def _balance(size: Array) -> Array:
    """Scales ``(n, ...)`` of states in which rows and columns of ``size`` ``(n, n, ...)``, not negative, have similar sizes.

    Two sweeps of Osborne's iteration (Parlett & Reinsch, Numer. Math. 13, 1969).
    """
    n, axes = len(size), (1,) * (size.ndim - 2)
    size = size * (1 - np.eye(n)).reshape(n, n, *axes)

    def balanced(k: Array, scales: Array) -> Array:
        row = sum(size[:, j] * scales[j] for j in range(n)) / scales
        column = sum(size[j] / scales[j] for j in range(n)) * scales
        factor = jnp.sqrt(row / column)
        chosen = (np.arange(n).reshape(n, *axes) == k % n) & (row > 0) & (column > 0) & jnp.isfinite(factor)
        return jnp.where(chosen, scales * factor, scales)

    return jax.lax.fori_loop(0, 2 * n, balanced, jnp.ones_like(size[0]))


def _scaled(matrix: Array, scales: Array) -> Array:
    """A matrix of states in the units ``scales``."""
    return matrix * scales / scales[:, None]


def compare(
    ends: Array | None,
    log_determinant: Array | None,
    coarse: Propagator,
    fine: Propagator,
    steps: Array,
    gain: Array | float,
    rtol: Array | float,
) -> Monodromy:
    """Monodromy matrix of ``fine`` and its error.

    ``ends`` are those of the system, ``gain`` is the error of ``coarse``, in the same units, over the error of ``fine``. The
    propagators are compared too, because the errors of a product of nearly rank one may be small by accident, relative to
    its norm. Rounding accumulates like the square root of ``steps``, or like ``steps`` where they are equal, which shows in
    the difference from ``coarse``; what was made on the way has at the end the size ``fine.growth``. Rounding of the entries
    of A is equal in both propagators and shifts exponents by `_ENTRIES` units of the stiffness; the slow modes of strong
    damping are differences of the squared entries of second-order equations, and their shift grows with the size of the
    products.
    """
    halves, n = (1 if ends is None else 2), len(fine.matrix)
    z_fine, z_coarse = (stored(partial(assemble, ends))(phi) for phi in (fine.matrix, coarse.matrix))
    sizes = stored(partial(assemble, None if ends is None else jnp.abs(ends)))
    size = sizes(jnp.abs(fine.matrix))
    # Entries that vanish are as wrong as their terms.
    scales = stored(_balance)(sizes(jnp.maximum(jnp.abs(fine.matrix), fine.terms)))
    plain = z_fine, z_fine - z_coarse
    z_fine, z_coarse, size = (stored(_scaled)(matrix, scales) for matrix in (z_fine, z_coarse, size))
    norm = jnp.sqrt(square_sum(size))
    centre = jnp.asarray(sum(z_fine[i, i] for i in range(n))) / n
    shift = centre * np.eye(n).reshape(n, n, *(1,) * centre.ndim)
    a_fine, slopes = stored(characteristic_polynomial)(z_fine - shift)
    a_coarse = stored(characteristic_coefficients)(z_coarse - shift)
    determinant = (-1) ** n * reduce(lambda total, a: a - total * centre, a_fine, 1.0)
    # The largest multiplier is as large as each mean, and at most that much nearer to 0 than to the centre.
    means = jnp.abs(centre), root_scale(a_fine) - jnp.abs(centre), root(jnp.abs(determinant), n)
    scale = reduce(jnp.maximum, means)
    log_scale = halves * fine.log_scale
    apart = z_fine - z_coarse
    square = square_sum(fine.matrix)
    relative = jnp.maximum(
        jnp.sqrt(square_sum(apart)) / scale, jnp.sqrt(square_sum(fine.matrix - coarse.matrix) / square)
    )
    changes = [jnp.abs(a_fine[k] - a_coarse[k]) / scale ** (k + 1) for k in range(n)]
    difference = 4 * reduce(jnp.maximum, changes, relative)
    residual = jnp.zeros_like(scale)
    if log_determinant is not None:
        residual = (determinant - jnp.exp(log_determinant - n * log_scale)) / scale**n
    lost = jnp.maximum(jnp.abs(residual), jnp.exp(halves * (fine.undamped - fine.log_scale)) / scale)
    truncation = jnp.maximum(difference / (gain - 1), lost)
    unit = np.finfo(float).eps * norm / scale
    grown = jnp.sqrt(jnp.maximum(fine.growth**2 / square, 1.0)) * unit
    of_entries = _ENTRIES * fine.stiffness * (halves * np.finfo(float).eps + jnp.minimum(fine.squared, 1.0) * unit)

    def rounding(slope: Array | float) -> Array:
        """An error of Z as large as a rounding of its terms changes a coefficient by its slope."""
        of_products = (1 + jnp.sqrt(steps) / 2) * slope * grown
        return of_products + jnp.minimum(steps / 2 * slope * grown, difference)

    of_matrix = jnp.maximum(4 / (gain - 1) * relative, lost) + of_entries
    errors = []
    for k in range(n):
        slope = slopes[k] / scale**k
        error = jnp.maximum(4 / (gain - 1) * changes[k], jnp.minimum(slope, 1.0) * of_matrix) + rounding(slope)
        # The last term counts products of errors where the slopes vanish.
        errors.append(scale ** (k + 1) * (error + (of_matrix + rounding(1.0)) ** (k + 1)))
    largest_slope = reduce(jnp.maximum, (slopes[k] / scale**k for k in range(1, n)), 1.0)
    met = truncation <= jnp.maximum(rtol, rounding(largest_slope) + of_entries)
    # The propagator itself keeps the units of its states.
    matrix, change, scales = (*plain, scales) if ends is None else (z_fine, apart, jnp.ones_like(scales))
    error = PolynomialError(jnp.stack(errors), centre)
    return Monodromy(matrix, log_scale, error, met, residual, (4 / (gain - 1)) * change, truncation, scales)
