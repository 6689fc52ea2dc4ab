"""Propagators of a linear periodic system along a coordinate x, as power series in x: a line costs as much as a few solves.

Let ``y' = x B(t) y``. Over a part of the span the propagator is

    sum_k x^k D_k,  D_k' = B D_(k-1),  D_0 = I and D_k = 0 for k > 0 at the start.

No equation has to be solved. The span is cut into equal parts, so short that few terms are enough. Integrals are those of
Radau's collocation, whose last node is the end of the part.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.numerics.collocation import radau
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, suits_one_kernel
from drivetrain_jax.systems import LinearPeriodic

# Nodes of a part and powers of x: both have about the same truncation error.
NODES, TERMS = 12, 20


def propagators_along(system: LinearPeriodic, lanes: int, parts: Array, x: Array) -> tuple[Array, Array]:
    """``Phi`` of ``lanes`` lines at the P positions ``x``, ``(P, n, n, lanes)``, and the truncation error, ``(lanes,)``.

    ``system`` is that of ``x = 1``; ``|x| <= 1``. The span is cut into ``parts`` (a traced integer). The truncation error is
    the size of the last term relative to the largest term, in the worst part.
    """
    if system.breakpoints:
        raise InputError(f"breakpoints: got {len(system.breakpoints)}; allowed with Series is none")
    weights, _, places = radau(NODES)
    size, length = system.size, system.span / parts
    powers = x[:, None] ** jnp.arange(TERMS + 1)
    matrix = partial(_matrix, system, lanes)

    def onward(number: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, left_out = state
        t = ((number + places) * length)[:, None]
        b = (in_one_kernel(matrix) if suits_one_kernel(matrix, t) else matrix)(t)

        def following(before: Array, _: None) -> tuple[Array, Array]:
            found = (length * weights @ _product(b, before).reshape(NODES, -1)).reshape(b.shape)
            return found, found[-1]

        unit = jnp.broadcast_to(jnp.eye(size)[..., None], b.shape)
        terms = jnp.concatenate([unit[-1:], jax.lax.scan(following, unit, length=TERMS)[1]])
        sizes = jnp.max(jnp.abs(terms), axis=(1, 2))
        part = (powers @ terms.reshape(TERMS + 1, -1)).reshape(phi.shape)
        return _product(part, phi), jnp.maximum(left_out, sizes[-1] / jnp.max(sizes, axis=0))

    unit = jnp.broadcast_to(jnp.eye(size)[..., None], (len(x), size, size, lanes))
    return jax.lax.fori_loop(0, parts, onward, (unit, jnp.zeros(lanes)))


def _matrix(system: LinearPeriodic, lanes: int, t: Array) -> Array:
    """``B`` at the times ``t`` ``(NODES, 1)``, ``(NODES, n, n, lanes)``."""
    rows = system.rows(*system.basis(t))
    entries = [[jnp.broadcast_to(jnp.asarray(x, float), (NODES, lanes)) for x in row] for row in rows]
    return jnp.stack([jnp.stack(row, axis=1) for row in entries], axis=1)


def _product(a: Array, b: Array) -> Array:
    """Products of matrices, ``(P, k, l, lanes)`` times ``(P, l, m, lanes)``."""
    return sum(a[:, :, j, None] * b[:, None, j] for j in range(b.shape[1]))  # pyright: ignore[reportReturnType]
