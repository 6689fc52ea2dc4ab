"""Errors of a section: what one strobe is wrong by, and what that adds up to over the memory of the motion.

Errors of strobes are carried on: a damped motion forgets them, an undamped one adds them up, close to a tongue they grow
for hundreds of strobes. Some strobes are taken again by finer equal steps: the error of one strobe. The whole motion, what
was discarded included, is marched once more by other equal steps. As long as that stays within a tenth of the section, the
error of the section is in the same proportion to its distance as the errors of the strobes are, so that few steps will do.
If it does not, while every strobe is right, more steps are tried.

Of a chaotic motion every number of steps gives another section: the error of one strobe is all that can be said of it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.chaos.growth import discarded, sampled
from drivetrain_jax.analysis.chaos.variational import Frame, one_kernel, strobe_map
from drivetrain_jax.systems import Flow

# Strobes that are taken again.
_TAKEN_AGAIN = 8
# Distances from the section up to which errors are in proportion, over its largest value.
_PROPORTIONAL = 0.1


class Steps(NamedTuple):
    """Equal steps a strobe: those of single strobes, those of the whole motion, and those (0: none) that are tried where
    the latter lead away from the section."""

    strobe: int
    motion: int
    then: int = 0


def watched(flow: Flow) -> np.ndarray:
    """Components that are neither phases nor angles."""
    return np.array([i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0])


def section_errors(flow: Flow, states: Array, first: int, steps: Steps, tolerated: float) -> tuple[Array, Array]:
    """Errors of single strobes and of the whole of ``states``, shape ``(T, n, ...)``, those after the first ``first``
    strobes from the start, over the largest value (a tenth or more: another section; NaN: not known).

    A second march is made only of motions whose errors of strobes are within ``tolerated``.
    """
    size = jnp.max(jnp.abs(states[:, watched(flow)]), axis=(0, 1))
    size = jnp.where(size == 0, 1.0, size)
    # One loop over the numbers of steps: marches are dear to compile.
    marches = jnp.array([count for count in steps[1:] if count])
    strobe, *changes = jax.lax.map(
        lambda n: _change(flow, states, first, n) / size, jnp.array([steps.strobe, *marches])
    )

    def whole(error: Array, march: tuple[Array, Array]) -> tuple[Array, None]:
        count, change = march
        unknown = jnp.isinf(error) | (~(error <= _PROPORTIONAL) & (strobe <= tolerated))

        def found() -> Array:
            distance = _distance(flow, states, first, count) / size
            share = jnp.where(change > 0, strobe / change, 1.0)
            return jnp.where(unknown, jnp.where(distance <= _PROPORTIONAL, distance * share, distance), error)

        return jax.lax.cond(jnp.any(unknown), found, lambda: error), None

    error, _ = jax.lax.scan(whole, jnp.full(strobe.shape, jnp.inf), (marches, jnp.stack(changes)))
    return strobe, jnp.where(jnp.isfinite(error), error, jnp.nan)


def _change(flow: Flow, states: Array, first: int, steps: Array) -> Array:
    """Largest change over a strobe when some of the ``states`` are carried on to the next one, shape ``(...)``."""
    begun = np.linspace(0, len(states) - 2, _TAKEN_AGAIN).astype(int)
    number = jnp.asarray(first + 1 + begun).reshape(-1, *(1,) * (states.ndim - 2))
    start = Frame(tuple(jnp.moveaxis(states[begun], 1, 0)))
    ends = one_kernel(flow)(lambda steps, frame: strobe_map(flow, steps)(number, frame))(steps, start).state
    return jnp.max(jnp.abs(jnp.stack(ends, axis=1) - states[begun + 1])[:, watched(flow)], axis=(0, 1))


def _distance(flow: Flow, states: Array, first: int, steps: Array) -> Array:
    """Largest distance of ``states`` from the motion by ``steps`` equal steps a strobe, shape ``(...)``."""
    start = discarded(flow, steps, jnp.int64(first))
    others, _ = sampled(flow, steps, start, jnp.int64(first), len(states))
    return jnp.max(jnp.abs(others - states)[:, watched(flow)], axis=(0, 1))
