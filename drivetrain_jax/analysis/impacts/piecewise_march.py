"""Motion of a piecewise linear oscillator over drive periods: every lane moves from event to event at its own pace.

Each pass of the loop advances every lane by one exact step (:mod:`~drivetrain_jax.analysis.impacts.piecewise_march`) that
certainly stays within its linear region. Steps therefore shrink towards a flank like Newton iterates and cannot miss a
crossing. A step has a least length, which carries the lane over the flank. The excess, 1e-12 of the shortest time scale,
changes the velocity by a relative 1e-24, because the force is continuous. Its effect of 1e-12 on the transition matrix is
corrected.

With a damper in contact only the damping jumps by j at a flank, and the acceleration by -j v. A neighbour that reaches the
flank later by dt = -du/v then has its velocity changed by -j du: the transition matrix has the factor [[1, 0], [-j, 1]]. The
effect of the excess on the velocity is corrected too.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.analysis.numerics.lanes import moved_in_time
from drivetrain_jax.systems import PiecewiseLinearOscillator, UnderdampedOscillator
from drivetrain_jax.systems._models import sincos

# Closed-form flow of a :class:`~drivetrain_jax.systems.PiecewiseLinearOscillator` within one linear region, and the
# longest step that certainly stays in the region. All functions act on lanes: arrays of one shape ``(N,)``.
#
# Within a region ``u'' + C u' + K u = F + B1 cos(omega t)``. With the harmonic response ``q`` subtracted, ``x = u - q``
# and ``y = x'``, and with the step response P and impulse response S = P' of the homogeneous equation,
#
#     x(t + d) = x + S y + P (F - K x),    y(t + d) = S' y + S (F - K x),    S' = 1 - K P - C S.
#
# ``[[1 - K P, S], [-K S, S']]`` is the transition matrix; its determinant is ``exp(-C d)``. Neither K = 0 nor critical
# damping is singular in this form. As the spring force is continuous, the transition matrix of a motion is the product
# of the transition matrices of its steps, with a factor where the damping jumps (:mod:`.piecewise_march`).

_TINY = 1e-150
# Largest |root| d for the Taylor series of the step response, and its number of terms.
_SHORT, _TERMS = 0.5, 14


class Piece(NamedTuple):
    """Constants of one linear region: ``K``, half the damping ``h = C/2``, ``root = sqrt(|K - h^2|)``, a flag of
    overdamping, the roots ``slow`` and ``fast`` (both -h if the region oscillates), the modulus ``rate`` of the larger root,
    and the harmonic response ``cosine cos(omega t) + sine sin(omega t)``."""

    stiffness: Array
    half_damping: Array
    root: Array
    overdamped: Array
    slow: Array
    fast: Array
    rate: Array
    cosine: Array
    sine: Array


def piece(oscillator: PiecewiseLinearOscillator, stiffness: Array, damping: Array) -> Piece:
    """The region of this stiffness and damping. The harmonic response of an undamped region at resonance is not finite."""
    h, omega = damping / 2, oscillator.omega
    q = stiffness - h**2
    overdamped = jnp.zeros_like(q, bool) if isinstance(oscillator, UnderdampedOscillator) else q < 0
    root = jnp.maximum(jnp.sqrt(jnp.abs(q)), _TINY)
    # The slow root follows from the product K of both roots, without cancellation.
    slow = jnp.where(overdamped, -stiffness / jnp.maximum(h + root, _TINY), -h)
    fast = jnp.where(overdamped, -(h + root), -h)
    rate = jnp.where(overdamped, h + root, jnp.sqrt(stiffness))
    detuning, lag = stiffness - omega**2, damping * omega
    scale = oscillator.B1 / (detuning**2 + lag**2)
    fields = (stiffness, h, root, overdamped, slow, fast, rate, scale * detuning, scale * lag)
    return Piece(*jnp.broadcast_arrays(*(jnp.asarray(field) for field in fields)))


def _short_step_response(region: Piece, d: Array) -> Array:
    """Step response by its Taylor series."""
    damping, stiffness = 2 * region.half_damping * d, region.stiffness * d * d
    before, term = jnp.zeros_like(d), d * d / 2
    total = term
    for n in range(1, _TERMS):
        before, term = term, -(damping * (n + 1) * term + stiffness * before) / ((n + 1) * (n + 2))
        total = total + term
    return total


def responses(region: Piece, d: Array) -> tuple[Array, Array, Array]:
    """Step response P, impulse response S and its derivative S' at the time ``d`` after a start from rest."""
    half_sine, half_cosine = sincos(jnp.where(region.overdamped, 0.0, region.root * d / 2))
    slow, fast = jnp.expm1(region.slow * d), jnp.expm1(region.fast * d)
    # Oscillating: exp(-h d) (sin, cos); the step response through the half angle.
    decay = 1 + slow
    ratio = 2 * half_sine * half_cosine / region.root
    wave = decay * ratio
    wave_rate = decay * (1 - 2 * half_sine**2) - region.half_damping * wave
    stiffness = jnp.maximum(region.stiffness, _TINY)
    wave_step = (decay * (2 * half_sine**2 - region.half_damping * ratio) - slow) / stiffness
    # Overdamped: differences of exponentials, by series where these are close.
    angle = region.root * d
    near = angle < 0.1
    square = jnp.where(near, angle, 0.0) ** 2
    hyperbolic = 1 + square / 6 * (1 + square / 20 * (1 + square / 42))
    middle = jnp.sqrt(decay * (1 + fast))
    apart = jnp.where(near, middle * d * hyperbolic, (slow - fast) / (2 * region.root))
    apart_rate = 1 + fast + region.slow * apart
    slow_integral = jnp.where(region.slow == 0, d, slow / jnp.where(region.slow == 0, 1.0, region.slow))
    fast_integral = fast / jnp.where(region.fast == 0, 1.0, region.fast)
    apart_step = jnp.where(
        near, (region.fast * apart - fast) / stiffness, (slow_integral - fast_integral) / (2 * region.root)
    )
    step = jnp.where(region.overdamped, apart_step, wave_step)
    short = region.rate * d < _SHORT
    step = jnp.where(short, _short_step_response(region, jnp.where(short, d, 0.0)), step)
    impulse = jnp.where(region.overdamped, apart, wave)
    return step, impulse, jnp.where(region.overdamped, apart_rate, wave_rate)


