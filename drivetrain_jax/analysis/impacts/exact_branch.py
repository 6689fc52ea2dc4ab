"""All orbits of the drive's period on the branch of a sweep, stable or not, with the folds and period doublings.

The branch runs through the first motion of period one of the sweep up. Continuation by arc length goes both ways to the
ends of the line (:mod:`~drivetrain_jax.analysis.numerics.continuation`). Newton's method corrects the orbits at the
frequencies of the line. Orbits of longer periods and closed branches are not included.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.impacts.attractor import take
from drivetrain_jax.analysis.impacts.motion import ABSENT, STABLE, UNSTABLE
from drivetrain_jax.analysis.impacts.orbit_measures import measure
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.analysis.impacts.plane_map import log_determinant, newton_correction, spectral_radius
from drivetrain_jax.analysis.numerics.branch_sections import course, distinct, sections
from drivetrain_jax.analysis.numerics.continuation import Mapped, PeriodMap, folds_and_doublings, follow
from drivetrain_jax.systems import PiecewiseLinearOscillator

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
        twice = {name: jnp.tile(value, 2) for name, value in vars(model).items() if name != "omega" and jnp.ndim(value)}
        lanes = prepare(replace(model, **twice).at(omega))
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
    own = {name: jnp.tile(v, 2) for name, v in vars(model).items() if name != "omega" and jnp.ndim(v)}
    both = replace(model, omega=1.0, **own)
    twice = jnp.tile(first, (1, 2))
    way = jnp.repeat(jnp.array([1.0, -1.0]), first.shape[1])
    limits = (low * (1 - 1e-9), high * (1 + 1e-9))
    scale = _scale(both, twice, limits[1])
    mapped = _period_map(both)
    found = follow(mapped, twice, scale, direction=way, attempts=_ATTEMPTS, longest=_LONGEST, limits=limits)
    along = course(found.x, scale)
    guess, exists, every = jax.lax.map(lambda w: sections(along, w, BRANCHES), jnp.asarray(omega))
    lanes = first.shape[1]
    number = np.broadcast_to(np.arange(omega.size)[:, None, None] * lanes, exists.shape)
    index = jnp.asarray((number + np.tile(np.arange(lanes), 2)).reshape(-1))
    points = _points(model, omega, lanes)
    states = jnp.moveaxis(guess, 2, 0).reshape(3, -1)[:2]
    results = _described(take(points, index), states, exists.reshape(-1), width)
    exists = exists.reshape(omega.size, 2 * BRANCHES, lanes)
    results, all_told = _ordered({name: x.reshape(exists.shape) for name, x in results.items()}, exists)
    complete = all_told & every.reshape(-1, 2, lanes).all(axis=1)
    complete &= _ended(found.x[:, 2], limits).reshape(2, lanes).all(axis=0)
    complete &= (found.x[:, 2] >= high).any(axis=0).reshape(2, lanes).any(axis=0)
    if special:
        every_map = lambda index: _period_map(take(both, index))  # noqa: E731
        frequencies, all_found = folds_and_doublings(every_map, found, (low, high), SPECIAL, SPECIAL, 2)
        for name, x in zip(("fold_frequency", "doubling_frequency"), frequencies, strict=True):
            results[name] = jnp.broadcast_to(x, (omega.size, *x.shape))
        complete &= all_found
    return results, complete


def _ended(omega: Array, limits: tuple[float, float]) -> Array:
    """True if the branch has left the limits."""
    return jnp.any((omega > limits[1]) | (omega < limits[0]), axis=0)


def _points(model: PiecewiseLinearOscillator, omega: np.ndarray, lanes: int) -> PiecewiseLinearOscillator:
    """The oscillators of all points, frequencies first."""
    own = {k: jnp.tile(v, omega.size) for k, v in vars(model).items() if k != "omega" and jnp.ndim(v)}
    return replace(model, **own).at(jnp.asarray(np.repeat(omega, lanes)))


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
    found = _corrected(model, states, exists)
    one = jnp.ones(exists.shape, jnp.int32)
    seen = measure(model, found[0], found[1], one, width=min(width, exists.size), integrals=False)
    there = jnp.isfinite(found[0]) & (seen.complete == 1)
    matrix = tuple(found[2:])
    rho = spectral_radius(matrix, log_determinant(model, matrix, model.period))
    stability = jnp.where(rho > 1 + _MARGIN, UNSTABLE, STABLE)
    return {
        "branch_u_max": jnp.where(there, seen.high, jnp.nan),
        "branch_u_min": jnp.where(there, seen.low, jnp.nan),
        "branch_stability": jnp.where(there, stability, ABSENT).astype(jnp.int8),
    }
