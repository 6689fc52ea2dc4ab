"""The oscillator with play integrated by diffrax, the rival of the closed form in the measurements.

With ``events`` the field is frozen to one linear region. The solver stops at the flank of the region, found by root finding
on the dense output, and continues in the next region. Without ``events`` the adaptive solver steps across the kinks, where
its error estimate is wrong.
"""

from __future__ import annotations

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import optimistix
from jax import Array

from drivetrain_jax.systems import PiecewiseLinearOscillator

_MOST_SEGMENTS, _LONGEST_ARC = 4096, 0.3


def _frozen(model: PiecewiseLinearOscillator, side: Array, t: Any, state: Array) -> Array:
    """The linear field of the region ``side``, continued beyond its flanks."""
    u, v = state
    spring = jnp.where(side == 0, model.alpha * u, u - side * (1 - model.alpha) * model.b)
    drive = model.B0 + model.B1 * jnp.cos(model.omega * t)
    return jnp.stack([v, drive - model.damping * v - model.stiffness * spring])


def _distance(model: PiecewiseLinearOscillator, side: Array, state: Array) -> tuple[Array, Array]:
    """Distances to the upper and the lower flank of the region, positive inside."""
    u = state[0]
    upper = jnp.where(side > 0, jnp.inf, jnp.where(side == 0, model.b, -model.b) - u)
    lower = jnp.where(side < 0, jnp.inf, u - jnp.where(side == 0, -model.b, model.b))
    return jnp.minimum(upper, 1e3), jnp.minimum(lower, 1e3)


def integrate(
    model: PiecewiseLinearOscillator, state: Array, end: Array, *, rtol: float, events: bool, max_steps: int = 100_000
) -> tuple[Array, Array]:
    """``(u, u')`` of one lane at the time ``end`` from ``state`` at 0, shape ``(2,)``, and a flag of success."""
    solver = diffrax.Dopri8()
    # Steps are short against every oscillation, because a contact that begins and ends within one step is missed.
    fastest = jnp.maximum(jnp.sqrt(model.stiffness * jnp.maximum(model.alpha, 1.0)), model.omega)
    longest = _LONGEST_ARC / fastest if events else None
    controller = diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol, dtmax=longest)
    options = {"saveat": diffrax.SaveAt(t1=True), "max_steps": max_steps, "throw": False}
    if not events:
        term = diffrax.ODETerm(lambda t, y, args: model.field(t, y))
        solution = diffrax.diffeqsolve(term, solver, 0.0, end, None, state, stepsize_controller=controller, **options)
        return solution.ys[0], solution.result == diffrax.RESULTS.successful
    term = diffrax.ODETerm(lambda t, y, side: _frozen(model, side, t, y))
    event = diffrax.Event(
        tuple(lambda t, y, args, k=k, **_: _distance(model, args, y)[k] for k in (0, 1)),
        optimistix.Newton(1e-12, 1e-12),
        direction=(False, False),
    )

    def segment(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, state, side, count = carry
        solution = diffrax.diffeqsolve(
            term, solver, t, end, None, state, side, stepsize_controller=controller, event=event, **options
        )
        upper, lower = solution.event_mask
        there = solution.ys[0]
        moved = jnp.clip(side + jnp.where(upper, 1.0, jnp.where(lower, -1.0, 0.0)), -1.0, 1.0)
        flank = jnp.where(jnp.where(upper, moved > 0, side > 0), model.b, -model.b)
        there = there.at[0].set(jnp.where(upper | lower, flank, there[0]))
        failed = ~(solution.result == diffrax.RESULTS.successful) & ~(upper | lower)
        return jnp.where(failed, jnp.nan, solution.ts[0]), there, moved, count + 1

    def going(carry: tuple[Array, Array, Array, Array]) -> Array:
        return (carry[0] < end) & (carry[3] < _MOST_SEGMENTS)

    side = jnp.where(state[0] > model.b, 1.0, jnp.where(state[0] < -model.b, -1.0, 0.0))
    t, there, _, _ = jax.lax.while_loop(going, segment, (jnp.zeros_like(end), state, side, jnp.asarray(0)))
    return there, t >= end
