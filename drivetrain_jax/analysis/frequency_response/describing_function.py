"""Bias and fundamental of the oscillator with play, ``u = m + A cos(omega t - phi)``, by its describing function.

With ``p = (b - m)/A``, ``q = (b + m)/A`` and the :func:`moments` h0, h1 of a clipped cosine, balance of mean and
fundamental gives, in units of ``k' = k/I`` and ``c' = c/I``,

    alpha m + (1 - alpha) A [h0(p) - h0(q)] = B0/k'                         the bias m(A), monotone in m
    kappa(A) = k' [alpha + (1 - alpha) (h1(p) + h1(q))]                     the equivalent stiffness
    [(kappa - omega^2)^2 + (c' omega)^2] A^2 = B1^2                         the response

For a given A the response is quadratic in omega^2: two arms ``omega^2 = kappa - c'^2/2 -+ sqrt(B1^2/A^2 - c'^2 kappa +
c'^4/4)`` that meet at the peak, on either side of the backbone ``omega^2 = kappa``. Folds are turning points of the arms.
With heavy damping (``kappa < c'^2/2``) the arms meet at no real frequency: the upper arm then ends at omega = 0, with the
largest amplitude, the static one ``kappa A = B1``.
The approximation is the harmonic balance with one harmonic and exact integrals. All functions broadcast over a trailing
batch; ``A`` may have more leading axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.continuation import bisect, first_marks, sign_changes
from drivetrain_jax.systems import PiecewiseLinearOscillator

# Stationary amplitudes of one-term approximations: all amplitudes at a frequency, and those of a slow sweep.
#
# Both closed-form approximations of a forced oscillator end in one equation for the amplitude A of the fundamental,
# ``residual(A, omega) = 0``. The residual is negative at A = 0 and positive for large A. The averaged amplitude grows
# where the residual is negative and falls where it is positive: the first, third, ... root is stable, every second root
# a saddle. Arrays have the batch as their trailing axes ``(...)``.


def refined(omega: np.ndarray, largest: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rising frequencies that contain ``omega``, and the position of each entry of ``omega`` in them.

    Steps are at most the fraction ``largest`` of the frequency, with at most ``most`` parts of one interval.
    """
    rising = np.unique(omega)
    ratio = np.log(rising[1:] / rising[:-1])
    parts = np.clip(np.ceil(ratio / largest), 1, most).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(rising[:-1], rising[1:], parts, strict=True)]
    fine = np.concatenate([*pieces, rising[-1:]])
    return fine, np.searchsorted(fine, omega)


def take(mask: Array, values: Array, missing: float = np.nan) -> Array:
    """The entry of ``values`` (K, ...) that each row of ``mask`` (n, K, ...) marks; ``missing`` where it marks none."""
    picked = jnp.sum(jnp.where(mask, values, 0.0), axis=1)
    return jnp.where(jnp.any(mask, axis=1), picked, missing)


