"""Monodromy matrix of a linear periodic system with a bound of its error, by two step sizes.

The propagator is computed with m/r, m, 2 m, 4 m, ... steps until two successive ones agree. With a scheme of order p the
error of the finer one is their difference over r^p - 1, then 2^p - 1. The bound is four times that error, measured on the
matrix and on the coefficients of its characteristic polynomial; the larger one counts, because either may vanish by
accident. The determinant is compared with Liouville's exact value, which detects an oscillation that both step sizes miss.
All functions broadcast over a trailing batch.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.floquet.multipliers import characteristic_coefficients, root_scale
from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.analysis.numerics.staged import staged
from drivetrain_jax.systems import dense

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Propagator
    from drivetrain_jax.systems import LinearPeriodic

# Most doublings of the predicted number of steps of a batch, and most steps.
_MAX_REFINEMENTS = 6
MAX_STEPS = 2**20
# The explicit scheme is stable for decays of up to this much in a step.
_STABLE = 6.0
# Rounding of the entries of A, in units of the last place. A search for the worst points showed that half is too little.
_ENTRIES = 16


class Monodromy(NamedTuple):
    """``Z = exp(log_scale) matrix`` (up to similarity), ``(n, n, ...)``.

    The coefficients a_k of ``matrix``'s characteristic polynomial are wrong by at most ``error`` times the k-th power of
    its spectral radius. ``met`` is true if this error is within the target or the limit of rounding. ``residual`` is det Z
    minus its exact value (Liouville) in units of the n-th power of a lower bound of the spectral radius; 0 if the exact
    value is not known. ``change`` is the error of ``matrix`` entry by entry, with a safety factor of four: the distance of
    the finer result from the limit extrapolated from both results, or None without a second result.
    """

    matrix: Array
    log_scale: Array
    error: Array
    met: Array
    residual: Array
    change: Array | None = None


def assemble(system: LinearPeriodic, phi: Array) -> Array:
    """The monodromy matrix, up to similarity, from the propagator over the span: ``Phi``, ``X Phi^T X Phi`` or
    ``R0 Phi^T R1 Phi``."""
    if system.reversal is not None:
        return _reversed(*map(dense, system.reversal()), phi)  # pyright: ignore[reportCallIssue]
    if system.reversor is None:
        return phi
    x = jnp.asarray(system.reversor).reshape(*phi.shape[:2], *(1,) * (phi.ndim - 2))
    return matmul(matmul(x, matmul(jnp.swapaxes(phi, 0, 1), x)), phi)


def _reversed(start: Array, end: Array, phi: Array) -> Array:
    # If no parameter of the reversal varies, its matrix is the same for all lanes.
    start, end = (each.reshape(*each.shape, *(1,) * (phi.ndim - each.ndim)) for each in (start, end))
    return matmul(matmul(start, jnp.swapaxes(phi, 0, 1)), matmul(end, phi))


def _assembled(system: LinearPeriodic, fine: Array, coarse: Array) -> tuple[Array, Array, Array]:
    """The monodromy matrices of two propagators, up to one similarity, and the size of the terms of the first."""
    z = [assemble(system, fine), assemble(system, coarse)]
    if system.reversal is None:
        return *z, jnp.sum(fine**2, axis=(0, 1)) ** (system.halves / 2)  # pyright: ignore[reportReturnType]
    size = _reversed(*(jnp.abs(dense(rows)) for rows in system.reversal()), jnp.abs(fine))  # pyright: ignore[reportCallIssue]
    scales = _balance(size)
    *z, size = (matrix * scales / scales[:, None] for matrix in (*z, size))
    return *z, jnp.sqrt(jnp.sum(size**2, axis=(0, 1)))  # pyright: ignore[reportReturnType]


def _balance(size: Array) -> Array:
    """Scales ``(n, ...)`` of states in which rows and columns of ``size`` ``(n, n, ...)``, not negative, have similar sizes.

    Two sweeps of Osborne's iteration (Parlett & Reinsch, Numer. Math. 13, 1969), in powers of 2.
    """
    scales = [jnp.ones(size.shape[2:])] * len(size)
    for k in 2 * list(range(len(size))):
        others = [j for j in range(len(size)) if j != k]
        row = sum(size[k, j] * scales[j] for j in others) / scales[k]
        column = sum(size[j, k] / scales[j] for j in others) * scales[k]
        factor = jnp.exp2(jnp.round(jnp.log2(row / column) / 2))
        scales[k] = scales[k] * jnp.where((row > 0) & (column > 0) & jnp.isfinite(factor), factor, 1.0)
    return jnp.stack(scales)


def stiffness_of(system: LinearPeriodic, shape: tuple[int, ...] = ()) -> Array:
    """Largest rate times the span in every lane, for the batch shape ``shape``.

    The rate is max |a_ij a_ji|^(1/2), which no scaling of states changes, averaged over 16 instants.
    """
    entries = _entries(system, (jnp.arange(16) + 0.5)[:, None] * system.span / 16)
    pairs = [jnp.abs(entry * entries[j, i]) for (i, j), entry in entries.items() if j <= i and (j, i) in entries]
    largest = reduce(jnp.maximum, pairs, jnp.zeros((16, *(shape or (1,)))))
    return system.span * jnp.mean(jnp.sqrt(largest), axis=0).reshape(shape)


def stable_steps(system: LinearPeriodic) -> Array:
    """Steps with which the explicit scheme is stable in all lanes; ``-tr A`` at 5 instants bounds the rates of decay."""
    # Only the diagonal is used: the compiler drops the other entries.
    entries = _entries(system, jnp.arange(5)[:, None] * system.span / 4)
    rate = -sum((entry for (i, j), entry in entries.items() if i == j), jnp.zeros(()))
    return jnp.nanmax(rate * system.span, initial=0.0) / _STABLE


def _entries(system: LinearPeriodic, times: Array) -> dict[tuple[int, int], Array]:
    """The entries of A at ``times`` ``(K, 1)`` that do not vanish identically; what does not depend on time, once."""
    basis = system.basis(times)
    split = staged(system.entries, *basis)
    return split.moving(split.fixed, *basis)


def compare(
    system: LinearPeriodic,
    coarse: Propagator,
    fine: Propagator,
    steps: Array,
    stiffness: Array | float,
    rtol: float,
    reduction: Array | float,
) -> Monodromy:
    """Monodromy matrix of ``fine`` and its error; ``stiffness`` as of :func:`stiffness_of`.

    ``reduction`` is the error of ``coarse`` over the error of ``fine``, minus one. The propagators are compared too, because
    the errors of a product of nearly rank one may be small by accident, relative to its norm. Rounding of the matrix
    products accumulates like the square root of ``steps``. Rounding during the march grows until its end by the factor
    ``fine.growth``, but at most to the difference from ``coarse``. Rounding of the entries of A is equal in both propagators
    and shifts exponents by `_ENTRIES` units of the ``stiffness``.
    """
    other = jnp.exp(coarse.log_scale - fine.log_scale) * coarse.matrix
    z_fine, z_coarse, norm = _assembled(system, fine.matrix, other)
    a_fine, a_coarse = characteristic_coefficients(z_fine), characteristic_coefficients(z_coarse)
    scale = root_scale(a_fine)
    n = a_fine.shape[0]
    log_scale = system.halves * fine.log_scale
    apart = z_fine - z_coarse
    differences = [jnp.sqrt(jnp.sum(apart**2, axis=(0, 1))) / scale]
    differences += [jnp.abs(a_fine[k] - a_coarse[k]) / scale ** (k + 1) for k in range(n)]
    differences.append(
        jnp.sqrt(jnp.sum((fine.matrix - other) ** 2, axis=(0, 1)) / jnp.sum(fine.matrix**2, axis=(0, 1)))
    )
    difference = 4 * jnp.max(jnp.stack(differences), axis=0)
    truncation = difference / reduction
    residual = jnp.zeros_like(scale)
    if system.log_determinant is not None:
        exact = jnp.exp(system.log_determinant() - n * log_scale)
        residual = ((-1) ** n * a_fine[-1] - exact) / scale**n
    truncation = jnp.maximum(truncation, jnp.abs(residual))
    # Without a reversal the size of the products is only estimated, and their assumed rounding covers eightfold growth.
    growth = jnp.maximum(fine.growth / (8 if system.reversal is None else 1), 1.0)
    unit = np.finfo(float).eps * norm / scale
    at_the_end = (4 + jnp.sqrt(steps)) * unit
    of_entries = _ENTRIES * system.halves * stiffness * np.finfo(float).eps
    rounding = at_the_end + jnp.minimum((growth - 1) * at_the_end, difference) + of_entries
    met = truncation <= jnp.maximum(rtol, rounding)
    return Monodromy(z_fine, log_scale, truncation + rounding, met, residual, (4 / reduction) * apart)


def _first_steps(
    steps: Array, ratio: Array | int, least: Array | float, most_pieces: Array | int
) -> tuple[Array, Array, Array]:
    """Steps of the first two propagators of :func:`direct_monodromy`, and pieces of equally many steps for both.

    The first one has ``ratio`` times fewer steps. A larger ratio costs less, but both step numbers must show the order of
    the scheme: hence a small tolerance, and at least the ``least`` number for stability or four fifths of the steps.
    """
    predicted = jnp.maximum(steps, 2)
    stable = jnp.minimum(jnp.ceil(least), predicted * 4 // 5).astype(predicted.dtype)
    begin = jnp.maximum(stable, -(-predicted // ratio))
    pieces = -(-begin // -(-begin // most_pieces))
    begin, predicted = (-(-count // pieces) * pieces for count in (begin, predicted))
    return begin, predicted, pieces


def direct_monodromy(
    system: LinearPeriodic,
    propagate: Callable[[Array, Array], Propagator],
    steps: Array,
    shape: tuple[int, ...],
    stiffness: Array | float,
    rtol: float,
    order: int,
    ratio: Array | int,
    least: Array | float,
    most_pieces: Array | int = 1,
    most: int = MAX_STEPS,
) -> Monodromy:
    """Refine from ``steps`` predicted steps (traced integer) until the error of every lane is at most ``rtol``.

    ``propagate(steps, pieces)`` returns the propagator of ``system`` with batch shape ``shape``, by a scheme of order
    ``order``, in up to ``most_pieces``. For ``stiffness`` see :func:`stiffness_of`, for ``ratio`` and ``least``
    :func:`_first_steps`. A lane that overflows has two doublings to recover and then no longer delays the others. After
    six doublings or ``most`` steps the error may exceed ``rtol``.
    """
    begin, predicted, pieces = _first_steps(steps, ratio, least, most_pieces)
    zero = jnp.zeros(shape)
    propagate = jax.jit(propagate)  # traced once, not for its shapes and again for its values
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape), jax.eval_shape(propagate, steps, pieces))
    unknown = Monodromy(blank.matrix, zero, jnp.full(shape, jnp.inf), jnp.zeros(shape, bool), zero, blank.matrix)

    def unfinished(state: tuple) -> Array:
        count, current, _, result = state
        finite = jnp.all(jnp.isfinite(result.matrix), axis=(0, 1))
        lagging = jnp.where(finite, count < 2 + _MAX_REFINEMENTS, count < 4) & ~result.met
        return (count < 2) | ((current <= most) & jnp.any(lagging))

    def refine(state: tuple) -> tuple:
        count, current, coarse, _ = state
        fine = propagate(current, pieces)

        def compared() -> Monodromy:
            gain = jnp.where(count == 1, predicted / begin, 2.0)
            return compare(system, coarse, fine, current, stiffness, rtol, gain**order - 1)

        following = jnp.where(count == 0, predicted, 2 * current)
        return count + 1, following, fine, jax.lax.cond(count > 0, compared, lambda: unknown)

    start = (jnp.int32(0), begin, blank, unknown)
    return jax.lax.while_loop(unfinished, refine, start)[-1]
