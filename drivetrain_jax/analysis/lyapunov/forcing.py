"""Decide if a field can be chaotic: two components without forcing cannot (Poincare and Bendixson).

A clock may turn without effect: the field does not contain it, or the amplitude of its forcing is zero.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems import Flow

# Fractions of a strobe at which the clocks are tested; at none of them the derivative of a harmonic vanishes by symmetry.
FRACTIONS = tuple((k + 0.37) / 8 for k in range(8))
# Number of components of a flow that cannot be chaotic without a clock; a phase is a clock among the components.
_PLANAR = 2


def driven(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where the field at ``y`` depends on any of its clocks, shape (...), however small the amplitude."""
    felt = [feels(flow, y, number) for number in range(len(flow.turns))]
    return jnp.any(jnp.stack([jnp.zeros(jnp.shape(y[0]), bool), *felt]), axis=0)


def feels(flow: Flow, y: tuple[Array, ...], number: int) -> Array:
    """Flags where the field at ``y`` depends on the clock ``number``, shape (...), however small the amplitude."""
    shape = (len(FRACTIONS), *jnp.shape(y[0]))
    angles = flow.angles(0, jnp.asarray(FRACTIONS).reshape(-1, *(1,) * jnp.ndim(y[0])))

    def rates(angle: Array) -> Array:
        turned = (*angles[:number], angle, *angles[number + 1 :])
        return jnp.stack([jnp.broadcast_to(jnp.asarray(rate, float), shape) for rate in flow.field(turned, y)])

    angle = jnp.broadcast_to(angles[number], shape)
    _, change = jax.jvp(rates, (angle,), (jnp.ones_like(angle),))
    return jnp.any(change != 0, axis=(0, 1))


def may_rest(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where the field vanishes at 0, whatever the clocks show; only phases keep their values of ``y``."""
    still = jnp.stack([x if i in flow.phases else jnp.zeros_like(x) for i, x in enumerate(y)])
    rates = jnp.stack([flow.vector(0, fraction, still) for fraction in FRACTIONS])
    moving = jnp.array([i for i in range(flow.size) if i not in flow.phases])
    return jnp.all(rates[:, moving] == 0, axis=(0, 1))


def may_be_chaotic(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where chaos is possible, shape (...); ``y`` is a state of the motion."""
    if flow.size > _PLANAR or flow.phases:
        return jnp.ones(jnp.shape(y[0]), bool)
    return driven(flow, y)