def follow(roots: Array) -> Array:
    """Indices of the roots of a sweep up and a sweep down, ``(L, K, ...) -> (L, 2, ...)``.

    ``roots`` rise along K and are padded with infinity; frequencies rise along L. A sweep starts from rest. Between folds
    the number of roots is constant, and the sweep keeps its position among them, even on steep branches. At the first
    frequency past a fold the amplitude changes like the averaged motion: to the next root above if the residual at the old
    amplitude is negative, to the next root below if it is positive.
    """
    size = roots.shape[1]

    def move(state: tuple[Array, Array, Array], at: Array) -> tuple[tuple[Array, Array, Array], Array]:
        amplitude, place, before = state
        below = jnp.sum(at < amplitude, axis=0)
        number = jnp.sum(jnp.isfinite(at), axis=0)
        index = jnp.where(number == before, place, jnp.minimum(2 * (below // 2), size - 1))
        reached = jnp.take_along_axis(at, index[None], axis=0)[0]
        return (jnp.where(jnp.isfinite(reached), reached, amplitude), index, number), index

    nowhere = jnp.zeros_like(jnp.sum(jnp.isfinite(roots[0]), axis=0))
    rest = (jnp.zeros_like(roots[0, 0]), nowhere, nowhere)
    up = jax.lax.scan(move, rest, roots)[1]
    down = jax.lax.scan(move, rest, roots, reverse=True)[1]
    return jnp.stack([up, down], axis=1)


# Bias and equivalent stiffness at an amplitude.

_BIAS_STEPS = 24


class Point(NamedTuple):
    """Bias ``m``, equivalent stiffness ``kappa`` and its derivative with respect to the amplitude."""

    bias: Array
    stiffness: Array
    slope: Array


def moments(x: Array) -> tuple[Array, Array]:
    """Mean h0 and half the fundamental h1 of the part of a cosine above ``x``.

    ``h0 = (sqrt(1 - x^2) - x acos x)/pi`` (``-x`` for x <= -1, 0 for x >= 1), ``h1 = (acos x - x sqrt(1 - x^2))/pi``.
    """
    inside = jnp.clip(x, -1.0, 1.0)
    root, angle = jnp.sqrt(1 - inside**2), jnp.arccos(inside)
    return (root - inside * angle) / jnp.pi + jnp.maximum(-1 - x, 0.0), (angle - inside * root) / jnp.pi


def imbalance(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> tuple[Array, Array]:
    """Mean force minus mean drive, over k', and its derivative with respect to the bias (not negative)."""
    p, q = (model.b - bias) / amplitude, (model.b + bias) / amplitude
    beyond, before = moments(p)[0], moments(q)[0]
    force = model.alpha * bias + (1 - model.alpha) * amplitude * (beyond - before)
    share = (jnp.arccos(jnp.clip(p, -1.0, 1.0)) + jnp.arccos(jnp.clip(q, -1.0, 1.0))) / jnp.pi
    return force - model.B0 / model.stiffness, model.alpha + (1 - model.alpha) * share


def improved(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> Array:
    """Bias after one Newton step; unchanged where the mean force does not depend on the bias (free within the play)."""
    value, slope = imbalance(model, amplitude, bias)
    return bias - jnp.where(slope > 0, value / jnp.where(slope > 0, slope, 1.0), 0.0)


def bias_of(model: PiecewiseLinearOscillator, amplitude: Array) -> Array:
    """The bias at which the mean force balances the mean drive: bisection and Newton steps in turn."""
    static, reach = model.B0 / model.stiffness, jnp.abs(1 - model.alpha) * model.b
    reach = reach + jnp.zeros_like(amplitude)

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, guess = state
        for trial in (guess, (low + high) / 2):
            value = imbalance(model, amplitude, trial)[0]
            low = jnp.where((value <= 0) & (trial > low), trial, low)
            high = jnp.where((value >= 0) & (trial < high), trial, high)
        return low, high, jnp.clip(improved(model, amplitude, (low + high) / 2), low, high)

    low, high, guess = jax.lax.fori_loop(0, _BIAS_STEPS, step, (static - reach, static + reach, static + 0 * reach))
    return jnp.clip(improved(model, amplitude, guess), low, high)


def point_at(model: PiecewiseLinearOscillator, amplitude: Array, bias: Array) -> Point:
    """Equivalent stiffness at a balanced ``bias``, and its total derivative along the bias curve m(A)."""
    p, q = (model.b - bias) / amplitude, (model.b + bias) / amplitude
    inside = tuple(jnp.clip(x, -1.0, 1.0) for x in (p, q))
    root_p, root_q = (jnp.sqrt(1 - x**2) for x in inside)
    soft = 1 - model.alpha
    stiffness = model.stiffness * (model.alpha + soft * (moments(p)[1] + moments(q)[1]))
    support = imbalance(model, amplitude, bias)[1]
    drift = soft * (root_q - root_p) / jnp.pi / jnp.where(support > 0, support, 1.0)
    turn = root_p * (drift + p) + root_q * (q - drift)
    slope = model.stiffness * soft * 2 / jnp.pi * turn / amplitude
    return Point(bias, stiffness, slope)


# Sampling of the arms to find their folds: number of logarithmic amplitudes, and their limits in units of the size of the
# motions; beyond the limits the arms have no folds. _HUGE: amplitude, in the same unit, that counts as infinite.
_NODES, _NEAR, _FAR, _HUGE = 320, 1e-9, 1e4, 1e9
_FOLDS_PER_ARM = 4
MOST_ROOTS = 5
_HALVINGS, _POLISH_STEPS = 20, 8
_TINY = 1e-300
_ENDS = (slice(None, -1), slice(1, None))


def _discriminant(model: PiecewiseLinearOscillator, amplitude: Array, stiffness: Array) -> Array:
    return (model.B1 / amplitude) ** 2 - model.damping**2 * stiffness + model.damping**4 / 4


def arm_slope(model: PiecewiseLinearOscillator, amplitude: Array, point: Point, sign: float) -> Array:
    """``d(omega^2)/dA`` along an arm, times the square root in its equation; zero at a fold."""
    root = jnp.sqrt(jnp.maximum(_discriminant(model, amplitude, point.stiffness), 0.0))
    half = -((model.B1 / amplitude) ** 2) / amplitude - model.damping**2 * point.slope / 2
    return point.slope * root + sign * half


def arm(model: PiecewiseLinearOscillator, amplitude: Array, point: Point, sign: float) -> Array:
    """Frequency on an arm; NaN where it does not exist."""
    square = point.stiffness - model.damping**2 / 2 + sign * jnp.sqrt(_discriminant(model, amplitude, point.stiffness))
    return jnp.sqrt(square)


def _length(model: PiecewiseLinearOscillator) -> Array:
    """A positive length of the size of the motions: half the play plus the displacements under static drives."""
    length = model.b + (jnp.abs(model.B0) + jnp.abs(model.B1)) / model.stiffness
    return jnp.where(length > 0, length, 1.0)


def peak(model: PiecewiseLinearOscillator, shape: tuple[int, ...]) -> Array:
    """Largest amplitude over all frequencies; a huge number if amplitudes are unbounded.

    At the peak the minimum of the response equation over all frequencies vanishes. The arms meet there or, with heavier
    damping, the peak is the static amplitude at the frequency 0. The minimum rises with the amplitude, because ``kappa A``
    does.
    """
    unit = _length(model)

    def beyond(log_amplitude: Array) -> Array:
        amplitude = unit * jnp.exp(log_amplitude)
        stiffness = point_at(model, amplitude, bias_of(model, amplitude)).stiffness
        return response_residual(model, _resonance(model, stiffness), amplitude, stiffness)

    # The unit only centres the bracket.
    span = jnp.full(shape, 60.0)
    return unit * jnp.exp(bisect(beyond, -span, span))


def _resonance(model: PiecewiseLinearOscillator, stiffness: Array) -> Array:
    """Frequency at which the response equation has its minimum for an amplitude; 0 with heavy damping."""
    return jnp.sqrt(jnp.maximum(stiffness - model.damping**2 / 2, 0.0))


class Skeleton(NamedTuple):
    """The part of the response that does not depend on the frequency.

    ``amplitudes`` (K, ...) rise from 0 to the ``peak``, with the ``points`` and the ``arms`` (omega^2 of the lower and of
    the upper arm) at each amplitude. Both arms are monotone between neighbours. ``folds`` (8, ...) are amplitudes, NaN
    after the last fold. Amplitudes beyond ``limit`` count as infinite.
    """

    amplitudes: Array
    points: Point
    arms: tuple[Array, Array]
    peak: Array
    folds: Array
    limit: Array


def _nodes(model: PiecewiseLinearOscillator, end: Array, far: float = _FAR) -> Array:
    """Rising amplitudes from the first contact with a flank to ``end``, logarithmic up to ``far`` sizes of the motions.

    Below the first contact of the motion about the static position the oscillator is linear.
    """
    unit, force, play = _length(model), jnp.abs(model.B0) / model.stiffness, model.alpha * model.b
    within = model.b - force / jnp.where(model.alpha > 0, model.alpha, 1.0)
    last = jnp.minimum(end, far * unit)
    first = jnp.clip(jnp.where(force <= play, within, force - play), _NEAR * unit, last / 2)
    part = jnp.linspace(0.0, 1.0, _NODES).reshape(_NODES, *(1,) * end.ndim)
    return jnp.concatenate([first * (last / first) ** part[:-1], last[None], end[None]])


def skeleton(model: PiecewiseLinearOscillator, shape: tuple[int, ...]) -> Skeleton:
    """The arms of a batch of ``shape``, with their folds."""
    top, limit = peak(model, shape), _HUGE * _length(model)
    end = jnp.minimum(top, limit)
    nodes = _nodes(model, end)
    points = point_at(model, nodes, bias_of(model, nodes))
    meet = (nodes >= top) & (_resonance(model, points.stiffness) > 0)
    folds = []
    for sign in (-1.0, 1.0):
        slope = arm_slope(model, nodes, points, sign)
        # The root vanishes where the arms meet: use the sign of the other term, to avoid rounding.
        slope = jnp.where(meet, -sign, slope)
        mask = sign_changes(slope > 0, _FOLDS_PER_ARM)
        low, high, start = take(mask, nodes[:-1]), take(mask, nodes[1:]), take(mask, slope[:-1])
        turned = jnp.where(start > 0, -1.0, 1.0)

        def uphill(amplitude: Array, sign: float = sign, turned: Array = turned) -> Array:
            point = point_at(model, amplitude, bias_of(model, amplitude))
            return turned * arm_slope(model, amplitude, point, sign)

        folds.append(bisect(uphill, low, high, 45))
    turning = jnp.concatenate(folds)
    amplitudes = jnp.sort(jnp.concatenate([nodes, jnp.where(jnp.isnan(turning), end, turning)]), axis=0)
    amplitudes = jnp.concatenate([jnp.zeros((1, *shape)), amplitudes])
    safe = jnp.maximum(amplitudes, _TINY)
    points = point_at(model, safe, bias_of(model, safe))
    centre = points.stiffness - model.damping**2 / 2
    half = jnp.sqrt(jnp.maximum(_discriminant(model, safe, points.stiffness), 0.0))
    half = jnp.where((safe >= top) & (_resonance(model, points.stiffness) > 0), 0.0, half)
    # The amplitude 0 lies below every solution, also without a drive.
    half = half.at[0].set(jnp.inf)
    return Skeleton(amplitudes, points, (centre - half, centre + half), top, turning, limit)


def peak_of(model: PiecewiseLinearOscillator, bones: Skeleton) -> tuple[Array, Array]:
    """Largest amplitude (infinite without damping) and its frequency ``sqrt(kappa - c'^2/2)``.

    With damping too heavy for a resonance, the static amplitude and the frequency 0.
    """
    point = point_at(model, bones.peak, bias_of(model, bones.peak))
    amplitude = jnp.where(bones.peak < bones.limit, bones.peak, jnp.inf)
    return jnp.where(model.B1 == 0, 0.0, amplitude), _resonance(model, point.stiffness)


def fold_frequencies(model: PiecewiseLinearOscillator, bones: Skeleton) -> Array:
    """Frequencies of the folds, ``(2 n, ...)``: first of the lower arm, then of the upper arm."""
    half = bones.folds.shape[0] // 2
    point = point_at(model, bones.folds, bias_of(model, bones.folds))
    sides = [arm(model, bones.folds, point, sign) for sign in (-1.0, 1.0)]
    return jnp.concatenate([sides[0][:half], sides[1][half:]])


def backbone(model: PiecewiseLinearOscillator, shape: tuple[int, ...], omega: Array) -> Array:
    """Largest amplitude of the undamped, undriven motion of each frequency ``(L,)``, ``kappa(A) = omega^2``, ``(L, ...)``.

    NaN if no motion has the frequency, as beyond the limit frequency of large motions. The backbone does not depend on the
    drive, and continues beyond the peak.
    """
    free = replace(model, B1=0.0)
    amplitudes = _nodes(free, jnp.broadcast_to(_HUGE * _length(free), shape), _HUGE)
    points = point_at(free, amplitudes, bias_of(free, amplitudes))

    def largest(omega: Array) -> Array:
        above = points.stiffness > omega**2
        mask = sign_changes(above[::-1], 1)[:, ::-1]
        low, high, stiffness = _interpolated(amplitudes, points, mask)
        rising = jnp.where(take(mask, above[1:], 1.0) > 0, 1.0, -1.0)
        amplitude_at = bisect(lambda a: rising * (stiffness(a) - omega**2), low, high, _HALVINGS)
        bias = _bias_between(points, mask, (amplitude_at - low) / (high - low))

        def polish(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
            amplitude, bias = state
            bias = improved(free, amplitude, bias)
            point = point_at(free, amplitude, bias)
            return jnp.clip(amplitude - (point.stiffness - omega**2) / point.slope, low, high), bias

        return jax.lax.fori_loop(0, _POLISH_STEPS, polish, (amplitude_at, bias))[0][0]

    return jax.lax.map(largest, omega)


def response_residual(model: PiecewiseLinearOscillator, omega: Array, amplitude: Array, stiffness: Array) -> Array:
    """``[(kappa - omega^2)^2 + (c' omega)^2] A^2 - B1^2``."""
    return ((stiffness - omega**2) ** 2 + (model.damping * omega) ** 2) * amplitude**2 - model.B1**2


def _interpolated(amplitudes: Array, points: Point, mask: Array) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Ends of the bracket marked by ``mask``, and its equivalent stiffness as a cubic through values and slopes."""
    low, high = take(mask, amplitudes[:-1]), take(mask, amplitudes[1:])
    ends = [take(mask, part[s]) for part in (points.stiffness, points.slope) for s in _ENDS]
    k0, k1, d0, d1 = ends
    width = high - low

    def stiffness(amplitude: Array) -> Array:
        s = (amplitude - low) / width
        bend = (1 - s) * (d0 * width - (k1 - k0)) + s * ((k1 - k0) - d1 * width)
        return k0 + s * (k1 - k0) + s * (1 - s) * bend

    return low, high, stiffness


def _bias_between(points: Point, mask: Array, part: Array) -> Array:
    """Bias at the fraction ``part`` of the bracket marked by ``mask``, by linear interpolation."""
    first, last = (take(mask, points.bias[s]) for s in _ENDS)
    return first + (last - first) * part


def _arm_gap(
    model: PiecewiseLinearOscillator, square: Array, amplitude: Array, stiffness: Array, sign: Array
) -> tuple[Array, Array]:
    """``omega^2`` minus the value of the arm at an amplitude, and half the distance of the arms."""
    half = jnp.sqrt(jnp.maximum(_discriminant(model, amplitude, stiffness), 0.0))
    return square - stiffness + model.damping**2 / 2 - sign * half, half


def _brackets(bones: Skeleton, square: Array) -> tuple[Array, Array, Array]:
    """Mask of the intervals of the skeleton where an arm crosses ``omega^2``, the arm (-1 or 1), and a sign.

    The last result is the sign of the slope of the gap (:func:`_arm_gap`) between ``omega^2`` and the arm.
    The arms are separate: at light damping both may cross a frequency between the same two amplitudes.
    """
    lower, upper = bones.arms
    # At the peak, where the arms meet, exactly one condition holds.
    crossed = jnp.stack([lower >= square, upper < square], axis=1)
    changes = crossed[1:] != crossed[:-1]
    both = first_marks(changes.reshape(-1, *changes.shape[2:]), MOST_ROOTS)
    both = both.reshape(MOST_ROOTS, *changes.shape)
    sign = jnp.where(jnp.any(both[:, :, 1], axis=1), 1.0, -1.0)
    becomes = jnp.any(both & crossed[1:], axis=(1, 2))
    return jnp.any(both, axis=2), sign, jnp.where(becomes, sign, -sign)


def roots(model: PiecewiseLinearOscillator, bones: Skeleton, omega: Array) -> tuple[Array, Point]:
    """All amplitudes at one frequency, rising, ``(MOST_ROOTS, ...)``, infinite after the last one, and their points."""
    square = omega**2
    mask, sign, turned = _brackets(bones, square)
    low, high, stiffness = _interpolated(bones.amplitudes, bones.points, mask)

    def above(amplitude: Array) -> Array:
        return turned * _arm_gap(model, square, amplitude, stiffness(amplitude), sign)[0]

    amplitude_near = jnp.maximum(bisect(above, low, high, _HALVINGS), _TINY)
    bias = _bias_between(bones.points, mask, (amplitude_near - low) / jnp.where(high > low, high - low, 1.0))
    bias = improved(model, amplitude_near, bias)

    def polish(_: int, state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, amplitude, bias = state
        bias = improved(model, amplitude, bias)
        point = point_at(model, amplitude, bias)
        gap, half = _arm_gap(model, square, amplitude, point.stiffness, sign)
        beyond = turned * gap > 0
        low, high = jnp.where(beyond, low, amplitude), jnp.where(beyond, amplitude, high)
        bend = model.B1**2 / amplitude**3 + model.damping**2 * point.slope / 2
        slope = -point.slope + sign * bend / jnp.maximum(half, _TINY)
        trial = amplitude - gap / jnp.where(slope != 0, slope, jnp.inf)
        # Rounding may put converged iterates just outside the bracket.
        slack = 4e-16 * amplitude
        inside = (trial >= low - slack) & (trial <= high + slack)
        return low, high, jnp.maximum(jnp.where(inside, trial, (low + high) / 2), _TINY), bias

    _, _, amplitude_near, bias = jax.lax.fori_loop(0, _POLISH_STEPS, polish, (low, high, amplitude_near, bias))
    exists = jnp.any(mask, axis=1) & (amplitude_near < bones.limit)
    order = jnp.argsort(jnp.where(exists, amplitude_near, jnp.inf), axis=0)
    amplitude_near, bias, exists = (jnp.take_along_axis(part, order, axis=0) for part in (amplitude_near, bias, exists))
    point = point_at(model, amplitude_near, improved(model, amplitude_near, bias))
    # Without drive the only motion is rest.
    driven = model.B1 != 0
    number = jnp.arange(MOST_ROOTS).reshape(-1, *(1,) * (amplitude_near.ndim - 1))
    amplitude = jnp.where(driven, amplitude_near, 0.0)
    return jnp.where(exists & (driven | (number == 0)), amplitude, jnp.inf), point


def decay_rate(model: PiecewiseLinearOscillator, omega: Array, amplitude: Array, point: Point) -> Array:
    """Largest real part of the eigenvalues ``-c'/2 -+ sqrt(-D (D + A D'))``, D = (omega^2 - kappa)/(2 omega)."""
    detuning = (omega**2 - point.stiffness) / (2 * omega)
    product = detuning * (detuning - amplitude * point.slope / (2 * omega))
    return -model.damping / 2 + jnp.sqrt(jnp.maximum(-product, 0.0))


def phase_lag(model: PiecewiseLinearOscillator, omega: Array, point: Point) -> Array:
    """``phi``: tan(phi) = c' omega/(kappa - omega^2)."""
    return jnp.arctan2(model.damping * omega * jnp.ones_like(point.stiffness), point.stiffness - omega**2)
