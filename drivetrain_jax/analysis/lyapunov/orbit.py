"""The periodic orbit to which a motion decays, and its exponents ``ln|multiplier| / period``.

Newton's method solves y = P(y) for the map P over a period, which is a common period of the clocks or a multiple of it. The
matrix P' comes from tangent vectors, and its eigenvalues are the multipliers. The orbit is that of the motion if the motion
starts on it, or if the orbit is stable and the motion lies so close that P is linear between both.

The exponents are computed with twice as many steps, until the change predicts their error. An equilibrium is an orbit of any
period.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.lyapunov.variational import Frame, Vector, batch_shape, one_kernel, strobe_map
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, matmul, solve
from drivetrain_jax.systems import Flow

# Decide if a field can be chaotic: two components without forcing cannot (Poincare and Bendixson).
#
# A clock may turn without effect: the field does not contain it, or the amplitude of its forcing is zero.

# Fractions of a strobe at which the clocks are tested; at none of them the derivative of a harmonic vanishes by symmetry.
FRACTIONS = tuple((k + 0.37) / 8 for k in range(8))
# Number of components of a flow that cannot be chaotic without a clock; a phase is a clock among the components.
_PLANAR = 2


def driven(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where the field at ``y`` depends on any of its clocks, shape (...), however small the amplitude."""
    felt = [feels(flow, y, number) for number in range(len(flow.turns))]
    return jnp.any(jnp.stack([jnp.zeros(jnp.shape(y[0]), bool), *felt]), axis=0)


def feels(flow: Flow, y: tuple[Array, ...], number: int) -> Array:
    """Flags where the field at ``y`` depends on the clock ``number``, shape (...), however small the amplitude."""
    shape = (len(FRACTIONS), *jnp.shape(y[0]))
    angles = flow.angles(0, jnp.asarray(FRACTIONS).reshape(-1, *(1,) * jnp.ndim(y[0])))

    def rates(angle: Array) -> Array:
        turned = (*angles[:number], angle, *angles[number + 1 :])
        return jnp.stack([jnp.broadcast_to(jnp.asarray(rate, float), shape) for rate in flow.field(turned, y)])

    angle = jnp.broadcast_to(angles[number], shape)
    _, change = jax.jvp(rates, (angle,), (jnp.ones_like(angle),))
    return jnp.any(change != 0, axis=(0, 1))


