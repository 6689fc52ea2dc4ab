"""Branches of exact periodic orbits over the drive's frequency, by pseudo-arclength continuation.

A point of a branch is ``x = (u, v, omega)`` with ``F^m(u, v; omega) = (u, v)``, F being the map over one drive period.
Branches run through folds and along unstable orbits, and do not end where an orbit loses its stability. Folds
(``det(1 - M) = 0``) and period doublings (``det(1 + M) = 0``) are located between the points that they separate.
All functions act on lanes: fields of the oscillator and the components of x have one shape ``(N,)``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.piecewise_march import march, prepare, start
from drivetrain_jax.analysis.plane_map import Matrix
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Newton: most corrections; size of the last one, over the scale; relative difference for the derivative to omega.
_CORRECTIONS, _CONVERGED, _DIFFERENCE = 8, 1e-12, 1e-6
# A step is shortened if it fails and lengthened if it takes few corrections.
_SHORTER, _LONGER, _FEW = 0.4, 1.4, 4
_MOST_STEPS = 100_000
_ROOT_STEPS = 40


class Branch(NamedTuple):
    """Points along a branch: ``x`` of shape ``(points, 3, N)`` and transition matrices over m periods, entries of
    shape ``(points, N)``. Where the continuation has stopped, the rest is NaN."""

    x: Array
    matrix: Matrix


class _Solved(NamedTuple):
    x: Array
    matrix: Matrix
    derivative: Array
    corrections: Array
    change: Array


def _map(model: PiecewiseLinearOscillator, multiple: int, x: Array) -> tuple[Array, Matrix, Array]:
    """``F^m`` of the state, its transition matrix, and its derivative to omega by a forward difference."""
    omega = jnp.concatenate([x[2], x[2] * (1 + _DIFFERENCE)])
    twice = {name: jnp.tile(value, 2) for name, value in vars(model).items() if jnp.ndim(value)}
    lanes = prepare(replace(model, **(twice | {"omega": omega})))
    begun = start(lanes, jnp.tile(x[0], 2), jnp.tile(x[1], 2), jnp.asarray(multiple, jnp.int32))
    end = march(lanes, begun, _MOST_STEPS)
    half = x.shape[1]
    state = jnp.stack([end.u, end.v])
    derivative = (state[:, half:] - state[:, :half]) / (omega[half:] - omega[:half])
    missing = jnp.where(end.left[:half] > 0, jnp.nan, 0.0)
    return state[:, :half] + missing, tuple(entry[:half] for entry in end.matrix), derivative


def _solve_3(rows: tuple[tuple[Array, Array, Array], ...], right: tuple[Array, Array, Array]) -> Array:
    """Solution of three equations, by Cramer's rule."""
    a, b, c = rows

    def determinant(p: tuple, q: tuple, r: tuple) -> Array:
        return (
            p[0] * (q[1] * r[2] - q[2] * r[1]) - p[1] * (q[0] * r[2] - q[2] * r[0]) + p[2] * (q[0] * r[1] - q[1] * r[0])
        )

    def replaced(k: int) -> Array:
        return determinant(
            *(tuple(right[i] if j == k else row[j] for j in range(3)) for i, row in enumerate((a, b, c)))
        )

    whole = determinant(a, b, c)
    return jnp.stack([replaced(k) / whole for k in range(3)])


def _on_plane(model: PiecewiseLinearOscillator, multiple: int, guess: Array, normal: Array, scale: Array) -> _Solved:
    """The orbit on the plane through ``guess`` with this normal (in units of ``scale``), by Newton's method."""
    lanes = guess.shape[1]

    def going(state: tuple[Array, _Solved]) -> Array:
        count, solved = state
        return (count < _CORRECTIONS) & jnp.any(solved.change > _CONVERGED)

    def correct(state: tuple[Array, _Solved]) -> tuple[Array, _Solved]:
        count, old = state
        end, m, derivative = _map(model, multiple, old.x)
        rows = (
            (m[0] - 1, m[1], derivative[0]),
            (m[2], m[3] - 1, derivative[1]),
            tuple(normal[k] / scale[k] for k in range(3)),
        )
        along = jnp.sum(normal * (guess - old.x) / scale, axis=0)
        step = _solve_3(rows, (old.x[0] - end[0], old.x[1] - end[1], along))
        change = jnp.max(jnp.abs(step / scale), axis=0)
        open_ = old.change > _CONVERGED
        new = _Solved(old.x + step, m, derivative, old.corrections + 1, change)
        return count + 1, jax.tree.map(lambda a, b: jnp.where(open_, a, b), new, old)

    zero = jnp.zeros(lanes)
    first = _Solved(guess, (zero,) * 4, jnp.zeros((2, lanes)), jnp.zeros(lanes, jnp.int32), zero + jnp.inf)
    return jax.lax.while_loop(going, correct, (jnp.asarray(0), first))[1]


