"""The estimator (31)-(36) of Bugaru & Vasile 2022, which is not a Lyapunov exponent.

    L_j = (1/T_f) sum_i log10(|Delta_j(T_i+1)| / |Delta(T_f)|)

for every component j, the clock that defines the strobe included; T_i are the strobes up to T_f. On every interval
(T_i, T_i+1) the second trajectory restarts from the first one plus a perturbation proportional to it.

The estimator is no exponent for four reasons: its base is 10; its ratio compares each time with the END; it compares one
component with a norm of mixed units; and its sum grows with the number of T_i, so that the result is inversely proportional
to their distance.

The paper does not print the length of an interval; here it is one strobe. An interval at whose end a component has the
distance 0 is left out, such as the first interval of a flow with a clock, which starts at 0.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.lyapunov.variational import Frame, initial_state, one_kernel, strobe_map
from drivetrain_jax.systems import Flow

# Relative perturbation of every component.
PERTURBATION = 1e-5


def component_count(flow: Flow) -> int:
    """Number of components: those of the state, and the clock that defines the strobe if there is one."""
    return flow.size + bool(flow.turns)


def paper_estimator(flow: Flow, steps: Any, max_time: float, members: Array) -> Array:
    """L_j of the ``members`` in 1/s, shape ``(component_count(flow), ...)``, over ``max_time``."""
    scale = flow.scale or (1.0,) * flow.size
    base = initial_state(flow)
    zero = jnp.zeros_like(base[0])
    advance = strobe_map(flow, steps)
    strobes = jnp.broadcast_to(jnp.ceil(jnp.asarray(max_time / flow.period)).astype(jnp.int64), zero.shape)

    def distances(k: Array, state: tuple, after: tuple) -> Array:
        """Distances of all components at the end of interval ``k`` from ``state`` to ``after``."""
        ahead = 2 * np.pi * PERTURBATION * k
        moved = strobe_map(replace(flow, field=_shifted(flow, ahead)), steps)
        other = moved(k, Frame(tuple(x * (1 + PERTURBATION) for x in state))).state
        parts = [(b - a) * s for a, b, s in zip(after, other, scale, strict=True)]
        return jnp.abs(jnp.stack([*parts, *[zero + ahead] * bool(flow.turns)]))

    def body(k: Array, carry: tuple) -> tuple:
        frame, total, counted, last = carry
        new = advance(k, frame)
        apart = distances(k, frame.state, new.state)
        counts = (k < strobes) & jnp.all(apart > 0, axis=0)
        logs = jnp.log10(jnp.where(counts, apart, 1.0))
        norm = jnp.log10(jnp.sqrt(jnp.sum(jnp.where(counts, apart, 1.0) ** 2, axis=0)))
        return new, total + logs, counted + counts, jnp.where(counts, norm, last)

    def march(start: tuple, count: Array) -> tuple:
        return jax.lax.fori_loop(0, count, body, start)

    start = (Frame(base), jnp.zeros((component_count(flow), *zero.shape)), zero, zero)
    _, total, counted, last = one_kernel(flow)(march)(start, jnp.max(jnp.where(members, strobes, 0)))
    return (total - counted * last) / (strobes * flow.period)


def _shifted(flow: Flow, ahead: Array) -> Any:
    """The field with its strobe clock ahead."""

    def field(angles: tuple, y: Any) -> Any:
        return flow.field((angles[0] + ahead, *angles[1:]) if angles else angles, y)

    return field
