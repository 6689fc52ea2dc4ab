"""Stability of a motion given by harmonics, from the exact transition matrix of disturbances along the motion.

A disturbance obeys ``y'' + c' y' + k' s(t) y = 0`` with s = 1 in contact and s = alpha within the play. As s is constant
between crossings of the flanks, the transition over the period is a product of closed-form matrices. Hill's infinite
determinant converges to the same multipliers; their product is ``exp(-c' T)`` exactly.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis, Contact
from drivetrain_jax.systems import PiecewiseLinearOscillator

_BLOCKS = 8
Rows = tuple[Array, Array, Array, Array]


def _transition(stiffness: Array, span: Array) -> Rows:
    """Transition matrix of ``z'' + stiffness z = 0`` over ``span`` by rows, determinant 1."""
    square = stiffness * span**2
    angle = jnp.sqrt(jnp.abs(square))
    small = angle < 1e-4
    safe = jnp.where(small, 1.0, angle)
    ratio = jnp.where(small, 1 - square / 6, jnp.where(square > 0, jnp.sin(safe), jnp.sinh(safe)) / safe)
    cosine = jnp.where(square > 0, jnp.cos(angle), jnp.cosh(angle))
    return cosine, span * ratio, -stiffness * span * ratio, cosine


def _product(later: Rows, earlier: Rows) -> Rows:
    a, b, c, d = later
    p, q, r, s = earlier
    return a * p + b * r, a * q + b * s, c * p + d * r, c * q + d * s


def _ordered_product(matrices: Rows) -> Rows:
    """Product of the matrices along the first axis, the last matrix leftmost.

    Blocks are multiplied in parallel, then their products. Loops store their results; in one long expression XLA would
    recompute the terms for every use.
    """
    tail = matrices[0].shape[1:]
    one, zero = jnp.ones(tail), jnp.zeros(tail)
    unit = (one, zero, zero, one)

    def multiply(product: Rows, factor: Rows) -> tuple[Rows, None]:
        return _product(factor, product), None

    filling = -matrices[0].shape[0] % _BLOCKS
    filled = (
        jnp.concatenate([m, jnp.broadcast_to(u, (filling, *tail))]) if filling else m
        for m, u in zip(matrices, unit, strict=True)
    )
    by_block = tuple(jnp.moveaxis(m.reshape(_BLOCKS, -1, *tail), 0, 1) for m in filled)
    blocks = jax.lax.scan(multiply, tuple(jnp.broadcast_to(u, (_BLOCKS, *tail)) for u in unit), by_block)[0]  # pyright: ignore[reportArgumentType]
    return jax.lax.scan(multiply, unit, blocks)[0]


def half_trace(model: PiecewiseLinearOscillator, basis: Basis, omega: Array, touch: Contact) -> Array:
    """Half the trace of the transition over the base period, divided by ``exp(-c' T/2)``.

    With the half trace h, the multipliers over that factor are ``h -+ sqrt(h^2 - 1)``. For h between -1 and 1 both have the
    modulus of the factor. An unstable motion has h > 1 beyond a fold, and h < -1 beyond a period doubling.
    """
    span = 2 * np.pi * basis.order / (omega * basis.count)
    here = jnp.abs(touch.u) > model.b
    after = jnp.roll(here, -1, axis=0)
    # In z = exp(c' t/2) y the damping vanishes and the stiffness is k' s - c'^2/4.
    first, last = (
        model.stiffness * jnp.where(contact, 1.0, model.alpha) - model.damping**2 / 4 for contact in (here, after)
    )
    upper = touch.u + jnp.roll(touch.u, -1, axis=0) > 0
    theta = jnp.where(here == after, 1.0, jnp.where(upper, *touch.crossings))
    steps = _product(_transition(last, (1 - theta) * span), _transition(first, theta * span))
    whole = _ordered_product(steps)
    return (whole[0] + whole[3]) / 2


def spectral_radius(model: PiecewiseLinearOscillator, basis: Basis, omega: Array, half: Array) -> Array:
    """Modulus of the larger multiplier over the base period."""
    decay = jnp.exp(-model.damping * np.pi * basis.order / omega)
    beyond = jnp.maximum(jnp.abs(half), 1.0)
    return decay * (beyond + jnp.sqrt(beyond**2 - 1))
