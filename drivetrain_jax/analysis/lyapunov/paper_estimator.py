"""The estimator (31)-(36) of Bugaru & Vasile 2022, as printed. It is not a Lyapunov exponent.

    L_j = (1/T_f) sum_i log10(|Delta_j(T_i)| / |Delta(T_f)|),  Delta = difference of two trajectories

for every component j, the clock that defines the strobe included; T_i are the strobes up to T_f. Nothing is made
normal again, the base is 10, the ratio compares each time with the END, one component with a norm of mixed units, and
the sum grows with the number of T_i: the result is inversely proportional to their distance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.variational import Frame, initial_state, one_kernel, strobe_map
from drivetrain_jax.systems import Flow

# Initial difference of every component, in the reported units.
PERTURBATION = 1e-6
_SMALLEST = 1e-300


def component_count(flow: Flow) -> int:
    """Number of components: those of the state, and the clock that defines the strobe if there is one."""
    return flow.size + bool(flow.turns)


def paper_estimator(flow: Flow, steps: Any, max_time: float) -> Array:
    """L_j in 1/s, shape ``(component_count(flow), ...)``, over ``max_time`` and differences of 1e-6 at t = 0."""
    scale = flow.scale or (1.0,) * flow.size
    base = initial_state(flow)
    zero = jnp.zeros_like(base[0])
    moved = tuple(x + PERTURBATION / s for x, s in zip(base, scale, strict=True))
    shifted = replace(flow, field=_shifted(flow))
    maps = strobe_map(flow, steps), strobe_map(shifted, steps)
    strobes = jnp.broadcast_to(jnp.ceil(jnp.asarray(max_time / flow.period)).astype(jnp.int64), zero.shape)

    def logs(one: Frame, other: Frame) -> tuple[Array, Array]:
        parts = [(b - a) * s for a, b, s in zip(one.state, other.state, scale, strict=True)]
        parts += [zero + PERTURBATION] * bool(flow.turns)
        delta = jnp.stack(parts)
        norm = jnp.sqrt(sum(part**2 for part in parts))
        return jnp.log10(jnp.maximum(jnp.abs(delta), _SMALLEST)), jnp.log10(jnp.maximum(norm, _SMALLEST))

    def body(k: Array, carry: tuple) -> tuple:
        frames, total, last = carry
        new = tuple(advance(k, frame) for advance, frame in zip(maps, frames, strict=True))
        components, norm = logs(*new)
        counts = k < strobes
        return new, total + jnp.where(counts, components, 0.0), jnp.where(counts, norm, last)

    def march(start: tuple, count: Array) -> tuple:
        return jax.lax.fori_loop(0, count, body, start)

    start = ((Frame(base), Frame(moved)), jnp.zeros((component_count(flow), *zero.shape)), zero)
    _, total, last = one_kernel(flow)(march)(start, jnp.max(strobes))
    return (total - strobes * last) / (strobes * flow.period)


def _shifted(flow: Flow) -> Any:
    """The field with its strobe clock advanced by the perturbation."""

    def field(angles: tuple, y: Any) -> Any:
        return flow.field((angles[0] + PERTURBATION, *angles[1:]) if angles else angles, y)

    return field
