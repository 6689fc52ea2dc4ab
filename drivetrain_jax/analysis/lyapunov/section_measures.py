"""Measures of a Poincare section: its period in strobes, and its distance from a smooth torus."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.lyapunov.growth_record import Record, sampled
from drivetrain_jax.analysis.lyapunov.variational import Frame, initial_state, one_kernel, strobe_map
from drivetrain_jax.systems import Flow

# The 0-1 test for chaos: does a walk driven by an observable stay bounded or diffuse?
#
# Gottwald & Melbourne, SIAM J. Appl. Dyn. Syst. 8 (2009) 129: with p(n) = sum phi(j) cos(j c), q(n) = sum phi(j) sin(j
# c), the mean square displacement M_c(n) = <(p(j+n) - p(j))^2 + (q(j+n) - q(j))^2> without its oscillating part <phi>^2
# (1 - cos n c)/(1 - cos c) grows linearly in n if phi is chaotic. K is the median over c of its correlation with n.

# As many angles as the authors use, equally spaced over their recommended range.
_ANGLES = 100
_RANGE = (math.pi / 5, 4 * math.pi / 5)
_CUT = 10
# Series computed together: their walks fit into the inner caches.
_BLOCK = 32


def chaos_k01(series: Array) -> Array:
    """K of ``series``, shape ``(T, ...)`` -> ``(...)``: near 0 if regular, near 1 if chaotic; 0 for a constant series.

    The displacements extend over 1 to T/10 samples. The test needs about 1000 samples, whose distance is not below the time
    scale of the series: oversampled flows look regular.
    """
    angles = _RANGE[0] + (_RANGE[1] - _RANGE[0]) * (jnp.arange(_ANGLES) + 0.5) / _ANGLES
    mean = jnp.mean(series, axis=0)
    size = jnp.max(jnp.abs(series - mean), axis=0)
    constant = ~(size > 1e-12 * jnp.abs(mean))
    # The test does not depend on the scale of the observable, and an offset only adds to the oscillating part.
    scaled = (series - mean) / jnp.where(constant, 1.0, size)
    values = jax.lax.map(lambda block: jax.lax.map(partial(_correlation, block), angles), _blocks(scaled))
    values = jnp.moveaxis(values, 1, 0).reshape(_ANGLES, -1)[:, : math.prod(size.shape)]
    return jnp.where(constant, 0.0, jnp.median(values.reshape(_ANGLES, *size.shape), axis=0))


def _blocks(series: Array) -> Array:
    """``(T, ...)`` in blocks of ``_BLOCK`` series, ``(blocks, T, _BLOCK)``, the last block padded with zeros."""
    flat = series.reshape(len(series), -1)
    flat = jnp.pad(flat, ((0, 0), (0, -flat.shape[1] % _BLOCK)))
    return jnp.moveaxis(flat.reshape(len(series), -1, _BLOCK), 1, 0)


def largest_k01(section: Array) -> Array:
    """The largest K of the components of ``section``, shape ``(T, n, ...)`` -> ``(...)``.

    The largest is the right one: all components of a regular motion are regular, and a slow component of a chaotic motion
    needs a longer record than a fast component.
    """
    return jnp.max(chaos_k01(section), axis=0)


def _correlation(series: Array, angle: Array) -> Array:
    """Correlation of the displacement with n, for one angle."""
    length = series.shape[0]
    cut = length // _CUT
    turns = (angle * jnp.arange(1, length + 1)).reshape(-1, *(1,) * (series.ndim - 1))
    p, q = jnp.cumsum(series * jnp.cos(turns), axis=0), jnp.cumsum(series * jnp.sin(turns), axis=0)
    kept = length - cut

    def displacement(n: Array) -> Array:
        moved = [jax.lax.dynamic_slice_in_dim(x, n, kept) - x[:kept] for x in (p, q)]
        return jnp.mean(moved[0] ** 2 + moved[1] ** 2, axis=0)

    n = jnp.arange(1, cut + 1)
    distance = jax.lax.map(displacement, n)
    steps = n.reshape(-1, *(1,) * (series.ndim - 1)) - (cut + 1) / 2
    spread = distance - jnp.mean(distance, axis=0)
    norm = jnp.sqrt(jnp.sum(steps**2, axis=0) * jnp.sum(spread**2, axis=0))
    return jnp.sum(steps * spread, axis=0) / jnp.where(norm > 0, norm, 1.0)


# Number of last strobes of a section that are compared with earlier ones.
_WINDOW = 64
# Harmonics of a clock in the fit of a torus, and iterations of the fit.
HARMONICS = 64
_ITERATIONS = 30


def period_multiple(section: Array, tolerance: Array, longest: int) -> Array:
    """Smallest p <= ``longest`` with |y(k) - y(k - p)| within ``tolerance`` of the largest |y|; 0 if there is none.

    ``section`` has shape ``(T, n, ...)`` with T >= longest + 64; the comparison runs over the last 64 strobes. p is the
    number of distinct points of a periodic motion. All components share one scale, because a component may vanish at the
    strobes. Leading axes of ``tolerance`` before the batch axes are kept, with one result for each entry.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    scale = jnp.where(scale > 0, scale, 1.0)
    end = section[-_WINDOW:] / scale

    def distance(p: Array) -> Array:
        start = section.shape[0] - _WINDOW - p
        earlier = jax.lax.dynamic_slice_in_dim(section, start, _WINDOW) / scale
        return jnp.max(jnp.abs(end - earlier), axis=(0, 1))

    def earliest(multiple: Array, p: Array) -> tuple[Array, None]:
        close = distance(p) <= tolerance
        return jnp.where((multiple == 0) & close, p, multiple), None

    none = jnp.zeros(jnp.broadcast_shapes(jnp.shape(tolerance), section.shape[2:]), jnp.int64)
    return jax.lax.scan(earliest, none, jnp.arange(1, longest + 1))[0]


