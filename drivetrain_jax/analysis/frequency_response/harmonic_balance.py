"""Harmonic balance of the oscillator with play by alternating frequency and time, for batches of oscillators.

``u = x0 + sum_j (x_{2j-1} cos j tau + x_{2j} sin j tau)``, j = 1..J, tau = omega t/m, for harmonics of the drive up to
J/m and subharmonics of order m. The spring force is evaluated at samples of u and projected on the same functions.
Plain sampling of a force with kinks is accurate to second order in the sample distance only. Here every crossing of a flank
is located on the cubic through the values and rates of the neighbouring samples. The force is integrated up to the crossing
with the weights of cubic interpolation (:func:`contact_weights`), which gains three orders. The same weights give the
Jacobian, which is the projection of the contact. Coefficients have shape ``(n, ...)``, n = 2 J + 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.linear_algebra import eliminated, solve
from drivetrain_jax.systems import PiecewiseLinearOscillator

_CROSSING_STEPS = 4
# Integrals over [0, 1] of the cubic interpolation polynomials of the samples -1, 0, 1, 2.
_WHOLE = (-1 / 24, 13 / 24, 13 / 24, -1 / 24)


@dataclass(frozen=True)
class Basis:
    """Basis functions: ``harmonics`` of the drive with subharmonics of order ``order``, and their samples.

    ``samples`` counts the points per period of the drive; 0 is a number suited to ``harmonics``.
    """

    harmonics: int
    order: int = 1
    samples: int = 0

    @property
    def highest(self) -> int:
        """J, the number of harmonics of the base frequency."""
        return self.harmonics * self.order

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return 2 * self.highest + 1

    @cached_property
    def count(self) -> int:
        """Number of samples per base period, the period of the subharmonic."""
        if self.samples:
            return self.samples * self.order
        # With fewer samples, a contact that appears and vanishes between two samples interrupts the branch.
        return self.order * max(64, 1 << (20 * self.harmonics - 1).bit_length())

    @cached_property
    def orders(self) -> np.ndarray:
        """The harmonic of each coefficient, shape (n,)."""
        return (np.arange(self.size) + 1) // 2

    @cached_property
    def values(self) -> np.ndarray:
        """The basis functions at the samples, (M, n)."""
        return self.functions_at(2 * np.pi * np.arange(self.count) / self.count)

    @cached_property
    def rates(self) -> np.ndarray:
        """Derivatives of the basis functions with respect to tau at the samples, (M, n)."""
        return self.values @ self.derivative

    @cached_property
    def derivative(self) -> np.ndarray:
        """Matrix of the derivative with respect to tau on coefficients, (n, n)."""
        matrix = np.zeros((self.size, self.size))
        for j in range(1, self.highest + 1):
            matrix[2 * j - 1, 2 * j], matrix[2 * j, 2 * j - 1] = j, -j
        return matrix

    @cached_property
    def projection(self) -> np.ndarray:
        """Matrix from samples to coefficients, (n, M)."""
        return self.values.T * np.where(self.orders == 0, 1.0, 2.0)[:, None] / self.count

    @cached_property
    def products(self) -> tuple[np.ndarray, ...]:
        """Coefficients that give the Jacobian from moments p of the contact: entry = a p[i] + b p[k], all (n, n)."""
        j, k = np.meshgrid(self.orders, self.orders, indexing="ij")
        sine = (np.arange(self.size) % 2 == 0) & (self.orders > 0)
        row, column = np.meshgrid(sine, sine, indexing="ij")
        shift = 2 * self.highest + 1
        mixed = np.where(row != column, shift, 0)
        difference, total = np.abs(j - k) + mixed, j + k + mixed
        a = np.where(row == column, 1.0, np.where(row, np.sign(j - k), np.sign(k - j)))
        b = np.where(row & column, -1.0, 1.0)
        half = np.where(j == 0, 0.5, 1.0)
        return difference, total, half * a, half * b

    @cached_property
    def moments(self) -> np.ndarray:
        """Matrix from samples to their means with cos 0..2J and sin 0..2J, (4J + 2, M)."""
        angle = np.outer(np.arange(2 * self.highest + 1), 2 * np.pi * np.arange(self.count) / self.count)
        return np.concatenate([np.cos(angle), np.sin(angle)]) / self.count

    def functions_at(self, tau: np.ndarray) -> np.ndarray:
        """The basis functions at ``tau`` (M,), shape (M, n)."""
        angle = np.outer(tau, self.orders)
        even = np.arange(self.size) % 2 == 0
        return np.where(even & (self.orders > 0), np.sin(angle), np.cos(angle))


class Contact(NamedTuple):
    """Samples ``u`` (M, ...) of a motion, its crossings of the flanks ``b`` and ``-b``, and the weights of either contact.

    A crossing is a fraction of the interval after each sample, meaningful where the sign of the distance changes.
    """

    u: Array
    crossings: tuple[Array, Array]
    weights: tuple[Array, Array]


def _part(theta: Array) -> tuple[Array, ...]:
    """Integrals over ``[0, theta]`` of the cubic interpolation polynomials of the samples -1, 0, 1, 2."""
    t2, t3, t4 = theta**2 / 2, theta**3 / 3, theta**4 / 4
    return ((-t4 + 3 * t3 - 2 * t2) / 6, (t4 - 2 * t3 - t2 + 2 * theta) / 2, (-t4 + t3 + 2 * t2) / 2, (t4 - t2) / 6)


def _crossing(d0: Array, d1: Array, rate0: Array, rate1: Array) -> Array:
    """Zero in [0, 1] of the cubic with the end values d0, d1 and end rates, by Newton steps from the zero of the chord."""
    change = d1 - d0
    theta = jnp.clip(d0 / jnp.where(change != 0, -change, 1.0), 0.0, 1.0)
    a, b = rate0 - change, change - rate1

    def newton(_: int, theta: Array) -> Array:
        bend = a * (1 - theta) + b * theta
        value = d0 + change * theta + theta * (1 - theta) * bend
        slope = change + (1 - 2 * theta) * bend + theta * (1 - theta) * (b - a)
        return jnp.clip(theta - value / jnp.where(slope != 0, slope, 1.0), 0.0, 1.0)

    # A loop stores its result; XLA would evaluate an expression again for each of the four weights.
    return jax.lax.fori_loop(0, _CROSSING_STEPS, newton, theta)


def contact_weights(distance: Array, rate: Array) -> tuple[Array, Array]:
    """Weights w for means over the part of the period where ``distance > 0``, and the crossings of 0.

    ``mean(w g)`` is the integral of g over this part, divided by the period. ``distance`` and its ``rate`` per sample are
    given at the samples (M, ...) of a period.
    """
    after, rate_after = jnp.roll(distance, -1, axis=0), jnp.roll(rate, -1, axis=0)
    theta = _crossing(distance, after, rate, rate_after)
    starts, ends = distance > 0, after > 0
    weights = jnp.zeros_like(distance)
    for offset, whole, part in zip((-1, 0, 1, 2), _WHOLE, _part(theta), strict=True):
        inside = jnp.where(starts, jnp.where(ends, whole, part), jnp.where(ends, whole - part, 0.0))
        weights = weights + jnp.roll(inside, offset, axis=0)
    return weights, theta


def contact(model: PiecewiseLinearOscillator, basis: Basis, x: Array) -> Contact:
    """Samples, crossings and contact weights of the motion with coefficients ``x``."""
    u = jnp.tensordot(basis.values, x, 1)
    rate = jnp.tensordot(basis.rates, x, 1) * (2 * np.pi / basis.count)
    distances = jnp.stack([u - model.b, -u - model.b], axis=1)
    weights, crossings = contact_weights(distances, jnp.stack([rate, -rate], axis=1))
    return Contact(u, (crossings[:, 0], crossings[:, 1]), (weights[:, 0], weights[:, 1]))


def residual(
    model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array, touch: Contact
) -> tuple[Array, Array]:
    """Unbalanced coefficients ``(n, ...)`` and their derivative with respect to ``omega``."""
    above, below = touch.weights
    beyond = above * (touch.u - model.b) + below * (touch.u + model.b)
    spring = model.alpha * x + (1 - model.alpha) * jnp.tensordot(basis.projection, beyond, 1)
    base, squares = omega / basis.order, (basis.orders**2).reshape(-1, *(1,) * (x.ndim - 1))
    turned, drive = jnp.tensordot(basis.derivative, x, 1), 2 * basis.order - 1
    force = model.damping * base * turned - base**2 * squares * x + model.stiffness * spring
    by_omega = (model.damping * turned - 2 * base * squares * x) / basis.order
    if model.follows:
        by_omega = by_omega.at[drive].add(-2 * model.unbalance * omega)
    return force.at[0].add(-model.B0).at[drive].add(-model.amplitude(omega)), by_omega


def jacobian(model: PiecewiseLinearOscillator, basis: Basis, omega: Array, touch: Contact) -> Array:
    """Derivative of the residual with respect to the coefficients, ``(n, n, ...)``."""
    moments = jnp.tensordot(basis.moments, touch.weights[0] + touch.weights[1], 1)
    tail = (1,) * (moments.ndim - 1)
    difference, total, a, b = basis.products
    shape = (basis.size, basis.size, *tail)
    stiffness = a.reshape(shape) * moments[difference] + b.reshape(shape) * moments[total]
    eye = np.eye(basis.size).reshape(shape)
    base = omega / basis.order
    squares = np.diag(basis.orders**2.0).reshape(shape)
    linear = model.damping * base * basis.derivative.reshape(shape) - base**2 * squares
    return linear + model.stiffness * (model.alpha * eye + (1 - model.alpha) * stiffness)


class Balanced(NamedTuple):
    """Coefficients ``x`` of a balanced motion, and its quality.

    ``step`` is the last Newton step over the size of ``x``; ``converged`` is true if it is negligible. ``saddle`` is true if
    the Jacobian has a negative determinant, as between two folds: the slow motion of the balance (:func:`drift`) then
    leaves this motion.
    """

    x: Array
    step: Array
    converged: Array
    saddle: Array


# Relative step that is negligible, and the least fraction of a Newton step.
_TOLERANCE, _LEAST_PART = 1e-11, 1 / 16


class _Iteration(NamedTuple):
    """State of the Newton iterations: ``best`` coefficients so far, with their Newton step ``change``, their residual
    ``unbalanced`` and the sign of their determinant (``saddle``). The next trial is a ``part`` of the Newton step, whose
    relative size is ``step``."""

    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    best: Array
    change: Array
    part: Array
    unbalanced: Array
    step: Array
    saddle: Array


def balance(model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array, iterations: int = 20) -> Balanced:
    """The balanced motion near ``x`` at fixed ``omega``, by Newton iterations until every lane converges, or ``iterations``.

    A step that increases the residual is halved, because the Jacobian of a force with kinks may change abruptly.
    """

    def norm(v: Array) -> Array:
        return jnp.sqrt(jnp.sum(v**2, axis=0))

    def improve(state: _Iteration) -> _Iteration:
        trial = state.best - state.part * state.change
        touch = contact(model, basis, trial)
        force, _ = residual(model, basis, trial, omega, touch)
        unbalanced = norm(force)
        change, negative, _ = eliminated(jacobian(model, basis, omega, touch), force[:, None])
        change = change[:, 0]
        usable = jnp.all(jnp.isfinite(change), axis=0)
        # After a small step the residual is rounding, and need not decrease.
        better = (unbalanced < state.unbalanced) | (state.part <= _LEAST_PART) | (state.step <= 1e-7)
        size = norm(trial) + norm(change)
        step = norm(change) / jnp.where(size > 0, size, 1.0)
        # A lane that has converged or failed does not move.
        going, taken = ~(state.step <= _TOLERANCE), better & usable
        moved = going & taken
        return _Iteration(
            state.count + 1,
            jnp.where(moved, jnp.where(step <= _TOLERANCE, trial - change, trial), state.best),
            jnp.where(moved, change, state.change),
            jnp.where(taken, 1.0, state.part / 2),
            jnp.where(moved, unbalanced, state.unbalanced),
            jnp.where(moved, step, state.step),
            jnp.where(moved, negative, state.saddle),
        )

    def unfinished(state: _Iteration) -> Array:
        return (state.count < iterations) & jnp.any(~(state.step <= _TOLERANCE))

    infinite = jnp.full(x.shape[1:], jnp.inf)
    never = jnp.zeros(x.shape[1:], bool)
    start = _Iteration(jnp.int32(0), x, jnp.zeros_like(x), jnp.ones(x.shape[1:]), infinite, infinite, never)
    end = jax.lax.while_loop(unfinished, improve, start)
    return Balanced(end.best, end.step, end.step <= _TOLERANCE, end.saddle)


_DRIFT_STEPS = 40


def drift(model: PiecewiseLinearOscillator, basis: Basis, x: Array, omega: Array) -> Array:
    """Coefficients after the slow motion of the balance from ``x``, which tends to a stable balanced motion.

    Slowly varying coefficients satisfy ``(2 omega/m D + c') x' = -residual``, where D is the derivative with respect to
    tau. The steps are implicit Euler steps of half a drive period. With few harmonics the balanced motion may be too far
    from the settled motion for Newton iterations alone.
    """
    tail = (1,) * (x.ndim - 1)
    turn = jnp.asarray(basis.derivative).reshape(basis.size, basis.size, *tail)
    eye = jnp.eye(basis.size).reshape(turn.shape)
    inertia = (2 * omega / basis.order * turn + model.damping * eye) * omega / np.pi

    def advance(_: Any, x: Array) -> Array:
        touch = contact(model, basis, x)
        force, _ = residual(model, basis, x, omega, touch)
        return x - solve(jacobian(model, basis, omega, touch) + inertia, force[:, None])[:, 0]

    return jax.lax.fori_loop(0, _DRIFT_STEPS, advance, x)


# Stability of a motion given by harmonics, from the exact transition matrix of disturbances along the motion.
#
# A disturbance obeys ``y'' + c' y' + k' s(t) y = 0`` with s = 1 in contact and s = alpha within the play. As s is constant
# between crossings of the flanks, the transition over the period is a product of closed-form matrices. Hill's infinite
# determinant converges to the same multipliers; their product is ``exp(-c' T)`` exactly.

_BLOCKS = 8
Rows = tuple[Array, Array, Array, Array]


def _transition(stiffness: Array, span: Array) -> Rows:
    """Transition matrix of ``z'' + stiffness z = 0`` over ``span`` by rows, determinant 1."""
    square = stiffness * span**2
    angle = jnp.sqrt(jnp.abs(square))
    small = angle < 1e-4
    safe = jnp.where(small, 1.0, angle)
    ratio = jnp.where(small, 1 - square / 6, jnp.where(square > 0, jnp.sin(safe), jnp.sinh(safe)) / safe)
    cosine = jnp.where(square > 0, jnp.cos(angle), jnp.cosh(angle))
    return cosine, span * ratio, -stiffness * span * ratio, cosine


def _product(later: Rows, earlier: Rows) -> Rows:
    a, b, c, d = later
    p, q, r, s = earlier
    return a * p + b * r, a * q + b * s, c * p + d * r, c * q + d * s


def _ordered_product(matrices: Rows) -> Rows:
    """Product of the matrices along the first axis, the last matrix leftmost.

    Blocks are multiplied in parallel, then their products. Loops store their results; in one long expression XLA would
    recompute the terms for every use.
    """
    tail = matrices[0].shape[1:]
    one, zero = jnp.ones(tail), jnp.zeros(tail)
    unit = (one, zero, zero, one)

    def multiply(product: Rows, factor: Rows) -> tuple[Rows, None]:
        return _product(factor, product), None

    filling = -matrices[0].shape[0] % _BLOCKS
    filled = (
        jnp.concatenate([m, jnp.broadcast_to(u, (filling, *tail))]) if filling else m
        for m, u in zip(matrices, unit, strict=True)
    )
    by_block = tuple(jnp.moveaxis(m.reshape(_BLOCKS, -1, *tail), 0, 1) for m in filled)
    blocks = jax.lax.scan(multiply, tuple(jnp.broadcast_to(u, (_BLOCKS, *tail)) for u in unit), by_block)[0]  # pyright: ignore[reportArgumentType]
    return jax.lax.scan(multiply, unit, blocks)[0]


def half_trace(model: PiecewiseLinearOscillator, basis: Basis, omega: Array, touch: Contact) -> Array:
    """Half the trace of the transition over the base period, divided by ``exp(-c' T/2)``.

    With the half trace h, the multipliers over that factor are ``h -+ sqrt(h^2 - 1)``. For h between -1 and 1 both have the
    modulus of the factor. An unstable motion has h > 1 beyond a fold, and h < -1 beyond a period doubling.
    """
    span = 2 * np.pi * basis.order / (omega * basis.count)
    here = jnp.abs(touch.u) > model.b
    after = jnp.roll(here, -1, axis=0)
    # In z = exp(c' t/2) y the damping vanishes and the stiffness is k' s - c'^2/4.
    first, last = (
        model.stiffness * jnp.where(contact, 1.0, model.alpha) - model.damping**2 / 4 for contact in (here, after)
    )
    upper = touch.u + jnp.roll(touch.u, -1, axis=0) > 0
    theta = jnp.where(here == after, 1.0, jnp.where(upper, *touch.crossings))
    steps = _product(_transition(last, (1 - theta) * span), _transition(first, theta * span))
    whole = _ordered_product(steps)
    return (whole[0] + whole[3]) / 2


def spectral_radius(model: PiecewiseLinearOscillator, basis: Basis, omega: Array, half: Array) -> Array:
    """Modulus of the larger multiplier over the base period."""
    decay = jnp.exp(-model.damping * np.pi * basis.order / omega)
    beyond = jnp.maximum(jnp.abs(half), 1.0)
    return decay * (beyond + jnp.sqrt(beyond**2 - 1))
