"""Trajectories of a flow and of vectors tangent to them, by equal steps of the explicit scheme of order 8 (DOP853).

A state is a tuple of components, each of the shape of the batch: XLA then fuses whole stages over the batch. Time
enters through :meth:`Flow.angles` of a counted strobe, so that nothing drifts however long the march is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from scipy.integrate import DOP853

from drivetrain_jax.systems import Flow

Vector = tuple[Array, ...]


class Frame(NamedTuple):
    """A point of a trajectory, tangent vectors there, and the integral of the divergence since some time."""

    state: Vector
    tangents: tuple[Vector, ...] = ()
    contraction: Array | None = None


def batch_shape(flow: Flow) -> tuple[int, ...]:
    """Shape of the batch that the parameters of ``flow`` span."""
    rates = jax.eval_shape(lambda: [jnp.asarray(r) for r in flow.field(flow.angles(0, 0.0), flow.start)])
    shapes = [jnp.shape(x) for x in (*flow.start, flow.period, *flow.turns)]
    return jnp.broadcast_shapes(*(r.shape for r in rates), *shapes)


def initial_state(flow: Flow) -> Vector:
    """``flow.start`` as arrays of the shape of the batch."""
    shape = batch_shape(flow)
    return tuple(jnp.broadcast_to(jnp.asarray(x, float), shape) for x in flow.start)


def initial_frame(flow: Flow) -> Frame:
    """The initial state and unit vectors along every component that is not a phase.

    Displacements that leave the phases alone stay so: their exponents are those of the flow without the zeros that the
    phases supply.
    """
    state = initial_state(flow)
    zero = jnp.zeros_like(state[0])
    moving = [i for i in range(flow.size) if i not in flow.phases]
    return Frame(state, tuple(tuple(zero + float(i == j) for i in range(flow.size)) for j in moving), zero)


def strobe_map(flow: Flow, steps: Any) -> Callable[[Array, Frame], Frame]:
    """The map ``(strobe, frame) -> frame one strobe later`` by ``steps`` equal steps (an integer, may be traced).

    ``y' = f(t, y)``, ``v' = (df/dy) v`` for every tangent vector (products with the Jacobian by forward
    differentiation) and, if the frame carries it, the integral of ``div f``.
    """
    h = flow.period / steps

    def advance(strobe: Array, frame: Frame) -> Frame:
        def step(i: Array, frame: Frame) -> Frame:
            return _step(flow, lambda c: flow.angles(strobe, (i + c) / steps), h, frame)

        return jax.lax.fori_loop(0, steps, step, frame)

    return advance


def _step(flow: Flow, angles: Callable[[float], tuple], h: Any, frame: Frame) -> Frame:
    """One step of DOP853 for everything that the frame carries."""
    rows = [frame.state, *frame.tangents]
    slopes: list[list[Vector]] = []
    gathered = frame.contraction
    for stage, (c, b) in enumerate(zip(DOP853.C, DOP853.B, strict=True)):
        at = [_advanced(row, h, DOP853.A[stage, :stage], [s[k] for s in slopes]) for k, row in enumerate(rows)]
        clocks = angles(float(c))
        slopes.append(_slopes(flow, clocks, at))
        if gathered is not None and b != 0:
            gathered = gathered + h * float(b) * divergence(flow, clocks, at[0])
    state, *tangents = (_advanced(row, h, DOP853.B, [s[k] for s in slopes]) for k, row in enumerate(rows))
    return Frame(state, tuple(tangents), gathered)


def _advanced(row: Vector, h: Any, weights: Any, slopes: list[Vector]) -> Vector:
    """``row + h sum(weights * slopes)``, component by component."""
    terms = [(float(w), slope) for w, slope in zip(weights, slopes, strict=True) if w != 0]
    if not terms:
        return row
    return tuple(x + h * sum(w * slope[i] for w, slope in terms) for i, x in enumerate(row))


def _field(flow: Flow, angles: tuple, shape: tuple[int, ...]) -> Callable[..., Vector]:
    def field(*y: Array) -> Vector:
        return tuple(jnp.broadcast_to(jnp.asarray(rate, float), shape) for rate in flow.field(angles, y))

    return field


def _slopes(flow: Flow, angles: tuple, rows: list[Vector]) -> list[Vector]:
    """Derivatives of the state ``rows[0]`` and of the tangent vectors ``rows[1:]``."""
    field = _field(flow, angles, rows[0][0].shape)
    if len(rows) == 1:
        return [field(*rows[0])]
    rates, push = jax.linearize(field, *rows[0])
    return [rates, *(push(*row) for row in rows[1:])]


def divergence(flow: Flow, angles: tuple, y: Vector) -> Array:
    """Trace of the field's Jacobian at ``y``: the closed form of the flow, or by forward differentiation."""
    if flow.divergence is not None:
        return jnp.asarray(flow.divergence(angles, y), float)
    _, push = jax.linearize(_field(flow, angles, y[0].shape), *y)
    zero = jnp.zeros_like(y[0])
    return sum(push(*(zero + float(i == j) for i in range(flow.size)))[j] for j in range(flow.size))


def orthonormal(vectors: tuple[Vector, ...]) -> tuple[tuple[Vector, ...], Array]:
    """Modified Gram-Schmidt: orthonormal vectors and the logarithms of the lengths, shape ``(len(vectors), ...)``."""
    basis: list[Vector] = []
    logs = []
    for vector in vectors:
        for unit in basis:
            along = sum(a * b for a, b in zip(unit, vector, strict=True))
            vector = tuple(b - along * a for a, b in zip(unit, vector, strict=True))
        length = jnp.sqrt(sum(a * a for a in vector))
        basis.append(tuple(a / length for a in vector))
        logs.append(jnp.log(length))
    return tuple(basis), jnp.stack(logs)
