"""Trajectories of a flow and of tangent vectors, by equal steps of the explicit scheme of order 8 (DOP853).

A state is a tuple of components, each of the shape of the batch. The results of a stage are stored before the next stage
begins (see :mod:`~drivetrain_jax.analysis.numerics.kernels`); for batches of 32 to 64 members they fit into the innermost
caches. Time enters through :meth:`Flow.angles` of a counted strobe, so the angles do not drift in a long march.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel
from drivetrain_jax.systems import Flow

Vector = tuple[Array, ...]


class Frame(NamedTuple):
    """A point of a trajectory, its tangent vectors, and the integral of the divergence since a chosen time.

    ``tangents``: components of the m vectors, each ``(m, ...)``; () if there are none.
    """

    state: Vector
    tangents: Vector = ()
    contraction: Array | None = None


def batch_shape(flow: Flow) -> tuple[int, ...]:
    """Shape of the batch: the common shape of the parameters of ``flow``."""
    rates = jax.eval_shape(lambda: [jnp.asarray(r) for r in flow.field(flow.angles(0, 0.0), flow.start)])
    shapes = [jnp.shape(x) for x in (*flow.start, flow.period, *flow.turns)]
    return jnp.broadcast_shapes(*(r.shape for r in rates), *shapes)  # pyright: ignore[reportReturnType]


def initial_state(flow: Flow) -> Vector:
    """``flow.start`` as arrays in the shape of the batch."""
    shape = batch_shape(flow)
    return tuple(jnp.broadcast_to(jnp.asarray(x, float), shape) for x in flow.start)


def initial_frame(flow: Flow) -> Frame:
    """The initial state and unit vectors along every component that is not a phase.

    A displacement that starts without a phase component never gets one. The exponents are therefore those of the flow
    without the zeros of its phases.
    """
    state = initial_state(flow)
    moving = jnp.array([i for i in range(flow.size) if i not in flow.phases])
    units = (moving[:, None] == jnp.arange(flow.size)).astype(float).T
    shape = (len(moving), *state[0].shape)
    tangents = (jnp.broadcast_to(u.reshape(-1, *(1,) * state[0].ndim), shape) for u in units)
    return Frame(state, tuple(tangents), jnp.zeros_like(state[0]))


def one_kernel(flow: Flow) -> Callable[[Callable], Callable]:
    """:func:`in_one_kernel` for a march of ``flow``, or the identity if the field has unsuitable operations."""

    def rates(y: Vector) -> Any:
        angles = flow.angles(0, 0.0)
        return flow.field(angles, y), divergence(flow, angles, y)

    return in_one_kernel if suits_one_kernel(rates, initial_state(flow)) else lambda function: function


def strobe_map(flow: Flow, steps: Any) -> Callable[..., Frame]:
    """The map ``(strobe, frame) -> frame one strobe later`` by ``steps`` equal steps (an integer, may be traced).

    The map ``(strobe, frame, first, last)`` makes only the steps ``first`` to ``last - 1``.

    The steps integrate ``y' = f(t, y)``, ``v' = (df/dy) v`` for every tangent vector (by forward differentiation) and, if
    the frame has it, the integral of ``div f``.
    """
    h = flow.period / steps

    def advance(strobe: Array, frame: Frame, first: Any = 0, last: Any = steps) -> Frame:
        def step(i: Array, frame: Frame) -> Frame:
            return _step(flow, lambda c: flow.angles(strobe, (i + c) / steps), h, frame)

        return jax.lax.fori_loop(first, last, step, frame)

    return advance


# Most lanes with the stages of a step in a loop, which compiles several times as fast; with more lanes it would be slower.
_LOOPED = 16


def _step(flow: Flow, angles: Callable[[float], tuple], h: Any, frame: Frame) -> Frame:
    """One step of DOP853 (Hairer, Norsett & Wanner, Solving ODEs I, 2nd ed. (1993), II.5) for all parts of the frame."""
    # Local import: it takes half a second, and only tracing needs it.
    from scipy.integrate import DOP853

    if frame.state[0].size <= _LOOPED:
        return _looped_step(flow, angles, h, frame, *map(jnp.asarray, (DOP853.A, DOP853.B, DOP853.C)))
    slopes: list[Frame] = []
    for stage, (c, b) in enumerate(zip(DOP853.C, DOP853.B, strict=True)):
        at = _advanced(frame._replace(contraction=None), h, DOP853.A[stage, :stage], slopes)
        contracts = frame.contraction is not None and b != 0
        slopes.append(_slopes(flow, contracts, angles(float(c)), at))
    return _advanced(frame, h, DOP853.B, slopes)


def _looped_step(
    flow: Flow, angles: Callable[[Any], tuple], h: Any, frame: Frame, rows: Array, weights: Array, nodes: Array
) -> Frame:
    """The step with the coefficients of a scheme, its stages in a loop."""
    start, contracts = frame._replace(contraction=None), frame.contraction is not None

    def moved(frame: Frame, weights: Array, slopes: Frame) -> Frame:
        def along(x: Array, rates: Array) -> Array:
            return x + h * sum(weights[j] * rate for j, rate in enumerate(rates))

        return jax.tree.map(along, frame, slopes)

    def stage(k: Array, slopes: Frame) -> Frame:
        at = stored(moved)(start, rows[k], slopes._replace(contraction=None))
        new = _slopes(flow, contracts, angles(nodes[k]), at)
        return jax.tree.map(lambda x, y: jax.lax.dynamic_update_index_in_dim(x, y, k, 0), slopes, new)

    blank = jax.tree.map(lambda x: jnp.zeros((len(nodes), *x.shape)), frame)
    return stored(moved)(frame, weights, jax.lax.fori_loop(0, len(nodes), stage, blank))


def _advanced(frame: Frame, h: Any, weights: Any, slopes: Sequence[Frame]) -> Frame:
    """``frame + h sum(weights * slopes)``, component by component."""
    terms = [(float(w), slope) for w, slope in zip(weights, slopes, strict=True) if w != 0]
    if not terms:
        return frame
    factors, slopes = zip(*terms, strict=True)

    def moved(frame: Frame, h: Any, slopes: tuple[Frame, ...]) -> Frame:
        def along(x: Array, *rates: Array) -> Array:
            return x + h * sum(w * rate for w, rate in zip(factors, rates, strict=True))

        return jax.tree.map(along, frame, *slopes)

    used = (slope if frame.contraction is not None else slope._replace(contraction=None) for slope in slopes)
    return stored(moved)(frame, h, tuple(used))


def _field(flow: Flow, angles: tuple, shape: tuple[int, ...]) -> Callable[..., Vector]:
    def field(*y: Array) -> Vector:
        return tuple(jnp.broadcast_to(jnp.asarray(rate, float), shape) for rate in flow.field(angles, y))

    return field


def _slopes(flow: Flow, contracts: bool, angles: tuple, at: Frame) -> Frame:
    """Derivatives of the state, of the tangent vectors and, if it ``contracts``, of the integral of the divergence."""
    field = _field(flow, angles, at.state[0].shape)
    contraction = jnp.broadcast_to(divergence(flow, angles, at.state), at.state[0].shape) if contracts else None
    if not at.tangents:
        return Frame(field(*at.state), (), contraction)
    rates, push = jax.linearize(field, *at.state)
    # The closure shares the factors of the linear map with the rates and the divergence.
    linear, factors = jax.closure_convert(push, *at.state)

    def pushed(tangents: Vector, factors: list[Array]) -> Vector:
        return jax.vmap(lambda *v: linear(*v, *factors))(*tangents)

    return Frame(rates, tuple(stored(pushed)(at.tangents, factors)), contraction)


def divergence(flow: Flow, angles: tuple, y: Vector) -> Array:
    """Trace of the field's Jacobian at ``y``: the closed form of the flow, or by forward differentiation."""
    if flow.divergence is not None:
        return jnp.asarray(flow.divergence(angles, y), float)
    _, push = jax.linearize(_field(flow, angles, y[0].shape), *y)
    zero = jnp.zeros_like(y[0])
    return sum(push(*(zero + float(i == j) for i in range(flow.size)))[j] for j in range(flow.size))  # pyright: ignore[reportReturnType]


