"""The branch of balanced motions through a given one, by arc-length continuation: it passes folds and keeps the
unstable motions.

Points lie on the curve of ``(x/scale, omega/width)``; a step goes along the tangent and Newton iterations on the plane
across it lead back. Every lane has its own step length, shortened where they fail and lengthened where they are quick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis, balance, contact, jacobian, residual
from drivetrain_jax.analysis.impacts.branch_sections import Course, sections
from drivetrain_jax.analysis.numerics.linear_algebra import solve
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Attempts to advance; step lengths in units of the scaled curve; iterations of a step.
_ATTEMPTS, _FIRST, _SHORTEST, _LONGEST, _CORRECTIONS = 1500, 0.02, 1e-6, 0.08, 5
# Largest correction that is left, and cosines of the turn of the tangent: at most, and for a longer step.
_CLOSED, _LEAST_COSINE, _STRAIGHT = 1e-9, 0.97, 0.996
_POLISH = 8


class Branch(NamedTuple):
    """Points of a branch: coefficients ``(S, n, ...)``, frequencies ``(S, ...)``, NaN after its end, and whether it has
    reached the far end of the frequencies."""

    x: Array
    omega: Array
    complete: Array


class _Front(NamedTuple):
    """The last point, its tangent, the step length and the number of the point."""

    point: Array
    tangent: Array
    length: Array
    number: Array


def _bordered(
    model: PiecewiseLinearOscillator, basis: Basis, units: tuple[Array, Array], point: Array, tangent: Array
) -> tuple[Array, Array]:
    """Residual (scaled unknowns) and the matrix of its derivatives with ``tangent`` as last row."""
    scale, width = units
    x, omega = point[:-1] * scale, point[-1] * width
    touch = contact(model, basis, x)
    force, by_omega = residual(model, basis, x, omega, touch)
    inner = jacobian(model, basis, omega, touch) * scale
    rows = jnp.concatenate([inner, (by_omega * width)[:, None]], axis=1)
    return force, jnp.concatenate([rows, tangent[None]])


def _normalised(vector: Array) -> Array:
    return vector / jnp.sqrt(jnp.sum(vector**2, axis=0))


def _advance(
    model: PiecewiseLinearOscillator, basis: Basis, units: tuple[Array, Array], front: _Front
) -> tuple[Array, Array, Array, Array]:
    """A trial step: point, tangent there, whether it closed, whether it was quick."""
    guess = front.point + front.length * front.tangent

    def correct(_: Any, state: tuple[Array, ...]) -> tuple[Array, ...]:
        point, _, first, _ = state
        force, matrix = _bordered(model, basis, units, point, front.tangent)
        along = jnp.sum(front.tangent * (point - guess), axis=0)
        right = jnp.zeros_like(point).at[-1].set(1.0)
        known = jnp.stack([jnp.concatenate([force, along[None]]), right], axis=1)
        solution = solve(matrix, known)
        change = jnp.sqrt(jnp.sum(solution[:, 0] ** 2, axis=0))
        return point - solution[:, 0], solution[:, 1], jnp.where(first < 0, change, first), change

    lost = jnp.full(front.length.shape, -1.0)
    point, tangent, first, last = jax.lax.fori_loop(0, _CORRECTIONS, correct, (guess, front.tangent, lost, lost))
    tangent = _normalised(tangent)
    turned = jnp.sum(tangent * front.tangent, axis=0)
    closed = (last < _CLOSED) & (turned > _LEAST_COSINE) & jnp.all(jnp.isfinite(point), axis=0)
    return point, tangent, closed, (first < 0.1 * front.length) & (turned > _STRAIGHT)


def trace(model: PiecewiseLinearOscillator, basis: Basis, x: Array, start: float, stop: float, scale: Array) -> Branch:
    """The branch through the balanced motion ``x`` (n, N) at the frequency ``start``, followed towards ``stop``.

    It ends where it leaves the frequencies on either side, or after a fixed number of attempts.
    """
    lanes = x.shape[1:]
    width = abs(stop - start)
    units = (scale, jnp.full(lanes, width))
    point = jnp.concatenate([x / scale, jnp.full((1, *lanes), start / width)])
    forwards = jnp.zeros_like(point).at[-1].set(1.0 if stop > start else -1.0)
    _, matrix = _bordered(model, basis, units, point, forwards)
    tangent = _normalised(solve(matrix, jnp.abs(forwards)[:, None])[:, 0])
    front = _Front(point, tangent, jnp.full(lanes, _FIRST), jnp.zeros(lanes, jnp.int32))
    points = jnp.full((_ATTEMPTS, *point.shape), jnp.nan).at[0].set(point)
    low, high = min(start, stop), max(start, stop)

    def attempt(state: tuple[Array, _Front, Array, Array]) -> tuple[Array, _Front, Array, Array]:
        count, front, going, points = state
        point, tangent, closed, quick = _advance(model, basis, units, front)
        moved = going & closed
        length = jnp.where(closed, jnp.where(quick, 1.4, 1.0), 0.4) * front.length
        after = _Front(
            jnp.where(moved, point, front.point),
            jnp.where(moved, tangent, front.tangent),
            jnp.minimum(length, _LONGEST),
            front.number + moved,
        )
        points = points.at[after.number, :, jnp.arange(lanes[0])].set(after.point.T)
        omega = after.point[-1] * width
        inside = (omega >= low * (1 - 1e-9)) & (omega <= high * (1 + 1e-9))
        return count + 1, after, going & inside & (length > _SHORTEST), points

    def unfinished(state: tuple[Array, _Front, Array, Array]) -> Array:
        return (state[0] < _ATTEMPTS - 1) & jnp.any(state[2])

    going = jnp.all(jnp.isfinite(point), axis=0)
    _, front, _, points = jax.lax.while_loop(unfinished, attempt, (jnp.int32(0), front, going, points))
    end = front.point[-1] * width
    complete = end >= high if stop > start else end <= low
    return Branch(points[:, :-1] * scale, points[:, -1] * width, complete)


def at_frequency(
    model: PiecewiseLinearOscillator, basis: Basis, branch: Course, omega: Array, count: int
) -> tuple[Array, Array, Array, Array]:
    """Up to ``count`` motions of the branch at ``omega``, in its order, balanced: ``(count, n, ...)``; flags of existing
    ones, of saddles of the balance, and if these are all."""
    guess, exists, every = sections(branch, omega, count)

    def improved(x: Array) -> tuple[Array, Array, Array]:
        found = balance(model, basis, x, omega + jnp.zeros(x.shape[1:]), _POLISH)
        return found.x, found.converged, found.saddle

    found, converged, saddle = jax.lax.map(improved, guess[:, :-1])
    return found, exists & converged, saddle, every & jnp.all(converged | ~exists, axis=0)
