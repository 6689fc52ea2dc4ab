"""Branches of periodic orbits over a parameter, by pseudo-arclength continuation.

A point of a branch is ``x = (y, p)`` with ``F(y; p) = y``, F being the map over one period (or any map whose fixed points
are the orbits). Branches run through folds and along unstable orbits, and do not end where an orbit loses its stability.
Folds (``det(1 - M) = 0``) and period doublings (``det(1 + M) = 0``) are located between neighbouring points of a branch. All
functions act on lanes: components of x have the shape ``(N,)``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import determinant, solve

# Newton: most corrections, and size of the last one.
_CORRECTIONS, _EXACT = 8, 1e-12
# Factors on the step length after a failure and after few corrections, and the number of corrections that counts as few.
_SHORTER, _LONGER, _FEW = 0.4, 1.4, 4
_SHORTEST, _CLOSED, _LEAST_COSINE = 1e-7, 1e-9, 0.8
# Largest distance of a point from its guess relative to the step; on an arc that turns by acos(0.8) it is tan(acos(0.8)/2).
_ASIDE = 1 / 3
# Limits so that no pair of folds or doublings hides between two points: largest deviation of a test value (``det(1 -+ M)``)
# from the line through the last two points, relative to the value; least such value; fraction of the longest step up to
# which steps are always accepted.
_BENT, _LEAST_DISTANCE, _FINE = 0.25, 1e-5, 1e-3
# Most steps of all motions of a branch.
_BUDGET = 5e6
# Locating a fold or doubling: most steps, and size of the last step relative to the chord.
_ROOT_STEPS, _LOCATED = 40, 1e-13
# Least unit of a component of the state there, relative to the largest: one that vanishes by symmetry has no digits.
_LEAST_UNIT = 1e-3
# Relative difference below which folds or doublings are the same.
_SAME = 1e-8


class Mapped(NamedTuple):
    """The map over a period at ``x``: the state at its ``end`` (n, N), the derivatives of the end by the state, ``matrix``
    (n, n, N), and by the parameter, ``slope`` (n, N), and the ``steps`` (N,) of the motions."""

    end: Array
    matrix: Array
    slope: Array
    steps: Array


PeriodMap = Callable[[Array], Mapped]


class Branch(NamedTuple):
    """Points along a branch: ``x`` of shape ``(points, n + 1, N)`` and transition matrices of shape ``(n, n, points, N)``,
    if folds and doublings are to be located. After the last point of a lane they are NaN."""

    x: Array
    matrix: Array | None = None


class _Solved(NamedTuple):
    """An iterate of Newton's method: ``x``, the transition matrix and the unit tangent of the branch at the iterate before,
    the number of ``corrections``, the size of the last one, and the steps of all motions."""

    x: Array
    matrix: Array
    tangent: Array
    corrections: Array
    change: Array
    steps: Array


def _guessed(x: Array) -> _Solved:
    """The guess ``x`` before any correction."""
    n, lanes = x.shape[0] - 1, x.shape[1]
    zero = jnp.zeros(lanes)
    return _Solved(x, jnp.zeros((n, n, lanes)), jnp.zeros_like(x), jnp.zeros(lanes, jnp.int32), zero + jnp.inf, zero)


def _corrected(period_map: PeriodMap, old: _Solved, guess: Array, normal: Array, scale: Array, open_: Array) -> _Solved:
    """``old`` after a Newton step towards the orbit on the plane through ``guess`` with the given ``normal`` (in units of
    ``scale``); lanes that are not ``open_`` do not move."""
    n = guess.shape[0] - 1
    image = period_map(jnp.where(open_, old.x, jnp.nan))
    ahead = jnp.sum(normal * (guess - old.x) / scale, axis=0)
    right = jnp.concatenate([(old.x[:-1] - image.end) / scale[:-1], ahead[None]])
    # Derivatives of F(y; p) - y in units of the scale, with the normal as last row.
    inner = image.matrix - jnp.eye(n)[:, :, None]
    rows = jnp.concatenate([inner, image.slope[:, None]], axis=1) * scale / scale[:-1, None]
    system = jnp.concatenate([rows, jnp.broadcast_to(normal, scale.shape)[None]])
    last = jnp.zeros_like(guess).at[-1].set(1.0)
    step, along = jnp.moveaxis(solve(system, jnp.stack([right, last], axis=1)), 1, 0)
    tangent = along / jnp.sqrt(jnp.sum(along**2, axis=0))
    change = jnp.max(jnp.abs(step), axis=0)
    new = _Solved(old.x + step * scale, image.matrix, tangent, old.corrections + 1, change, old.steps + image.steps)
    return jax.tree.map(lambda a, b: jnp.where(open_, a, b), new, old)


def _unsolved(solved: _Solved, converged: float) -> Array:
    """Flags of lanes that need another correction, and have one left."""
    return (solved.change > converged) & (solved.corrections < _CORRECTIONS)


class _Front(NamedTuple):
    """The last orbit; the ``guess`` of the next one and what Newton's method has made of it, ``trial``; the length of the
    step between them, the ``number`` of orbits on the branch, that of ``attempts``, the last change of both test values,
    ``(2, N)``, and the steps of all motions."""

    solved: _Solved
    guess: Array
    trial: _Solved
    length: Array
    number: Array
    attempts: Array
    change: Array
    spent: Array


def follow(
    period_map: PeriodMap,
    x: Array,
    scale: Array,
    *,
    direction: Array,
    attempts: int,
    longest: float = 0.05,
    limits: tuple[Array | float, Array | float] = (0.0, np.inf),
    converged: float = _EXACT,
    special: bool = True,
) -> Branch:
    """The branch of orbits through ``x = (y, p)``, shape ``(n + 1, N)``.

    ``x`` is a guess for the first point, whose parameter is kept. ``direction`` (+1, -1), a number or of shape ``(N,)``, is
    the initial direction of p. The branch ends beyond the ``limits`` of p, after ``attempts`` steps, failed ones included,
    or when its motions have taken 5e6 steps. ``longest`` is the longest step, in units of ``scale`` (n + 1, N).
    ``converged`` is the size of the last Newton correction. If ``special``, no pair of folds or doublings hides between two
    points.
    """
    closed = max(converged, _CLOSED)
    lanes = jnp.arange(x.shape[1])

    def row(solved: _Solved) -> Array:
        """The stored values of a point of the branch; the matrix of many states would take much memory."""
        return jnp.concatenate([solved.x, solved.matrix.reshape(-1, lanes.size)]) if special else solved.x

    def going(front: _Front) -> Array:
        """Flags of branches that have not ended; the others do not move."""
        inside = (front.solved.x[-1] >= limits[0]) & (front.solved.x[-1] <= limits[1])
        left = (front.attempts < attempts) & (front.spent <= _BUDGET)
        return (inside | (front.number == 0)) & left & (front.length > _SHORTEST)

    def correct(state: tuple[_Front, Array]) -> tuple[_Front, Array]:
        # Every lane is at a correction of its own: none waits for the slowest to converge.
        front, store = state
        open_ = going(front)
        trial = _corrected(period_map, front.trial, front.guess, front.solved.tangent, scale, open_)
        ended = open_ & ~_unsolved(trial, converged)
        front = _advanced(front._replace(trial=trial), ended, scale, longest, closed, special)
        return front, store.at[front.number, :, lanes].set(row(front.solved).T)

    rise = jnp.zeros_like(x).at[-1].set(direction)
    none, unit = jnp.zeros(lanes.size, jnp.int32), jnp.ones(lanes.size)
    start = _guessed(x)._replace(tangent=rise)
    begin = _Front(start, x, start, longest * unit, none, none, jnp.zeros((2, lanes.size)), 0 * unit)
    # The first row is that of lanes without an orbit yet.
    store = jnp.full((1 + attempts, *row(start).shape), jnp.nan)
    store = jax.lax.while_loop(lambda state: jnp.any(going(state[0])), correct, (begin, store))[1][1:]
    n = x.shape[0] - 1
    matrix = jnp.moveaxis(store[:, n + 1 :], 1, 0)
    return Branch(store[:, : n + 1], matrix.reshape(n, n, *matrix.shape[1:]) if special else None)


def _tests(matrix: Array) -> Array:
    """``det(1 - M)`` and ``det(1 + M)`` of matrices ``(n, n, ...)``: zero at a fold, and where a period doubles."""
    eye = jnp.eye(matrix.shape[0]).reshape(*matrix.shape[:2], *(1,) * (matrix.ndim - 2))
    return jnp.stack([determinant(eye - matrix), determinant(eye + matrix)])


def _straight(front: _Front) -> Array:
    """True if both tests change so steadily that no pair of folds or doublings hides between orbit and trial."""
    old, new = _tests(front.solved.matrix), _tests(front.trial.matrix)
    bent = jnp.abs(new - old - front.change * front.length)
    least = jnp.maximum(jnp.minimum(jnp.abs(old), jnp.abs(new)), _LEAST_DISTANCE)
    return jnp.all(bent <= _BENT * least, axis=0)


def _advanced(front: _Front, ended: Array, scale: Array, longest: float, closed: float, special: bool) -> _Front:
    """The front at its trial where Newton's method has ``ended`` well, or else at the old orbit with a shorter step, and the
    guess of the next orbit. A branch without a first orbit has ended.

    A point that is not near the tangent may lie on another part of the branch, or on another branch.
    """
    there, first, change = front.trial, front.number == 0, front.change
    aside = jnp.sqrt(jnp.sum(((there.x - front.guess) / scale) ** 2, axis=0))
    near = (aside <= _ASIDE * front.length) & (there.x[-1] > 0)
    near &= jnp.sum(there.tangent * front.solved.tangent, axis=0) > _LEAST_COSINE
    if special:
        near &= (front.length <= _FINE * longest) | _straight(front)
        change = jnp.where(first, 0.0, (_tests(there.matrix) - _tests(front.solved.matrix)) / front.length)
    moved = ended & (there.change <= closed) & (near | first)
    # The parameter of the first orbit is known.
    there = there._replace(x=there.x.at[-1].set(jnp.where(first, front.guess[-1], there.x[-1])))
    longer = jnp.minimum(jnp.where(there.corrections <= _FEW, _LONGER, 1.0) * front.length, longest)
    shorter = jnp.where(first, 0.0, _SHORTER * front.length)
    solved = jax.tree.map(lambda new, old: jnp.where(moved, new, old), there, front.solved)
    length = jnp.where(ended, jnp.where(moved, longer, shorter), front.length)
    guess = jnp.where(ended, solved.x + length * solved.tangent * scale, front.guess)
    return _Front(
        solved,
        guess,
        jax.tree.map(lambda new, old: jnp.where(ended, new, old), _guessed(guess), front.trial),
        length,
        front.number + moved,
        front.attempts + ended,
        jnp.where(moved, change, front.change),
        front.spent + jnp.where(ended, front.trial.steps, 0.0),
    )


def locate(period_map: PeriodMap, ends: tuple[Array, Array], tests: tuple[Array, Array], doubling: Array) -> Array:
    """``x`` at a fold or (where ``doubling``) a period doubling between two points of a branch, in every lane.

    ``ends`` are x before and after the sign change of the test, shape ``(n + 1, N)`` each; ``tests`` are the values of the
    test there. The method is the Illinois variant of the secant method on planes across the chord. NaN where the ends are
    NaN, and where no orbit was found between them.
    """
    chord = ends[1] - ends[0]
    scale = jnp.abs(ends[0]) + jnp.abs(ends[1])
    scale = scale.at[:-1].set(jnp.maximum(scale[:-1], _LEAST_UNIT * jnp.max(scale[:-1], axis=0)))
    normal = chord / scale
    span = jnp.sum(normal**2, axis=0)

    def narrow(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, a, fa, b, fb, _, _ = state
        part = jnp.where(fb == fa, (a + b) / 2, b - fb * (b - a) / jnp.where(fb == fa, 1.0, fb - fa))
        guess = ends[0] + part * chord
        solved = jax.lax.while_loop(
            lambda solved: jnp.any(_unsolved(solved, _EXACT)),
            lambda solved: _corrected(period_map, solved, guess, normal, scale, _unsolved(solved, _EXACT)),
            _guessed(guess),
        )
        f = jnp.where(doubling, *_tests(solved.matrix)[::-1])
        opposite = f * fb < 0
        settled = jnp.abs(part - b) <= _LOCATED
        bracket = (jnp.where(opposite, b, a), jnp.where(opposite, fb, fa / 2), part, f)
        between = (solved.change <= _CLOSED) & (jnp.sum(((solved.x - guess) / scale) ** 2, axis=0) <= span)
        return count + 1, *bracket, jnp.where(between, solved.x, jnp.nan), settled

    def unfinished(state: tuple[Array, ...]) -> Array:
        return (state[0] < _ROOT_STEPS) & jnp.any(~state[-1] & jnp.isfinite(state[2] + state[4]))

    zero, lanes = jnp.zeros(chord.shape[1]), jnp.zeros(chord.shape[1], bool)
    state = (jnp.asarray(0), zero, tests[0], zero + 1, tests[1], ends[0] + jnp.nan, lanes)
    return jax.lax.while_loop(unfinished, narrow, state)[5]


def folds_and_doublings(
    map_of: Callable[[Array], PeriodMap],
    branch: Branch,
    limits: tuple[float, float],
    per_part: int,
    most: int,
    parts: int,
) -> tuple[Array, Array]:
    """Parameters of folds and period doublings within the limits, ``(2, most, N)``: of each the largest ones, rising, NaN
    after the last one.

    ``branch`` has ``parts N`` lanes, the parts of every line N apart, and up to ``per_part`` of both kinds on a part. What
    several parts have in common counts once.
    ``map_of(index)`` is the period map of the lanes ``index``. The second result, ``(N,)``, is true if all were located, and
    there are no others.
    """
    tests = _tests(branch.matrix)  # pyright: ignore[reportArgumentType]
    changes = (tests[:, 1:] * tests[:, :-1] < 0).transpose(1, 0, 2)
    lanes = changes.shape[2]

    # One more than are located, to detect further ones.
    above = jnp.maximum(branch.x[1:, -1], branch.x[:-1, -1])[:, None]
    above = jnp.where(changes, above, -jnp.inf)
    place = jnp.argsort(-above, axis=0)[: per_part + 1]
    exists = jnp.take_along_axis(changes, place, axis=0)
    column = jnp.broadcast_to(jnp.arange(lanes), place.shape)
    kind = jnp.broadcast_to(jnp.arange(2)[:, None], place.shape)

    def ends_of(shift: int) -> tuple[Array, Array]:
        x = jnp.where(exists[:, :, None], jnp.moveaxis(branch.x[place + shift, :, column], -1, 2), jnp.nan)
        value = jnp.where(exists, tests[kind, place + shift, column], jnp.nan)
        return jnp.moveaxis(x, 2, 0).reshape(branch.x.shape[1], -1), value.reshape(-1)

    (before, first), (after, second) = ends_of(0), ends_of(1)
    x = locate(map_of(column.reshape(-1)), (before, after), (first, second), kind.reshape(-1) == 1)
    p = x[-1].reshape(place.shape)
    lost = jnp.any(exists & jnp.isnan(p), axis=(0, 1)).reshape(parts, -1).any(axis=0)
    p = jnp.where((p >= limits[0]) & (p <= limits[1]), p, -jnp.inf)
    more = jnp.any(jnp.isfinite(p[per_part]), axis=0).reshape(parts, -1).any(axis=0)
    # Join the parts of a line, select the largest parameters, then sort them.
    p = jnp.moveaxis(p.reshape(-1, 2, parts, lanes // parts), 2, 0).reshape(-1, 2, lanes // parts)
    falling = -jnp.sort(-p, axis=0)
    again = jnp.diff(falling, axis=0) >= -_SAME * falling[1:]
    falling = -jnp.sort(-falling.at[1:].set(jnp.where(again, -jnp.inf, falling[1:])), axis=0)
    more |= jnp.any(jnp.isfinite(falling[most:]), axis=(0, 1))
    rising = jnp.sort(jnp.where(jnp.isinf(falling[:most]), jnp.nan, falling[:most]), axis=0)
    return jnp.moveaxis(rising, 1, 0), ~lost & ~more


# Motions of a branch at a given frequency, from points along the branch.
#
# Between two points the branch is a Hermite cubic with the slopes of parabolas through three points. The cubic is cut in two
# where it turns back in frequency, so that the motions on both sides of a fold are found.


def bisect(function: Callable[[Array], Array], low: Array, high: Array, halvings: int = 60) -> Array:
    """The point between ``low`` and ``high`` at which ``function`` becomes positive."""

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        above = function(middle) > 0
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    low, high = jax.lax.fori_loop(0, halvings, halve, (low, high))
    return (low + high) / 2


def sign_changes(positive: Array, count: int) -> Array:
    """Mask ``(count, K - 1, ...)`` of the interval with the n-th change of sign along the first axis."""
    return first_marks(positive[1:] != positive[:-1], count)


def first_marks(marks: Array, count: int) -> Array:
    """The first ``count`` of the ``marks`` (K, ...) along the first axis, one per row: ``(count, K, ...)``."""
    rank = jnp.cumsum(marks, axis=0)
    number = jnp.arange(1, count + 1).reshape(count, *(1,) * marks.ndim)
    return marks & (rank == number)


_SECTION_HALVINGS = 50
# Relative difference of extremes below which two motions are the same.
_EQUAL = 1e-9


class Course(NamedTuple):
    """Points of a branch, and the slopes at both ends of each interval.

    ``cut`` is the fraction of each interval at which it is cut. ``nodes`` are the frequencies at the points and, between
    them, at the cuts.
    """

    points: Array
    slopes: tuple[Array, Array]
    cut: Array
    nodes: Array


def _cubic(ends: tuple[Array, Array], slopes: tuple[Array, Array], part: Array) -> Array:
    rest = 1 - part
    values = rest**2 * (1 + 2 * part) * ends[0] + part**2 * (3 - 2 * part) * ends[1]
    return values + part * rest * (rest * slopes[0] - part * slopes[1])


def course(points: Array, scale: Array) -> Course:
    """The branch through ``points``, shape ``(S, n, N)``, the frequency last among the n, NaN after the last point.

    ``scale``, shape ``(n, N)``, makes the components comparable.
    """
    rise = jnp.diff(points, axis=0)
    length = jnp.sqrt(jnp.sum((rise / scale) ** 2, axis=1, keepdims=True))
    rate = rise / jnp.where(length > 0, length, 1.0)
    inner = (length[1:] * rate[:-1] + length[:-1] * rate[1:]) / (length[1:] + length[:-1])
    # At both ends of the branch, use the slope of the chord.
    inner = jnp.where(jnp.isfinite(inner), inner, rate[:-1])
    slope = jnp.concatenate([rate[:1], inner, rate[-1:]])
    slopes = (slope[:-1] * length, slope[1:] * length)
    omega = points[:, -1]
    first, last, total = slopes[0][:, -1], slopes[1][:, -1], rise[:, -1]
    # Zero of the derivative of the cubic: first + 2 (3 total - 2 first - last) s + 3 (first + last - 2 total) s^2.
    middle, square = 3 * total - 2 * first - last, 3 * (first + last - 2 * total)
    root = jnp.sqrt(jnp.maximum(middle**2 - first * square, 0.0))
    part = -first / (middle + jnp.where(middle < 0, -root, root))
    other = -(middle + jnp.where(middle < 0, -root, root)) / jnp.where(square == 0, 1.0, square)
    part = jnp.where((part > 0) & (part < 1), part, other)
    turns = (first * last < 0) & (part > 0) & (part < 1)
    cut = jnp.where(turns, part, 0.5)
    between = _cubic((omega[:-1], omega[1:]), (first, last), cut)
    nodes = jnp.stack([omega[:-1], between], axis=1).reshape(-1, omega.shape[1])
    return Course(points, slopes, cut, jnp.concatenate([nodes, omega[-1:]]))


def sections(branch: Course, omega: Array, count: int) -> tuple[Array, Array, Array]:
    """Up to ``count`` positions of the branch at ``omega`` in its order, ``(count, n, N)``, and two flags.

    The flags mark existing positions, and lanes in which these are all positions.
    """
    above = branch.nodes > omega
    changes = sign_changes(above, count) & jnp.isfinite(branch.nodes[1:])
    every = jnp.sum((above[1:] != above[:-1]) & jnp.isfinite(branch.nodes[1:]), axis=0) <= count
    exists = jnp.any(changes, axis=1)
    place = jnp.argmax(changes, axis=1)
    number, second = place // 2, place % 2

    def taken(values: Array, shift: int = 0) -> Array:
        if values.ndim == 2:
            return jnp.take_along_axis(values, number + shift, axis=0)
        return jnp.take_along_axis(values, (number + shift)[:, None], axis=0)

    ends = (taken(branch.points), taken(branch.points, 1))
    slopes = tuple(taken(slope) for slope in branch.slopes)
    cut = taken(branch.cut)
    low, high = jnp.where(second, cut, 0.0), jnp.where(second, 1.0, cut)
    start = jnp.take_along_axis(branch.nodes, place, axis=0) > omega

    def passed(part: Array) -> Array:
        here = _cubic((ends[0][:, -1], ends[1][:, -1]), (slopes[0][:, -1], slopes[1][:, -1]), part) > omega
        return (here != start).astype(int)

    part = bisect(passed, low, high, _SECTION_HALVINGS)
    places = _cubic(ends, slopes, part[:, None])  # pyright: ignore[reportArgumentType]
    return jnp.where(exists[:, None], places, 0.0), exists, every


def distinct(high: Array, low: Array) -> Array:
    """True if all motions with these extremes, ``(count, ...)`` by rising ``high`` and NaN after the last, are different.

    If two positions of a branch lead to the same motion, another motion is missing.
    """
    size = jnp.maximum(jnp.abs(high), jnp.abs(low))[1:]
    same = (jnp.abs(jnp.diff(high, axis=0)) <= _EQUAL * size) & (jnp.abs(jnp.diff(low, axis=0)) <= _EQUAL * size)
    return ~jnp.any(same, axis=0)