def orthonormal(tangents: Vector) -> tuple[Vector, Array]:
    """Orthonormal vectors by modified Gram-Schmidt, components ``(m, ...)``, and logarithms of the lengths ``(m, ...)``."""
    basis: list[Vector] = []
    logs = []
    for vector in zip(*tangents, strict=True):
        for unit in basis:
            along = sum(a * b for a, b in zip(unit, vector, strict=True))
            vector = tuple(b - along * a for a, b in zip(unit, vector, strict=True))
        length = jnp.sqrt(sum(a * a for a in vector))
        basis.append(tuple(a / length for a in vector))
        logs.append(jnp.log(length))
    return tuple(jnp.stack(component) for component in zip(*basis, strict=True)), jnp.stack(logs)


# Steps per strobe for a march of tangent vectors, and the number of orthonormalisations within a strobe.
#
# Both numbers are predicted before the march from the largest angular frequency of the flow and its divergence at the
# start. A step of length h turns by y = rho h at the fastest rate rho. By its stability function on the imaginary axis,
# DOP853 changes the logarithm of an amplitude by 2.4e-8 y^10 with little damping, and by less than 4e-7 of the decay
# with strong damping. For exponents only the ratio to the decay matters.

# Fewest steps per strobe, also those of a flow without a known frequency; most steps unless the option `steps` is given.
LEAST, MOST = 48, 100_000
# Damping of an amplitude by one step that turns by a radian; it grows with the tenth power of the angle.
_DAMPING, _POWER = 2.4e-8, 10
# Largest change by the steps: of an exponent relative to its size, and of the logarithm of an amplitude within a strobe.
# Both are a hundredth of the errors that ``resolution`` detects.
_CHANGE, _ROUNDING = 1e-5, 1e-11
# Longest step in radians of the fastest motion.
_LONGEST = 1.4
# Logarithm of the largest ratio of two vectors before an orthonormalisation, to keep the shorter one clear of rounding.
_PARTING = 12.0


