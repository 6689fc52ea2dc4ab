"""Decide if a motion approaches a periodic orbit that Newton's method found from one of its states.

Newton's method may converge to an orbit whose basin does not contain the state. One recurrence that agrees with the
linearisation about the orbit proves nothing, because the remainder is a vector that vanishes at some points. Therefore the
motion is continued. With M the transition matrix about the orbit ``z*``, rho its spectral radius and m the period multiple,
every recurrence must satisfy

    |F^m(z) - z* - M (z - z*)| <= 0.02 (1 - rho) |z - z*|

until the visited points enclose the rest of the way. With complex multipliers of argument theta the motion passes through
all directions within ``max(2 pi/theta, pi/(pi - theta))`` recurrences. The gaps between these directions, at most 120
degrees, count as closed after the distance has shrunk by ``cos(gap/2)``. With real multipliers the faster component must
have shrunk by a factor of 30 relative to the other. In any case a decrease of the distance by this factor is enough.

Near a fold or a period doubling rho is nearly 1, and this test would need thousands of periods. The motion then moves slowly
along one line, the direction of the slow multiplier. The map shows that no other orbit lies on this line: from each of
eight points between the orbit and the motion, one recurrence (two if the multiplier is negative) must lead nearer to the
orbit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.plane_map import Matrix, apply, spectral_radius

# Tolerated remainder of the linearisation relative to the contraction 1 - rho.
REMAINDER = 0.02
# Distance at which the motion has arrived, relative to its distance from the flank.
_ARRIVED = 1e-9
_DECAY = np.log(30.0)
# A slow approach: least modulus of the slow multiplier, largest ratio of the fast multiplier to the slow one, and largest
# distance of the motion from the slow line relative to its distance from the orbit.
_SLOW, _APART, _OFF = 0.9, 0.9, 0.1
# Number of points tested on the slow line, and their least contraction as a fraction of 1 - rho.
PROBES, _PULL = 8, 0.2


class Orbit(NamedTuple):
    """An orbit through ``u, v``, each field ``(width,)``: the transition ``matrix`` over its period, the logarithm of the
    determinant of the matrix, and the estimated ``error`` of u."""

    u: Array
    v: Array
    matrix: Matrix
    log_determinant: Array
    error: Array


def attracts(orbit: Orbit) -> Array:
    """True if all multipliers lie inside the unit circle."""
    return spectral_radius(orbit.matrix, orbit.log_determinant) < 1


def recurrences(orbit: Orbit) -> Array:
    """Number of recurrences that must satisfy the linearisation (module docstring), at least 2."""
    rho = spectral_radius(orbit.matrix, orbit.log_determinant)
    half = (orbit.matrix[0] + orbit.matrix[3]) / 2
    gap = half**2 - jnp.exp(orbit.log_determinant)
    angle = jnp.arctan2(jnp.sqrt(jnp.maximum(-gap, 0.0)), half)
    apart = jnp.maximum(2 * jnp.log(rho) - orbit.log_determinant, 1e-300)
    decay = jnp.maximum(-jnp.log(rho), 1e-300)
    rest = jnp.maximum(np.pi - angle, 1e-300)
    turn = jnp.maximum(2 * np.pi / jnp.maximum(angle, 1e-300), np.pi / rest)
    turn = turn - jnp.log(jnp.cos(jnp.minimum(angle / 2, rest))) / decay
    needed = jnp.minimum(jnp.where(gap < 0, turn, _DECAY / apart), _DECAY / decay)
    return jnp.maximum(jnp.ceil(needed), 2.0)


def reach(u: Array, v: Array, flank: Any, omega: Array) -> Array:
    """Size of a motion through ``(u, v)``, from the flank: at a wide backlash the motion may be far from the origin."""
    return jnp.abs(jnp.abs(u) - flank) + jnp.abs(v) / omega


def linearisation_holds(
    orbit: Orbit, before: tuple[Array, Array], after: tuple[Array, Array], flank: Any, omega: Array
) -> tuple[Array, Array]:
    """Flags where ``after``, one recurrence after ``before``, agrees with the linearisation, and flags of arrival."""
    rho = spectral_radius(orbit.matrix, orbit.log_determinant)
    away = (before[0] - orbit.u, before[1] - orbit.v)
    ahead = apply(orbit.matrix, *away)
    rest = jnp.abs(after[0] - orbit.u - ahead[0]) + jnp.abs(after[1] - orbit.v - ahead[1]) / omega
    distance = jnp.abs(away[0]) + jnp.abs(away[1]) / omega
    arrived = distance <= _ARRIVED * reach(orbit.u, orbit.v, flank, omega) + orbit.error
    return (rest <= REMAINDER * (1 - rho) * distance) | arrived, arrived


def along(orbit: Orbit, away: tuple[Array, Array]) -> tuple[Array, Array]:
    """Component of ``away`` along the slow line: the projection ``(M - mu_fast)/(mu_slow - mu_fast)`` (real mu only)."""
    half = (orbit.matrix[0] + orbit.matrix[3]) / 2
    root = jnp.sqrt(jnp.maximum(half**2 - jnp.exp(orbit.log_determinant), 0.0))
    slow, fast = jnp.where(half < 0, half - root, half + root), jnp.where(half < 0, half + root, half - root)
    moved = apply(orbit.matrix, *away)
    return tuple((m - fast * x) / (slow - fast) for m, x in zip(moved, away, strict=True))  # pyright: ignore[reportReturnType]


def is_slow(orbit: Orbit, state: tuple[Array, Array], omega: Array) -> Array:
    """Flags where the motion in ``state`` moves slowly towards the orbit along the slow line."""
    half = (orbit.matrix[0] + orbit.matrix[3]) / 2
    rho, real = spectral_radius(orbit.matrix, orbit.log_determinant), half**2 > jnp.exp(orbit.log_determinant)
    away = (state[0] - orbit.u, state[1] - orbit.v)
    part = along(orbit, away)
    off = jnp.abs(away[0] - part[0]) + jnp.abs(away[1] - part[1]) / omega
    distance = jnp.abs(away[0]) + jnp.abs(away[1]) / omega
    apart = jnp.exp(orbit.log_determinant) <= _APART * rho**2
    return real & (rho > _SLOW) & (rho < 1) & apart & (off <= _OFF * distance)


def doubled(orbit: Orbit) -> tuple[Orbit, Array]:
    """The orbit, over two periods where its slow multiplier is negative, and flags of these lanes.

    Over one period a motion near such an orbit changes sides, and the orbit may attract from one side only.
    """
    a, b, c, d = orbit.matrix
    negative = a + d < 0
    square = (a * a + b * c, b * (a + d), c * (a + d), b * c + d * d)
    matrix = tuple(jnp.where(negative, new, old) for new, old in zip(square, orbit.matrix, strict=True))
    return orbit._replace(matrix=matrix, log_determinant=jnp.where(negative, 2, 1) * orbit.log_determinant), negative


def probe(orbit: Orbit, state: tuple[Array, Array], number: Array) -> tuple[Array, tuple[Array, Array]]:
    """Point ``number`` of the line, from 0: its position (0 the orbit, 1 ``state``) and its state."""
    place = (number + 1) / PROBES
    return place, (orbit.u + place * (state[0] - orbit.u), orbit.v + place * (state[1] - orbit.v))


def is_attracted(
    orbit: Orbit, state: tuple[Array, Array], place: Array, after: tuple[Array, Array], omega: Array
) -> Array:
    """Flags where ``after``, one recurrence after the point ``place`` of the line to ``state``, lies nearer to the orbit on
    the same side."""
    rho = spectral_radius(orbit.matrix, orbit.log_determinant)
    unit = along(orbit, (state[0] - orbit.u, state[1] - orbit.v))
    there = along(orbit, (after[0] - orbit.u, after[1] - orbit.v))
    product = there[0] * unit[0] + there[1] * unit[1] / omega**2
    reached = product / (unit[0] ** 2 + unit[1] ** 2 / omega**2) / place
    return (reached > 0) & (reached <= 1 - _PULL * (1 - rho))
