"""The branch of balanced motions through a given motion, stable or not, by arc-length continuation through folds.

The branch is a curve of points ``(x/scale, omega/width)``. A step goes along the tangent; Newton iterations in the plane
across the tangent lead back to the curve. Every lane has its own step length, shortened where the iterations fail and
lengthened where they converge quickly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis, balance, contact, jacobian, residual
from drivetrain_jax.analysis.numerics.branch_sections import Course, sections
from drivetrain_jax.analysis.numerics.linear_algebra import solve
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Most steps, failed ones included; first, shortest and longest step in scaled units; Newton iterations per step.
_ATTEMPTS, _FIRST, _SHORTEST, _LONGEST, _CORRECTIONS = 1500, 0.02, 1e-6, 0.08, 5
# Largest last correction; least cosine of the turn of the tangent for a step to be kept, and for a longer next step.
_CLOSED, _LEAST_COSINE, _STRAIGHT = 1e-9, 0.97, 0.996
_POLISH = 8


class Branch(NamedTuple):
    """Points of a branch: coefficients ``(S, n, ...)`` and frequencies ``(S, ...)``, NaN after the last point.

    ``complete`` is true if the branch has reached the far end of the frequencies.
    """

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
    """Point and tangent after a trial step, and two flags: the iterations converged, and they converged quickly."""
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
    """The branch through the balanced motion ``x`` (n, N) at the frequency ``start``, continued towards ``stop``.

    The branch ends where it leaves the range of frequencies on either side, or after a fixed number of steps.
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
    """Up to ``count`` balanced motions at ``omega`` in the order of the branch, ``(count, n, ...)``, and three flags.

    The flags mark existing motions, saddles of the balance, and lanes whose motions are all found.
    """
    guess, exists, every = sections(branch, omega, count)

    def improved(x: Array) -> tuple[Array, Array, Array]:
        found = balance(model, basis, x, omega + jnp.zeros(x.shape[1:]), _POLISH)
        return found.x, found.converged, found.saddle

    found, converged, saddle = jax.lax.map(improved, guess[:, :-1])
    return found, exists & converged, saddle, every & jnp.all(converged | ~exists, axis=0)