class Bound(NamedTuple):
    """A function of time known to lie above ``value + slope t + curvature t^2/2 - jerk t^3/6`` for ``t >= 0``."""

    value: Array
    slope: Array
    curvature: Array
    jerk: Array


def _parabola_root(bound: Bound, span: Array) -> Array:
    """First positive root of the parabola below ``bound`` on ``[0, span]``, infinite if there is none."""
    curvature = bound.curvature - bound.jerk * span / 3
    discriminant = bound.slope**2 - 2 * curvature * bound.value
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    falls = bound.slope < 0
    numerator = jnp.where(falls, 2 * bound.value, bound.slope + root)
    denominator = jnp.where(falls, root - bound.slope, -curvature)
    exists = jnp.where(falls, discriminant >= 0, curvature < 0)
    return jnp.where(exists, numerator / jnp.where(exists, denominator, 1.0), jnp.inf)


def certain_span(bounds: tuple[Bound, ...], likely: Array, limit: Array) -> Array:
    """A time up to which none of ``bounds`` falls below zero, at most ``limit``; the search starts at ``likely``.

    On ``[0, s]`` the cubic lies above a parabola, so the smaller one of ``s`` and the first root of the parabola is certain.
    A second trial with a smaller ``s`` makes the root accurate to third order. Repeated steps are a Newton iteration that
    approaches a zero from one side and cannot pass it.
    """
    best, span = jnp.zeros_like(limit), jnp.minimum(likely, limit)
    for _ in range(_TRIALS):
        root = jnp.stack([_parabola_root(bound, span) for bound in bounds]).min(axis=0)
        best = jnp.maximum(best, jnp.minimum(root, span))
        span = jnp.minimum(_STRETCH * best, limit)
    return best


_TRIALS, _STRETCH = 2, 1.3


# Least step: ratio to the shortest time scale, and to the latest time in a period (its rounding).
_LEAST_STEP, _LEAST_PART = 1e-12, 1e-15
# Longest step, as a phase of the drive.
_LONGEST_PHASE = 1.5
_LIKELY_ARC = 2.5
# Most steps of a drive period: a point that needs as many takes tens of seconds.
_MOST_STEPS = 2e7
# Distance from a flank, in half backlashes, within which a lane is carried over it; longest such step of a slow lane, in
# radians of the region's fastest motion.
_ON_FLANK, _RESTING_ARC = 4e-16, 0.1


