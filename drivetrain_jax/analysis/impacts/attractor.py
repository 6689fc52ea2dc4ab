"""From initial conditions to attractors of a piecewise linear oscillator, many points at a time.

A *job* is a sequence of points: a single point for a steady state, a line of drive frequencies for an up or down sweep.
Each point starts from the state at which the previous point ended. ``width`` lanes process the queue of jobs, each at its
own pace, so a lane that settles slowly, or never, does not delay the others.

A lane settles period by period and from time to time tries Newton shooting from its state: ``z <- z + (1 - M)^-1 (F^m(z) -
z)``, where M is the exact transition matrix over m periods and the motion nearly recurs after m periods. An orbit is
accepted as the attractor under two conditions: all its multipliers lie inside the unit circle, and the motion, continued
from the start of the search, approaches the orbit.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.motion import Matrix, apply, log_determinant, newton_correction, spectral_radius
from drivetrain_jax.analysis.impacts.piecewise_march import Lanes, Motion, allowed_steps, locate, prepare, stays, step
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Lanes on their way to attractors: they settle period by period, start searches, and confirm the results.
#
# A *lane* processes one point at a time, stores the states of the last 33 periods to guess the period multiple, and
# accumulates the growth of a tangent for the Lyapunov exponent.

# Decide if a motion approaches a periodic orbit that Newton's method found from one of its states.
#
# Newton's method may converge to an orbit whose basin does not contain the state. One recurrence that agrees with the
# linearisation about the orbit proves nothing, because the remainder is a vector that vanishes at some points.
# Therefore the motion is continued. With M the transition matrix about the orbit ``z*``, rho its spectral radius and m
# the period multiple, every recurrence must satisfy
#
#     |F^m(z) - z* - M (z - z*)| <= 0.02 (1 - rho) |z - z*|
#
# until the visited points enclose the rest of the way. With complex multipliers of argument theta the motion passes
# through all directions within ``max(2 pi/theta, pi/(pi - theta))`` recurrences. The gaps between these directions, at
# most 120 degrees, count as closed after the distance has shrunk by ``cos(gap/2)``. With real multipliers the faster
# component must have shrunk by a factor of 30 relative to the other. In any case a decrease of the distance by this
# factor is enough.
#
# Near a fold or a period doubling rho is nearly 1, and this test would need thousands of periods. The motion then moves
# slowly along one line, the direction of the slow multiplier. The map shows that no other orbit lies on this line: from
# each of eight points between the orbit and the motion, one recurrence (two if the multiplier is negative) must lead
# nearer to the orbit.

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


MOST_PERIODS = 32
# Ratios to the best recurrence up to which another one counts as equally good: generous and narrow.
_NEAR, _NARROW = 30.0, 1.5
# Recurrences for which an orbit is kept although the motion does not yet satisfy the linearisation about it.
_PATIENCE = 8
_ROWS = np.arange(MOST_PERIODS + 1, dtype=np.int32)[:, None]


class Lane(NamedTuple):
    """State of the lanes, each field ``(width, ...)``: job, place in the job, motion, and search in progress."""

    job: Array
    place: Array
    motion: Motion
    count: Array  # periods settled  # pyright: ignore[reportIncompatibleMethodOverride]
    due: Array  # periods after which the next search starts
    latest: tuple[Array, Array]  # state after the settled periods
    tangent: tuple[Array, Array]
    growth: Array  # logarithm of the growth of the tangent
    cost: Array  # largest number of steps of a settled period
    spent: Array  # steps in all, of searches too
    searching: Array
    multiple: Array
    corrections: Array
    second: Array  # candidate to try if this period multiple fails
    guess: tuple[Array, Array]
    first: tuple[Array, Array]  # F^m of the initial state of the search
    change: Array  # size of the last correction
    approaching: Array
    orbit: Orbit  # the orbit that the motion approaches
    begun: Array  # periods settled when the approach began
    held: Array  # successive recurrences that agree with the linearisation
    probing: Array  # number of the point on the slow line under test, -1: none


def select(condition: Array, new: Any, old: Any) -> Any:
    """``new`` where the condition holds, else ``old``, for trees of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def candidates(lane: Lane, history: Array, omega: Array) -> tuple[Array, Array]:
    """Two guesses at the period multiple, for a generous and for a narrow factor.

    A guess is the smallest m whose recurrence is within this factor of the best one. Row ``n % 33`` of ``history``, shape
    ``(33, 2 width)``, holds displacements and velocities after n periods.
    """
    u, v = lane.latest
    distance = jnp.abs(history[:, : u.size] - u) + jnp.abs(history[:, u.size :] - v) / omega
    age = (lane.count - _ROWS) % (MOST_PERIODS + 1)
    distance = jnp.where((age > 0) & (age <= lane.count), distance, jnp.inf)
    best = distance.min(axis=0)
    floor = 1e-13 * (jnp.abs(u) + jnp.abs(v) / omega)

    def smallest(factor: float) -> Array:
        recurs = distance <= factor * best + floor
        return jnp.where(recurs, age, MOST_PERIODS).min(axis=0).astype(jnp.int32)

    first, second = smallest(_NEAR), smallest(_NARROW)
    # Near an orbit whose period is about to double the motion alternates: twice the period recurs best, but Newton's method
    # converges slowly for twice the period and fast for the period itself.
    return first, jnp.where((second == first) & (first % 2 == 0), first // 2, second)


def record(history: Array, now: Array, lane: Lane) -> Array:
    """``history`` with the latest state in the lanes ``now``."""
    row = jnp.where(now, lane.count % (MOST_PERIODS + 1), -1)
    return jnp.where(jnp.concatenate([row, row]) == _ROWS, jnp.concatenate(lane.latest), history)


def restart(lane: Lane, going: Array, u: Array, v: Array, periods: Array | int) -> Lane:
    """Lanes ``going`` restart at the beginning of a period from ``(u, v)``."""
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    count = jnp.zeros(u.shape, jnp.int32)
    fresh = Motion(zero, one, zero, u, v, (one, zero, zero, one), jnp.broadcast_to(periods, u.shape) + count, count)
    return lane._replace(motion=select(going, fresh, lane.motion))


def settle(lane: Lane, now: Array, forget: int, omega: Array) -> Lane:
    """The lanes after one more settled period in the lanes ``now``; at period ``forget`` the growth restarts from 0."""
    motion = lane.motion
    count = lane.count + 1
    tangent = apply(motion.matrix, *lane.tangent)
    size = jnp.abs(tangent[0]) + jnp.abs(tangent[1]) / omega
    settled = lane._replace(
        count=count,
        latest=(motion.u, motion.v),
        tangent=(tangent[0] / size, tangent[1] / size),
        growth=jnp.where(count == forget, 0.0, lane.growth + jnp.log(size)),
        cost=jnp.maximum(lane.cost, motion.steps),
    )
    return restart(select(now, settled, lane), now, motion.u, motion.v, 1)


def search(lane: Lane, now: Array, multiple: Array, second: Array) -> Lane:
    """Start Newton shooting from the latest state in the lanes ``now``, for this period multiple."""
    begun = lane._replace(
        searching=jnp.ones_like(now),
        approaching=jnp.zeros_like(now),
        held=jnp.zeros_like(lane.held),
        multiple=multiple,
        second=second,
        corrections=jnp.zeros_like(lane.corrections),
        guess=lane.latest,
        change=jnp.full_like(lane.change, jnp.inf),
    )
    return restart(select(now, begun, lane), now, *lane.latest, multiple)


def resume(lane: Lane, failed: Array) -> Lane:
    """The lanes after failed searches: they try the second candidate if there is one, else continue settling."""
    lane = lane._replace(probing=jnp.where(failed, -1, lane.probing))
    again = failed & (lane.second != lane.multiple)
    back = failed & ~again
    due = jnp.where(back, lane.count + jnp.maximum(4, lane.count // 3), lane.due)
    lane = restart(lane._replace(searching=lane.searching & ~back, due=due), back, *lane.latest, 1)
    return search(lane, again, lane.second, lane.second)


def approach(lane: Lane, now: Array, orbit: Orbit) -> Lane:
    """The lanes after an orbit was found in the lanes ``now``: the motion continues from the latest state."""
    begun = lane._replace(
        searching=jnp.zeros_like(now),
        approaching=jnp.ones_like(now),
        orbit=orbit,
        begun=lane.count,
        due=lane.count + jnp.maximum(_PATIENCE * lane.multiple, lane.count // 3),
    )
    return restart(select(now, begun, lane), now, *lane.latest, 1)


def confirm(lane: Lane, now: Array, history: Array, flank: Any, omega: Array) -> tuple[Lane, Array]:
    """The lanes after a period in the lanes ``now``, and flags of lanes that have approached their orbit for long enough.

    If the motion does not satisfy the linearisation about the orbit, counting restarts; a new search may follow.
    """
    due = now & lane.approaching & (lane.count > lane.begun) & ((lane.count - lane.begun) % lane.multiple == 0)
    row = (lane.count - lane.multiple) % (MOST_PERIODS + 1)
    past = jnp.where(jnp.concatenate([row, row]) == _ROWS, history, 0.0).sum(axis=0)
    ok, arrived = linearisation_holds(lane.orbit, (past[: row.size], past[row.size :]), lane.latest, flank, omega)
    held = jnp.where(due, jnp.where(ok, lane.held + 1, 0), lane.held)
    return lane._replace(held=held), due & ok & (arrived | (held >= recurrences(lane.orbit)))


def try_line(lane: Lane, now: Array, orbit: Orbit, omega: Array) -> tuple[Lane, Array, Array]:
    """The lanes with the next point on the slow line, flags of success and flags of failure.

    Lanes ``now`` have found an orbit that they approach slowly, or have run from a point on the line. A lane succeeds if
    all its points approached the orbit, and fails at the first point that did not.
    """
    begins = now & (lane.probing < 0)
    twice, negative = doubled(orbit)
    negative &= lane.multiple <= MOST_PERIODS // 2
    multiple = jnp.where(begins & negative, 2 * lane.multiple, lane.multiple)
    lane = lane._replace(orbit=select(begins, select(negative, twice, orbit), lane.orbit), multiple=multiple)
    place, _ = probe(lane.orbit, lane.latest, lane.probing)
    good = is_attracted(lane.orbit, lane.latest, place, (lane.motion.u, lane.motion.v), omega)
    number = lane.probing + now.astype(jnp.int32)
    failed = now & ~begins & ~good
    through = now & ~begins & good & (number >= PROBES)
    _, start = probe(lane.orbit, lane.latest, number)
    # After a failure there is no other candidate.
    lane = lane._replace(probing=number, second=jnp.where(failed, lane.multiple, lane.second))
    lane = restart(lane, now & ~failed & ~through, *start, lane.multiple)
    return lane, through, failed


def enter(lane: Lane, now: Array, job: Array, place: Array, u: Array, v: Array, hint: Array) -> Lane:
    """Lanes ``now`` enter a new point from ``(u, v)`` and search at once for an orbit of ``hint`` periods."""
    zero = jnp.zeros_like(u)
    fresh = lane._replace(
        job=job,
        place=place,
        count=jnp.zeros_like(lane.count),
        due=jnp.full_like(lane.due, 4),
        probing=jnp.full_like(lane.probing, -1),
        latest=(u, v),
        tangent=(zero + 0.6, zero + 0.8),
        growth=zero,
        cost=jnp.zeros_like(lane.count),
        spent=zero,
    )
    return search(select(now, fresh, lane), now, hint, hint)


def blank(width: int) -> Lane:
    """Lanes without a point; :func:`enter` replaces all their values but the kinds."""
    real, whole, flag = jnp.zeros(width), jnp.zeros(width, jnp.int32), jnp.zeros(width, bool)
    pair, matrix = (real, real), (real, real, real, real)
    motion = Motion(real, real + 1, real, real, real, matrix, whole, whole)
    orbit = Orbit(real, real, matrix, real, real)
    return Lane(
        whole, whole, motion, whole, whole, pair, pair, real, whole, real, flag, whole, whole, whole,
        pair, pair, real, flag, orbit, whole, whole, whole,
    )  # fmt: skip


# Newton: most corrections, relative size of the last correction, and size below which corrections may stall by rounding.
_CORRECTIONS, _CONVERGED, _ROUNDING = 12, 1e-11, 1e-7
# Largest ratio of successive corrections: 2/3 at worst near an orbit whose period is about to double.
_SHRINKING = 0.75
# A search fails at this multiple of the usual velocity, or of the steps for settling.
_ASTRAY, _COSTLY = 3.0, 4
# Most steps of a point, searches included, and more for each of ``most_periods``. Of 64 points with drives down to 1e-3 of
# the natural frequency and damping down to 1e-4, 62 need at most 5e5, and the others do not repeat within 2e6.
_BUDGET, _PER_PERIOD = 4e5, 100
_EPS = np.finfo(float).eps
# Rounding of a period over that of the states at its steps, and steps between two looks at the lanes.
_GROWTH, _FEW = 64, 8


class Attractors(NamedTuple):
    """The attractor of each point, every field of shape ``(points,)``.

    ``u, v``: state at the start of a drive period; ``multiple``: number of periods m after which the state recurs (0 if not
    within 32); ``matrix``: transition matrix over m periods; ``error``: estimated absolute error of u; ``periods``: drive
    periods run; ``exponent``: Lyapunov exponent per unit of time, meaningful if ``multiple`` is 0; ``stalled``: 1 if the
    motion was stopped because of its number of steps (it is not measured), 2 because it is not finite, else 0.
    """

    u: Array
    v: Array
    multiple: Array
    matrix: Matrix
    error: Array
    periods: Array
    exponent: Array
    stalled: Array


_RESULT = Attractors(0, 0, 0, (0, 0, 0, 0), 0, 0, 0, 0)  # pyright: ignore[reportArgumentType]


def averaged(periods: Any) -> Any:
    """Number of last periods over which the growth of a tangent is averaged."""
    return periods - periods // 4


def take(oscillator: PiecewiseLinearOscillator, index: Array) -> PiecewiseLinearOscillator:
    """The oscillators at the positions ``index``; fields common to all stay scalars."""
    chosen = {f.name: getattr(oscillator, f.name) for f in fields(oscillator)}
    return replace(oscillator, **{name: x[index] if jnp.ndim(x) else x for name, x in chosen.items()})


def repeated(oscillator: PiecewiseLinearOscillator, times: int) -> PiecewiseLinearOscillator:
    """All oscillators ``times`` times; fields common to all stay scalars."""
    values = {name: jnp.tile(x, times) for name, x in vars(oscillator).items() if name != "omega" and jnp.ndim(x)}
    return replace(oscillator, **values)


class _Verdict(NamedTuple):
    """Outcome of a correction: lanes that found an attracting orbit, lanes that approach it slowly, the orbit, and
    failed lanes."""

    found: Array
    slow: Array
    orbit: Orbit
    failed: Array


def _speed(local: PiecewiseLinearOscillator, u: Array, v: Array) -> Array:
    """The velocity that corresponds to the energy of a state in contact, within a factor of two."""
    return jnp.abs(v) + jnp.sqrt(local.stiffness) * jnp.maximum(jnp.abs(u) - local.b, 0.0)


def _shoot(
    lane: Lane, now: Array, local: PiecewiseLinearOscillator, lanes: Lanes, omega: Array
) -> tuple[Lane, _Verdict]:
    """One Newton correction in the lanes ``now``, and its outcome."""
    motion, (u, v) = lane.motion, lane.guess
    first = select(lane.corrections == 0, (motion.u, motion.v), lane.first)
    du, dv = newton_correction(motion.matrix, motion.u - u, motion.v - v)
    guess = (u + du, v + dv)
    change = jnp.abs(du) + jnp.abs(dv) / omega
    rounding = _rounding(lanes, motion, guess, omega)
    size = reach(*guess, local.b, omega)
    stuck = (change <= _ROUNDING * size + 64 * _EPS * jnp.abs(guess[0])) & (change > lane.change / 2)
    converged = (change <= _CONVERGED * size) | stuck
    drive = jnp.abs(local.B0) + jnp.abs(local.B1)
    usual = local.omega * local.b + drive * (1 / local.omega + 1 / jnp.sqrt(local.stiffness))
    astray = ~(_speed(local, *guess) <= _ASTRAY * (_speed(local, *lane.latest) + usual))
    going = now & ~converged & (lane.corrections < _CORRECTIONS) & ~astray & (change <= _SHRINKING * lane.change)
    contraction = log_determinant(local, motion.matrix, lane.multiple * 2 * np.pi / omega)
    # At the limit of rounding, what is left may be as large as the last change and more.
    orbit = Orbit(*guess, motion.matrix, contraction, 2 * change + rounding)
    stable = now & converged & attracts(orbit)
    holds, _ = linearisation_holds(orbit, lane.latest, first, local.b, omega)
    slow = stable & is_slow(orbit, lane.latest, omega) & ~holds
    corrections = lane.corrections + now.astype(jnp.int32)
    corrected = lane._replace(guess=guess, first=first, change=change, corrections=corrections)
    lane = restart(select(going, corrected, lane), going, *guess, lane.multiple)
    return lane, _Verdict(stable & ~slow, slow, orbit, now & ~going & ~stable)


def _rounding(lanes: Lanes, motion: Motion, state: tuple[Array, Array], omega: Array) -> Array:
    """Effect on the u of an orbit of rounding the motion over its period.

    Rounding may grow within the period, which is not followed: with 32 in place of `_GROWTH`, the estimate was 7 % too small
    at one of 200,000 random orbits.
    """
    by_u, by_v = (newton_correction(motion.matrix, 1.0 - k + 0 * motion.u, k * omega)[0] for k in (0.0, 1.0))
    inverse = jnp.abs(by_u) + jnp.abs(by_v)
    size = jnp.abs(state[0]) + jnp.abs(state[1]) / omega
    rounding = _GROWTH * size * jnp.sqrt(motion.steps.astype(float)) + 2 * _taken_off(lanes, motion)
    return _EPS * rounding * (1 + inverse)


def _taken_off(lanes: Lanes, motion: Motion) -> Array:
    """Largest harmonic response that steps subtract from the displacement, which limits their accuracy."""
    here = locate(lanes, motion.u)
    here_removed, contact, gap = (
        jnp.hypot(piece.cosine, piece.sine) for piece in (here.region, lanes.contact, lanes.gap)
    )
    return jnp.where(stays(lanes, here, motion), here_removed, jnp.maximum(contact, gap))


class _Work(NamedTuple):
    """The lanes, their latest states, the number of the next job, and the results so far, one row per field."""

    lane: Lane
    history: Array
    queue: Array
    store: Array


class _Task(NamedTuple):
    """The input: the points ``visits`` of all jobs in turn, ``length`` per job, and the initial states ``origin``."""

    oscillator: PiecewiseLinearOscillator
    visits: Array
    length: int
    origin: tuple[Array, Array]
    most_periods: int


def attractors(
    oscillator: PiecewiseLinearOscillator, route: Array, u0: Array, v0: Array, *, most_periods: int, width: int
) -> Attractors:
    """Attractors reached at the points of every job.

    ``oscillator`` holds scalars or arrays over all points. ``route``, shape ``(jobs, length)``, lists the points of each
    job in order; ``u0, v0``, shape ``(jobs,)``, are the initial states of the jobs. Each later point starts from the final
    state of the previous one. Results have the shape ``(jobs, length)``.
    """
    jobs, length = route.shape
    width = min(width, jobs)
    total = jobs * length
    task = _Task(oscillator, route.reshape(total), length, (u0, v0), most_periods)
    # One array for all results: several parallel scatters make XLA's CPU compiler abort (jax 0.10.2).
    store = jnp.zeros((len(jax.tree.leaves(_RESULT)), total))
    numbers = jnp.arange(width, dtype=jnp.int32)
    lane = enter(blank(width), numbers >= 0, numbers, 0 * numbers, u0[:width], v0[:width], 0 * numbers + 1)
    history = record(jnp.zeros((MOST_PERIODS + 1, 2 * width)), lane.searching, lane)
    work = _Work(lane, history, jnp.asarray(width, jnp.int32), store)
    work = jax.lax.while_loop(lambda work: jnp.any(work.lane.job < jobs), lambda work: _tick(task, work), work)
    rows = jax.tree.unflatten(jax.tree.structure(_RESULT), list(work.store.reshape(-1, jobs, length)))
    return rows._replace(**{name: getattr(rows, name).astype(jnp.int32) for name in ("multiple", "periods", "stalled")})


def _tick(task: _Task, work: _Work) -> _Work:
    """Advance all lanes by a few steps; lanes at the end of a period or of a search continue with the next task."""
    lane, history = work.lane, work.history
    total = task.visits.size
    working = lane.job < total // task.length
    place = jnp.where(working, lane.job, 0) * task.length + lane.place
    local = take(task.oscillator, task.visits[place])
    lanes = prepare(local)
    omega = lanes.omega + jnp.zeros(place.shape)
    motion = jax.lax.fori_loop(0, _FEW, lambda _, motion: step(lanes, motion), lane.motion)
    lane = lane._replace(motion=motion, spent=lane.spent + _FEW)
    # A lane that moves from event to event without progress is stopped.
    searching = lane.searching & (lane.count > 0)
    most = lane.multiple * jnp.where(searching, _COSTLY * lane.cost + 500, allowed_steps(lanes))
    broken = ~jnp.isfinite(motion.u) | (motion.steps > most)
    broken |= lane.spent > _BUDGET + _PER_PERIOD * task.most_periods
    ready = working & ((lane.motion.left <= 0) | broken)
    shot, probed = (ready & lane.searching & ~broken & (on == (lane.probing >= 0)) for on in (False, True))
    after, verdict = _shoot(lane, shot, local, lanes, omega)
    settles = ready & ~lane.searching & ~broken
    after = settle(after, settles, task.most_periods - averaged(task.most_periods), omega)
    after, reached = confirm(after, settles, history, local.b, omega)
    history = record(history, settles, after)
    first, second = candidates(after, history, omega)
    after = search(after, settles & (after.held == 0) & (after.count >= after.due), first, second)
    after = approach(after, verdict.found, verdict.orbit)
    after, through, left = try_line(after, probed | verdict.slow, verdict.orbit, omega)
    reached |= through
    after = resume(after, verdict.failed | left | (ready & lane.searching & broken))
    stalled = ready & ~lane.searching & broken
    done = reached | stalled | (settles & (after.count >= task.most_periods))
    result = _result(after, reached, stalled, averaged(task.most_periods) * 2 * np.pi / omega)
    rows = jnp.stack(jax.tree.leaves(result)).astype(float)
    store = work.store.at[:, jnp.where(done, place, total)].set(rows, mode="drop")
    lane, queue = _proceed(after, done, result, work.queue, task)
    return _Work(lane, record(history, done, lane), queue, store)


def _result(lane: Lane, reached: Array, stalled: Array, span: Array) -> Attractors:
    """The result of a finished lane; ``span`` is the time over which the tangent of an unsettled lane has grown."""
    orbit = lane.orbit
    return Attractors(
        u=jnp.where(reached, orbit.u, lane.latest[0]),
        v=jnp.where(reached, orbit.v, lane.latest[1]),
        multiple=jnp.where(reached, lane.multiple, 0),
        matrix=orbit.matrix,
        error=jnp.where(reached, orbit.error, jnp.nan),
        periods=lane.count,
        exponent=lane.growth / span,
        stalled=jnp.where(stalled, jnp.where(jnp.isfinite(lane.motion.u), 1, 2), 0),
    )


def _proceed(lane: Lane, done: Array, result: Attractors, queue: Array, task: _Task) -> tuple[Lane, Array]:
    """Finished lanes continue with the next point of their job or, at its end, the next job of the queue."""
    origin = task.origin
    jobs = origin[0].size
    last = done & (lane.place == task.length - 1)
    fresh = queue + jnp.cumsum(last.astype(jnp.int32)) - 1
    job = jnp.where(last, fresh, lane.job)
    place = jnp.where(last, 0, lane.place + 1).astype(jnp.int32)
    index = jnp.minimum(job, jobs - 1)
    finite = jnp.isfinite(result.u) & ~last
    u = jnp.where(finite, result.u, origin[0][index])
    v = jnp.where(finite, result.v, origin[1][index])
    hint = jnp.where(last | (result.multiple == 0), 1, result.multiple)
    return enter(lane, done, job, place, u, v, hint), queue + last.sum().astype(jnp.int32)