def torus_residual(section: Array, angle: Array | None) -> Array:
    """Largest distance of the section from a smooth closed curve over ``angle``, over the largest |y|, ``(n, ...)``.

    ``section`` has shape ``(T, n, ...)``, ``angle`` ``(T, ...)`` is in rad. The curve is the best-fitting trigonometric
    polynomial of degree ``HARMONICS``, found by conjugate gradients on the normal equations; for a short section this is the
    fit with the smallest coefficients. Without an angle the curve is a point, the mean.
    """
    scale = jnp.max(jnp.abs(section), axis=(0, 1))
    scale = jnp.where(scale > 0, scale, 1.0)
    target = section / scale
    target = target - jnp.mean(target, axis=0)
    if angle is None:
        return jnp.max(jnp.abs(target), axis=0)
    turn = (jnp.cos(angle)[:, None], jnp.sin(angle)[:, None])
    return jnp.max(jnp.abs(target - _smooth(target, turn)), axis=0)


def _smooth(target: Array, turn: tuple[Array, Array]) -> Array:
    """Values of the best fit at the strobes."""

    def curve(coefficients: Array) -> Array:
        def add(carry: tuple, pair: Array) -> tuple:
            total, c, s = carry
            total = total + pair[0] * c + pair[1] * s
            return (total, c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]), None

        constant, pairs = coefficients[0, 0], coefficients[1:]
        start = (jnp.zeros_like(target) + constant, jnp.zeros_like(target) + turn[0], jnp.zeros_like(target) + turn[1])
        return jax.lax.scan(add, start, pairs)[0][0]

    def moments(values: Array) -> Array:
        def take(carry: tuple, _: None) -> tuple:
            c, s = carry
            pair = jnp.stack([jnp.mean(values * c, axis=0), jnp.mean(values * s, axis=0)])
            return (c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]), pair

        ones = jnp.ones_like(turn[0])
        return jax.lax.scan(take, (ones, 0 * ones), None, length=HARMONICS + 1)[1]

    right = moments(target)
    zero = jnp.zeros_like(right)
    size = jnp.sum(right**2, axis=(0, 1))

    def iterate(_: int, carry: tuple) -> tuple:
        x, r, p, rr = carry
        image = moments(curve(p))
        step = jnp.where(rr > 1e-34 * size, rr / jnp.sum(p * image, axis=(0, 1)), 0.0)
        x, r = x + step * p, r - step * image
        new = jnp.sum(r**2, axis=(0, 1))
        return x, r, r + jnp.where(rr > 0, new / rr, 0.0) * p, new

    solution = jax.lax.fori_loop(0, _ITERATIONS, iterate, (zero, right, right, size))[0]
    return curve(solution)


# The strobes after a run: the 0-1 test, and the close returns of a torus.

# Strobes after the run, and the longest return in strobes that is searched.
SAMPLES, LONGEST = 1024, 512
# Distances of close returns, relative to the motion: a torus comes as close as the smaller ones, but later.
_RETURNS = (0.3, 0.1, 0.03, 0.01)


