"""Branches of forced periodic orbits over the speed, stable or not, with their folds and period doublings.

Continuation by arc length (:mod:`~drivetrain_jax.analysis.numerics.continuation`) begins at speeds along the line, at the
orbits to which Newton's method leads from rest there, and runs both ways over a ratio of 1.3, through folds. Newton's method
corrects the orbits at the speeds of the line. Orbits on branches that these do not meet are not found.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.analysis._base import Outcome, Request, Solver
from drivetrain_jax.analysis.forced.analysis import NEAR, SAME, STABLE_MARGIN, distinct, orbits_near
from drivetrain_jax.analysis.forced.orbit import REACH, speed_map
from drivetrain_jax.analysis.impacts.motion import ABSENT, STABILITY, STABLE, UNSTABLE
from drivetrain_jax.analysis.numerics.continuation import course, folds_and_doublings, follow, sections
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import ForcedModel, System

BRANCHES, _SPECIAL = 7, 16
# Ratio of neighbouring starts, most starts, steps of each branch, its longest step, and the tolerance of its integrations.
_SPACING, _STARTS, _ATTEMPTS, _LONGEST, _RTOL = 1.15, 48, 150, 0.06, 1e-9
# Positions of one branch at a speed, folds and doublings of each kind on one branch, most steps of an integration.
_EACH, _EACH_SPECIAL, _STEPS = 3, 4, 4096


def variables(system: type[System]) -> tuple[Variable, ...]:
    """Variables of the branches, in the units of the system's displacements."""
    assert system.displacements is not None  # System refuses a model of forced without them
    units, speed = system.state[0].units, system.parameter(system.role("speed")).units
    own = ("branch",)
    return (
        Variable("branch_amplitude", units, "largest displacement of the orbits", (*own, system.displacements.name)),
        Variable("branch_spectral_radius", "1", "spectral radius of the monodromy matrix about the orbits", own),
        Variable("branch_stability", "1", "stability of the orbits", own, dtype="int8", flags=STABILITY),
        Variable("fold_frequency", speed, "speeds at which branches turn back, rising", ("fold",)),
        Variable("doubling_frequency", speed, "speeds at which periods double, rising", ("doubling",)),
    )


def dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Orbits, displacements, folds and doublings."""
    assert system.displacements is not None
    numbers = tuple(range(1, _SPECIAL + 1))
    return (
        Dimension("branch", "number of the orbit, by rising amplitude", tuple(range(1, BRANCHES + 1))),
        system.displacements,
        Dimension("fold", "number of the fold", numbers),
        Dimension("doubling", "number of the period doubling", numbers),
    )


def solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    """The solver of lines."""
    solve = over_lanes(partial(_solve, system, request))
    return (Solver("continuation", solve, seconds=1e-2, chunk=8, march=True, short_loops=True, lengthy=True),)


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """The requested results of one line; ``effort`` only orders the batches."""
    speed, n = system.role("speed"), len(system.state)
    rising, place = np.unique(np.asarray(values[speed]), return_inverse=True)

    def model_at(value: Any) -> ForcedModel:
        return system.models["frequency_response"].build({**values, speed: value})

    special = not {"fold_frequency", "doubling_frequency"}.isdisjoint(request.outputs)
    guesses, every, frequencies = _branches(model_at, rising, n, special)

    def at(each: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        value, guess, every = each
        found = orbits_near(model_at(value), guess, request.options["rtol"])
        exists = distinct(found.orbit.state, SAME)
        order = jnp.lexsort((jnp.max(found.largest, axis=1), ~exists))
        exists = exists[order]
        largest = jnp.where(exists[:, None], found.largest[order], jnp.nan)
        radius = jnp.where(exists, found.radius[order], jnp.nan)
        stability = jnp.where(radius > 1 + STABLE_MARGIN, UNSTABLE, STABLE)
        stability = jnp.where(exists, stability, ABSENT).astype(jnp.int8)
        missed = jnp.any(exists & (found.orbit.outcome[order] != Outcome.SUCCESS))
        lost = jnp.any(jnp.isfinite(guess[:, 0]) & jnp.isnan(found.radius))
        outcome = jnp.where(missed | lost | ~every, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
        outcome = jnp.where(jnp.any(exists), outcome, Outcome.NOT_CONVERGED)
        return largest, radius, stability, outcome.astype(jnp.int8)

    columns = jax.lax.map(at, (jnp.asarray(rising), guesses, every))
    names = ("branch_amplitude", "branch_spectral_radius", "branch_stability", "outcome")
    results = {name: column[place] for name, column in zip(names, columns, strict=True)}
    results |= {name: jnp.broadcast_to(x, (place.size, *x.shape)) for name, x in frequencies.items()}
    return {name: results[name] for name in (*request.outputs, "outcome")}


def _branches(model_at: Any, rising: np.ndarray, n: int, special: bool) -> tuple[Array, Array, dict[str, Array]]:
    """Approximate orbits at the speeds ``rising`` (L,), ``(L, BRANCHES, n)``, NaN after the last; flags of speeds with no
    others, ``(L,)``; and frequencies of folds and doublings, if ``special``."""
    low, high = float(rising[0]), float(rising[-1])
    starts = np.geomspace(low, high, min(math.ceil(math.log(high / low) / math.log(_SPACING)) + 1, _STARTS))
    at = jnp.asarray(np.tile(starts, 2))
    x = jnp.concatenate([jnp.zeros((n, at.size)), at[None]])
    scale = jnp.concatenate([jnp.ones((n, at.size)), at[None]])
    mapped = jax.vmap(lambda x: speed_map(model_at, x, _RTOL, _STEPS), 1, -1)
    found = follow(
        mapped,
        x,
        scale,
        direction=jnp.repeat(jnp.array([1.0, -1.0]), starts.size),
        attempts=_ATTEMPTS,
        longest=_LONGEST,
        limits=(jnp.maximum(at / REACH, low) * (1 - 1e-9), jnp.minimum(at * REACH, high) * (1 + 1e-9)),
        converged=1e-9,
    )
    along = course(found.x, scale)

    def positions(value: Array) -> tuple[Array, Array]:
        guess, exists, every = sections(along, value, _EACH)
        y = jnp.where(exists[:, None], guess, jnp.nan)[:, :n].transpose(0, 2, 1).reshape(-1, n)
        new = distinct(y, NEAR)
        first = jnp.argsort(~new)[:BRANCHES]
        return jnp.where(new[first][:, None], y[first], jnp.nan), jnp.all(every) & (jnp.sum(new) <= BRANCHES)

    guesses, every = jax.lax.map(positions, jnp.asarray(rising))
    frequencies: dict[str, Array] = {}
    if special:
        p, complete = folds_and_doublings(lambda _: mapped, found, (low, high), _EACH_SPECIAL, _SPECIAL, at.size)
        frequencies |= zip(("fold_frequency", "doubling_frequency"), p[..., 0], strict=True)
        every &= complete[0]
    return guesses, every, frequencies