def _tangent(solved: _Solved, before: Array, scale: Array) -> Array:
    """Unit tangent of the branch in units of ``scale``, pointing the way of ``before``."""
    m, d = solved.matrix, solved.derivative
    # Orthogonal to both rows of (M - 1, dF/domega).
    first = jnp.stack([(m[0] - 1) * scale[0], m[1] * scale[1], d[0] * scale[2]])
    second = jnp.stack([m[2] * scale[0], (m[3] - 1) * scale[1], d[1] * scale[2]])
    cross = jnp.cross(first / jnp.max(jnp.abs(first), axis=0), second / jnp.max(jnp.abs(second), axis=0), axis=0)
    cross = cross / jnp.sqrt(jnp.sum(cross**2, axis=0))
    return cross * jnp.where(jnp.sum(cross * before, axis=0) < 0, -1.0, 1.0)


def follow(
    model: PiecewiseLinearOscillator,
    multiple: int,
    x: Array,
    *,
    direction: float,
    points: int,
    longest: float = 0.05,
    scale: Array | None = None,
) -> Branch:
    """The branch of orbits of ``multiple`` drive periods through ``x = (u, v, omega)``, shape ``(3, N)``.

    ``x`` is a guess for the first point, which has its frequency; ``direction`` (+1, -1) is the way omega goes at
    first. ``longest`` is the longest step, in units of ``scale``, shape ``(3, N)`` (default: size of the first state,
    that times omega, omega).
    """
    if scale is None:
        size = jnp.abs(x[0]) + jnp.abs(x[1]) / x[2] + model.b
        scale = jnp.stack([size, size * x[2], x[2]])
    rise = jnp.zeros_like(x).at[2].set(direction)
    first = _on_plane(model, multiple, x, rise, scale)

    def step(carry: tuple[_Solved, Array, Array], _: None) -> tuple[tuple, tuple[Array, Matrix]]:
        here, tangent, length = carry
        there = _on_plane(model, multiple, here.x + length * tangent * scale, tangent, scale)
        turned = _tangent(there, tangent, scale)
        good = (there.change <= 1e-9) & (jnp.sum(turned * tangent, axis=0) > 0.8) & (there.x[2] > 0)
        few = there.corrections <= _FEW
        longer = jnp.minimum(jnp.where(few, _LONGER, 1.0) * length, longest)
        length = jnp.where(good, longer, _SHORTER * length)
        here = jax.tree.map(lambda new, old: jnp.where(good, new, old), there, here)
        tangent = jnp.where(good, turned, tangent)
        shown = jax.tree.map(lambda v: jnp.where(good, v, jnp.nan), (here.x, here.matrix))
        return (here, tangent, length), shown

    begin = (first, _tangent(first, rise, scale), jnp.full(x.shape[1:], longest))
    _, (rest, matrices) = jax.lax.scan(step, begin, None, length=points - 1)
    return Branch(
        jnp.concatenate([first.x[None], rest]),
        tuple(jnp.concatenate([a[None], b]) for a, b in zip(first.matrix, matrices, strict=True)),
    )


def fold_test(matrix: Matrix) -> Array:
    """``det(1 - M)``: zero where a multiplier is 1."""
    return (1 - matrix[0]) * (1 - matrix[3]) - matrix[1] * matrix[2]


def doubling_test(matrix: Matrix) -> Array:
    """``det(1 + M)``: zero where a multiplier is -1."""
    return (1 + matrix[0]) * (1 + matrix[3]) - matrix[1] * matrix[2]


def locate(
    model: PiecewiseLinearOscillator, multiple: int, ends: tuple[Array, Array], test: str
) -> tuple[Array, Matrix]:
    """The fold (``test = "fold"``) or period doubling (``"doubling"``) between two points of a branch.

    ``ends``: x before and after, shape ``(3, N)`` each, between which the test changes sign. By the Illinois variant
    of the secant method on planes across the chord.
    """
    function = {"fold": fold_test, "doubling": doubling_test}[test]
    chord = ends[1] - ends[0]
    scale = jnp.abs(ends[0]) + jnp.abs(ends[1])
    normal = chord / scale

    def at(part: Array) -> tuple[Array, Array, Matrix]:
        solved = _on_plane(model, multiple, ends[0] + part * chord, normal, scale)
        return function(solved.matrix), solved.x, solved.matrix

    def narrow(_: Array, state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        a, fa, b, fb = state
        part = jnp.where(fb == fa, (a + b) / 2, b - fb * (b - a) / jnp.where(fb == fa, 1.0, fb - fa))
        f, _, _ = at(part)
        opposite = f * fb < 0
        return jnp.where(opposite, b, a), jnp.where(opposite, fb, fa / 2), part, f

    zero, one = jnp.zeros(chord.shape[1]), jnp.ones(chord.shape[1])
    *_, part, _ = jax.lax.fori_loop(0, _ROOT_STEPS, narrow, (zero, at(zero)[0], one, at(one)[0]))
    _, x, matrix = at(part)
    return x, matrix
