"""States at given times and events of a motion of a piecewise linear oscillator from any start, exact up to rounding."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.piecewise_march import (
    Lanes,
    Motion,
    advance,
    allowed_steps,
    locate,
    next_step,
    prepare,
    start,
)
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.systems import PiecewiseLinearOscillator

DRIVE, BACK, NO_EVENT = range(3)


class Events(NamedTuple):
    """Contacts made and lost, in order: ``time``, number of the ``flank`` and ``velocity``, shape ``(events, N)``.

    After the last event, entries are NaN and ``NO_EVENT``. The ``number`` (N,) of events may exceed the length of the list.
    """

    time: Array
    flank: Array
    velocity: Array
    number: Array


class _Walk(NamedTuple):
    """State of the march: the motion, whose periods ``left`` count down from 0, and the events so far."""

    motion: Motion
    events: Events


def timed_motion(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, times: np.ndarray, most_events: int
) -> tuple[Array, Array, Events, Array]:
    """Displacement and velocity ``(T, N)`` at the rising ``times``, the first ``most_events`` events, and flags ``(N,)``.

    The motion starts in the state ``(u, v)`` at t = 0. A flag marks a lane that needs too many steps: a grazing motion, or
    one whose oscillator is so much faster than its drive that it is not begun. Times are counted in whole periods and a
    fraction, so that the phase of the drive does not drift.
    """
    lanes = jax.tree.map(lambda x: x + jnp.zeros(u.shape), prepare(oscillator, times[-1]))
    turns = jnp.asarray(times)[:, None] / lanes.period
    periods = jnp.floor(turns).astype(jnp.int32)
    allowed = allowed_steps(lanes, times[-1])
    most = jnp.where(allowed > 0, 2 * (periods[-1] + 1) * allowed + 2 * len(times), 0)
    none = jnp.full((most_events, *u.shape), jnp.nan)
    nothing = Events(none, jnp.full(none.shape, NO_EVENT, jnp.int8), none, jnp.zeros(u.shape, jnp.int32))

    def to(walk: _Walk, target: tuple[Array, Array]) -> tuple[_Walk, tuple[Array, Array]]:
        def active(motion: Motion) -> Array:
            whole, part = target
            early = (-motion.left < whole) | ((-motion.left == whole) & (motion.time < part))
            return early & jnp.isfinite(motion.u) & (motion.steps < most)

        walk = jax.lax.while_loop(
            lambda w: jnp.any(active(w.motion)), lambda w: _moved(lanes, w, target, active(w.motion)), walk
        )
        late = jnp.where(walk.motion.steps < most, 0.0, jnp.nan)
        return walk, (walk.motion.u + late, walk.motion.v + late)

    begin = _Walk(start(lanes, u, v, jnp.zeros(u.shape, jnp.int32)), nothing)
    end, (high, rate) = jax.lax.scan(to, begin, (periods, (turns - periods) * lanes.period))
    return high, rate, end.events, end.motion.steps >= most


def _moved(lanes: Lanes, walk: _Walk, target: tuple[Array, Array], active: Array) -> _Walk:
    """The march after one step of the ``active`` lanes, at most to the ``target``: whole periods and the time after them."""
    motion, (whole, part) = walk.motion, target
    here = locate(lanes, motion.u)
    # The end of a step does not influence the motion, and its derivative may be infinite: it is not differentiated.
    d = next_step(*jax.lax.stop_gradient((lanes, here, motion)))
    d = jnp.where(d >= lanes.period - motion.time, lanes.period - motion.time, d)
    d = jnp.where(-motion.left == whole, jnp.minimum(d, part - motion.time), d)
    # Stored: computed once more with another rounding, a displacement on a flank would be kept and yet not be an event.
    moved = stored(advance)(lanes, here, motion, d)
    after = locate(lanes, moved.u).side
    crosses = active & (after != here.side)
    flank = jnp.where(here.side + after > 0, DRIVE, BACK).astype(jnp.int8)
    time = moved.time - moved.left * lanes.period
    kept = jax.tree.map(lambda new, old: jnp.where(active, new, old), moved, motion)
    return _Walk(kept, _recorded(walk.events, crosses, time, flank, moved.v))


def _recorded(events: Events, crosses: Array, time: Array, flank: Array, velocity: Array) -> Events:
    """``events`` with one more event in the lanes that cross a flank; when the list is full, the event is only counted."""
    length = events.time.shape[0]
    place = jnp.where(crosses, events.number, length), jnp.arange(crosses.shape[0])
    return Events(
        events.time.at[place].set(time, mode="drop"),
        events.flank.at[place].set(flank, mode="drop"),
        events.velocity.at[place].set(velocity, mode="drop"),
        events.number + crosses,
    )
