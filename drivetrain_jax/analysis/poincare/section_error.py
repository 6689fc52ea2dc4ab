"""Errors of a section: the error within one strobe, and the accumulated error over the memory of the motion.

A damped motion forgets the errors of its strobes, an undamped motion accumulates them, and close to a tongue they grow for
hundreds of strobes. Some strobes are repeated with finer equal steps, which gives the error of one strobe. The whole
motion, discarded strobes included, is repeated once with other equal steps, which may be few. Let r be the ratio of the
error of a strobe to the change of this strobe by the other steps. As long as both motions differ by at most a tenth of the
section, the error of the section is at most r times their distance.

The ratio r varies: steps resolve a violent start worse than the settled motion, and the start may dominate the error.
Therefore the first strobes from the start are also repeated, and the largest ratio counts. If the error may still matter, or
the other steps diverge although every strobe is right, the motion is repeated with more steps, and the distance is the
error.

The section of a chaotic motion differs for every number of steps: only the error of one strobe is meaningful.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.lyapunov.growth_record import discarded, sampled
from drivetrain_jax.analysis.lyapunov.variational import Frame, initial_state, one_kernel, strobe_map
from drivetrain_jax.systems import Flow

# Number of repeated strobes: of the section, and from the start.
_TAKEN_AGAIN, EARLY = 8, 16
# Relative distance from the section up to which errors are proportional.
_PROPORTIONAL = 0.1
# Fraction of the largest change below which the change of a strobe is ignored, as its ratio may be that of rounding;
# fraction of the tolerance above which an estimate is repeated with more steps.
_CONSIDERABLE, _DOUBTFUL = 0.01, 0.1


class _Strobes(NamedTuple):
    """Strobes to repeat: their numbers, shape ``(K,)``, and the states at their begin and end, ``(K, n, ...)``."""

    number: np.ndarray
    begin: Array
    end: Array


class Steps(NamedTuple):
    """Equal steps per strobe: of single strobes, of the whole motion, and of the whole motion in doubtful cases.

    The third number is 0 (no repetition) or at least the first one.
    """

    strobe: int
    motion: int
    then: int = 0


def watched(flow: Flow) -> np.ndarray:
    """Components that are neither phases nor angles."""
    return np.array([i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0])


def section_errors(
    flow: Flow, states: Array, early: Array, first: int, steps: Steps, tolerated: float
) -> tuple[Array, Array]:
    """Errors of single strobes and of the whole section ``states``, shape ``(T, n, ...)``, relative to its largest value.

    An error of a tenth or more means another section; NaN is unknown. The states follow after ``first`` strobes from the
    start; ``early`` holds the states after the first ``min(first, EARLY)`` of those strobes, by the same steps.

    Only motions whose strobe errors are within ``tolerated``, or that agree with the first march, have a second march.
    """
    size = jnp.max(jnp.abs(states[:, watched(flow)]), axis=(0, 1))
    size = jnp.where(size == 0, 1.0, size)
    strobes = _strobes(flow, states, early, first)
    # One loop over the numbers of steps, because marches are expensive to compile.
    errors, changes = jax.lax.map(lambda n: _changes(flow, strobes, n) / size, jnp.array(steps[:2]))
    strobe = jnp.max(errors[strobes.number >= first], axis=0)
    share = _share(errors, changes)
    marches = [(steps.motion, share), (steps.then, jnp.ones_like(share))][: 2 if steps.then else 1]

    def whole(error: Array, march: tuple[Array, Array]) -> tuple[Array, None]:
        count, share = march
        followed = error <= _PROPORTIONAL
        doubtful = ~(error <= _DOUBTFUL * tolerated) & (followed | (strobe <= tolerated))
        unknown = jnp.isinf(error) | doubtful

        def found() -> Array:
            distance = _distance(flow, states, first, count) / size
            return jnp.where(unknown, jnp.where(distance <= _PROPORTIONAL, distance * share, distance), error)

        return jax.lax.cond(jnp.any(unknown), found, lambda: error), None

    counts, shares = zip(*marches, strict=True)
    error, _ = jax.lax.scan(whole, jnp.full(strobe.shape, jnp.inf), (jnp.array(counts), jnp.stack(shares)))
    return strobe, jnp.where(jnp.isfinite(error), error, jnp.nan)


def _strobes(flow: Flow, states: Array, early: Array, first: int) -> _Strobes:
    """The first strobes from the start, and some of the section."""
    start = jnp.stack(initial_state(flow))[None]
    known = jnp.concatenate([start, early, states[: EARLY - len(early)]])
    begun = np.linspace(0, len(states) - 2, _TAKEN_AGAIN).astype(int)
    return _Strobes(
        np.concatenate([np.arange(len(known) - 1), first + 1 + begun]),
        jnp.concatenate([known[:-1], states[begun]]),
        jnp.concatenate([known[1:], states[begun + 1]]),
    )


def _changes(flow: Flow, strobes: _Strobes, steps: Array) -> Array:
    """Largest change of each of the ``strobes`` when repeated with ``steps`` equal steps, shape ``(K, ...)``."""
    number = jnp.asarray(strobes.number).reshape(-1, *(1,) * (strobes.begin.ndim - 2))
    begin = Frame(tuple(jnp.moveaxis(strobes.begin, 1, 0)))
    ends = one_kernel(flow)(lambda steps, frame: strobe_map(flow, steps)(number, frame))(steps, begin).state
    return jnp.max(jnp.abs(jnp.stack(ends, axis=1) - strobes.end)[:, watched(flow)], axis=1)


def _share(errors: Array, changes: Array) -> Array:
    """Largest ratio of ``errors`` to relevant ``changes``, both ``(K, ...)``; 1 if nothing changes."""
    largest = jnp.max(jnp.where(jnp.isfinite(changes), changes, 0.0), axis=0)
    considerable = (changes > 0) & (changes >= _CONSIDERABLE * largest)
    ratio = jnp.where(considerable, errors / jnp.where(considerable, changes, 1.0), 0.0)
    return jnp.where(largest > 0, jnp.max(ratio, axis=0), 1.0)


def _distance(flow: Flow, states: Array, first: int, steps: Array) -> Array:
    """Largest distance of ``states`` from the motion with ``steps`` equal steps per strobe, shape ``(...)``."""
    start = discarded(flow, steps, jnp.int64(first))
    others, _ = sampled(flow, steps, start, jnp.int64(first), len(states))
    return jnp.max(jnp.abs(others - states)[:, watched(flow)], axis=(0, 1))
