"""The paper's method: the determinant of the plain transfer matrices, scanned for changes of sign.

    Psi(p) = (R31 R42 - R32 R41) - k_D (R11 R32 - R12 R31),   R = R_n ... R_1 T_A

Each product grows like exp(tau), tau = sum of all phases z, their difference does not: Psi loses exp(tau) in accuracy.
At tau of about 11 pi, mode 12, all digits are gone and the scan finds roots of the rounding; at 355 it overflows.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import characteristic
from drivetrain_jax.analysis.critical_speeds.frequency_roots import Roots
from drivetrain_jax.analysis.critical_speeds.mechanisms import zero_modes
from drivetrain_jax.analysis.critical_speeds.segments import Scales
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.systems import Shaft
from drivetrain_jax.systems.trigonometry import sincos

POINTS_PER_MODE = 16
_BISECTIONS = 54
# Relative distance on either side of a root at which its number is counted.
_APART = 1e-7


def determinant(shaft: Shaft, q: Array) -> Array:
    """Psi at ``q = sqrt(p)``, over (1 + k_A)(1 + k_D), also in the limit of rigid supports; ``q``: ``(...,
    *lanes)``."""
    scales = Scales.of(shaft)
    (move_A, force_A), (move_D, force_D) = (_shares(k) for k in (shaft.k[0], shaft.k[-1]))
    zero = q * 0 * move_A
    # Columns for theta_A and F_A/k_A, rows f, theta, M, F; with k_A = 0 the second is a displacement without force.
    state = ((zero, zero + move_A), (zero + 1, zero), (zero, zero), (zero, zero + force_A))

    def step(state: Any, segment: tuple[Array, ...]) -> tuple[Any, None]:
        beta, b, EI = segment
        z, alpha = q * beta, q * b
        (s, c), ch, sh = sincos(z), jnp.cosh(z), jnp.sinh(z)
        f = ((ch + c) / 2, (sh + s) / 2, (ch - c) / 2, (sh - s) / 2)
        d = (1.0, 1 / alpha, -1 / (alpha**2 * EI), -1 / (alpha**3 * EI))
        scaled = [[d[j] * state[j][column] for column in (0, 1)] for j in range(4)]
        return tuple(
            tuple(sum(f[(j - i) % 4] * scaled[j][column] for j in range(4)) / d[i] for column in (0, 1))
            for i in range(4)
        ), None

    state, _ = jax.lax.scan(step, state, (scales.beta, scales.b, shaft.EI))
    (r11, r12), _, (r31, r32), (r41, r42) = state
    return (r31 * r42 - r32 * r41) * move_D - force_D * (r11 * r32 - r12 * r31)


def _shares(k: Array) -> tuple[Array, Array]:
    """``1/(1 + k)`` and ``k/(1 + k)``."""
    move = 1 / (1 + k)
    return move, 1 - move


def find_roots(shaft: Shaft, modes: int) -> Roots:
    """The first changes of sign of the determinant as natural frequencies; NaN where the scan found too few.

    ``certified`` says whether the Wittrick-Williams count gives each its number.
    """
    total = jnp.sum(Scales.of(shaft).beta, axis=0)
    span = modes + math.ceil(1.6 * shaft.segments)
    points = POINTS_PER_MODE * span
    lanes = shaft.lanes
    column = (points, *(1,) * len(lanes))
    grid = jnp.arange(1, points + 1).reshape(column) * (math.pi / POINTS_PER_MODE) / total
    grid = jnp.concatenate([jnp.broadcast_to(grid[:1], (1, *lanes)) * 1e-4, jnp.broadcast_to(grid, (points, *lanes))])
    positive = determinant(shaft, grid) > 0
    number = jnp.cumsum(positive[1:] != positive[:-1], axis=0)
    index = jnp.arange(1, modes + 1).reshape(modes, *(1,) * len(lanes))
    zeros = zero_modes(shaft)
    wanted = index - zeros
    cell = jnp.argmax(number[None] >= wanted[:, None], axis=1)
    found = (number[-1] >= wanted) & (wanted > 0)
    low, high = (jnp.take_along_axis(grid, cell + shift, axis=0) for shift in (0, 1))
    sign = jnp.take_along_axis(positive, cell, axis=0)

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        same = (stored(determinant)(shaft, middle) > 0) == sign
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high))
    q = jnp.where(wanted <= 0, 0.0, jnp.where(found, 0.5 * (low + high), jnp.nan))
    safe = jnp.where(q > 0, q, 1.0)
    below, above = (characteristic(shaft, safe * (1 + shift)).count for shift in (-_APART, _APART))
    certified = (wanted <= 0) | (found & (below < index) & (above >= index))  # pyright: ignore[reportOptionalOperand]
    return Roots(q, jnp.where(q > 0, 2 * (high - low) / safe, 0.0), certified)
