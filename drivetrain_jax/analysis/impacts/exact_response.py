"""Results of exact motions of an oscillator with play: single points, and sweeps of the drive's frequency up and down.

:func:`sweeps` is the method ``exact`` of the analysis ``frequency_response``. ``model.omega`` has the shape ``(L,)``; the
other fields are scalars or have the shape ``(N,)``. Results have the frequencies first, then the direction (up, down), then
the lanes.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.impacts.attractor import Attractors, attractors, averaged, repeated, take
from drivetrain_jax.analysis.impacts.motion import (
    ABSENT,
    REGIMES,
    STABLE,
    UNSTABLE,
    log_determinant,
    newton_correction,
    phase_lag,
    regime,
    spectral_radius,
)
from drivetrain_jax.analysis.impacts.orbit_measures import Measures, measure
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.analysis.numerics.continuation import (
    Mapped,
    PeriodMap,
    course,
    distinct,
    folds_and_doublings,
    follow,
    sections,
)
from drivetrain_jax.systems import PiecewiseLinearOscillator

NON_PERIODIC = REGIMES.index("non_periodic")
# Results that need integrals over the motion.
INTEGRALS = frozenset(("u_mean", "u_rms", "phase"))
# Logarithmic growth of a tangent that only chaos explains, lasting or transient: shear makes a tangent grow in proportion to
# time.
_WILD = 20.0
# Error of u, relative to the distance from the flanks, that may confuse one attractor with another.
_DECIDES = 1e-3
# Excess of the spectral radius over 1 that is no rounding: a motion without damping has 1.
_UNSTABLE = 1e-6
# Lanes computed at a time: enough to fill the vector units, but few lanes wait for the slowest. Sweeps have fewer lanes,
# because they are long jobs of very different length.
WIDTH, _SWEEP_WIDTH = 64, 32


def describe(
    oscillator: PiecewiseLinearOscillator, motions: Attractors, *, rtol: float, integrals: bool = True
) -> dict[str, Array]:
    """All results of ``motions``, every field of shape ``(N,)`` as those of ``oscillator``.

    Impacts, contacts, states and multipliers are pairs, ``(2, N)``. Unknown values are NaN (``stability``: absent).

    A motion that recurs within 32 periods is measured over its period. A motion that does not, but whose tangent has
    grown by exp(20) over the last three quarters of the run, is non-periodic (``period_multiple`` 0), or still a transient,
    and measured over 32 drive periods. Any other motion has not settled, nor has an orbit whose spectral radius exceeds 1.
    ``outcome`` is TOLERANCE_NOT_MET where the estimated error of u exceeds ``rtol`` times its size, or a thousandth of the
    largest distance from the flanks.
    """
    stopped = motions.stalled == 1
    u, v = jnp.where(stopped, jnp.nan, motions.u), motions.v
    seen = measure(oscillator, u, v, motions.multiple, width=WIDTH, integrals=integrals)
    periodic = motions.multiple > 0
    wild = ~periodic & (motions.exponent * averaged(motions.periods) * oscillator.period > _WILD)
    size = jnp.maximum(jnp.abs(seen.high), jnp.abs(seen.low))
    # Not the size of u: at a wide backlash the motion about a flank is far from the origin.
    away = jnp.maximum(*(jnp.abs(jnp.abs(u) - oscillator.b) for u in (seen.high, seen.low)))
    exact = (motions.error <= rtol * size) & (motions.error <= _DECIDES * away)
    outcome = jnp.where(periodic & ~exact, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
    results = periodic_results(oscillator, seen)
    unstable = periodic & (results["spectral_radius"] > 1 + _UNSTABLE)
    outcome = jnp.where((periodic | wild) & ~unstable, outcome, Outcome.NOT_CONVERGED)
    outcome = jnp.where((motions.stalled > 0) | (seen.complete == 0), Outcome.STEP_LIMIT, outcome)
    finite = jnp.isfinite(motions.u) & (stopped | jnp.isfinite(seen.high + seen.low))
    outcome = jnp.where(finite, outcome, Outcome.NOT_FINITE)
    known = outcome < Outcome.NOT_CONVERGED
    results |= {name: jnp.where(periodic, results[name], jnp.nan) for name in ("floquet_multiplier", "spectral_radius")}
    results["lyapunov_exponent"] = jnp.where(periodic, results["lyapunov_exponent"], motions.exponent)
    results["orbit_state"] = jnp.stack([motions.u, motions.v])
    results["state_error"] = jnp.where(periodic, motions.error, jnp.nan)
    results = {name: jnp.where(known, value, jnp.nan) for name, value in results.items()}
    kind = jnp.where(periodic, regime(oscillator, seen.high, seen.low), NON_PERIODIC)
    return results | {
        "regime": jnp.where(known, kind, NON_PERIODIC).astype(jnp.int8),
        "stability": jnp.where(known, jnp.where(periodic, STABLE, UNSTABLE), ABSENT).astype(jnp.int8),
        "period_multiple": jnp.where(periodic & known, seen.periods, 0).astype(jnp.int32),
        "periods_settled": motions.periods,
        "outcome": outcome.astype(jnp.int8),
    }


def periodic_results(oscillator: PiecewiseLinearOscillator, seen: Measures) -> dict[str, Array]:
    """Extremes, means, contacts and impacts over the measured periods, and the multipliers and Lyapunov exponent of a motion
    with this period."""
    span = seen.periods * oscillator.period
    mean, square, cosine, sine = (integral / span for integral in seen.integrals)
    size = jnp.maximum(jnp.abs(seen.high), jnp.abs(seen.low))
    contraction = log_determinant(oscillator, seen.matrix, span)
    half, determinant = (seen.matrix[0] + seen.matrix[3]) / 2, jnp.exp(contraction)
    root = jnp.sqrt((half**2 - determinant).astype(complex))
    # The larger multiplier first; the smaller one from the product loses no digits.
    first = half + jnp.where(half < 0, -root, root)
    rho = spectral_radius(seen.matrix, contraction)
    return {
        "u_max": seen.high,
        "u_min": seen.low,
        "u_mean": mean,
        "u_rms": jnp.sqrt(square),
        "phase": phase_lag(2 * cosine, 2 * sine, size),
        "impacts": jnp.stack(seen.impacts),
        "impact_velocity": jnp.stack(seen.speed),
        "contact_fraction": jnp.stack(seen.contact) / span,
        "floquet_multiplier": jnp.stack([first, jnp.where(first == 0, 0.0, determinant / first)]),
        "spectral_radius": rho,
        # A radius that underflows has no logarithm.
        "lyapunov_exponent": jnp.where(rho > 0, jnp.log(rho) / span, jnp.nan),
    }


def batch_shape(model: PiecewiseLinearOscillator) -> tuple[int, ...]:
    """Shape of the batch: of all fields but the frequency."""
    fields = (model.damping, model.stiffness, model.alpha, model.b, model.B0, model.B1, model.unbalance)
    return jnp.broadcast_shapes(*(jnp.shape(field) for field in fields))


def points_of(model: PiecewiseLinearOscillator, length: int, lanes: int) -> PiecewiseLinearOscillator:
    """The oscillators of all points, frequencies first: fields of shape ``(length * lanes,)``, or scalars."""
    return repeated(model, length).driven_at(jnp.repeat(jnp.asarray(model.omega), lanes))


def sweeps(
    model: PiecewiseLinearOscillator, *, most_periods: int = 1000, rtol: float = 1e-10, integrals: bool = True
) -> dict[str, Array]:
    """Results of sweeps of the drive's frequency up and down from rest; each frequency starts on the previous motion.

    ``model.omega`` has the shape ``(L,)`` and rises; other fields are scalars or have the shape ``(N,)``. The results are
    those of :func:`describe` in the shape ``(L, 2, N)`` (direction up, down), or ``(L, 2, 2, N)`` for results with their own
    axis (flank, multiplier, state). Without lanes the last axis is missing. If a motion has not settled after
    ``most_periods`` drive periods, the next frequency starts from its last state.
    """
    shape = batch_shape(model)
    length, lanes = jnp.size(model.omega), int(np.prod(shape, dtype=int))
    points = points_of(model, length, lanes)
    up = np.arange(length * lanes, dtype=np.int32).reshape(length, lanes).T
    route = np.concatenate([up, up[:, ::-1]])
    rest = jnp.zeros(2 * lanes)
    motions = attractors(points, jnp.asarray(route), rest, rest, most_periods=most_periods, width=_SWEEP_WIDTH)
    flat = jax.tree.map(lambda x: x.reshape(-1), motions)
    results = describe(take(points, jnp.asarray(route.reshape(-1))), flat, rtol=rtol, integrals=integrals)

    def arrange(x: Array) -> Array:
        axes = x.shape[:-1]
        both = x.reshape(*axes, 2, lanes, length)
        both = jnp.stack([both[..., 0, :, :], both[..., 1, :, ::-1]])
        # (direction, own..., lane, frequency) to (frequency, direction, own..., lane).
        return jnp.moveaxis(both, -1, 0).reshape(length, 2, *axes, *shape)

    return {name: arrange(value) for name, value in results.items()}


# All orbits of the drive's period on the branch of a sweep, stable or not, with the folds and period doublings.
#
# The branch runs through the first motion of period one of the sweep up. Continuation by arc length goes both ways to
# the ends of the line (:mod:`~drivetrain_jax.analysis.numerics.continuation`). Newton's method corrects the orbits at
# the frequencies of the line. Orbits of longer periods and closed branches are not included.

BRANCHES, SPECIAL = 7, 16
_ATTEMPTS, _LONGEST = 3000, 0.04
# Relative difference for the derivative by omega.
_DIFFERENCE = 1e-6
_BLOCK, _CORRECTIONS, _MOST_STEPS, _MARGIN = 64, 6, 100_000, 1e-9


def _scale(model: PiecewiseLinearOscillator, x: Array, highest: float) -> Array:
    """Units for ``(u, v, omega)`` on the branch through ``x``, ``(3, N)``, up to the frequency ``highest``.

    Size of its state, size times omega, and omega; the geometric mean of both frequencies replaces omega, otherwise there
    would be too many steps.
    """
    usual = jnp.sqrt(x[2] * highest)
    size = jnp.abs(x[0]) + jnp.abs(x[1]) / x[2] + model.b
    return jnp.stack([size, size * usual, usual])


def _period_map(model: PiecewiseLinearOscillator) -> PeriodMap:
    """The map of ``(u, v, omega)`` over a drive period; the derivative by omega is a forward difference."""

    def mapped(x: Array) -> Mapped:
        omega = jnp.concatenate([x[2], x[2] * (1 + _DIFFERENCE)])
        lanes = prepare(repeated(model, 2).driven_at(omega))
        end = march(lanes, start(lanes, jnp.tile(x[0], 2), jnp.tile(x[1], 2), jnp.asarray(1, jnp.int32)), _MOST_STEPS)
        half = x.shape[1]
        state = jnp.stack([end.u, end.v])
        slope = (state[:, half:] - state[:, :half]) / (omega[half:] - omega[:half])
        missing = jnp.where(end.left[:half] > 0, jnp.nan, 0.0)
        matrix = jnp.stack(end.matrix)[:, :half].reshape(2, 2, half)
        return Mapped(state[:, :half] + missing, matrix, slope, end.steps[:half])

    return mapped


def branch(
    model: PiecewiseLinearOscillator, omega: np.ndarray, first: Array, *, special: bool, width: int
) -> tuple[dict[str, Array], Array]:
    """Results of the branches through ``first = (u, v, omega)``, shape ``(3, N)``, over the rising ``omega`` (L,).

    ``branch_u_max, branch_u_min, branch_stability``, shape ``(L, 7, N)``, by rising largest displacement; if ``special``,
    ``fold_frequency`` and ``doubling_frequency``, shape ``(L, 16, N)``, the largest 16 within the line, rising. A lane with
    NaN in ``first`` has no branch.

    The second result, shape ``(L, N)``, is true if the branch is complete: it left the line both ways (to the highest
    frequency at least one way), all its orbits were found, and it has no more orbits, folds or doublings than the results.
    """
    low, high = float(omega[0]), float(omega[-1])
    both = replace(repeated(model, 2), omega=1.0)
    twice = jnp.tile(first, (1, 2))
    way = jnp.repeat(jnp.array([1.0, -1.0]), first.shape[1])
    limits = (low * (1 - 1e-9), high * (1 + 1e-9))
    scale = _scale(both, twice, limits[1])
    mapped = _period_map(both)
    path = follow(mapped, twice, scale, direction=way, attempts=_ATTEMPTS, longest=_LONGEST, limits=limits)
    along = course(path.x, scale)
    guess, exists, every = jax.lax.map(lambda w: sections(along, w, BRANCHES), jnp.asarray(omega))
    lanes = first.shape[1]
    number = np.broadcast_to(np.arange(omega.size)[:, None, None] * lanes, exists.shape)
    index = jnp.asarray((number + np.tile(np.arange(lanes), 2)).reshape(-1))
    points = points_of(replace(model, omega=omega), omega.size, lanes)
    states = jnp.moveaxis(guess, 2, 0).reshape(3, -1)[:2]
    results = _described(take(points, index), states, exists.reshape(-1), width)
    exists = exists.reshape(omega.size, 2 * BRANCHES, lanes)
    results, all_told = _ordered({name: x.reshape(exists.shape) for name, x in results.items()}, exists)
    complete = all_told & every.reshape(-1, 2, lanes).all(axis=1)
    ended = jnp.any((path.x[:, 2] > limits[1]) | (path.x[:, 2] < limits[0]), axis=0)
    complete &= ended.reshape(2, lanes).all(axis=0)
    complete &= (path.x[:, 2] >= high).any(axis=0).reshape(2, lanes).any(axis=0)
    if special:
        every_map = lambda index: _period_map(take(both, index))  # noqa: E731
        frequencies, all_found = folds_and_doublings(every_map, path, (low, high), SPECIAL, SPECIAL, 2)
        for name, x in zip(("fold_frequency", "doubling_frequency"), frequencies, strict=True):
            results[name] = jnp.broadcast_to(x, (omega.size, *x.shape))
        complete &= all_found
    return results, complete


def _ordered(results: dict[str, Array], exists: Array) -> tuple[dict[str, Array], Array]:
    """Results by rising largest displacement along the second axis, missing ones last, and flags of complete points.

    A point is complete if each position of the branch has its own orbit, and all of them fit into the results.
    """
    order = jnp.argsort(results["branch_u_max"], axis=1)
    ordered = {name: jnp.take_along_axis(x, order, axis=1) for name, x in results.items()}
    high, low = (jnp.moveaxis(ordered[name], 1, 0) for name in ("branch_u_max", "branch_u_min"))
    number = jnp.sum(exists, axis=1)
    all_told = distinct(high, low) & (jnp.sum(jnp.isfinite(high), axis=0) == number) & (number <= BRANCHES)
    return {name: x[:, :BRANCHES] for name, x in ordered.items()}, all_told


def _corrected(model: PiecewiseLinearOscillator, states: Array, exists: Array) -> Array:
    """Orbits ``(u, v)`` and transition matrices, ``(6, K)``, from guesses ``(2, K)``, a block of lanes at a time."""
    total = exists.size
    order = jnp.argsort(~exists)
    order = jnp.concatenate([order, jnp.full(_BLOCK, order[-1])]).astype(jnp.int32)
    count = jnp.sum(exists)

    def block(state: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, store = state
        index = jax.lax.dynamic_slice(order, (begin,), (_BLOCK,))
        ours = begin + jnp.arange(_BLOCK) < count
        lanes = jax.tree.map(lambda x: x + jnp.zeros(_BLOCK), prepare(take(model, index)))

        def correct(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            number, z, _, _ = state
            end = march(lanes, start(lanes, z[0], z[1], jnp.asarray(1, jnp.int32)), _MOST_STEPS)
            step = jnp.stack(newton_correction(end.matrix, end.u - z[0], end.v - z[1]))
            size = jnp.abs(z[0]) + jnp.abs(z[1]) / lanes.omega
            change = (jnp.abs(step[0]) + jnp.abs(step[1]) / lanes.omega) / size
            return number + 1, z + step, jnp.stack(end.matrix), change

        def unfinished(state: tuple[Array, Array, Array, Array]) -> Array:
            return (state[0] < _CORRECTIONS) & jnp.any(ours & (state[3] > 1e-13))

        z = jnp.where(ours, states[:, index], jnp.nan)
        begun = (jnp.asarray(0), z, jnp.zeros((4, _BLOCK)), jnp.full(_BLOCK, jnp.inf))
        _, z, matrix, change = jax.lax.while_loop(unfinished, correct, begun)
        z = jnp.where(change < 1e-9, z, jnp.nan)
        where = jnp.where(ours, index, total)
        return begin + _BLOCK, store.at[:, where].set(jnp.concatenate([z, matrix]), mode="drop")

    store = jnp.full((6, total), jnp.nan)
    return jax.lax.while_loop(lambda state: state[0] < count, block, (jnp.asarray(0), store))[1]


def _described(model: PiecewiseLinearOscillator, states: Array, exists: Array, width: int) -> dict[str, Array]:
    """Extremes and stability of the orbits near ``states`` (2, K)."""
    orbits = _corrected(model, states, exists)
    one = jnp.ones(exists.shape, jnp.int32)
    seen = measure(model, orbits[0], orbits[1], one, width=min(width, exists.size), integrals=False)
    there = jnp.isfinite(orbits[0]) & (seen.complete == 1)
    matrix = tuple(orbits[2:])
    rho = spectral_radius(matrix, log_determinant(model, matrix, model.period))
    stability = jnp.where(rho > 1 + _MARGIN, UNSTABLE, STABLE)
    return {
        "branch_u_max": jnp.where(there, seen.high, jnp.nan),
        "branch_u_min": jnp.where(there, seen.low, jnp.nan),
        "branch_stability": jnp.where(there, stability, ABSENT).astype(jnp.int8),
    }
