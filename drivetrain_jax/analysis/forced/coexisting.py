"""Periodic orbits over the speed: their map over a period, and a search for those that coexist at one speed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.forced.orbit import transition
from drivetrain_jax.analysis.numerics.branch_sections import course, sections
from drivetrain_jax.analysis.numerics.continuation import Mapped, follow
from drivetrain_jax.systems import ForcedModel

# Ratio of speeds over which the search runs, and orbits kept of each direction.
REACH, _EACH = 1.3, 3
# Most steps of the search, its longest step, tolerance of its integrations, and last correction of its points. All are
# coarse, because Newton's method corrects what is found.
_ATTEMPTS, _LONGEST, _RTOL, _CONVERGED = 60, 0.1, 1e-5, 1e-3
# Most steps of an integration of the search: far from any orbit of interest a state may oscillate without limit.
_STEPS = 256
# Most orbits that a point compares: from the path of growing forcing, and from both directions of the search.
MOST = 1 + 2 * _EACH


def speed_map(model_at: Callable[[Any], ForcedModel], x: Array, rtol: float, most: int = _STEPS) -> Mapped:
    """The map over a period of one lane ``x = (y, speed)``, shape ``(n + 1,)``.

    NaN if the integration fails or needs more than ``most`` steps.
    """
    n = x.size - 1

    def extended(s: Any, x: Array) -> Array:
        model = model_at(x[n])
        return jnp.append(model.period * model.field(model.period * s, x[:n]), 0.0)

    # Lanes that have ended are NaN: they integrate over an empty span.
    step = transition(extended, x, jnp.where(jnp.all(jnp.isfinite(x)), 1.0, 0.0), rtol, most)
    end = jnp.where(step.outcome == Outcome.SUCCESS, step.end[:n], jnp.nan)
    return Mapped(end, step.matrix[:n, :n], step.matrix[:n, n], jnp.asarray(step.steps, float))


def neighbours(model_at: Callable[[Any], ForcedModel], speed: Array, n: int) -> Array:
    """Approximate orbits at ``speed`` on branches from a lower and from a higher speed, ``(MOST - 1, n)``, NaN if missing.

    Both branches begin at the orbit to which Newton's method leads from rest, 1.3 times below and above the speed, and run
    through folds to the other end of this range.
    """
    far = speed * jnp.array([1 / REACH, REACH])
    x = jnp.concatenate([jnp.zeros((n, 2)), far[None]])
    scale = jnp.concatenate([jnp.ones((n, 2)), jnp.full((1, 2), speed)])
    found = follow(
        jax.vmap(lambda x: speed_map(model_at, x, _RTOL), 1, -1),
        x,
        scale,
        direction=jnp.array([1.0, -1.0]),
        attempts=_ATTEMPTS,
        longest=_LONGEST,
        limits=(far[0] * (1 - 1e-9), far[1] * (1 + 1e-9)),
        converged=_CONVERGED,
        special=False,
    )
    guess, exists, _ = sections(course(found.x, scale), speed, _EACH)
    return jnp.where(exists[:, None], guess, jnp.nan)[:, :n].transpose(0, 2, 1).reshape(-1, n)
