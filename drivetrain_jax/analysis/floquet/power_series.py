"""Propagators of a linear periodic system along a coordinate x, as power series in x: a line costs as much as a few solves.

Let ``A(t, x) = A0(t) + x A1(t)``, where ``A0`` only leads from the ``first`` states to the others. The states
``y~ = (I - G) y`` with ``G' = A0`` obey ``y~' = x B y~``, ``B = (I - G) A1 (I + G)``. Over a part of the span, with
``G = 0`` at its start, the propagator is

    (I + G) sum_k x^k D_k,  D_k' = B D_(k-1),  D_0 = I and D_k = 0 for k > 0 at the start:

No equation has to be solved. The span is cut into equal parts, so short that few terms are enough. Integrals are those of
Radau's collocation, whose last node is the end of the part.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.numerics.collocation import radau
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, suits_one_kernel
from drivetrain_jax.systems import LinearPeriodic

# Nodes of a part and powers of x: both have about the same truncation error.
NODES, TERMS = 12, 20

Form = Callable[[Any], LinearPeriodic]


def propagators_along(form: Form, ends: Array, first: int, lanes: int, parts: Array, x: Array) -> tuple[Array, Array]:
    """``Phi`` of ``lanes`` lines at the P positions ``x``, ``(P, n, n, lanes)``, and the truncation error, ``(lanes,)``.

    ``form(p)`` is the system for the value p of the coordinate's parameter. ``ends`` ``(2,)`` are the values of p at
    ``x = 0`` and ``x = 1``; ``|x| <= 1``. The span is cut into ``parts`` (a traced integer). The truncation error is the
    size of the last term relative to the largest term, in the worst part, and infinite if ``A0`` has entries that do not
    lead from the ``first`` states to the others.
    """
    weights, _, places = radau(NODES)
    system = form(ends[0])
    if system.breakpoints:
        raise InputError(f"breakpoints: got {len(system.breakpoints)}; allowed with Series is none")
    size, length = system.size, system.span / parts
    powers = x[:, None] ** jnp.arange(TERMS + 1)
    leads = ((jnp.arange(size) >= first)[:, None] & (jnp.arange(size) < first))[..., None]

    def integral(slopes: Array) -> Array:
        return (length * weights @ slopes.reshape(NODES, -1)).reshape(slopes.shape)

    def onward(number: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, left_out = state
        constant, varying = _split(form, ends, ((number + places) * length)[:, None], lanes)
        wrong = jnp.any(jnp.where(leads, 0.0, constant) != 0, axis=(0, 1, 2))
        terms = _terms(constant[:, first:, :first], varying, first, integral)
        sizes = jnp.max(jnp.abs(terms), axis=(1, 2))
        missing = jnp.where(wrong, jnp.inf, sizes[-1] / jnp.max(sizes, axis=0))
        part = (powers @ terms.reshape(TERMS + 1, -1)).reshape(phi.shape)
        return _product(part, phi), jnp.maximum(left_out, missing)

    unit = jnp.broadcast_to(jnp.eye(size)[..., None], (len(x), size, size, lanes))
    return jax.lax.fori_loop(0, parts, onward, (unit, jnp.zeros(lanes)))


def _terms(constant: Array, varying: Array, first: int, integral: Callable[[Array], Array]) -> Array:
    """The terms at the end of a part, ``(TERMS + 1, n, n, lanes)``, from ``A0`` ``(NODES, n - first, first, lanes)`` and
    ``A1`` ``(NODES, n, n, lanes)``."""
    g = integral(constant)
    b = varying.at[:, :, :first].add(_product(varying[:, :, first:], g))
    b = b.at[:, first:].add(-_product(g, b[:, :first]))

    def following(before: Array, _: None) -> tuple[Array, Array]:
        found = integral(_product(b, before))
        return found, found[-1]

    unit = jnp.broadcast_to(jnp.eye(varying.shape[1])[..., None], varying.shape)
    terms = jnp.concatenate([unit[-1:], jax.lax.scan(following, unit, length=TERMS)[1]])
    return terms.at[:, first:].add(_product(g[-1:], terms[:, :first]))


def _split(form: Form, ends: Array, t: Array, lanes: int) -> tuple[Array, Array]:
    """``A0`` and ``A1`` at the times ``t`` ``(NODES, 1)``, both ``(NODES, n, n, lanes)``."""

    def matrix(parameter: Array) -> Array:
        system = form(parameter)
        rows = system.rows(*system.basis(t))
        entries = [[jnp.broadcast_to(jnp.asarray(x, float), (NODES, lanes)) for x in row] for row in rows]
        return jnp.stack([jnp.stack(row, axis=1) for row in entries], axis=1)

    # Both ends at once: terms that do not depend on the coordinate are computed once.
    both = jax.vmap(matrix)
    start, end = (in_one_kernel(both) if suits_one_kernel(both, ends) else both)(ends)
    return start, end - start


def _product(a: Array, b: Array) -> Array:
    """Products of matrices, ``(P, k, l, lanes)`` times ``(P, l, m, lanes)``."""
    return sum(a[:, :, j, None] * b[:, None, j] for j in range(b.shape[1]))  # pyright: ignore[reportReturnType]
