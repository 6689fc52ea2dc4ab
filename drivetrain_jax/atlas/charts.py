"""Closed-form results on grids, tile by tile, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._machine import in_threads
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.quartic import EPS, Blocks, determinant, square_norm, transposed_product
from drivetrain_jax.analysis.numerics.kernels import compiler_options, in_one_kernel
from drivetrain_jax.analysis.numerics.lanes import by_rows
from drivetrain_jax.atlas.evaluation import NODES, Tile, filled_up
from drivetrain_jax.atlas.interpolation import analysis_matrix
from drivetrain_jax.systems import FloquetModel

# Stability without damping, where stable multipliers lie exactly on the unit circle.
#
# If Phi = [[A, B], [C, D]] is symplectic, (sigma + 1/sigma)/2 = 1 + 2 m with the eigenvalues m of M = B^T C, and
# det M = det B det C, det(I + M) = det A det D. All multipliers lie on the unit circle, apart from each other, if and only
# if m_1 != m_2 are real with -1 < m < 0: then every motion stays bounded. At the tip of a tongue the products of the
# determinants vanish to second order. The signs of the four single determinants are therefore used: each is known wherever
# the determinant exceeds its own error.


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


# Most rows and columns of a tile. The columns of a row are the lanes of all loops; XLA computes so short a row in one task.
ROWS, COLUMNS = 64, 512
UNDECIDED = 2
# Factor by which interpolation between nodes may amplify rounding: the Lebesgue constant of 24 nodes is 2.99.
_SPREAD = 3.0

Build = Callable[[Mapping[str, Any]], FloquetModel]
# Results of cells by name, and flags of the cells to compute again by eigenvalues (`results_of_coefficients`).
Cells = dict[str, np.ndarray]


def evaluated_tiles(
    tiles: Iterator[Tile],
    axes: Sequence[np.ndarray],
    names: Sequence[str],
    fixed: Mapping[str, Any],
    kernels: Sequence[Any],
    rtol: float,
) -> Iterator[tuple[Tile, Cells]]:
    """Yield every tile with the results of its cells, ``(R, C)``, in order.

    ``axes`` are the axes of the grid in parameters; ``kernels`` of :func:`tile_kernel` serve sparse and dense tiles.
    """

    constants = {name: jnp.asarray(value) for name, value in fixed.items()}

    def work(tile: Tile) -> Cells:
        cells = tile.columns if tile.spread is None else tile.spread
        values = {name: axis[i] for name, axis, i in zip(names, axes, tile.index, strict=True)}
        rows, columns = (len(i) for i in tile.index[-2:])
        values[names[-1]] = filled_up(values[names[-1]], cells.shape[1])
        values[names[-2]] = filled_up(values[names[-2]], len(tile.first))
        factors = (tile.first, tile.columns) if tile.spread is None else (tile.first, tile.columns, tile.spread)
        cells_of_tile = kernels[tile.spread is not None](*factors, tile.panel.value_error, values, constants, rtol)
        return {name: np.asarray(x)[:rows, :columns] for name, x in cells_of_tile.items()}

    return in_threads(tiles, work)


@lru_cache(maxsize=32)
def tile_kernel(build: Build, names: tuple[str, ...], kind: str) -> Any:
    """The kernel that computes the results ``(R, C)`` of a tile, see :func:`results_of_coefficients`.

    ``kind``: ``dense`` or ``sparse`` like the tile, ``undamped`` for sparse tiles with cells that may be Hamiltonian.
    """

    def bind(values: Mapping, fixed: Mapping, row: Array) -> FloquetModel:
        leading = {name: values[name][0] for name in names[:-2]}
        return build({**fixed, **leading, names[-2]: row, names[-1]: values[names[-1]]})

    # Row by row, because the intermediate results of a row fit into the cache. The last product is inside the loop: a row
    # of a larger result would be copied at every use.
    def sparse(first, columns, error, values, fixed, rtol):
        def row(inputs: tuple[Array, Array]) -> dict[str, Array]:
            weights, value = inputs
            model, phi = bind(values, fixed, value), weights @ columns
            log_d = jnp.broadcast_to(model.reduced.log_determinant(), phi.shape[1:])  # pyright: ignore[reportOptionalCall]
            parts = quartic.blocks(phi)
            exact = exact_verdict(model, parts, error) if kind == "undamped" else None
            return results_of_coefficients(in_one_kernel(quartic.coefficients)(parts, log_d, error), rtol, exact)

        return by_rows(row, (first, values[names[-2]]))

    def dense(first, columns, spread, error, values, fixed, rtol):
        parts = quartic.blocks(jnp.moveaxis(first @ columns, 1, 0))
        at_nodes, rounding, changes = (jnp.stack(x, axis=1) for x in in_one_kernel(quartic.invariants)(parts, error))
        series, slopes = (jnp.abs(x @ analysis_matrix(NODES).T) for x in (at_nodes, changes))
        # An error of Phi changes each cell as much as its own derivatives say, bounded by the sum of their coefficients;
        # rounding of the nodes is spread; twice the last coefficients bound what the nodes leave out.
        bounds = jnp.sum(slopes, -1) + _SPREAD * jnp.max(rounding, -1) + 2 * jnp.sum(series[..., -3:], -1)

        def row(inputs: tuple[Array, Array, Array]) -> dict[str, Array]:
            e, bounds, value = inputs
            lanes = e @ spread
            log_d = jnp.broadcast_to(bind(values, fixed, value).reduced.log_determinant(), lanes.shape[1:])  # pyright: ignore[reportOptionalCall]
            return results_of_coefficients(quartic.with_determinant(lanes, bounds, log_d), rtol)

        return by_rows(row, (at_nodes, bounds, values[names[-2]]))

    return jax.jit(dense if kind == "dense" else sparse, compiler_options=compiler_options())


def exact_verdict(model: FloquetModel, phi: quartic.Blocks, value_error: Array) -> Array:
    """The verdict of Hamiltonian lanes, -1 of others."""
    shape = phi.a[0][0].shape
    applies = jnp.broadcast_to(jnp.asarray(model.hamiltonian()), shape)  # pyright: ignore[reportOptionalCall]
    nothing = jnp.full(shape, -1, jnp.int8)
    return jax.lax.cond(
        jnp.any(applies), lambda: jnp.where(applies, verdict(phi, value_error), nothing), lambda: nothing
    )


def results_of_coefficients(c: quartic.Coefficients, rtol: Array, exact: Array | None = None) -> dict[str, Array]:
    """Results of lanes by name, and flags ``unsure`` of lanes to compute again by eigenvalues.

    ``exact`` holds the verdicts of Hamiltonian lanes. The interval of rho of every other lane without the flag excludes 1.
    """

    def results(c: quartic.Coefficients, rtol: Array, exact: Array | None) -> dict[str, Array]:
        rho, error, unsure = quartic.spectral_radius(c)
        # A bound at the limit of rounding cannot be improved.
        unsure = (unsure & (error > 4 * quartic.EPS)) | ~(jnp.abs(rho - 1) > error)
        verdict = jnp.where(unsure, UNDECIDED, rho > 1).astype(jnp.int8)
        if exact is not None:
            rho, error, verdict = exactly(exact, rho, error, verdict)
            # Hamiltonian cells are decided; for the others eigenvalues may give a better bound.
            unsure &= exact != 0
        outcome = jnp.where(error <= 10 * rtol * rho, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET).astype(jnp.int8)
        decided = {"spectral_radius": rho, "spectral_radius_error": error, "verdict": verdict}
        return decided | {"outcome": outcome, "unsure": unsure}

    # Thirty small kernels repeat the coefficients, take up to a quarter longer to run and half as long again to compile.
    return in_one_kernel(results)(c, rtol, exact)


def exactly(exact: Array, rho: Array, error: Array, verdict: Array) -> tuple[Array, Array, Array]:
    """Results with the verdict ``exact`` where it is not negative: a stable Hamiltonian system has rho = 1."""
    return (
        jnp.where(exact == 0, 1.0, rho),
        jnp.where(exact == 0, 4 * quartic.EPS, error),
        jnp.where(exact >= 0, exact, verdict).astype(jnp.int8),
    )
