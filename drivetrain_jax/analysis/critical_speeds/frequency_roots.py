"""Natural frequencies of a stepped shaft: certified brackets, and their derivatives.

The j-th frequency is where the count N passes from below j to j or more. Every step keeps a bracket with N(low) < j <=
N(high), so that no frequency can be missed and none invented. The upper end comes from the clamped-clamped frequencies
of the segments, each of which has at least ``z/pi - 1.6`` of them below z (without any mass in segments from a sum of
stiffness over mass), the lower one from falling powers of 4. Once
a bracket holds one frequency alone, steps follow Psi (interpolation, truncation and projection: Oliveira & Takahashi,
ACM TOMS 47 (2020) 5, never more than one step worse than bisection); in clusters they bisect. All modes of all lanes go
through the same ``COMMON_STEPS``; the few brackets that are open then go on by themselves, to ``MAX_STEPS`` at most. A
bracket that is closed stays as it is, so results do not depend on the lanes beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import stacked
from drivetrain_jax.analysis.critical_speeds import coupled
from drivetrain_jax.analysis.critical_speeds.compound import Scales, Value, characteristic, pairings
from drivetrain_jax.analysis.critical_speeds.mechanisms import (
    highest_frequency,
    is_undefined,
    number_of_modes,
    zero_modes,
)
from drivetrain_jax.analysis.numerics.kernels import stored
from drivetrain_jax.systems import Shaft
from drivetrain_jax.systems._models import sincos

MAX_STEPS = 90
# After this many steps some 5 % of the brackets are open.
COMMON_STEPS = 16
# A clamped segment has more frequencies below the phase z than z/pi minus this.
_CLAMPED_DEFICIT = 1.6
# Relative width at which a bracket in q is closed, and what rounding may add to it.
_CLOSED = 4 * np.finfo(float).eps
# Ratio of the ends up to which a bracket is narrow enough for arithmetic means and for interpolation.
_NEAR = 4.0
_TRUNCATION = 0.2
# An upper end rises by factors of _NEAR, nine times at most, while the count does not confirm it.
_HIGHEST = 1.5 / _NEAR**10
# Share of the brackets that continue together, and the smallest useful number.
_FEW, _WORTH = 1 / 16, 32
# Relative distance up to which frequencies count as one; and up to which a zero of Psi is that of the frequency.
_MULTIPLE = 1e-13
_ZERO = 1e-9


class Roots(NamedTuple):
    """``q = sqrt(p)`` of the natural frequencies p [rad/s], rising; the relative ``width`` of the brackets of p;
    whether the count certifies each: ``(modes, *lanes)``. A zero mode has the exact q = 0, a mode that a shaft without
    mass in its segments does not have is infinite, and what was not found is NaN."""

    q: Array
    width: Array
    certified: Array


class _Brackets(NamedTuple):
    """Ends of the brackets in q, the count and Psi there (a count of -1 above must yet be confirmed), the factor of the next
    lower trial while ``low`` is 0,
    whether one simple root is left, the width when that was first so, and the reach of interpolation that is left."""

    low: Array
    high: Array
    count_low: Array
    count_high: Array
    psi_low: Array
    psi_high: Array
    shrink: Array
    isolated: Array
    first_width: Array
    span: Array


def _start(shaft: Shaft, modes: int) -> _Brackets:
    lanes, massive = shaft.lanes, shaft.rhoA > 0
    total = jnp.sum(jnp.where(massive, Scales.from_shaft(shaft).beta, 0.0), axis=0)
    # NaN where rhoA is NaN: such a lane has no bracket.
    total = total + 0.0 * jnp.sum(shaft.rhoA, axis=0)
    index = jnp.arange(1, modes + 1).reshape(modes, *(1,) * len(lanes))
    high = math.pi * (index + _CLAMPED_DEFICIT * shaft.segments) / jnp.where(total == 0, 1.0, total)
    high = jnp.where(total == 0, highest_frequency(shaft), high)
    high = jnp.where(is_undefined(shaft), jnp.nan, jnp.broadcast_to(high, (modes, *lanes)))
    zero = jnp.zeros_like(high)
    # The gyroscopic effect may lift frequencies above those at rest: the count must confirm their upper ends.
    above = zero + (jnp.inf if shaft.spin is None and shaft.k_y is None else -1.0)
    return _Brackets(zero, high, zero - 1, above, zero, zero, zero + 1 / _NEAR, zero > 0, zero, zero)


def _unconfirmed(b: _Brackets) -> Array:
    return b.count_high < 0


def _trial(b: _Brackets) -> Array:
    """The next point of every bracket."""
    middle = 0.5 * (b.low + b.high)
    width = b.high - b.low
    slope = b.psi_high - b.psi_low
    secant = b.low - b.psi_low * width / jnp.where(slope == 0, 1.0, slope)
    secant = jnp.where(b.isolated, jnp.clip(secant, b.low, b.high), middle)
    towards = jnp.where(middle > secant, 1.0, -1.0)
    first = jnp.where(b.isolated, b.first_width, width)
    push = jnp.maximum(_TRUNCATION * width * width / first, 0.5 * _CLOSED * b.high)
    truncated = jnp.where(push < jnp.abs(middle - secant), secant + towards * push, middle)
    reach = jnp.where(b.isolated, jnp.maximum(b.span - 0.5 * width, 0.0), 0.0)
    truncated = jnp.clip(truncated, middle - reach, middle + reach)
    near = b.high <= _NEAR * b.low
    trial = jnp.where(b.low == 0, b.high * b.shrink, jnp.where(near, truncated, jnp.sqrt(b.low * b.high)))
    return jnp.where(_unconfirmed(b), b.high, trial)


def _closed(b: _Brackets) -> Array:
    return ~(b.high - b.low > _CLOSED * b.high) | (_unconfirmed(b) & (b.shrink < _HIGHEST))


def _step(shaft: Shaft, index: Array, b: _Brackets) -> _Brackets:
    q = _trial(b)
    # Computed once for all uses: near a root two kernels may round to different counts, and the ends would contradict.
    value = stored(_characteristic(shaft))(shaft, q)
    above, unconfirmed = value.count >= index, _unconfirmed(b)
    shrink = jnp.where((b.low == 0) & above & ~unconfirmed, b.shrink * b.shrink, b.shrink)
    shrink = jnp.where(unconfirmed & ~above, b.shrink / _NEAR, shrink)
    low, high = jnp.where(above, b.low, q), jnp.where(above, q, jnp.where(unconfirmed, _NEAR * b.high, b.high))
    count_low, count_high = jnp.where(above, b.count_low, value.count), jnp.where(above, value.count, b.count_high)
    psi_low, psi_high = jnp.where(above, b.psi_low, value.psi), jnp.where(above, value.psi, b.psi_high)
    isolated = (count_high - count_low == 1) & (high <= _NEAR * low) & (psi_low * psi_high < 0)
    first_width = jnp.where(isolated & ~b.isolated, high - low, b.first_width)
    span = jnp.where(b.isolated, 0.5 * b.span, high - low)
    new = _Brackets(low, high, count_low, count_high, psi_low, psi_high, shrink, isolated, first_width, span)
    done = _closed(b)
    return jax.tree.map(lambda old, fresh: jnp.where(done, old, fresh), b, new)


def _characteristic(shaft: Shaft) -> Callable[[Shaft, Array], Value]:
    return characteristic if shaft.k_y is None else coupled.characteristic


def _search(shaft: Shaft, modes: int) -> _Brackets:
    brackets = _start(shaft, modes)
    index = jnp.arange(1, modes + 1).reshape(modes, *(1,) * (brackets.high.ndim - 1))
    # Zero modes are known; their brackets are closed from the start. So are those of lanes that are not finite, and of
    # modes that a shaft without mass in segments does not have.
    known = (index <= zero_modes(shaft)) | (index > number_of_modes(shaft)) | ~jnp.isfinite(brackets.high)
    brackets = brackets._replace(low=jnp.where(known, brackets.high, brackets.low))

    room = int(_FEW * brackets.high.size)
    if room < _WORTH:
        return _advance(shaft, index, 0, brackets, MAX_STEPS)
    return _finish(shaft, _advance(shaft, index, 0, brackets, COMMON_STEPS), room)


def _advance(shaft: Shaft, index: Array, count: int, brackets: _Brackets, most: int) -> _Brackets:
    """Steps ``count`` to ``most`` of all brackets, or until they are closed."""

    return jax.lax.while_loop(
        lambda state: (state[0] < most) & ~jnp.all(_closed(state[1])),
        lambda state: (state[0] + 1, _step(shaft, index, state[1])),
        (jnp.int32(count), brackets),
    )[1]


def _finish(shaft: Shaft, brackets: _Brackets, room: int) -> _Brackets:
    """The further steps of the open brackets, ``room`` of them at a time, each with its own shaft."""
    shape = brackets.high.shape
    lanes = math.prod(shape[1:])
    fields = jax.tree.map(lambda field: field.reshape(len(field), lanes), shaft.spread())

    def some(state: tuple[_Brackets, Array]) -> tuple[_Brackets, Array]:
        flat, left = state
        # Free places are taken by the first of them once more: the same values, written twice.
        place = jnp.nonzero(left, size=room, fill_value=jnp.argmax(left))[0]
        chosen = jax.tree.map(lambda field: field[:, place % lanes], fields)
        done = _advance(chosen, place // lanes + 1, COMMON_STEPS, jax.tree.map(lambda x: x[place], flat), MAX_STEPS)
        return jax.tree.map(lambda x, new: x.at[place].set(new), flat, done), left.at[place].set(False)

    flat = jax.tree.map(lambda x: x.reshape(-1), brackets)
    flat, _ = jax.lax.while_loop(lambda state: jnp.any(state[1]), some, (flat, ~_closed(flat)))
    return jax.tree.map(lambda x: x.reshape(shape), flat)


def find_roots(shaft: Shaft, modes: int) -> Roots:
    """The first ``modes`` natural frequencies of every lane, zero modes included. Derivatives:
    :func:`frequency_derivatives`."""
    brackets = _search(shaft, modes)
    index = jnp.arange(1, modes + 1).reshape(modes, *(1,) * (brackets.high.ndim - 1))
    finite = jnp.isfinite(brackets.high)
    zero, absent = (index <= zero_modes(shaft)) & finite, (index > number_of_modes(shaft)) & finite
    absent = absent | (~zero & finite & _unconfirmed(brackets) & _closed(brackets))
    certified = (_closed(brackets) & (brackets.low > 0) & (brackets.count_low >= 0) & finite) | zero | absent
    q = jnp.where(zero, 0.0, 0.5 * (brackets.low + brackets.high))
    width = jnp.where(zero, 0.0, 2 * (brackets.high - brackets.low) / brackets.high)
    q = jnp.where(absent, jnp.inf, jnp.where(certified, q, jnp.nan))
    return Roots(q, jnp.where(absent, 0.0, width), certified)


def frequency_derivatives(build: Callable[[Any], Shaft], parameters: Any, q: Array) -> Array:
    """Derivatives ``(modes, P)`` of the angular frequencies ``p = q^2`` of one shaft by all P ``parameters``.

    With Psi, the closed form of the characteristic function, ``dp = -(dPsi/dparameter) / (dPsi/dp)``: one evaluation for
    each parameter, whatever the number of steps that found p: the energy formulas of docs/theory/bicardan.md, (12).
    A zero mode has the derivative 0, but none by the stiffness of a spring that could hold it, where p grows as sqrt(k). A
    multiple frequency and an infinite one have none (NaN); beside another one at the relative distance d the error is of the
    order of eps/d.
    """
    shaft, moving = build(parameters), (q > 0) & jnp.isfinite(q)
    safe = jnp.where(moving, q, 1.0)
    function = pairings if shaft.k_y is None else partial(coupled.residual, coupled.null_vectors(shaft, safe))
    psi, along_q = jax.jvp(lambda x: function(shaft, x), (safe,), (jnp.ones_like(safe),))
    along = stacked(jax.jacfwd(lambda p: function(build(p), safe))(parameters))
    # A section that the mode does not reach does not show its frequency as a zero.
    section = jnp.argmin(jnp.abs(psi / along_q), axis=0)[None]
    along_q, along = (
        jnp.take_along_axis(x, i, axis=0)[0] for x, i in ((along_q, section), (along, section[..., None]))
    )
    none = multiple(shaft, q) | ~jnp.isfinite(q)
    slope = jnp.where(none[:, None], jnp.nan, -2 * safe[:, None] * along / along_q[:, None])

    def missing(parameters: Any) -> Array:
        """Stiffness of all springs and hinges that are not there."""
        springs = build(parameters)
        present = [x for x in (springs.k, springs.k_y, springs.k_hinge, springs.k_rot) if x is not None]
        return jnp.concatenate([jnp.where(x == 0, x, 0.0) for x in present])

    held = jnp.any(stacked(jax.jacfwd(missing)(parameters)) != 0, axis=0)
    return jnp.where(q == 0, jnp.where(held[:, None], jnp.nan, 0.0), slope.T).T


def follows(q: Array) -> Array:
    """Flags of the frequencies that agree with the one before to rounding."""
    near = q[1:] - q[:-1] <= _MULTIPLE * q[1:]
    return jnp.concatenate([jnp.zeros_like(q[:1], bool), near])


def multiple(shaft: Shaft, q: Array) -> Array:
    """Flags of the frequencies that agree with a neighbour to rounding, including the one after the last."""
    after = follows(q)
    above = jnp.where((q[-1:] > 0) & jnp.isfinite(q[-1:]), q[-1:] * (1 + _MULTIPLE), 1.0)
    beyond = (q[-1:] > 0) & (_characteristic(shaft)(shaft, above).count > len(q))
    return after | jnp.concatenate([after[1:], beyond])


def relative_error(shaft: Shaft, roots: Roots) -> Array:
    """Estimated relative error of ``p = q^2``, shape ``(modes, *lanes)``.

    The same equations run from D to A round differently: how far their zero lies away shows the rounding of both. Added
    to it are the width of the bracket and the rounding of p itself.
    """
    elastic = (roots.q > 0) & jnp.isfinite(roots.q)
    safe = jnp.where(elastic, roots.q, 1.0)
    mirrored = shaft.mirrored()
    value, slope = jax.jvp(lambda q: pairings(mirrored, q), (safe,), (jnp.ones_like(safe),))
    shifts = jnp.abs(value / (slope * safe))
    shifts = jnp.where(jnp.isfinite(shifts), shifts, jnp.inf)
    # A value that is no zero belongs to a section that the mode does not reach.
    shift = jnp.where(shifts[-1] < _ZERO, shifts[-1], jnp.min(shifts, axis=0))
    # In a cluster Psi is flat, and its zero is inaccurate: use only the bracket.
    shift = jnp.where(jnp.isfinite(shift), jnp.minimum(shift, 1.0), 0.0)
    return jnp.where(elastic, 2 * shift + roots.width + 2 * np.finfo(float).eps, 0.0)


# The paper's method: the determinant of the plain transfer matrices, scanned for changes of sign.
#
#     Psi(p) = (R31 R42 - R32 R41) - k_D (R11 R32 - R12 R31),   R = R_n ... R_1 T_A
#
# Each product grows like exp(tau), tau = sum of all phases z, their difference does not: Psi loses exp(tau) in
# accuracy. At tau of about 11 pi, mode 12, all digits are gone and the scan finds roots of the rounding; at 355 it
# overflows.

POINTS_PER_MODE = 16
_BISECTIONS = 54
# Relative distance on either side of a root at which its number is counted.
_APART = 1e-7


def determinant(shaft: Shaft, q: Array) -> Array:
    """Psi at ``q = sqrt(p)``, over (1 + k_A)(1 + k_D), also in the limit of rigid supports; ``q``: ``(...,
    *lanes)``."""
    scales = Scales.from_shaft(shaft)
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


def krylov_roots(shaft: Shaft, modes: int) -> Roots:
    """The first changes of sign of the determinant as natural frequencies; NaN where the scan found too few.

    ``certified`` says whether the Wittrick-Williams count gives each its number.
    """
    total = jnp.sum(Scales.from_shaft(shaft).beta, axis=0)
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
    crossed = (number[-1] >= wanted) & (wanted > 0)
    low, high = (jnp.take_along_axis(grid, cell + shift, axis=0) for shift in (0, 1))
    sign = jnp.take_along_axis(positive, cell, axis=0)

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        same = (stored(determinant)(shaft, middle) > 0) == sign
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high))
    q = jnp.where(wanted <= 0, 0.0, jnp.where(crossed, 0.5 * (low + high), jnp.nan))
    safe = jnp.where(q > 0, q, 1.0)
    below, above = (characteristic(shaft, safe * (1 + shift)).count for shift in (-_APART, _APART))
    certified = (wanted <= 0) | (crossed & (below < index) & (above >= index))
    return Roots(q, jnp.where(q > 0, 2 * (high - low) / safe, 0.0), certified)
