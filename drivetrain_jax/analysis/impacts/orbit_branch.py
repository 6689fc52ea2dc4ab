"""Branches of exact periodic orbits over the drive's frequency, by pseudo-arclength continuation.

A point of a branch is ``x = (u, v, omega)`` with ``F^m(u, v; omega) = (u, v)``, F being the map over one drive period.
Branches run through folds and along unstable orbits, and do not end where an orbit loses its stability. Folds
(``det(1 - M) = 0``) and period doublings (``det(1 + M) = 0``) are located between neighbouring points of a branch.
All functions act on lanes: fields of the oscillator and components of x have the same shape ``(N,)``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.analysis.impacts.plane_map import Matrix
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Newton: most corrections; last correction over the scale; relative difference for the derivative by omega.
_CORRECTIONS, _CONVERGED, _DIFFERENCE = 8, 1e-12, 1e-6
# Factors on the step length after a failure and after few corrections, and the number of corrections that counts as few.
_SHORTER, _LONGER, _FEW = 0.4, 1.4, 4
_SHORTEST, _CLOSED, _LEAST_COSINE = 1e-7, 1e-9, 0.8
# Largest distance of a point from its guess relative to the step; on an arc that turns by acos(0.8) it is tan(acos(0.8)/2).
_ASIDE = 1 / 3
# Limits so that no pair of folds or doublings hides between two points: largest deviation of the trace from the line through
# the last two points, relative to the smallest test value (``det(1 -+ M)``); least such value; fraction of the longest step
# up to which steps are always accepted.
_BENT, _LEAST_DISTANCE, _FINE = 0.25, 0.02, 0.01
# Most steps of the motion over a period, and of all motions of a branch.
_MOST_STEPS, _BUDGET = 100_000, 5e6
# Locating a fold or doubling: most steps, and size of the last step relative to the chord.
_ROOT_STEPS, _LOCATED = 40, 1e-13


class Branch(NamedTuple):
    """Points along a branch: ``x`` of shape ``(points, 3, N)`` and transition matrices over m periods, entries of
    shape ``(points, N)``. After the last point of a lane they are NaN."""

    x: Array
    matrix: Matrix


class _Solved(NamedTuple):
    x: Array
    matrix: Matrix
    derivative: Array
    corrections: Array
    change: Array
    steps: Array


def _map(model: PiecewiseLinearOscillator, multiple: int, x: Array) -> tuple[Array, Matrix, Array, Array]:
    """``F^m`` of the state, its transition matrix, its derivative by omega from a forward difference, and the steps."""
    omega = jnp.concatenate([x[2], x[2] * (1 + _DIFFERENCE)])
    twice = {name: jnp.tile(value, 2) for name, value in vars(model).items() if name != "omega" and jnp.ndim(value)}
    lanes = prepare(replace(model, **twice).at(omega))
    begun = start(lanes, jnp.tile(x[0], 2), jnp.tile(x[1], 2), jnp.asarray(multiple, jnp.int32))
    end = march(lanes, begun, _MOST_STEPS)
    half = x.shape[1]
    state = jnp.stack([end.u, end.v])
    derivative = (state[:, half:] - state[:, :half]) / (omega[half:] - omega[:half])
    missing = jnp.where(end.left[:half] > 0, jnp.nan, 0.0)
    return state[:, :half] + missing, tuple(entry[:half] for entry in end.matrix), derivative, end.steps[:half]


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
    """The orbit on the plane through ``guess`` with the given ``normal`` (in units of ``scale``), by Newton's method."""
    lanes = guess.shape[1]

    def going(state: tuple[Array, _Solved]) -> Array:
        count, solved = state
        return (count < _CORRECTIONS) & jnp.any(solved.change > _CONVERGED)

    def correct(state: tuple[Array, _Solved]) -> tuple[Array, _Solved]:
        count, old = state
        end, m, derivative, steps = _map(model, multiple, old.x)
        rows = (
            (m[0] - 1, m[1], derivative[0]),
            (m[2], m[3] - 1, derivative[1]),
            tuple(normal[k] / scale[k] for k in range(3)),
        )
        along = jnp.sum(normal * (guess - old.x) / scale, axis=0)
        step = _solve_3(rows, (old.x[0] - end[0], old.x[1] - end[1], along))  # pyright: ignore[reportArgumentType]
        change = jnp.max(jnp.abs(step / scale), axis=0)
        open_ = old.change > _CONVERGED
        new = _Solved(old.x + step, m, derivative, old.corrections + 1, change, old.steps + steps)
        return count + 1, jax.tree.map(lambda a, b: jnp.where(open_, a, b), new, old)

    zero = jnp.zeros(lanes)
    first = _Solved(guess, (zero,) * 4, jnp.zeros((2, lanes)), jnp.zeros(lanes, jnp.int32), zero + jnp.inf, zero)
    return jax.lax.while_loop(going, correct, (jnp.asarray(0), first))[1]


