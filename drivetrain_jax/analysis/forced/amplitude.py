"""Largest displacements over a period, found on every step of an adaptive integration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.forced.orbit import MAX_STEPS, Field, controller

# Fraction of a step next to its ends within which the continuous extension is as accurate as the step.
EDGE = 0.01


class _Peaks(NamedTuple):
    """State of the loop of :func:`amplitudes`: the next step ``[t0, t1]`` from ``y``, flags ``aimed`` (k,) of the components
    whose peak is at ``t1``, and the largest values so far with their times ``when``."""

    t0: Array
    t1: Array
    y: Array
    aimed: Array
    largest: Array
    when: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    made_jump: Any
    solver: Any
    control: Any


def amplitudes(
    field: Field, start: Array, period: float, indices: tuple[int, ...], rtol: float
) -> tuple[Array, Array, Array, Array]:
    """Largest ``|y_i|`` over a period for the components ``indices``, their times, the state at its end, and an ``Outcome``.

    Every accepted step of the integration is searched for a peak, so that none is missed however fast the solution
    oscillates. A step with a new largest value is repeated so that it ends at the peak: the solver's continuous extension
    is ten to a hundred times less accurate than its steps.
    """
    import diffrax

    term, control = diffrax.ODETerm(lambda t, y, _: field(t, y)), controller(period, rtol)
    # A loop over the stages that can be differentiated forwards.
    solver = diffrax.Dopri8(scan_kind="lax")
    order, fixed = solver.error_order(term), jax.lax.stop_gradient

    def unfinished(s: _Peaks) -> Array:
        return (s.t0 < period) & (s.count < MAX_STEPS) & (s.t1 > s.t0)

    def advance(s: _Peaks) -> _Peaks:
        y1, error, dense, state, _ = solver.step(term, s.t0, s.t1, s.y, None, s.solver, s.made_jump)
        # The ends of steps are not differentiated: at a peak the solution is stationary in time.
        adapted = control.adapt_step_size(s.t0, s.t1, *fixed((s.y, y1)), None, fixed(error), order, s.control)  # pyright: ignore[reportArgumentType]
        keep, t0, t1, jump, controlled, result = adapted
        # An empty step ends the loop: the controller has stopped.
        t1 = jnp.where(result == diffrax.RESULTS.successful, jnp.minimum(t1, period), t0)
        between = solver.interpolation_cls(t0=s.t0, t1=s.t1, **dense)
        found = _peaks_on_step(field, between.evaluate, s.t0, s.t1, s.y, y1, indices)
        (largest, when), aimed, nearest = _larger_peaks(s, found, keep)
        again = jnp.any(aimed)
        t0, t1 = jnp.where(again, s.t0, t0), jnp.where(again, nearest, t1)
        y, state, largest, when = jax.tree.map(
            lambda new, old: jnp.where(keep & ~again, new, old),
            (y1, state, largest, when),
            (s.y, s.solver, s.largest, s.when),
        )
        return _Peaks(t0, t1, y, aimed, largest, when, s.count + 1, jump, state, controlled)

    zero = jnp.zeros(())
    t1, controlled = control.init(term, zero, period, fixed(start), None, None, solver.func, order)
    t1 = jnp.minimum(t1, period)
    first = _at_start(t1, start, indices, solver.init(term, zero, t1, start, None), controlled)
    last = jax.lax.while_loop(unfinished, advance, first)
    stopped = jnp.where(last.count < MAX_STEPS, Outcome.NOT_FINITE, Outcome.STEP_LIMIT)
    return last.largest, last.when, last.y, jnp.where(last.t0 < period, stopped, Outcome.SUCCESS)


def _larger(best: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """The larger values of both pairs of values and times."""
    return jnp.maximum(best[0], other[0]), jnp.where(other[0] > best[0], other[1], best[1])


def _at_start(t1: Array, start: Array, indices: tuple[int, ...], solver: Any, control: Any) -> _Peaks:
    """The loop before its first step, to ``t1``."""
    largest, zero = jnp.abs(start[jnp.array(indices)]), jnp.zeros(())
    jump, count = jnp.array(False), jnp.zeros((), int)
    return _Peaks(zero, t1, start, largest < 0, largest, 0 * largest, count, jump, solver, control)


def _larger_peaks(s: _Peaks, found: _Found, keep: Any) -> tuple[tuple[Array, Array], Array, Array]:
    """Largest values and their times after an accepted step, flags of the components with the first new peak in the step,
    and the time of this peak: the step is repeated to end there."""
    largest = _larger((s.largest, s.when), (found.at_end, s.t1))
    new = keep & ~jnp.any(s.aimed) & (found.value > largest[0]) & (jnp.abs(found.place - 0.5) < 0.5 - EDGE)
    nearest = jax.lax.stop_gradient(jnp.min(jnp.where(new, found.place, 1.0)))
    place = jnp.where(s.aimed, s.t1 + found.late, s.t0 + found.place * (s.t1 - s.t0))
    largest = _larger(largest, (jnp.where(s.aimed, found.near_end, found.value), place))
    return largest, new & (found.place == nearest), s.t0 + nearest * (s.t1 - s.t0)


class _Found(NamedTuple):
    """``|y_i|`` on a step: ``at_end``, extrapolated to the peak ``near_end`` by the time ``late``, and the largest ``value``
    in between, at the fraction ``place``, or 0 if there is none."""

    at_end: Array
    near_end: Array
    late: Array
    value: Array
    place: Array


def _peaks_on_step(
    field: Field, evaluate: Callable, t0: Array, t1: Array, y0: Array, y1: Array, indices: tuple[int, ...]
) -> _Found:
    """Largest ``|y_i|`` on a step, at its end and where the derivative changes sign in between.

    A cubic through y' and y'' at both ends interpolates the derivative. The parabola y - d^2/(2 y'') removes the derivative
    d that remains at its root.
    """
    h = t1 - t0

    def derivatives(t: Array, y: Array) -> tuple[Array, Array]:
        slope = field(t, y)
        return slope, jax.jvp(field, (t, y), (jnp.ones_like(t), slope))[1]

    (slope0, curve0), (slope1, curve1) = derivatives(t0, y0), derivatives(t1, y1)

    def of(i: Array) -> _Found:
        x, inside = _cubic_root(slope0[i], slope1[i], h * curve0[i], h * curve1[i])
        y = evaluate(t0 + x * h)
        slope, curve = (d[i] for d in derivatives(t0 + x * h, y))
        value, shift = _vertex(y[i], slope, curve)
        near_end, late = _vertex(y1[i], slope1[i], curve1[i])
        between = jnp.where(inside, jnp.abs(value), 0.0), jnp.clip(x + shift / h, 0.0, 1.0)
        return _Found(jnp.abs(y1[i]), jnp.abs(near_end), late, *between)

    return jax.vmap(of)(jnp.array(indices))


def _vertex(y: Array, slope: Array, curve: Array) -> tuple[Array, Array]:
    """Value at the vertex of the parabola through a point, and the time to it; without curvature the point itself and 0."""
    shift = jnp.where(curve == 0, 0.0, -slope / jnp.where(curve == 0, 1.0, curve))
    return y + slope * shift / 2, shift


def _cubic_root(p0: Array, p1: Array, d0: Array, d1: Array) -> tuple[Array, Array]:
    """Root on [0, 1] of the cubic with end values ``p`` of opposite sign and end slopes ``d``, and True if it has one."""
    a, b = 2 * (p0 - p1) + d0 + d1, 3 * (p1 - p0) - 2 * d0 - d1
    inside = p0 * p1 < 0
    left, right = jnp.zeros_like(p0), jnp.ones_like(p0)
    x = jnp.where(inside, p0 / jnp.where(inside, p0 - p1, 1.0), 0.0)
    for _ in range(4):
        value, slope = ((a * x + b) * x + d0) * x + p0, (3 * a * x + 2 * b) * x + d0
        same = value * p0 > 0
        left, right = jnp.where(same, x, left), jnp.where(same, right, x)
        newton = x - value / jnp.where(slope == 0, jnp.inf, slope)
        x = jnp.where((newton >= left) & (newton <= right), newton, (left + right) / 2)
    return x, inside
