"""Largest displacements over a period, found on every step of an adaptive integration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.periodic.orbit import MAX_STEPS, Field, controller


class _Peaks(NamedTuple):
    """State of the loop of :func:`amplitudes`: the step ``[t0, t1]`` to try from ``y`` and the largest so far."""

    t0: Array
    t1: Array
    y: Array
    largest: Array
    count: Array
    made_jump: Any
    solver: Any
    control: Any


def amplitudes(
    field: Field, start: Array, period: float, indices: tuple[int, ...], rtol: float
) -> tuple[Array, Array, Array]:
    """Largest ``|y_i|`` over a period for the components ``indices``, the state at its end, and an ``Outcome``.

    Every accepted step of the integration is searched for a peak, so that none is missed however fast the solution
    oscillates; the error is that of the solver's continuous extension, about ``rtol`` for a state of order one.
    """
    import diffrax

    term, solver, control = diffrax.ODETerm(lambda t, y, _: field(t, y)), diffrax.Dopri8(), controller(period, rtol)
    order = solver.error_order(term)

    def unfinished(s: _Peaks) -> Array:
        return (s.t0 < period) & (s.count < MAX_STEPS) & (s.t1 > s.t0)

    def advance(s: _Peaks) -> _Peaks:
        y1, error, dense, state, _ = solver.step(term, s.t0, s.t1, s.y, None, s.solver, s.made_jump)
        adapted = control.adapt_step_size(s.t0, s.t1, s.y, y1, None, error, order, s.control)
        keep, t0, t1, jump, controlled, result = adapted
        between = solver.interpolation_cls(t0=s.t0, t1=s.t1, **dense)
        largest = jnp.maximum(s.largest, _largest_on_step(field, between.evaluate, s.t0, s.t1, s.y, y1, indices))
        y, state, largest = jax.tree.map(
            lambda new, old: jnp.where(keep, new, old), (y1, state, largest), (s.y, s.solver, s.largest)
        )
        # An empty step ends the loop: the controller has given up.
        t1 = jnp.where(result == diffrax.RESULTS.successful, jnp.minimum(t1, period), t0)
        return _Peaks(t0, t1, y, largest, s.count + 1, jump, state, controlled)

    zero = jnp.zeros(())
    t1, controlled = control.init(term, zero, period, start, None, None, solver.func, order)
    t1 = jnp.minimum(t1, period)
    state = solver.init(term, zero, t1, start, None)
    largest, jump = jnp.abs(start[jnp.array(indices)]), jnp.array(False)
    first = _Peaks(zero, t1, start, largest, jnp.zeros((), int), jump, state, controlled)
    last = jax.lax.while_loop(unfinished, advance, first)
    stopped = jnp.where(last.count < MAX_STEPS, Outcome.NOT_FINITE, Outcome.STEP_LIMIT)
    return last.largest, last.y, jnp.where(last.t0 < period, stopped, Outcome.SUCCESS)


def _largest_on_step(
    field: Field, evaluate: Callable, t0: Array, t1: Array, y0: Array, y1: Array, indices: tuple[int, ...]
) -> Array:
    """Largest ``|y_i|`` on a step, at its end or where the derivative changes sign in between.

    The derivative is taken as a cubic from y' and y'' at both ends; what this leaves at the point found, y' = d, is
    removed by the parabola y - d^2/(2 y'').
    """
    h = t1 - t0

    def derivatives(t: Array, y: Array) -> tuple[Array, Array]:
        slope = field(t, y)
        return slope, jax.jvp(field, (t, y), (jnp.ones_like(t), slope))[1]

    slopes, curves = zip(derivatives(t0, y0), derivatives(t1, y1), strict=True)
    largest = []
    for i in indices:
        x, inside = _cubic_root(slopes[0][i], slopes[1][i], h * curves[0][i], h * curves[1][i])
        y = evaluate(t0 + x * h)
        slope, curve = (d[i] for d in derivatives(t0 + x * h, y))
        correction = jnp.where(curve == 0, 0.0, slope**2 / (2 * jnp.where(curve == 0, 1.0, curve)))
        largest.append(jnp.where(inside, jnp.abs(y[i] - correction), 0.0))
    return jnp.maximum(jnp.stack(largest), jnp.abs(y1[jnp.array(indices)]))


def _cubic_root(p0: Array, p1: Array, d0: Array, d1: Array) -> tuple[Array, Array]:
    """Root on [0, 1] of the cubic with end values ``p`` of opposite sign and end slopes ``d``; whether there is one."""
    a, b = 2 * (p0 - p1) + d0 + d1, 3 * (p1 - p0) - 2 * d0 - d1
    inside = p0 * p1 < 0
    left, right = jnp.zeros_like(p0), jnp.ones_like(p0)
    x = jnp.where(inside, p0 / jnp.where(inside, p0 - p1, 1.0), 0.0)
    for _ in range(4):
        value, slope = ((a * x + b) * x + d0) * x + p0, (3 * a * x + 2 * b) * x + d0
        same = value * p0 > 0
        left, right = jnp.where(same, x, left), jnp.where(same, right, x)
        newton = x - value / jnp.where(slope == 0, jnp.inf, slope)
        x = jnp.where((newton > left) & (newton < right), newton, (left + right) / 2)
    return x, inside