def contraction(flow: Flow) -> Array:
    """Contraction rate of volume (minus the divergence of the field) at the start of the motion, shape (...)."""
    rate = -jnp.asarray(divergence(flow, flow.angles(0, 0.0), initial_state(flow)), float)
    return jnp.broadcast_to(rate, batch_shape(flow))


def needed_steps(flow: Flow) -> Array:
    """Equal steps per strobe for exponents accurate to 1e-5, at least ``LEAST``, as numbers of shape (...)."""
    if flow.fastest is None:
        return jnp.full(batch_shape(flow), float(LEAST))
    volume = jnp.abs(contraction(flow))
    rate = jnp.maximum(flow.fastest, volume)
    angle = rate * flow.period
    # Tolerated change of the logarithm of an amplitude per radian.
    tolerated = jnp.maximum(_CHANGE * volume / flow.size / rate, _ROUNDING / angle)
    longest = jnp.minimum((tolerated / _DAMPING) ** (1 / (_POWER - 1)), _LONGEST)
    steps = jnp.ceil(angle / longest)
    # A field of NaN is marched too, and ends as NOT_FINITE.
    return jnp.where(jnp.isnan(steps), LEAST, jnp.maximum(steps, LEAST))


def needed_parts(flow: Flow, steps: Any, active: Array) -> Array:
    """Parts of a strobe after which vectors are orthonormalised, an integer for all ``active`` members, at most ``steps``.

    If no vector grows, vectors separate no faster than volume contracts.
    """
    parts = jnp.ceil(jnp.abs(contraction(flow)) * flow.period / _PARTING)
    return jnp.clip(jnp.max(jnp.where(jnp.isnan(parts) | ~active, 1.0, parts)), 1, steps).astype(jnp.int64)