class Lanes(NamedTuple):
    """An oscillator with its derived constants: regions, flanks and time scales, each of shape ``(N,)``.

    ``jump``: damping in contact minus damping within the play; None if the damper always acts.
    """

    contact: Piece
    gap: Piece
    flank: Array
    offset: Array
    mean: Array
    amplitude: Array
    omega: Array
    period: Array
    least: Array
    jump: Array | None


def prepare(oscillator: PiecewiseLinearOscillator, span: float = np.inf) -> Lanes:
    """Constants of the lanes for a motion over the time ``span``.

    Without backlash the position of the flanks is negative and contact is permanent.
    """
    stiffness, b = jnp.asarray(oscillator.stiffness), jnp.asarray(oscillator.b)
    damping = jnp.asarray(oscillator.damping)
    contact = piece(oscillator, stiffness, damping)
    gap = piece(oscillator, oscillator.alpha * stiffness, damping if oscillator.damps_play else 0 * damping)
    period = jnp.asarray(oscillator.period)
    latest = jnp.minimum(period, span)
    least = jnp.maximum(_LEAST_STEP / jnp.maximum(contact.rate, gap.rate), _LEAST_PART * latest)
    lanes = Lanes(
        contact,
        gap,
        jnp.where(b > 0, b, -1.0),
        stiffness * (1 - oscillator.alpha) * b,
        jnp.asarray(oscillator.B0),
        jnp.asarray(oscillator.B1),
        jnp.asarray(oscillator.omega),
        period,
        least,
        None if oscillator.damps_play else damping,
    )
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves(lanes)))
    return jax.tree.map(lambda x: jnp.broadcast_to(x, shape), lanes)


class Motion(NamedTuple):
    """State of the lanes: time since the start of the period, cosine and sine of the drive's phase, displacement,
    velocity, transition matrix ``(m11, m12, m21, m22)``, remaining periods, and number of steps."""

    time: Array
    cosine: Array
    sine: Array
    u: Array
    v: Array
    matrix: tuple[Array, Array, Array, Array]
    left: Array
    steps: Array


def start(lanes: Lanes, u: Array, v: Array, periods: Array) -> Motion:
    """Lanes at the start of a drive period with a unit transition matrix."""
    zero, one = jnp.zeros_like(lanes.period), jnp.ones_like(lanes.period)
    count = jnp.zeros(zero.shape, jnp.int32)
    return Motion(zero, one, zero, u + zero, v + zero, (one, zero, zero, one), periods + count, count)


class Here(NamedTuple):
    """The region of a lane (``side`` +1, 0, -1; 2 without backlash), the constants of the region, and its constant force."""

    side: Array
    region: Piece
    force: Array


def locate(lanes: Lanes, u: Array) -> Here:
    """Region of the displacement ``u``: in contact beyond the flanks; in the gap between them, flanks included."""
    linear = lanes.flank < 0
    side = jnp.where(u > lanes.flank, 1.0, jnp.where(u < -lanes.flank, -1.0, 0.0))
    region = jax.tree.map(partial(jnp.where, linear | (side != 0)), lanes.contact, lanes.gap)
    force = lanes.mean + jnp.where(linear, 0.0, side * lanes.offset)
    return Here(jnp.where(linear, 2.0, side), region, force)


class Derivatives(NamedTuple):
    """Second to fourth derivative of u, and bounds of the third and fourth until the region or ``limit`` ends."""

    acceleration: Array
    jerk: Array
    snap: Array
    jerk_bound: Array
    snap_bound: Array


def derivatives(lanes: Lanes, here: Here, motion: Motion, limit: Array) -> Derivatives:
    """Derivatives at the current time, and their bounds.

    ``w = u''`` obeys the same equation with the drive ``-omega^2 B1 cos(omega t)``. Hence ``sqrt(w'^2 + K w^2)`` grows by at
    most ``omega^2 |B1|`` per unit of time, and the same expression in ``w'`` by at most ``omega^3 |B1|``.
    """
    damping, stiffness = 2 * here.region.half_damping, here.region.stiffness
    omega, drive = lanes.omega, lanes.amplitude
    a = here.force - damping * motion.v - stiffness * motion.u + drive * motion.cosine
    j = -damping * a - stiffness * motion.v - drive * omega * motion.sine
    s = -damping * j - stiffness * a - drive * omega**2 * motion.cosine
    growth = jnp.abs(drive) * omega**2 * limit
    jerk = jnp.sqrt(j**2 + stiffness * a**2) + growth
    return Derivatives(a, j, s, jerk, jnp.sqrt(s**2 + stiffness * j**2) + omega * growth)


