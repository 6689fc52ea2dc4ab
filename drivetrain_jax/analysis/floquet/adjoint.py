"""The adjoint of the explicit march of order 8: gradients of sums of entries of a propagator by parameters.

With the propagators ``P_k`` of the steps the change of ``sum(W * Phi)`` is the sum over k of
``(P_K ... P_{k+1})^T W (P_{k-1} ... P_1)^T * dP_k``, entry by entry. The factors on the right are marched forwards and those
on the left backwards; states are kept on two levels, and the steps between two of them are differentiated at once.

A step from ``Y = I`` with the stages ``k_s = A_s Y_s``, ``Y_s = I + h sum_j a_sj k_j`` returns ``I + h sum_s b_s k_s``. The
adjoints of a weight W on the result are ``k'_s = h (b_s W + sum_{j > s} a_js Y'_j)`` and ``Y'_s = A_s^T k'_s``, and the
gradient by ``A_s`` is ``k'_s Y_s^T``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.floquet.propagator import Entries, Rows, advanced, explicit_march, identity, slopes_at
from drivetrain_jax.analysis.numerics import dop853
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel
from drivetrain_jax.analysis.numerics.lanes import Constants, in_blocks, lanes_last
from drivetrain_jax.analysis.numerics.linear_algebra import matmul
from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Steps differentiated at once, states kept on each of two levels (1 million steps in all), and lanes per block.
_STEPS, _KEPT, _LANES = 8, 360, 32

Build = Callable[[Any], FloquetModel]


class Part(eqx.Module):
    """A system between two of its breakpoints.

    The unit of time is the span of the part, so that derivatives include the motion of its ends.
    """

    parameters: Any
    build: Build = eqx.field(static=True)
    constants: Constants = eqx.field(static=True)
    number: int = eqx.field(static=True)

    def rows(self, s: Any) -> tuple[tuple[Any, ...], ...]:
        """``A`` times the span, at the fraction s of the span."""
        form = reduced_form(self.build, self.parameters, self.constants).parts[self.number]
        entries = form.entries(*form.basis(s * form.span))
        states = range(form.size)
        return tuple(tuple(form.span * entries[i, j] if (i, j) in entries else 0 for j in states) for i in states)

    @property
    def system(self) -> LinearPeriodic:
        """The part as a system of span 1."""
        return LinearPeriodic(self.rows, 1.0)


def reduced_form(build: Build, parameters: Any, constants: Constants) -> LinearPeriodic:
    """The reduced form of the system with these ``parameters`` (arrays) and ``constants`` (all else)."""
    return build(eqx.combine(parameters, constants.tree)).reduced


def weighted_gradient(part: Part, before: Array, weights: Array, steps: Array) -> Any:
    """The gradient ``(F,)`` of ``sum(weights * (Phi before))`` by each parameter of one ``part``, in ``steps`` steps.

    Phi is the propagator of the part; ``before`` is ``(n, n)`` and ``weights`` ``(F, n, n)``.
    """
    fixed = Constants((part.build, part.constants, part.number))
    return lanes_last(_pulled, fixed, (part.parameters, before, weights), steps, _LANES)


def _pulled(fixed: Constants, given: tuple[Any, Array, Array], steps: Array) -> Any:
    """The :func:`weighted_gradient` of all lanes, which are the last axis of each array."""
    parameters, before, weights = given
    lanes = max(x.shape[-1] for x in jax.tree.leaves(given) if x.ndim)
    parameters = jax.tree.map(lambda x: jnp.broadcast_to(x, lanes), parameters)
    before, weights = (jnp.broadcast_to(x, (*x.shape[:-1], lanes)) for x in (before, weights))
    build, constants, number = fixed.tree
    part = partial(Part, build=build, constants=constants, number=number)
    system = part(parameters).system
    blocks = -(-steps // _STEPS)
    long = -(-blocks // _KEPT)
    short = -(-blocks // long)
    h = 1 / (long * short * _STEPS)

    def interval(number: Array, carry: tuple[Array, Any, Array]) -> tuple[Array, Any, Array]:
        """First the states before the long intervals; then, for each of these from the last, before its blocks."""
        kept, gradient, weights = carry
        first = number == 0
        level, k = jnp.where(first, 0, 1), jnp.where(first, 0, long - number)
        count, length = jnp.where(first, long, short), jnp.where(first, short * _STEPS, _STEPS)
        start = k * (short * _STEPS * h)

        def onward(i: Array, kept: Array) -> Array:
            t = start + i * (length * h)
            return kept.at[level, i + 1].set(
                matmul(explicit_march(system, t, t + length * h, length)[0], kept[level, i])
            )

        def back(j: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            block = short - 1 - j
            t = start + block * (_STEPS * h)
            more, weights = _pulled_block(part, parameters, t, h, kept[1, block], carry[1])
            return jax.tree.map(jnp.add, carry[0], more), weights

        kept = jax.lax.fori_loop(0, count - 1, onward, kept.at[level, 0].set(kept[0, k]))
        gradient, weights = jax.lax.fori_loop(0, jnp.where(first, 0, short), back, (gradient, weights))
        return kept, gradient, weights

    kept = jnp.zeros((2, _KEPT, *before.shape)).at[0, 0].set(before)
    none = jax.tree.map(lambda x: jnp.zeros((len(weights), *x.shape)), parameters)
    return jax.lax.fori_loop(0, long + 1, interval, (kept, none, weights))[1]


def _pulled_block(
    part: Callable[[Any], Part], parameters: Any, start: Array, h: Array, state: Array, weights: Array
) -> tuple[Any, Array]:
    """Gradients over ``_STEPS`` steps, each step on its own, and the weights pulled back to their start."""
    n, lanes = state.shape[-2:]
    starts = jnp.repeat(start + h * jnp.arange(_STEPS), lanes)
    spread = jax.tree.map(lambda x: jnp.tile(x, _STEPS), parameters)

    def propagators(own: tuple[Any, Array], _: int) -> Array:
        return explicit_march(part(own[0]).system, own[1], own[1] + h, 1)[0]

    def gradients(own: tuple[Any, Array, Array], _: int) -> Any:
        return _step_gradient(lambda values: part(values).system, *own[:2], h, own[2])

    def folded(x: Array) -> Array:
        return x.reshape(*x.shape[:-1], _STEPS, lanes)

    each = jnp.moveaxis(folded(in_blocks(propagators, (spread, starts), len(starts), _LANES)), 2, 0)
    _, states = jax.lax.scan(lambda y, p: (matmul(p, y), y), state, each)

    def back(after: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        p, before = step
        own = jnp.sum(after[:, :, None] * before[None, None], axis=3)
        return jax.vmap(matmul, (None, 0))(jnp.swapaxes(p, 0, 1), after), own

    weights, own = jax.lax.scan(back, weights, (each, states), reverse=True)
    own = jnp.moveaxis(own, 0, 3).reshape(len(weights), n, n, -1)
    found = jax.lax.map(lambda x: in_blocks(gradients, (spread, starts, x), len(starts), _LANES), own)
    return jax.tree.map(lambda x: jnp.sum(folded(x), axis=1), found), weights


def _step_gradient(
    system: Callable[[Any], LinearPeriodic], parameters: Any, starts: Array, h: Array, weights: Array
) -> Any:
    """The gradient ``(lanes,)`` of ``sum(weights * P)`` by each of ``parameters`` ``(lanes,)``.

    P is the propagator of the step of length ``h`` from each of ``starts`` ``(lanes,)``; ``weights`` are ``(n, n, lanes)``.
    """

    def gradient(parameters: Any, starts: Array, h: Array, weights: Rows) -> Any:
        times = starts + h * jnp.asarray(dop853.C)[:, None]

        def entries(values: Any) -> Entries:
            form = system(values)
            return {place: jnp.broadcast_to(x, times.shape) for place, x in form.entries(*form.basis(times)).items()}

        spread = jax.tree.map(lambda x: jnp.broadcast_to(x, times.shape), parameters)
        at_stages, pull = jax.vjp(entries, spread)
        (found,) = pull(_by_entries(at_stages, h, weights))
        return jax.tree.map(lambda x: sum(x[k] for k in range(dop853.STAGES)), found)

    given = parameters, starts, h, list(weights)
    return in_one_kernel(gradient)(*given) if suits_one_kernel(gradient, *given) else gradient(*given)


def _by_entries(at_stages: Entries, h: Array, weights: Rows) -> Entries:
    """The gradient by the entries of ``A`` at all stages, ``(stages, lanes)`` each."""
    n, lanes = weights[0].shape
    start, states, slopes = identity(n, lanes), [], []
    for stage, row in enumerate(dop853.A):
        states.append(advanced(start, h, row[:stage], slopes))
        slopes.append(stored(partial(slopes_at, stage))(at_stages, states[-1]))
    adjoints: list[Rows] = [[]] * dop853.STAGES
    found: dict[tuple[int, int], list[Array]] = {place: [] for place in at_stages}
    for stage in reversed(range(dop853.STAGES)):
        later = [k for k in range(stage + 1, dop853.STAGES) if dop853.A[k][stage]]
        factors = [dop853.B[stage], *(dop853.A[k][stage] for k in later)]
        total = stored(partial(_combined, factors))(h, weights, *(adjoints[k] for k in later))
        own = {place: entry[stage] for place, entry in at_stages.items()}
        adjoints[stage] = stored(_transposed)(own, total)
        for (i, j), rows in found.items():
            rows.insert(0, stored(_inner)(total[i], states[stage][j]))
    return {place: jnp.concatenate(rows) for place, rows in found.items()}


def _combined(factors: list[float], h: Array, *used: Rows) -> Rows:
    """``h sum(factors * used)``."""
    return [h * sum(float(f) * rows[i] for f, rows in zip(factors, used, strict=True)) for i in range(len(used[0]))]


def _transposed(entries: Entries, rows: Rows) -> Rows:
    """``A^T rows``."""
    found: Rows = [0] * len(rows)  # pyright: ignore[reportAssignmentType]
    for (i, j), entry in entries.items():
        found[j] = found[j] + entry * rows[i]
    return found


def _inner(x: Array, y: Array) -> Array:
    product = x * y
    return sum(product[k : k + 1] for k in range(len(x)))  # pyright: ignore[reportReturnType]