def may_rest(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where the field vanishes at 0, whatever the clocks show; only phases keep their values of ``y``."""
    still = jnp.stack([x if i in flow.phases else jnp.zeros_like(x) for i, x in enumerate(y)])
    rates = jnp.stack([flow.vector(0, fraction, still) for fraction in FRACTIONS])
    moving = jnp.array([i for i in range(flow.size) if i not in flow.phases])
    return jnp.all(rates[:, moving] == 0, axis=(0, 1))


def may_be_chaotic(flow: Flow, y: tuple[Array, ...]) -> Array:
    """Flags where chaos is possible, shape (...); ``y`` is a state of the motion."""
    if flow.size > _PLANAR or flow.phases:
        return jnp.ones(jnp.shape(y[0]), bool)
    return driven(flow, y)


# Longest common period of the clocks and longest multiple of it that is looked for, in strobes.
LONGEST, _MULTIPLES = 8192, 512
_EPS, _TURN = np.finfo(float).eps, 2 * math.pi
# Roundings in the turns of a clock.
_TURNED = 16 * _EPS
# Newton's corrections that end the iteration, and distances below which strobes are equal: relative to the state, and for a
# state near zero relative to the motion before.
_CLOSE, _ZERO = 1e-9, 1e-13
# Largest part of the decay over a period that may be due to the curvature of the map.
_CURVED = 0.1
# Ratio of a strobe's distance from its return to the smallest one below which it counts as the same return.
_SAME = 10.0
# Target of the exponents' errors, relative to the largest exponent; part of a change by twice the steps that remains (1/512
# by the order of the scheme); roundings in a multiplier.
_TARGET, _REMAINS, _ROUNDINGS = 1e-10, 1 / 32, 16 * _EPS
# Size below which tangent vectors are lengthened.
_LOW = 1e-100
# Limits of the iteration: corrections, and steps.
_CORRECTIONS, _WORK = 16, 2e6


class Orbit(NamedTuple):
    """The orbit of every motion that has one.

    ``found`` (...): flags; ``multiple`` (...): its period in strobes, else 0; ``exponents``, ``errors`` (n, ...): in falling
    order; ``divergence`` (...): mean divergence of the field along the orbit.
    """

    found: Array
    multiple: Array
    exponents: Array
    errors: Array
    divergence: Array


class _Turn(NamedTuple):
    """The map over a period: the end, its derivative by the start over ``exp(shift)``, the integral of the divergence, the
    first strobe that equals the start (0: none), and ``shift``."""

    end: Array
    matrix: Array
    contraction: Array
    back: Array
    shift: Array


class _Search(NamedTuple):
    """State of Newton's iteration.

    ``correction``, ``work``: number of corrections and steps so far; ``steps``: per strobe; ``state``: the iterate;
    ``change``: its last change; ``active``: members that go on; ``settled``: members that have converged with these
    ``steps``; ``first``: end of the first period; ``belongs``: see :func:`_belongs`, with the smallest number of steps;
    ``turn``: the last period; ``exponents``, ``errors``: by the largest number of steps with which the iteration converged.
    """

    correction: Array
    work: Array
    steps: Array
    state: Array
    change: Array
    active: Array
    settled: Array
    first: Array
    belongs: Array
    turn: _Turn
    exponents: Array
    errors: Array


def common_period(flow: Flow, y: Vector) -> Array:
    """Strobes after which all clocks that the field feels at ``y`` have made whole turns, 0 above ``LONGEST``, (...)."""
    if all(isinstance(turns, int) for turns in flow.turns):
        return jnp.ones(batch_shape(flow), jnp.int64)
    strobes = jnp.arange(1, LONGEST + 1).reshape(-1, *(1,) * len(batch_shape(flow)))
    whole = jnp.ones((LONGEST, *batch_shape(flow)), bool)
    for number, turns in enumerate(flow.turns):
        if not isinstance(turns, int):
            turned = strobes * turns
            closed = abs(turned - jnp.round(turned)) <= _TURNED * abs(turned)
            whole &= closed | ~feels(flow, y, number)
    return jnp.where(jnp.any(whole, axis=0), 1 + jnp.argmax(whole, axis=0), 0)


def no_orbit(flow: Flow) -> Orbit:
    """An orbit for no member."""
    shape = batch_shape(flow)
    nothing = jnp.zeros((flow.size - len(flow.phases), *shape))
    return Orbit(jnp.zeros(shape, bool), jnp.zeros(shape, jnp.int64), nothing, nothing, jnp.zeros(shape))


def find_orbit(
    flow: Flow, steps: Any, state: Vector, strobe: Array, period: Array, wanted: Array, longer: Array
) -> Orbit:
    """Orbits of the ``wanted`` motions, which are at ``state`` at ``strobe``; ``period``: see :func:`common_period`.

    ``longer``: motions whose orbit may have a multiple of this period, the one after which the motion comes closest.
    """
    if flow.phases:
        return no_orbit(flow)

    def search(known: Orbit, again: Array) -> tuple[Orbit, None]:
        missing = wanted & ~known.found & (period > 0)
        multiple = period
        if flow.turns:
            missing &= ~again | (longer & (2 * period <= _MULTIPLES))
            multiple = jax.lax.cond(
                again & jnp.any(missing), lambda: _return(flow, steps, state, strobe, period), lambda: period
            )
            missing &= ~again | (multiple != period)
        orbit = _newton(flow, steps, state, strobe, jnp.where(missing, multiple, 0))
        return jax.tree.map(lambda new, old: jnp.where(orbit.found, new, old), orbit, known), None

    return jax.lax.scan(search, no_orbit(flow), jnp.array([False, True] if flow.turns else [False]))[0]


def _return(flow: Flow, steps: Any, state: Vector, strobe: Array, period: Array) -> Array:
    """The multiple of ``period``, up to ``_MULTIPLES`` strobes, after which the motion is closest to ``state``."""
    advance = one_kernel(flow)(strobe_map(flow, steps))

    def next_strobe(frame: Frame, k: Array) -> tuple[Frame, Array]:
        frame = advance(strobe + k, frame)
        return frame, jnp.where((k + 1) % period == 0, _size(_difference(flow, frame.state, state)), jnp.inf)

    _, distance = jax.lax.scan(next_strobe, Frame(state), jnp.arange(_MULTIPLES))
    least = jnp.min(distance, axis=0)
    near = distance <= jnp.maximum(_SAME * least, _CLOSE * _size(state))
    return jnp.where(jnp.isfinite(least), 1 + jnp.argmax(near, axis=0), period)


def _newton(flow: Flow, steps: Any, state: Vector, strobe: Array, multiple: Array) -> Orbit:
    """Orbits with the periods ``multiple`` (0: none) near ``state``, by Newton's method with more and more steps."""
    start, scale, period = jnp.stack(state), _size(state), jnp.maximum(multiple, 1) * flow.period
    shape = start.shape[1:]

    def correct(s: _Search) -> _Search:
        moving = s.active & ~s.settled
        length = jnp.where(moving, multiple, 0)
        turn = _turn(flow, s.steps, s.state, strobe, length, scale)
        eye = jnp.eye(flow.size).reshape(flow.size, flow.size, *(1,) * len(shape))
        matrix = turn.matrix * jnp.exp(turn.shift)
        delta = solve(eye - matrix, _difference(flow, turn.end, s.state)[:, None])[:, 0]
        change = _size(delta)
        settled = moving & (change <= _CLOSE * jnp.maximum(scale, _size(s.state)))
        failed = moving & ~settled & ~(change <= s.change / 2)
        first = jnp.where(s.correction == 0, turn.end, s.first)
        exponents, rounding = _exponents(turn, period, multiple)
        errors = _REMAINS * abs(exponents - s.exponents) + rounding
        done = settled & jnp.all(errors <= _TARGET * jnp.max(abs(exponents), axis=0) + 2 * rounding, axis=0)
        belongs = _belongs(flow, (start, first, s.state + delta), matrix, exponents[0] * period)
        belongs = jnp.where(jnp.isinf(s.exponents[0]), belongs, s.belongs)
        active = s.active & ~failed & ~done
        refined = jnp.all(s.settled | settled | ~active)
        return _Search(
            s.correction + 1, s.work + s.steps * jnp.max(length), jnp.where(refined, 2 * s.steps, s.steps),
            jnp.where(moving, s.state + delta, s.state), jnp.where(refined, jnp.inf, jnp.where(moving, change, s.change)),
            active, (s.settled | settled) & ~refined, first, belongs,
            jax.tree.map(lambda new, old: jnp.where(moving, new, old), turn, s.turn),
            jnp.where(settled, exponents, s.exponents), jnp.where(settled, errors, s.errors),
        )  # fmt: skip

    def unfinished(s: _Search) -> Array:
        return jnp.any(s.active) & (s.correction < _CORRECTIONS) & (s.work < _WORK)

    unknown = jnp.full(start.shape, jnp.inf)
    nothing = _Turn(start, jnp.zeros((flow.size, *start.shape)), unknown[0], multiple, jnp.zeros(shape))
    s = jax.lax.while_loop(unfinished, correct, _Search(
        jnp.int64(0), jnp.float64(0), jnp.maximum(jnp.asarray(steps) // 2, 1), start, unknown[0], multiple > 0,
        jnp.zeros(shape, bool), start, jnp.zeros(shape, bool), nothing, unknown, unknown,
    ))  # fmt: skip
    decays = s.belongs & (s.exponents[0] < -s.errors[0])
    converged = jnp.all(jnp.isfinite(s.errors), axis=0) & (decays | jnp.all(s.state == start, axis=0))
    back = jnp.where((s.turn.back > 0) & (multiple % jnp.maximum(s.turn.back, 1) == 0), s.turn.back, multiple)
    return Orbit(converged, jnp.where(converged, back, 0), s.exponents, s.errors, s.turn.contraction / period)


def _belongs(flow: Flow, states: tuple[Array, Array, Array], matrix: Array, growth: Array) -> Array:
    """Flags where a motion decays to an orbit by the linear map.

    ``states``: of the motion, of the motion a period later, and of the orbit; ``growth``: logarithm of the largest
    multiplier.
    """
    start, first, orbit = states
    before, after = (_difference(flow, y, orbit) for y in (start, first))
    curved, away = _size(after - matmul(matrix, before[:, None])[:, 0]), _size(before)
    # The slower the decay, the smaller a curvature upsets it.
    near = (away <= _CLOSE * _size(orbit)) | (curved <= _CURVED * -jnp.expm1(growth) * away)
    return near & (growth < 0)


def _turn(flow: Flow, steps: Any, start: Array, strobe: Array, length: Array, scale: Array) -> _Turn:
    """The map of ``start`` over ``length`` strobes."""
    n, shape = flow.size, start.shape[1:]
    advance = strobe_map(flow, steps)

    def march(longest: Array, frame: Frame, strobe: Array, length: Array, scale: Array) -> tuple[Frame, Array, Array]:
        first = frame.state
        least = jnp.maximum(_CLOSE * _size(first), _ZERO * scale)

        def body(k: Array, carry: tuple[Frame, Array, Array]) -> tuple[Frame, Array, Array]:
            frame, back, shift = carry
            new = jax.tree.map(lambda a, b: jnp.where(k < length, a, b), advance(strobe + k, frame), frame)
            equal = _size(_difference(flow, new.state, first)) <= least
            # Over a long period tangent vectors may fall below the smallest number.
            low = reduce(jnp.maximum, [abs(x[i]) for x in new.tangents for i in range(n)]) < _LOW
            new = new._replace(tangents=tuple(jnp.where(low, x / _LOW, x) for x in new.tangents))
            return new, jnp.where((back == 0) & equal, k + 1, back), shift + jnp.where(low, math.log(_LOW), 0.0)

        return jax.lax.fori_loop(0, longest, body, (frame, jnp.zeros_like(length), jnp.zeros(shape)))

    units = (jnp.broadcast_to(u.reshape(n, *(1,) * len(shape)), (n, *shape)) for u in jnp.eye(n))
    frame = Frame(tuple(start), tuple(units), jnp.zeros(shape))
    frame, back, shift = one_kernel(flow)(march)(jnp.max(length), frame, strobe, length, scale)
    return _Turn(jnp.stack(frame.state), jnp.stack(frame.tangents), frame.contraction, back, shift)


def _exponents(turn: _Turn, period: Array, multiple: Array) -> tuple[Array, Array]:
    """Exponents in falling order and their rounding errors, ``(n, ...)``, of a map over ``period``.

    Rounding moves a multiplier the more, the closer it is to others relative to what the matrix has beside a multiple of the
    unit matrix, and a double one by the root. The smallest exponent is the rest of the mean divergence where rounding hides
    it.
    """
    n = len(turn.matrix)
    eye = jnp.eye(n).reshape(n, n, *(1,) * (turn.matrix.ndim - 2))
    real, imaginary = eigenvalues(turn.matrix)
    modulus = jnp.hypot(real, imaginary)
    beside = jnp.sqrt(jnp.sum((turn.matrix - eye * jnp.mean(real, axis=0)) ** 2, axis=(0, 1)))
    gaps = jnp.hypot(real[:, None] - real, imaginary[:, None] - imaginary) / beside
    change = _ROUNDINGS * jnp.sqrt(multiple) * jnp.max(modulus, axis=0)
    slope = jnp.maximum(jnp.prod(jnp.where(eye > 0, 1.0, gaps), axis=1), jnp.sqrt(change / beside))
    errors = change / jnp.where(beside > 0, slope, 1.0) / modulus / period
    order = jnp.argsort(-modulus, axis=0)
    exponents, errors = (
        jnp.take_along_axis(x, order, axis=0) for x in ((jnp.log(modulus) + turn.shift) / period, errors)
    )
    rest, uncertain = turn.contraction / period - jnp.sum(exponents[:-1], axis=0), jnp.sum(errors[:-1], axis=0)
    small = _TARGET * jnp.max(abs(exponents), axis=0)
    hidden = (errors[-1] > jnp.maximum(uncertain, small)) | ~(abs(rest - exponents[-1]) <= small)
    exponents = exponents.at[-1].set(jnp.where(hidden, rest, exponents[-1]))
    return exponents, errors.at[-1].set(jnp.where(hidden, uncertain, errors[-1]))


def _difference(flow: Flow, a: Any, b: Any) -> Any:
    """``a - b``, of angles up to whole turns."""
    parts = [x - y for x, y in zip(a, b, strict=True)]
    parts = [x - _TURN * jnp.round(x / _TURN) if i in flow.cyclic else x for i, x in enumerate(parts)]
    return jnp.stack(parts) if isinstance(a, Array) else parts


def _size(y: Any) -> Array:
    """Largest modulus of the components."""
    return reduce(jnp.maximum, [abs(x) for x in y])