def flank_bounds(lanes: Lanes, side: Array, motion: Motion, rate: Derivatives) -> tuple[Bound, Bound]:
    """Bounds of the distances to the flanks on either side of the region (infinite without a flank)."""
    b, u, v, a, jerk = lanes.flank, motion.u, motion.v, rate.acceleration, rate.jerk_bound
    inside, sign = side == 0, jnp.where(side == 0, -1.0, side)
    near = jnp.where(inside, b - u, sign * u - b)
    near = jnp.where(side == 2, jnp.inf, near)
    return (
        Bound(near, jnp.where(side == 2, 0.0, sign * v), sign * a, jerk),
        Bound(jnp.where(inside, b + u, jnp.inf), jnp.where(inside, v, 0.0), a, jerk),
    )


def _overdue(lanes: Lanes, here: Here, u: Array, v: Array, d: Array) -> Array:
    """Time in contact at the end of a step from the gap (``here``), or minus the time in the gap of a step from contact.

    The step has the length ``d`` and ends in ``(u, v)``.
    """
    inside = here.side == 0
    over = jnp.abs(u) - lanes.flank
    over = jnp.where(inside, over, -over)
    # A lane that reverses at the flank may be beyond it during the whole step; a lane at rest on the flank is not.
    passes = (jnp.abs(over) <= 2 * jnp.abs(v) * d) & (v != 0)
    late = jnp.where(passes, over / jnp.where(passes, jnp.abs(v), 1.0), d)
    value = jnp.where(over > _ON_FLANK * lanes.flank, jnp.minimum(late, d), 0.0)
    # The derivative is that of the time of the crossing, also where rounding leaves no excess.
    late = late + jax.lax.stop_gradient(value - late)
    return jnp.where(inside & (over > 0), late, jnp.where((jnp.abs(here.side) == 1) & (over >= 0), -late, 0.0))


def advance(lanes: Lanes, here: Here, motion: Motion, d: Array) -> Motion:
    """``motion`` after the time ``d`` in the region ``here``, with the end of a period counted."""
    region, omega = here.region, lanes.omega
    step, impulse, rate = responses(region, d)
    ends = d >= lanes.period - motion.time
    time = jnp.where(ends, 0.0, motion.time + d)
    sine, cosine = sincos(omega * time)
    x = motion.u - (region.cosine * motion.cosine + region.sine * motion.sine)
    y = motion.v - omega * (region.sine * motion.cosine - region.cosine * motion.sine)
    pull = here.force - region.stiffness * x
    u = x + impulse * y + step * pull + (region.cosine * cosine + region.sine * sine)
    v = rate * y + impulse * pull + omega * (region.sine * cosine - region.cosine * sine)
    m11, m12, m21, m22 = motion.matrix
    p11, p21 = 1 - region.stiffness * step, -region.stiffness * impulse
    m11, m21 = p11 * m11 + impulse * m21, p21 * m11 + rate * m21
    m12, m22 = p11 * m12 + impulse * m22, p21 * m12 + rate * m22
    overdue = _overdue(lanes, here, u, v, d)
    turned, kept = overdue * (lanes.contact.stiffness - lanes.gap.stiffness), 1.0
    if lanes.jump is not None:
        touches, touched = jnp.abs(u) > lanes.flank, jnp.abs(here.side) == 1
        crossed = jnp.where(here.side == 2, 0.0, touches * 1.0 - touched)
        turned = turned + crossed * lanes.jump - overdue * lanes.jump**2 * touches
        kept = 1 - overdue * lanes.jump
        v = kept * v
    matrix = kept * m11, kept * m12, m21 - turned * m11, m22 - turned * m12
    return Motion(time, cosine, sine, u, v, matrix, motion.left - ends, motion.steps + 1)


def advanced_once(lanes: Lanes, here: Here, motion: Motion, d: Array) -> Motion:
    """:func:`advance`, with one rounding of the displacement where the damping jumps.

    Compiled code may round a displacement on a flank differently in its two uses: in the factor of the jump, and as the
    start of the next step, which would then apply the factor once more.
    """
    return (advance if lanes.jump is None else stored(advance))(lanes, here, motion, d)


