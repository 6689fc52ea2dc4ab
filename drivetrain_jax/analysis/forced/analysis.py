"""Forced response: periodic solution of the linearised system, and the nonlinear periodic orbit with its multipliers.

Linear: the variational equations over one period T from rest give ``y(T; y0) = r + Z y0``, hence ``y0 = (I - Z)^-1 r``.
Nonlinear: continuation along growing forcing (:func:`~drivetrain_jax.analysis.forced.orbit.along_forcing`), and along
the speed of the system, if it has one, from below and from above (:func:`~drivetrain_jax.analysis.forced.orbit.neighbours`),
unless the first path ends near the linear response. Of several orbits the result is the stable one of the smallest
amplitude, or the smallest one if none is stable; ``orbit_count`` is their number. Orbits on branches that these paths do
not meet are not found.

Outcome: ``TOLERANCE_NOT_MET`` if the estimated error of a state exceeds ``rtol`` times its largest entry; ``NOT_CONVERGED``
if I - Z is singular to working accuracy or no nonlinear orbit was found. Only missing results are NaN: without an orbit, a
finite linear response and ``condition`` are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver, forward_derivatives
from drivetrain_jax.analysis.forced.orbit import (
    MAX_STEPS,
    Field,
    Orbit,
    Transition,
    along_forcing,
    controller,
    corrected,
    in_units_of,
    integrate,
    neighbours,
    newton_step,
    periodic_slopes,
    size_of,
    transition,
)
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.analysis.numerics.lanes import Constants, over_lanes
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, solve, spectral_norm
from drivetrain_jax.systems import ForcedModel, System

# Largest displacements over a period, found on every step of an adaptive integration.


# Fraction of a step next to its ends within which the continuous extension is as accurate as the step.
EDGE = 0.01


class _Peaks(NamedTuple):
    """State of the loop of :func:`amplitudes`: the next step ``[t0, t1]`` from ``y``, flags ``aimed`` (k,) of the rows
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
    field: Field, start: Array, period: float, rows: Array, rtol: float
) -> tuple[Array, Array, Array, Array]:
    """Largest ``|row . y|`` over a period for ``rows`` (k, n), their times, the state at its end, and an ``Outcome``.

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
        peaks = _peaks_on_step(field, between.evaluate, s.t0, s.t1, s.y, y1, rows)
        (largest, when), aimed, nearest = _larger_peaks(s, peaks, keep)
        again = jnp.any(aimed)
        t0, t1 = jnp.where(again, s.t0, t0), jnp.where(again, nearest, t1)
        y, state, largest, when = jax.tree.map(
            lambda new, old: jnp.where(keep & ~again, new, old),
            (y1, state, largest, when),
            (s.y, s.solver, s.largest, s.when),
        )
        return _Peaks(t0, t1, y, aimed, largest, when, s.count + 1, jump, state, controlled)

    zero, largest = jnp.zeros(()), jnp.abs(rows @ start)
    t1, controlled = control.init(term, zero, period, fixed(start), None, None, solver.func, order)
    t1 = jnp.minimum(t1, period)
    begun = jnp.zeros((), int), jnp.array(False), solver.init(term, zero, t1, start, None), controlled
    first = _Peaks(zero, t1, start, largest < 0, largest, 0 * largest, *begun)
    last = jax.lax.while_loop(unfinished, advance, first)
    stopped = jnp.where(last.count < MAX_STEPS, Outcome.NOT_FINITE, Outcome.STEP_LIMIT)
    return last.largest, last.when, last.y, jnp.where(last.t0 < period, stopped, Outcome.SUCCESS)


def _larger(best: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """The larger values of both pairs of values and times."""
    return jnp.maximum(best[0], other[0]), jnp.where(other[0] > best[0], other[1], best[1])


def _larger_peaks(s: _Peaks, peaks: _Found, keep: Any) -> tuple[tuple[Array, Array], Array, Array]:
    """Largest values and their times after an accepted step, flags of the components with the first new peak in the step,
    and the time of this peak: the step is repeated to end there."""
    largest = _larger((s.largest, s.when), (peaks.at_end, s.t1))
    new = keep & ~jnp.any(s.aimed) & (peaks.value > largest[0]) & (jnp.abs(peaks.place - 0.5) < 0.5 - EDGE)
    nearest = jax.lax.stop_gradient(jnp.min(jnp.where(new, peaks.place, 1.0)))
    place = jnp.where(s.aimed, s.t1 + peaks.late, s.t0 + peaks.place * (s.t1 - s.t0))
    largest = _larger(largest, (jnp.where(s.aimed, peaks.near_end, peaks.value), place))
    return largest, new & (peaks.place == nearest), s.t0 + nearest * (s.t1 - s.t0)


class _Found(NamedTuple):
    """``|row . y|`` on a step: ``at_end``, extrapolated to the peak ``near_end`` by the time ``late``, and the largest
    ``value`` in between, at the fraction ``place``, or 0 if there is none."""

    at_end: Array
    near_end: Array
    late: Array
    value: Array
    place: Array


def _peaks_on_step(field: Field, evaluate: Callable, t0: Array, t1: Array, y0: Array, y1: Array, rows: Array) -> _Found:
    """Largest ``|row . y|`` on a step, at its end and where the derivative changes sign in between.

    A cubic through y' and y'' at both ends interpolates the derivative. The parabola y - d^2/(2 y'') removes the derivative
    d that remains at its root.
    """
    h = t1 - t0

    def derivatives(t: Array, y: Array) -> tuple[Array, Array]:
        slope = field(t, y)
        return slope, jax.jvp(field, (t, y), (jnp.ones_like(t), slope))[1]

    (slope0, curve0), (slope1, curve1) = derivatives(t0, y0), derivatives(t1, y1)

    def peak_of(row: Array) -> _Found:
        x, inside = _cubic_root(row @ slope0, row @ slope1, h * (row @ curve0), h * (row @ curve1))
        y, end = evaluate(t0 + x * h), row @ y1
        slope, curve = (row @ d for d in derivatives(t0 + x * h, y))
        value, shift = _vertex(row @ y, slope, curve)
        near_end, late = _vertex(end, row @ slope1, row @ curve1)
        between = jnp.where(inside, jnp.abs(value), 0.0), jnp.clip(x + shift / h, 0.0, 1.0)
        return _Found(jnp.abs(end), jnp.abs(near_end), late, *between)

    return jax.vmap(peak_of)(rows)


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


TORQUES = frozenset(("torque", "torque_phase", "orbit_torque", "orbit_torque_phase"))
PEAKS = frozenset(("amplitude", "amplitude_phase", "torque", "torque_phase"))
LINEAR = PEAKS | {"periodic_state", "periodic_state_error", "condition"}

Build = Callable[[Mapping[str, Any]], ForcedModel]

# Tolerances of the first and the closing integration relative to ``rtol``, and the smallest tolerance. The closing
# integration is more accurate, because it estimates the error of the first.
TRANSITION_SHARPNESS, CLOSING_SHARPNESS, SHARPEST = 0.1, 0.001, 1e-14
# Assumed ratio of the error of the closing integration to its tolerance. At 256 random points and four rtol the estimates
# then covered the true errors; without this term they were up to 27 times too small.
CLOSING_ERROR = 0.1
# Loosest ``rtol`` for these tolerances: (I - Z)^-1 multiplies their errors by up to its condition.
LOOSEST = 1e-6
# Largest assumed error of Z. I - Z counts as singular if its condition times this error reaches ``NOT_FOUND``. A looser
# request assumes no larger error, because the closing integration shows the error of the solution.
SINGULAR_SHARPNESS = 1e-11
# Relative error above which a periodic solution counts as not found.
NOT_FOUND = 1e-2
# Largest excess of a spectral radius over 1 by rounding, and relative difference of states of one orbit, and of approximate
# states.
STABLE_MARGIN, SAME, NEAR = 1e-8, 1e-6, 1e-3
# Difference of the first orbit from the linear response, relative to the response, up to which no others are searched for.
# Orbits coexist where the resonance is bent: in the chart of 2,829 cells (sweeps/cardan_orbit_chart.toml) the difference is
# at least 0.45 in all cells with several orbits.
LEAST_BEND = 0.05
FORCING_SAMPLES = 64
# Points per chunk: of the linear response, and of orbits. One orbit with hundreds of corrections delays all in its chunk.
CHUNK, ORBITS_CHUNK = 128, 16


class Response(NamedTuple):
    """Periodic solution of the linear system: ``state`` (n,), absolute ``error``, the ``largest`` values and their ``phase``
    (None unless requested), and the map over one period."""

    state: Array
    error: Array
    largest: Array | None
    phase: Array | None
    step: Transition
    outcome: Array


def _worst(*outcomes: Array) -> Array:
    return jnp.max(jnp.stack([jnp.asarray(o) for o in outcomes]))


def _sharpness(rtol: float, factor: float) -> float:
    return max(factor * min(rtol, LOOSEST), SHARPEST)


def _mapped(model: ForcedModel, n: int, rtol: float) -> tuple[Transition, Array, Array]:
    """The map over one period in units of the forcing, its fixed point in those units, and the unit."""
    rest = jnp.zeros(n)
    phases = model.period * np.arange(FORCING_SAMPLES) / FORCING_SAMPLES
    forcing = size_of(jax.vmap(lambda t: model.linear(t, rest))(phases))
    field = in_units_of(forcing, model.linear)
    step = transition(field, rest, model.period, _sharpness(rtol, TRANSITION_SHARPNESS))
    return step, newton_step(step, rest), forcing


def linear_response(model: ForcedModel, n: int, rtol: float, rows: Array | None) -> Response:
    """Periodic solution of ``y' = linear(t, y)``, with the largest ``|row . y|``; ``n`` is the size of the state.

    ``y0 = (I - Z)^-1 r`` is integrated over another period. The closing error times (I - Z)^-1 corrects ``y0``. The stored
    error is this correction plus (I - Z)^-1 times the assumed error of the closing integration.
    """
    step, unit, forcing = _mapped(model, n, rtol)
    # Without a solution there is nothing to integrate.
    exists = (step.outcome == Outcome.SUCCESS) & jnp.all(jnp.isfinite(unit))
    unit = jnp.where(exists, unit, 0.0)
    size = size_of(unit)
    start, field, sharp = unit / size, in_units_of(size * forcing, model.linear), _sharpness(rtol, CLOSING_SHARPNESS)
    (largest, phase), correction, closed = _closed(model, field, start, step.matrix, sharp, rows)
    error = jnp.max(jnp.abs(correction)) + CLOSING_ERROR * sharp * _gain(step.matrix)
    lost = ~exists | ~(error <= NOT_FOUND) | ~_regular(step.matrix, rtol)
    missed = jnp.where(error > rtol, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
    outcome = _worst(step.outcome, closed, jnp.where(lost, Outcome.NOT_CONVERGED, missed))
    state, error, largest = jax.tree.map(
        lambda x: jnp.where(outcome < Outcome.NOT_CONVERGED, size * forcing * x, jnp.nan),
        (start + correction, error, largest),
    )
    phase = None if phase is None else jnp.where(outcome < Outcome.NOT_CONVERGED, phase, jnp.nan)
    return Response(state, error, largest, phase, step, outcome)


def _closed(
    model: ForcedModel, field: Field, start: Array, matrix: Array, sharp: float, rows: Array | None
) -> tuple[tuple[Array | None, Array | None], Array, Array]:
    """Largest ``|row . y|`` over a period and their phases (None without rows), the correction of ``start`` by the closing
    error, and the outcome. ``start`` is of order one; ``matrix`` is the transition."""
    if rows is not None:
        largest, phase, end, closed = amplitudes(field, start, model.period, rows, sharp)
    else:
        (largest, phase), (end, closed, _) = (None, None), integrate(field, start, model.period, sharp)
    return (largest, phase), newton_step(Transition(end, matrix, closed), start), closed


def _regular(matrix: Array, rtol: float) -> Array:
    """True if ``I - Z`` is further from singular than the accuracy of Z."""
    return _condition(matrix) * min(_sharpness(rtol, TRANSITION_SHARPNESS), SINGULAR_SHARPNESS) < NOT_FOUND


def _gain(matrix: Array) -> Array:
    """Largest entry of ``(I - Z)^-1 e`` for an error ``e`` with entries up to 1."""
    return jnp.max(jnp.sum(jnp.abs(solve(jnp.eye(matrix.shape[0]) - matrix, jnp.eye(matrix.shape[0]))), axis=1))


def _condition(matrix: Array) -> Array:
    """2-norm condition number of ``I - Z``; infinite if it is singular."""
    difference = jnp.eye(matrix.shape[0]) - matrix
    inverse = solve(difference, jnp.eye(matrix.shape[0]))
    condition = spectral_norm(difference) * spectral_norm(jnp.where(jnp.isfinite(inverse), inverse, 0.0))
    return jnp.where(jnp.all(jnp.isfinite(inverse)), condition, jnp.inf)


class Found(NamedTuple):
    """An orbit, the largest displacements on it, and torques if asked for, with their phases (k,), its spectral radius, and
    the number of different orbits at the point."""

    orbit: Orbit
    largest: Array
    phase: Array
    radius: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]


def nonlinear_orbit(
    model: ForcedModel, response: Response, rtol: float, search: Callable[[Array], Array], rows: Array
) -> Found:
    """The stable periodic orbit of the smallest amplitude, or the smallest one if none is stable.

    The orbits are that on the path that starts along ``response``, and those near the states ``search(wanted)`` (m, n).
    They are wanted where the path does not end, or not near the linear response. Without a ``response`` the
    orbit is NaN and has the outcome of ``response``.
    """
    usable = response.outcome < Outcome.NOT_CONVERGED
    start = jnp.where(usable, response.state, 0.0)
    # Nonlinearity matters for states of order one; a smaller response is measured in units of its own size.
    unit = jax.lax.stop_gradient(jnp.minimum(size_of(start), 1.0))
    first = unit * along_forcing(in_units_of(unit, model.field), model.period, start.size)
    bend = jnp.max(jnp.abs(first - start)) / size_of(start)
    guesses = jnp.concatenate([first[None], search(usable & ~(bend <= LEAST_BEND))])
    guesses = jnp.where(usable & distinct(guesses, NEAR)[:, None], guesses, jnp.nan)
    # One after another, because points have few: in a batch, a missing orbit would cost as much as one.
    units = jnp.ones(len(guesses)).at[0].set(unit)
    every = jax.lax.map(lambda near: _near(model, rtol, rows, *near), (guesses, units))
    exists = every.orbit.outcome < Outcome.NOT_CONVERGED
    unstable = every.radius > 1 + STABLE_MARGIN
    amplitude = every.largest[:, : len(model.displacements)]
    best = jnp.lexsort((jnp.max(amplitude, axis=1), unstable, ~exists))[0]
    found = jax.tree.map(lambda x: x[jnp.where(jnp.any(exists), best, 0)], every)
    orbit = found.orbit._replace(outcome=jnp.where(usable, found.orbit.outcome, response.outcome))
    return found._replace(orbit=orbit, count=jnp.sum(distinct(every.orbit.state, SAME)))


def distinct(states: Array, near: float) -> Array:
    """Flags of the states (m, n) that are not NaN and not, up to ``near`` times their size, one of those before them."""
    apart = jnp.max(jnp.abs(states[:, None] - states[None]), axis=2)
    exists = jnp.isfinite(states[:, 0])
    # The largest entry of NaN is -inf on some processors.
    same = jnp.tril(apart <= near * jax.vmap(size_of)(states)[:, None], -1) & exists
    return exists & ~jnp.any(same, axis=1)


def orbits_near(model: ForcedModel, guesses: Array, rtol: float) -> Found:
    """The orbits to which Newton's method leads from ``guesses`` (m, n), as results of m orbits; NaN where there is none."""
    rows = model.peaks(guesses.shape[1], torques=False)
    return jax.vmap(partial(_near, model, rtol, rows))(guesses)


