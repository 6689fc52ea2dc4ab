"""Closed-form results at scattered points, box by box, on all cores."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.numerics.kernels import compiler_options, in_one_kernel, options_for_few
from drivetrain_jax.atlas.charts import Cells, errors_of, exact_verdict, in_threads, results_of_coefficients
from drivetrain_jax.atlas.expansion import Cell, Expansion
from drivetrain_jax.atlas.floquet_quantity import Build
from drivetrain_jax.atlas.panels import Atlas

# Points of a row, whose intermediate results fit into the cache, and rows of a block.
LANES, ROWS = 128, 16


def evaluated_cells(
    expansion: Expansion, points: np.ndarray, x: np.ndarray, atlas: Atlas, kernel: Any, rtol: float
) -> Iterator[tuple[np.ndarray, Cells]]:
    """Yield numbers of points and their results, block by block.

    ``points`` ``(N, d)`` are the parameters, ``x`` ``(N, d)`` the coordinates; ``kernel`` comes from :func:`point_kernel`.
    """
    block = LANES * ROWS

    def work(part: tuple[Cell, int]) -> Cells:
        cell, start = part
        # The last block is padded with its last point.
        numbers = np.minimum(np.arange(start, start + block), cell.index.size - 1)
        columns = points[cell.index[numbers]].T
        values, rows = dict(zip(atlas.parameters, columns, strict=True)), -(-(cell.index.size - start) // LANES)
        found = kernel(
            cell.tensor,
            cell.place[:, numbers],
            np.int32(min(rows, ROWS)),
            errors_of(cell.panel),
            cell.left_out,
            values,
            atlas.fixed,
            rtol,
        )
        return {name: np.asarray(x)[: cell.index.size - start] for name, x in found.items()}

    parts = ((cell, start) for cell in expansion.cells(x) for start in range(0, cell.index.size, block))
    for (cell, start), found in in_threads(parts, work):
        yield cell.index[start : start + block], found


@lru_cache(maxsize=16)
def point_kernel(build: Build, undamped: bool, few: bool) -> Any:
    """The kernel of the results ``(LANES ROWS,)`` of a block of points, see :func:`charts.results_of_coefficients`.

    It fills the first ``rows`` rows. ``undamped``: points may be Hamiltonian; ``few``: a block has one row at most.
    """

    def kernel(tensor, place, rows, errors, left_out, values, fixed, rtol):
        count = max((*tensor.shape[:-2], tensor.shape[-1]))
        polynomials = in_one_kernel(partial(_chebyshev, count=count))

        def row(i: Array) -> dict[str, Array]:
            def cut(array: Array) -> Array:
                return jax.lax.dynamic_slice_in_dim(array, i * LANES, LANES, axis=-1)

            phi = _values(tensor, polynomials(cut(place)))
            model = build({**fixed, **{name: cut(column) for name, column in values.items()}})
            log_d = jnp.broadcast_to(model.reduced.log_determinant(), (LANES,))  # pyright: ignore[reportOptionalCall]
            parts = quartic.blocks(phi)
            exact = exact_verdict(model, parts, errors[0] + left_out) if undamped else None
            return results_of_coefficients(quartic.coefficients(parts, log_d, errors[1:, None], left_out), rtol, exact)

        def store(i: Array, results: dict[str, Array]) -> dict[str, Array]:
            return {
                name: jax.lax.dynamic_update_slice_in_dim(results[name], new, i * LANES, axis=0)
                for name, new in row(i).items()
            }

        shapes = jax.eval_shape(row, jnp.int32(0))
        blank = {name: jnp.zeros(place.shape[1], shape.dtype) for name, shape in shapes.items()}
        return jax.lax.fori_loop(0, rows, store, blank)

    return jax.jit(kernel, compiler_options=options_for_few() if few else compiler_options())


def _chebyshev(x: Array, count: int) -> Array:
    """``T_0 .. T_(count - 1)`` at ``x``, ``(count, *x.shape)``. The recurrence is accurate enough for few of them."""

    def step(pair: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        return (pair[1], 2 * x * pair[1] - pair[0]), pair[0]

    return jax.lax.scan(step, (jnp.ones_like(x), x), None, length=count)[1]


def _values(tensor: Array, polynomials: Array) -> Array:
    """Values ``(m, N)`` from ``tensor`` ``(n_2, ..., n_d, m, n_1)`` and T_j of each coordinate, ``(n, d, N)``."""
    *others, m, first = tensor.shape
    values = (tensor.reshape(-1, first) @ polynomials[:first, 0]).reshape(*others, m, -1)
    for k, n in enumerate(others, start=1):
        # Term by term, because the compiler does not vectorise a sum over a middle axis.
        values = sum(values[j] * polynomials[j, k] for j in range(n))  # pyright: ignore[reportIndexIssue]
    return values  # pyright: ignore[reportReturnType]
