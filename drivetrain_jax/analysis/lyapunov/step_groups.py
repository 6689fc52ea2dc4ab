"""Limits on the work of a run, and groups of members that need a similar number of steps.

A batch marches in lockstep: every member pays for the most steps per strobe and for the most strobes of all members. One
group for each range of steps bounds this product, so an extreme member does not multiply the work of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis._base import MOST_STEPS, Outcome, Request
from drivetrain_jax.analysis.lyapunov.growth_record import SEGMENTS
from drivetrain_jax.analysis.lyapunov.march_steps import LEAST, MOST, needed_steps
from drivetrain_jax.analysis.lyapunov.variational import batch_shape, initial_state
from drivetrain_jax.systems import Flow

# Most steps of a run of up to a second with predicted steps, in proportion for a longer one: half a minute on one core. The
# paper's scenes take 1e6 steps in 4 s, and the driveshaft at 10 Hz takes 3e6.
MOST_WORK = 2e7
# Upper limits of the steps per strobe of each group.
_GROUPS = (200, 1000, 5000, 25_000, MOST)


def starts(flow: Flow) -> Array:
    """Flags where the period, the state and the field are finite at the start, shape (...)."""
    y = initial_state(flow)
    values = (flow.period, *y, *flow.field(flow.angles(0, 0.0), y))
    return jnp.broadcast_to(reduce(jnp.logical_and, map(jnp.isfinite, map(jnp.asarray, values))), batch_shape(flow))


def is_short_enough(steps: Any, strobes: Any, following: int, request: Request) -> Any:
    """Flags where ``strobes`` in ``max_time`` and the ``following`` ones are within the limits of work.

    The limit grows with given ``steps``, because the user asked for them.
    """
    given, longest = request.options["steps"], request.options["max_time"]
    most = MOST_WORK * max(1.0, longest) * max(1.0, (given or LEAST) / LEAST)
    within = (steps * strobes <= MOST_STEPS) & (steps * (strobes + SEGMENTS + following) <= most)
    return within if given else within & (steps <= MOST)


def by_groups(
    flow: Flow,
    request: Request,
    following: int,
    march: Callable[[Any, Array], dict[str, Array]],
    blank: Mapping[str, Any],
) -> dict[str, Array]:
    """Results of ``march(steps, members)`` of each group, merged; those of members without a march are ``blank`` or NaN.

    The outcome is ``NOT_FINITE`` without a start.
    """
    given = request.options["steps"]
    needed = jnp.full(batch_shape(flow), float(given)) if given else needed_steps(flow)
    started = starts(flow)
    able = started & is_short_enough(needed, request.options["max_time"] / jnp.asarray(flow.period), following, request)

    def empty() -> dict[str, Array]:
        shapes = jax.eval_shape(lambda: march(given or jnp.int64(LEAST), able))
        found = {name: jnp.full(x.shape, blank.get(name, jnp.nan), x.dtype) for name, x in shapes.items()}
        return found | {"outcome": jnp.where(started, found["outcome"], jnp.int8(Outcome.NOT_FINITE))}

    def group(found: dict[str, Array], limits: tuple[Any, Any]) -> tuple[dict[str, Array], None]:
        members = able & (needed > limits[0]) & (needed <= limits[1])
        steps = given or jnp.max(jnp.where(members, needed, LEAST)).astype(jnp.int64)

        def merged() -> dict[str, Array]:
            new = march(steps, members)
            return {name: jnp.where(members, new[name], x) for name, x in found.items()}

        return jax.lax.cond(jnp.any(members), merged, lambda: found), None

    if given or flow.fastest is None:
        return group(empty(), (0.0, jnp.inf))[0]
    limits = jnp.array([0.0, *_GROUPS[:-1]]), jnp.array(_GROUPS, float)
    return jax.lax.scan(group, empty(), limits)[0]