def _near(model: ForcedModel, rtol: float, rows: Array, guess: Array, unit: Any = 1.0) -> Found:
    """The orbit to which Newton's method leads from ``guess``, in this ``unit``, corrected by its closing error, with the
    largest ``|row . y|`` and its spectral radius."""
    orbit = corrected(
        in_units_of(unit, model.field), guess / unit, model.period, _sharpness(rtol, TRANSITION_SHARPNESS)
    )
    orbit = orbit._replace(state=unit * orbit.state, error=unit * orbit.error)
    exists = orbit.outcome < Outcome.NOT_CONVERGED
    state = jnp.where(exists, orbit.state, 0.0)
    size = size_of(state)
    field, sharp = in_units_of(size, model.field), _sharpness(rtol, CLOSING_SHARPNESS)
    # A missing orbit is integrated over an empty span.
    model = replace(model, period=jnp.where(exists, model.period, 0.0))
    (largest, phase), correction, closed = _closed(model, field, state / size, orbit.matrix, sharp, rows)
    error = size * jnp.max(jnp.abs(correction)) + orbit.error
    missed = jnp.where(error <= rtol * size, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    outcome = _worst(orbit.outcome, jnp.where(exists, _worst(closed, missed), orbit.outcome))
    exists = outcome < Outcome.NOT_CONVERGED
    radius = jnp.max(jnp.hypot(*eigenvalues(jnp.where(exists, orbit.matrix, jnp.eye(state.size)))))
    state, matrix, error, largest, phase, radius = jax.tree.map(
        lambda x: jnp.where(exists, x, jnp.nan),
        (state, orbit.matrix, error, size * jnp.asarray(largest), phase, radius),
    )
    return Found(Orbit(state, matrix, error, outcome, orbit.corrections), largest, phase, radius, exists)


def _tops(model: ForcedModel, prefix: str, largest: Array, phase: Array) -> dict[str, Array]:
    """The largest displacements and torques with their phases by name."""
    count, top = len(model.displacements), {"": largest, "_phase": phase}
    results = {f"{prefix}amplitude{end}": x[:count] for end, x in top.items()}
    return results | {f"{prefix}torque{end}": x[count:] for end, x in top.items()}


def _others(build: Build, n: int, speed: str, values: Mapping[str, Any], wanted: Array) -> Array:
    """Approximate orbits at the point, ``(m, n)``, by a search along the parameter ``speed``: NaN unless ``wanted``, none
    without a speed."""
    if values.get(speed) is None:
        return jnp.zeros((0, n))
    # Newton's method gives the derivatives of the orbits.
    fixed = jax.tree.map(jax.lax.stop_gradient, dict(values))
    at = jnp.where(wanted, fixed[speed], jnp.nan)
    return neighbours(lambda value: build(fixed | {speed: value}), at, n)


def _solve(
    build: Build, n: int, speed: str, request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    """All requested results of one point; ``effort`` only orders the batches, as every integration is adaptive."""
    model, rtol = build(values), request.options["rtol"]
    n = model.size or n
    rows = model.peaks(n, not TORQUES.isdisjoint(request.outputs))
    response = linear_response(model, n, rtol, None if PEAKS.isdisjoint(request.outputs) else rows)
    results: dict[str, Any] = {"periodic_state": response.state, "periodic_state_error": response.error}
    if response.largest is not None and response.phase is not None:
        results |= _tops(model, "", response.largest, response.phase)
    outcome = response.outcome
    if "condition" in request.outputs:
        results["condition"] = jnp.where(
            response.step.outcome == Outcome.SUCCESS, _condition(response.step.matrix), jnp.nan
        )
    if not LINEAR.issuperset(request.outputs):
        best = nonlinear_orbit(model, response, rtol, partial(_others, build, n, speed, values), rows)
        results |= _tops(model, "orbit_", best.largest, best.phase)
        results |= {"orbit_state": best.orbit.state, "orbit_state_error": best.orbit.error}
        results |= {"orbit_spectral_radius": best.radius, "orbit_count": best.count.astype(jnp.int32)}
        outcome = _worst(outcome, best.orbit.outcome)
    return {name: results[name] for name in request.outputs} | {"outcome": outcome.astype(jnp.int8)}


def predicted_steps(build: Build, n: int, moving: int, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Steps of one integration, shape (N,), from the mean spectral radius of the linear field over three phases.

    Infinite where the field is not finite.
    """
    matrices = np.moveaxis(predicted(_matrices, (build, n, moving), columns), -1, 0)
    finite = np.all(np.isfinite(matrices), axis=(1, 2, 3))
    rates = np.abs(np.linalg.eigvals(np.where(finite[:, None, None, None], matrices, 0.0))).max(axis=-1)
    return np.where(finite, np.ceil(20 + 2 * np.mean(rates, axis=-1)), np.inf)


def _matrices(build: Build, n: int, moving: int, values: Mapping[str, Any]) -> Array:
    """The period times the Jacobian of the linear field of one point at three phases, ``(3, n, n)``."""
    model = build(values)
    n = model.size or n
    if moving not in (0, len(model.displacements)):
        raise InputError(
            f"system: its model has {len(model.displacements)} displacements; expected {moving}, as it says"
        )
    phases = model.period * jnp.array([0.0, 0.25, 0.5])
    return model.period * jax.vmap(lambda t: jax.jacfwd(lambda y: model.linear(t, y))(jnp.zeros(n)))(phases)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    build, n = system.models["forced"].build, len(system.state)
    steps = partial(predicted_steps, build, n, len(_displacements(system).values))
    chunk = CHUNK if LINEAR.issuperset(request.outputs) else ORBITS_CHUNK
    solve = over_lanes(partial(_solve, build, n, system.roles.get("speed", ""), request))
    return (Solver("diffrax", solve, steps, seconds=3e-5, chunk=chunk, march=True, short_loops=True),)


# Results whose derivatives need second derivatives of the field: they come from differentiating the first solver.
_SECOND = frozenset(("condition", "orbit_spectral_radius"))


# A periodic solution, its displacements and its torques, by the field of the model.
_SOLUTIONS = {
    "linear": ("periodic_state", "amplitude", "torque"),
    "field": ("orbit_state", "orbit_amplitude", "orbit_torque"),
}


def _derivative_outputs(outputs: tuple[str, ...]) -> tuple[str, ...]:
    needed: tuple[str, ...] = ()
    for state, *tops in _SOLUTIONS.values():
        phases = tuple(f"{name}_phase" for name in tops if name in outputs)
        needed += (state, *phases) if phases or state in outputs else ()
    return needed


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    """Jacobians of states and amplitudes by the variational equations, and of the other results through the solver."""
    build, slopes = system.models["forced"].build, {}
    second = tuple(name for name in request.outputs if name in _SECOND)
    if second:
        kept = {name: results[name] for name in second}
        asked = Request(second, request.method, request.options)
        slopes |= forward_derivatives(_solvers, system, asked, parameters, constants, kept)
    for field, names in _SOLUTIONS.items():
        if names[0] in request.outputs:
            model = lambda p: build(eqx.combine(p, constants.tree))  # noqa: E731
            slopes |= _slopes(model, field, parameters, results, names, request.options["rtol"])
    return slopes


def _slopes(
    model: Callable[[Any], ForcedModel],
    which: str,
    parameters: Any,
    results: Mapping[str, Array],
    names: tuple[str, ...],
    rtol: float,
) -> dict[str, Array]:
    """Jacobians of the periodic solution ``names[0]`` of the field ``which``, and of ``names[1:]`` that are requested."""

    def field(parameters: Any, s: Any, y: Array) -> Array:
        there = model(parameters)
        return there.period * getattr(there, which)(there.period * s, y)

    here, (state, *tops) = model(parameters), names
    count, end = len(here.displacements), results[state].size
    # The rows of displacements come first, then those of torques.
    parts = {name: slice(k * count, (k + 1) * count) for k, name in enumerate(tops) if f"{name}_phase" in results}

    def rows(parameters: Any) -> Array:
        every = model(parameters).peaks(end, torques=tops[1] in parts)
        return jnp.concatenate([jnp.zeros((0, end)), *(every[part] for part in parts.values())])

    places = jnp.concatenate([jnp.zeros(0), *(results[f"{name}_phase"] for name in parts)]) / here.period
    of_state, of_tops = periodic_slopes(field, parameters, results[state], (places, rows), _sharpness(rtol, 1.0))
    return {state: of_state} | dict(zip(parts, jnp.split(of_tops, max(len(parts), 1)), strict=False))


def _displacements(system: type[System]) -> Dimension:
    assert system.displacements is not None  # System refuses a model of forced without them
    return system.displacements


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    names, several = tuple(c.name for c in system.state), bool(system.state_axis)
    values, components = ((), names) if several else (names, ())
    return Dimension("state", "component of the state", values, components=components), _displacements(system)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The variables, in the units of the system's state."""
    units, length = ", ".join(dict.fromkeys(c.units for c in system.state)), system.state[0].units
    moving, state = (_displacements(system).name,), ("state",)
    time = system.unit_of_time()
    torque = Variable("torque", system.torque_units, "largest torque over the period, linear system", moving)
    torques = (
        torque,
        Variable("torque_phase", time, "time at which the torque is largest, linear system", moving),
        replace(torque, name="orbit_torque", long_name="largest torque over the period, nonlinear orbit"),
        Variable("orbit_torque_phase", time, "time at which the torque is largest, nonlinear orbit", moving),
    )
    variables = (
        Variable("periodic_state", units, "periodic solution of the linear system at the start of a period", state),
        Variable("periodic_state_error", units, "estimated absolute error of periodic_state"),
        Variable("amplitude", length, "largest displacement over the period, linear system", moving),
        Variable("amplitude_phase", time, "time at which the displacement is largest, linear system", moving),
        Variable("condition", "1", "2-norm condition number of I - Z, linear system"),
        Variable("orbit_state", units, "nonlinear periodic orbit at the start of a period", state),
        Variable("orbit_state_error", units, "estimated absolute error of orbit_state"),
        Variable("orbit_amplitude", length, "largest displacement over the period, nonlinear orbit", moving),
        Variable("orbit_amplitude_phase", time, "time at which the displacement is largest, nonlinear orbit", moving),
        Variable("orbit_spectral_radius", "1", "spectral radius of the monodromy matrix about the nonlinear orbit"),
        Variable("orbit_count", "1", "number of different nonlinear orbits found (0: none)", dtype="int32"),
    )
    if not system.torque_units:
        return {"variables": variables}
    return {"variables": variables + torques, "default_outputs": (*DEFAULT_OUTPUTS, "torque")}


DEFAULT_OUTPUTS = ("periodic_state", "amplitude", "condition")
ANALYSIS = Analysis(
    name="forced",
    title="forced response",
    variables=(),
    default_outputs=DEFAULT_OUTPUTS,
    methods={"shooting": ("rtol",)},
    method_titles={"shooting": "periodic orbit by Newton's method over one period"},
    options=(RTOL,),
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=_derivatives,
    derivative_outputs=_derivative_outputs,
    of_system=_of_system,
)