def _tangent(solved: _Solved, before: Array, scale: Array) -> Array:
    """Unit tangent of the branch in units of ``scale``, in the direction of the tangent ``before``."""
    m, d = solved.matrix, solved.derivative
    # Orthogonal to both rows of (M - 1, dF/domega).
    first = jnp.stack([(m[0] - 1) * scale[0], m[1] * scale[1], d[0] * scale[2]])
    second = jnp.stack([m[2] * scale[0], (m[3] - 1) * scale[1], d[1] * scale[2]])
    cross = jnp.cross(first / jnp.max(jnp.abs(first), axis=0), second / jnp.max(jnp.abs(second), axis=0), axis=0)
    cross = cross / jnp.sqrt(jnp.sum(cross**2, axis=0))
    return cross * jnp.where(jnp.sum(cross * before, axis=0) < 0, -1.0, 1.0)


def scale_of(model: PiecewiseLinearOscillator, x: Array, highest: float = np.inf) -> Array:
    """Units for ``(u, v, omega)`` on the branch through ``x``, ``(3, N)``: size of its state, size times omega, and omega.

    For a branch up to the frequency ``highest`` the geometric mean of both frequencies replaces omega: otherwise there would
    be too many steps.
    """
    usual = jnp.sqrt(x[2] * highest) if np.isfinite(highest) else x[2]
    size = jnp.abs(x[0]) + jnp.abs(x[1]) / x[2] + model.b
    return jnp.stack([size, size * usual, usual])


class _Front(NamedTuple):
    """The last orbit, the tangent there, the length of the next step, the number of the orbit on the branch, the last
    change of the trace of the transition matrix, and the steps of all motions."""

    solved: _Solved
    tangent: Array
    length: Array
    number: Array
    slope: Array
    spent: Array


def follow(
    model: PiecewiseLinearOscillator,
    multiple: int,
    x: Array,
    *,
    direction: Array,
    attempts: int,
    longest: float = 0.05,
    limits: tuple[float, float] = (0.0, np.inf),
) -> Branch:
    """The branch of orbits of ``multiple`` drive periods through ``x = (u, v, omega)``, shape ``(3, N)``.

    ``x`` is a guess for the first point, whose frequency is kept. ``direction`` (+1, -1), a number or of shape ``(N,)``, is
    the initial direction of omega. The branch ends beyond the ``limits`` of omega, after ``attempts`` steps, failed ones
    included, or when its motions have taken 5e6 steps. ``longest`` is the longest step, in units of :func:`scale_of`.
    """
    scale = scale_of(model, x, limits[1])
    rise = jnp.zeros_like(x).at[2].set(direction)
    first = _on_plane(model, multiple, x, rise, scale)
    first = first._replace(x=jnp.where(first.change <= _CLOSED, first.x.at[2].set(x[2]), jnp.nan))
    lanes = jnp.arange(x.shape[1])
    store = jnp.full((attempts, 7, x.shape[1]), jnp.nan).at[0].set(_row(first))

    def step(state: tuple[Array, _Front, Array]) -> tuple[Array, _Front, Array]:
        count, front, store = state
        guess = jnp.where(_going(front, limits), front.solved.x + front.length * front.tangent * scale, jnp.nan)
        there = _on_plane(model, multiple, guess, front.tangent, scale)
        aside = jnp.sqrt(jnp.sum(((there.x - guess) / scale) ** 2, axis=0))
        near = (aside <= _ASIDE * front.length) & ((front.length <= _FINE * longest) | _straight(front, there))
        front = _moved(front, there, near, _tangent(there, front.tangent, scale), longest, limits)
        return count + 1, front, store.at[front.number, :, lanes].set(_row(front.solved).T)

    def unfinished(state: tuple[Array, _Front, Array]) -> Array:
        return (state[0] < attempts) & jnp.any(_going(state[1], limits))

    begin = _Front(
        first,
        _tangent(first, rise, scale),
        jnp.full(lanes.shape, longest),
        jnp.zeros_like(lanes),
        jnp.zeros(lanes.shape),
        first.steps,
    )
    *_, store = jax.lax.while_loop(unfinished, step, (jnp.asarray(1), begin, store))
    return Branch(store[:, :3], tuple(store[:, 3 + k] for k in range(4)))