def likely_span(here: Here) -> Array:
    """First guess of the length of a step: a large part of an oscillation of the region."""
    return _LIKELY_ARC / jnp.maximum(here.region.rate, 1e-300)


def stays(lanes: Lanes, here: Here, motion: Motion) -> Array:
    """True if the energy of the free motion about the harmonic response is too small ever to leave the region."""
    region = here.region
    x = motion.u - (region.cosine * motion.cosine + region.sine * motion.sine)
    y = motion.v - lanes.omega * (region.sine * motion.cosine - region.cosine * motion.sine)
    stiffness = jnp.maximum(region.stiffness, 1e-300)
    rest = here.force / stiffness
    reach = jnp.sqrt((x - rest) ** 2 + y**2 / stiffness) + jnp.sqrt(region.cosine**2 + region.sine**2)
    low, high = rest - reach, rest + reach
    inside = (high < lanes.flank) & (low > -lanes.flank)
    outside = jnp.where(here.side > 0, low > lanes.flank, high < -lanes.flank)
    return jnp.where(here.side == 0, inside, outside) | (here.side == 2)


def least_step(lanes: Lanes, here: Here, motion: Motion, rate: Derivatives) -> Array:
    """The least step. On a flank, up to rounding, it is long enough to move even a slow lane off the flank."""
    way = jnp.maximum(_ON_FLANK * jnp.abs(lanes.flank), 1e-300)
    longest = _RESTING_ARC / jnp.maximum(here.region.rate, 1e-300)
    pull = jnp.abs(rate.acceleration) + longest * rate.jerk_bound
    leaving = longest / (1 + longest * (jnp.abs(motion.v) / way + jnp.sqrt(pull / way)))
    on_flank = jnp.abs(jnp.abs(motion.u) - lanes.flank) <= way
    return jnp.where(on_flank, jnp.maximum(leaving, lanes.least), lanes.least)


def next_step(lanes: Lanes, here: Here, motion: Motion) -> Array:
    """The longest step that certainly stays in the region ``here``, at least the least step, within the period."""
    rest = lanes.period - motion.time
    limit = jnp.minimum(rest, _LONGEST_PHASE / lanes.omega)
    rate = derivatives(lanes, here, motion, limit)
    d = certain_span(flank_bounds(lanes, here.side, motion, rate), likely_span(here), limit)
    d = jnp.maximum(d, least_step(lanes, here, motion, rate))
    return jnp.where(stays(lanes, here, motion), rest, jnp.minimum(d, rest))


def step(lanes: Lanes, motion: Motion) -> Motion:
    """``motion`` after one step in the finite lanes with remaining periods."""
    here = locate(lanes, motion.u)
    moved = advanced_once(lanes, here, motion, next_step(lanes, here, motion))
    active = (motion.left > 0) & jnp.isfinite(motion.u)
    return jax.tree.map(lambda new, old: jnp.where(active, new, old), moved, motion)


def usual_steps(lanes: Lanes, span: float = np.inf) -> Array:
    """Number of steps that no drive period exceeds (measured: 5 per oscillation, up to 15 per crossing).

    A motion over the time ``span`` has no longer period than that.
    """
    period = jnp.minimum(lanes.period, span)
    return 2000 + 100 * period * jnp.maximum(lanes.contact.rate, lanes.gap.rate) / (2 * np.pi)


def allowed_steps(lanes: Lanes, span: float = np.inf) -> Array:
    """:func:`usual_steps`, or 0 where that is so much that the motion is not begun."""
    steps = usual_steps(lanes, span)
    return jnp.where(steps <= _MOST_STEPS, steps, 0.0)


def march(lanes: Lanes, motion: Motion, most_steps: int) -> Motion:
    """``motion`` after its remaining periods.

    A lane that needs more than ``most_steps`` steps keeps periods ``left``. Lanes that are finished or not finite wait.
    """

    def going(motion: Motion) -> Array:
        return jnp.any((motion.left > 0) & (motion.steps < most_steps) & jnp.isfinite(motion.u))

    return jax.lax.while_loop(going, lambda moving: step(lanes, moving), motion)


# States at given times and events of a motion from any start.

DRIVE, BACK, NO_EVENT = range(3)


