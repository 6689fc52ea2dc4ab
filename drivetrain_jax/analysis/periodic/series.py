"""Propagators of a linear periodic system along a coordinate x, as power series in x: a line for the price of a few solves.

Where ``A(t, x) = A0(t) + x A1(t)``, the propagator over a part of the span is ``sum_k x^k D_k`` with

    D_k' = A1 D_(k-1) + A0 D_k,  D_0 = I and D_k = 0 for k > 0 at the start.

If ``A0`` only leads from the ``first`` states to the others, nothing has to be solved: the rows of the first states are
integrals of what is known, and so are then the other rows. The span is cut into equal parts, so short that few terms are
enough; integrals are those of Radau's collocation, whose last node is the end of the part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, suits_one_kernel
from drivetrain_jax.analysis.periodic.propagator import radau_iia
from drivetrain_jax.systems import LinearPeriodic

# Nodes of a part and powers of x: what both leave out is about the same.
NODES, TERMS = 12, 20

Form = Callable[[Any], LinearPeriodic]
Integral = Callable[[Array], Array]
# Entries of a matrix at the nodes of a part, (NODES, lanes); None if they vanish identically.
Entries = Sequence[Sequence[Array | None]]


def propagators_along(form: Form, ends: Array, first: int, lanes: int, parts: Array, x: Array) -> tuple[Array, Array]:
    """``Phi`` of ``lanes`` lines at the P positions ``x``, ``(P, n, n, lanes)``, and what was left out, ``(lanes,)``.

    ``form(p)`` is the system where the coordinate's parameter is p; ``ends`` ``(2,)`` are its values where the coordinate is
    0 and where it is 1 in the units of ``x``; ``|x| <= 1``. The span is cut into ``parts`` (a traced integer). What was left
    out is the size of the last term relative to the largest one, in the worst part: infinite where ``A0`` has entries that
    do not lead from the ``first`` states to the others.
    """
    weights, places = radau_iia(NODES)
    system = form(ends[0])
    size, length = system.size, system.span / parts
    powers = x[:, None] ** jnp.arange(TERMS + 1)

    def integral(slopes: Array) -> Array:
        return (length * weights @ slopes.reshape(NODES, -1)).reshape(slopes.shape)

    def onward(number: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, left_out = state
        constant, varying, wrong = _split(form, ends, ((number + places) * length)[:, None], first, lanes)
        terms = _terms(constant, varying, first, integral)
        sizes = jnp.max(jnp.abs(terms), axis=(1, 2))
        missing = jnp.where(wrong, jnp.inf, sizes[-1] / jnp.max(sizes, axis=0))
        part = (powers @ terms.reshape(TERMS + 1, -1)).reshape(phi.shape)
        return _product(part, phi), jnp.maximum(left_out, missing)

    unit = jnp.broadcast_to(jnp.eye(size)[..., None], (len(x), size, size, lanes))
    return jax.lax.fori_loop(0, parts, onward, (unit, jnp.zeros(lanes)))


def _terms(constant: Entries, varying: Entries, first: int, integral: Integral) -> Array:
    """``D_k`` at the end of a part, ``(TERMS + 1, n, n, lanes)``, from what :func:`_split` gives."""

    def completed(top: Array, slopes: Array) -> Array:
        return jnp.concatenate([top, integral(slopes + _times(constant, top))], axis=1)

    def following(before: Array, _: None) -> tuple[Array, Array]:
        slopes = _times(varying, before)
        found = completed(integral(slopes[:, :first]), slopes[:, first:])
        return found, found[-1]

    size, lanes = len(varying), next(x for row in varying for x in row if x is not None).shape[1]
    unit = jnp.broadcast_to(jnp.eye(size)[..., None], (NODES, size, size, lanes))
    begin = unit.at[:, first:].add(integral(_times(constant, unit[:, :first])))
    return jnp.concatenate([begin[-1:], jax.lax.scan(following, begin, length=TERMS)[1]])


def _split(form: Form, ends: Array, t: Array, first: int, lanes: int) -> tuple[Entries, Entries, Array]:
    """At the times ``t`` ``(NODES, 1)``: the rows of ``A0`` after the first ones, as far as they lead from the first states,
    those of ``A1``, and whether ``A0`` has entries elsewhere, ``(lanes,)``."""
    places: list[tuple[int, int]] = []

    def entries(parameter: Array) -> list[Array]:
        system = form(parameter)
        rows = system.rows(*system.basis(t))
        there = [
            (i, j, x) for i, row in enumerate(rows) for j, x in enumerate(row) if not (isinstance(x, int) and x == 0)
        ]
        places[:] = [(i, j) for i, j, _ in there]
        return [jnp.asarray(x, float) for *_, x in there]

    # Both ends at once: what does not depend on the coordinate is computed once.
    both = jax.vmap(entries)
    found = (in_one_kernel(both) if suits_one_kernel(both, ends) else both)(ends)
    size, wrong = form(ends[0]).size, jnp.zeros(lanes, bool)
    constant, varying = ([[None] * size for _ in range(size)] for _ in range(2))
    for (i, j), (start, end) in zip(places, found, strict=True):
        constant[i][j], varying[i][j] = (jnp.broadcast_to(x, (NODES, lanes)) for x in (start, end - start))
        if not i >= first > j:
            wrong |= jnp.any(constant[i][j] != 0, axis=0)
    return [row[:first] for row in constant[first:]], varying, wrong


def _times(rows: Entries, matrices: Array) -> Array:
    """``(m, k, n, lanes)`` from k rows of entries and ``(m, l, n, lanes)``."""
    nothing = jnp.zeros(matrices[:, 0].shape)
    products = ([x[:, None] * matrices[:, j] for j, x in enumerate(row) if x is not None] or [nothing] for row in rows)
    return jnp.stack([sum(terms[1:], terms[0]) for terms in products], axis=1)


def _product(a: Array, b: Array) -> Array:
    """Products of matrices ``(P, n, n, lanes)``."""
    return sum(a[:, :, j, None] * b[:, None, j] for j in range(b.shape[1]))