def _row(solved: _Solved) -> Array:
    """The stored values of a point of a branch, ``(7, N)``."""
    return jnp.concatenate([solved.x, jnp.stack(solved.matrix)])


def _going(front: _Front, limits: tuple[float, float]) -> Array:
    """Flags of branches that have not ended; the others do not move."""
    omega = front.solved.x[2]
    inside = (omega >= limits[0]) & (omega <= limits[1])
    return inside & (front.length > _SHORTEST) & (front.spent <= _BUDGET)


def _straight(front: _Front, there: _Solved) -> Array:
    """True if the trace changes so steadily that no pair of folds or doublings hides between the last two points."""
    old, new = front.solved.matrix, there.matrix
    bent = jnp.abs(new[0] + new[3] - old[0] - old[3] - front.slope * front.length)
    tests = jnp.stack([test(matrix) for test in (fold_test, doubling_test) for matrix in (old, new)])
    return bent <= _BENT * jnp.maximum(jnp.min(jnp.abs(tests), axis=0), _LEAST_DISTANCE)


def _moved(
    front: _Front, there: _Solved, near: Array, tangent: Array, longest: float, limits: tuple[float, float]
) -> _Front:
    """The front at ``there``, or the old one with a shorter step if ``there`` is not acceptable.

    A point that is not ``near`` the tangent may lie on another part of the branch, or on another branch.
    """
    good = (
        near & (there.change <= _CLOSED) & (jnp.sum(tangent * front.tangent, axis=0) > _LEAST_COSINE) & (there.x[2] > 0)
    )
    longer = jnp.minimum(jnp.where(there.corrections <= _FEW, _LONGER, 1.0) * front.length, longest)
    moved = good & _going(front, limits)
    slope = (there.matrix[0] + there.matrix[3] - front.solved.matrix[0] - front.solved.matrix[3]) / front.length
    return _Front(
        jax.tree.map(lambda new, old: jnp.where(moved, new, old), there, front.solved),
        jnp.where(moved, tangent, front.tangent),
        jnp.where(good, longer, _SHORTER * front.length),
        front.number + moved,
        jnp.where(moved, slope, front.slope),
        front.spent + there.steps,
    )


def fold_test(matrix: Matrix) -> Array:
    """``det(1 - M)``: zero where a multiplier is 1."""
    return (1 - matrix[0]) * (1 - matrix[3]) - matrix[1] * matrix[2]


def doubling_test(matrix: Matrix) -> Array:
    """``det(1 + M)``: zero where a multiplier is -1."""
    return (1 + matrix[0]) * (1 + matrix[3]) - matrix[1] * matrix[2]


def locate(
    model: PiecewiseLinearOscillator,
    multiple: int,
    ends: tuple[Array, Array],
    tests: tuple[Array, Array],
    doubling: Array,
) -> Array:
    """``x`` at a fold or (where ``doubling``) a period doubling between two points of a branch, in every lane.

    ``ends`` are x before and after the sign change of the test, shape ``(3, N)`` each; ``tests`` are the values of the test
    there. The method is the Illinois variant of the secant method on planes across the chord. NaN where the ends are NaN,
    and where no orbit was found between them.
    """
    chord = ends[1] - ends[0]
    scale = jnp.abs(ends[0]) + jnp.abs(ends[1])
    normal = chord / scale
    span = jnp.sum(normal**2, axis=0)

    def narrow(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, a, fa, b, fb, _, _ = state
        part = jnp.where(fb == fa, (a + b) / 2, b - fb * (b - a) / jnp.where(fb == fa, 1.0, fb - fa))
        solved = _on_plane(model, multiple, ends[0] + part * chord, normal, scale)
        f = jnp.where(doubling, doubling_test(solved.matrix), fold_test(solved.matrix))
        opposite = f * fb < 0
        settled = jnp.abs(part - b) <= _LOCATED
        bracket = (jnp.where(opposite, b, a), jnp.where(opposite, fb, fa / 2), part, f)
        between = (solved.change <= _CLOSED) & (
            jnp.sum(((solved.x - ends[0] - part * chord) / scale) ** 2, axis=0) <= span
        )
        return count + 1, *bracket, jnp.where(between, solved.x, jnp.nan), settled

    def unfinished(state: tuple[Array, ...]) -> Array:
        return (state[0] < _ROOT_STEPS) & jnp.any(~state[-1] & jnp.isfinite(state[2] + state[4]))

    zero, lanes = jnp.zeros(chord.shape[1]), jnp.zeros(chord.shape[1], bool)
    state = (jnp.asarray(0), zero, tests[0], zero + 1, tests[1], ends[0] + jnp.nan, lanes)
    return jax.lax.while_loop(unfinished, narrow, state)[5]