class Events(NamedTuple):
    """Contacts made and lost, in order: ``time``, number of the ``flank`` and ``velocity``, shape ``(events, N)``.

    After the last event, entries are NaN and ``NO_EVENT``. The ``number`` (N,) of events may exceed the length of the list.
    """

    time: Array
    flank: Array
    velocity: Array
    number: Array


class _Walk(NamedTuple):
    """State of the march: the motion, whose periods ``left`` count down from 0, and the events so far."""

    motion: Motion
    events: Events


def timed_motion(
    oscillator: PiecewiseLinearOscillator, u: Array, v: Array, turns: Array, span: float = np.inf, most_events: int = 1
) -> tuple[Array, Array, Events, Array]:
    """Displacement and velocity after the rising ``turns`` (T, N) of the drive, the first ``most_events`` events, and flags
    ``(N,)``.

    The motion starts in the state ``(u, v)`` at t = 0 and lasts for ``span``, if that is given. A flag marks a lane that
    needs too many steps: a grazing motion, or one whose oscillator is so much faster than its drive that it is not begun.
    """
    lanes = jax.tree.map(lambda x: x + jnp.zeros(u.shape), prepare(oscillator, span))
    periods = jnp.floor(turns).astype(jnp.int32)
    allowed = allowed_steps(lanes, span)
    most = jnp.where(allowed > 0, 2 * (periods[-1] + 1) * allowed + 2 * len(turns), 0)
    none = jnp.full((most_events, *u.shape), jnp.nan)
    nothing = Events(none, jnp.full(none.shape, NO_EVENT, jnp.int8), none, jnp.zeros(u.shape, jnp.int32))

    def to(walk: _Walk, target: tuple[Array, Array]) -> tuple[_Walk, tuple[Array, Array]]:
        def active(motion: Motion) -> Array:
            whole, part = target
            early = (-motion.left < whole) | ((-motion.left == whole) & (motion.time < part))
            return early & jnp.isfinite(motion.u) & (motion.steps < most)

        walk = jax.lax.while_loop(
            lambda w: jnp.any(active(w.motion)), lambda w: _moved(lanes, w, target, active(w.motion)), walk
        )
        late = jnp.where(walk.motion.steps < most, 0.0, jnp.nan)
        return walk, (jnp.stack([walk.motion.u, walk.motion.v]) + late, target[1] - walk.motion.time)

    begin = _Walk(start(lanes, u, v, jnp.zeros(u.shape, jnp.int32)), nothing)
    end, (states, late) = jax.lax.scan(to, begin, (periods, (turns - periods) * lanes.period))
    states = jnp.swapaxes(states, 0, 1)
    high, rate = moved_in_time(states, oscillator.field(turns * lanes.period, states), late)
    return high, rate, end.events, end.motion.steps >= most


def _moved(lanes: Lanes, walk: _Walk, target: tuple[Array, Array], active: Array) -> _Walk:
    """The march after one step of the ``active`` lanes, at most to the ``target``: whole periods and the time after them."""
    motion, (whole, part) = walk.motion, target
    here = locate(lanes, motion.u)
    # The end of a step does not influence the motion, and its derivative may be infinite: it is not differentiated.
    d = next_step(*jax.lax.stop_gradient((lanes, here, motion)))
    d = jnp.where(d >= lanes.period - motion.time, lanes.period - motion.time, d)
    d = jnp.where(-motion.left == whole, jnp.minimum(d, part - motion.time), d)
    # Stored: computed once more with another rounding, a displacement on a flank would be kept and yet not be an event.
    moved = stored(advance)(lanes, here, motion, d)
    after = locate(lanes, moved.u).side
    crosses = active & (after != here.side)
    flank = jnp.where(here.side + after > 0, DRIVE, BACK).astype(jnp.int8)
    time = moved.time - moved.left * lanes.period
    kept = jax.tree.map(lambda new, old: jnp.where(active, new, old), moved, motion)
    return _Walk(kept, _recorded(walk.events, crosses, time, flank, moved.v))


def _recorded(events: Events, crosses: Array, time: Array, flank: Array, velocity: Array) -> Events:
    """``events`` with one more event in the lanes that cross a flank; when the list is full, the event is only counted."""
    length = events.time.shape[0]
    place = jnp.where(crosses, events.number, length), jnp.arange(crosses.shape[0])
    return Events(
        events.time.at[place].set(time, mode="drop"),
        events.flank.at[place].set(flank, mode="drop"),
        events.velocity.at[place].set(velocity, mode="drop"),
        events.number + crosses,
    )