def sample(flow: Flow, steps: Any, record: Record, needed: Array) -> tuple[Array, Array]:
    """K of the 0-1 test over ``SAMPLES`` strobes after the run, and flags of motions that :func:`returns` finds.

    K is 0 for motions that are not ``needed``, and NaN for unbounded ones.
    """
    watched = [i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0]
    needed = needed & record.bounded

    def look() -> tuple[Array, Array]:
        states, _ = sampled(flow, steps, record.state, record.strobe, SAMPLES)
        section = states[:, jnp.array(watched)]
        finite = jnp.all(jnp.isfinite(section), axis=(0, 1))
        k01 = jnp.where(needed, jnp.where(finite, largest_k01(section), jnp.nan), 0.0)
        return k01, needed & finite & returns(section)

    k01, back = jax.lax.cond(jnp.any(needed), look, lambda: (jnp.zeros(needed.shape), jnp.zeros_like(needed)))
    return jnp.where(record.bounded, k01, jnp.nan), back


def returns(section: Array) -> Array:
    """Flags of motions whose close returns take the longer, the closer they are, shape (...).

    A slow decay towards a period is as close to itself after this period as after any other time.
    """
    tolerance = jnp.broadcast_to(
        jnp.array(_RETURNS).reshape(-1, *(1,) * (section.ndim - 2)), (len(_RETURNS), *section.shape[2:])
    )
    after = period_multiple(section, tolerance, LONGEST)
    first = jnp.min(jnp.where(after > 0, after, LONGEST), axis=0)
    return jnp.max(after, axis=0) > first


# The estimator (31)-(36) of Bugaru & Vasile 2022, which is not a Lyapunov exponent.
#
#     L_j = (1/T_f) sum_i log10(|Delta_j(T_i+1)| / |Delta(T_f)|)
#
# for every component j, the clock that defines the strobe included; T_i are the strobes up to T_f. On every interval
# (T_i, T_i+1) the second trajectory restarts from the first one plus a perturbation proportional to it.
#
# The estimator is no exponent for four reasons: its base is 10; its ratio compares each time with the END; it compares
# one component with a norm of mixed units; and its sum grows with the number of T_i, so that the result is inversely
# proportional to their distance.
#
# The paper does not print the length of an interval; here it is one strobe. An interval at whose end a component has
# the distance 0 is left out, such as the first interval of a flow with a clock, which starts at 0.

# Relative perturbation of every component.
PERTURBATION = 1e-5


def component_count(flow: Flow) -> int:
    """Number of components: those of the state, and the clock that defines the strobe if there is one."""
    return flow.size + bool(flow.turns)


def paper_estimator(flow: Flow, steps: Any, max_time: float, members: Array) -> Array:
    """L_j of the ``members`` in 1/s, shape ``(component_count(flow), ...)``, over ``max_time``."""
    scale = flow.scale or (1.0,) * flow.size
    base = initial_state(flow)
    zero = jnp.zeros_like(base[0])
    advance = strobe_map(flow, steps)
    strobes = jnp.broadcast_to(jnp.ceil(jnp.asarray(max_time / flow.period)).astype(jnp.int64), zero.shape)

    def distances(k: Array, state: tuple, after: tuple) -> Array:
        """Distances of all components at the end of interval ``k`` from ``state`` to ``after``."""
        ahead = 2 * np.pi * PERTURBATION * k
        moved = strobe_map(replace(flow, field=_shifted(flow, ahead)), steps)
        other = moved(k, Frame(tuple(x * (1 + PERTURBATION) for x in state))).state
        parts = [(b - a) * s for a, b, s in zip(after, other, scale, strict=True)]
        return jnp.abs(jnp.stack([*parts, *[zero + ahead] * bool(flow.turns)]))

    def body(k: Array, carry: tuple) -> tuple:
        frame, total, counted, last = carry
        new = advance(k, frame)
        apart = distances(k, frame.state, new.state)
        counts = (k < strobes) & jnp.all(apart > 0, axis=0)
        logs = jnp.log10(jnp.where(counts, apart, 1.0))
        norm = jnp.log10(jnp.sqrt(jnp.sum(jnp.where(counts, apart, 1.0) ** 2, axis=0)))
        return new, total + logs, counted + counts, jnp.where(counts, norm, last)

    def march(start: tuple, count: Array) -> tuple:
        return jax.lax.fori_loop(0, count, body, start)

    start = (Frame(base), jnp.zeros((component_count(flow), *zero.shape)), zero, zero)
    _, total, counted, last = one_kernel(flow)(march)(start, jnp.max(jnp.where(members, strobes, 0)))
    return (total - counted * last) / (strobes * flow.period)


def _shifted(flow: Flow, ahead: Array) -> Any:
    """The field with its strobe clock ahead."""

    def field(angles: tuple, y: Any) -> Any:
        return flow.field((angles[0] + ahead, *angles[1:]) if angles else angles, y)

    return field
