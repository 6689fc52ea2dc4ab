"""The direct solvers of a periodic system: explicit, batched inside the state, and L-stable where that is cheaper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Solver
from drivetrain_jax.analysis.numerics.lanes import in_blocks
from drivetrain_jax.analysis.periodic.direct import Monodromy, direct_monodromy, stable_steps, stiffness_of
from drivetrain_jax.analysis.periodic.floquet_effort import (
    LONG,
    PANEL_COST,
    explicit_effort,
    implicit_effort,
    strongly_damped,
)
from drivetrain_jax.analysis.periodic.propagator import (
    EXPLICIT_ORDER,
    IMPLICIT_ORDER,
    LANES,
    PIECES,
    Propagator,
    explicit_propagator,
    implicit_propagator,
)
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System

# Steps of the explicit scheme over those of the coarser solution that tells its error, up to this rtol, where the system
# predicts them itself: of any other one it is not known that the order of the scheme shows with so few.
_RATIO, _FINE = 4, 1e-8

Form = Callable[[FloquetModel], LinearPeriodic]
Results = Callable[[FloquetModel, Monodromy], dict[str, Array]]


def direct_solvers(
    system: System,
    rtol: float,
    target: float,
    form: Form,
    results: Results,
    chunks: tuple[int, int] = (512, 64),
    stiff: Form | None = None,
) -> tuple[Solver, ...]:
    """Solvers that give ``results(model, monodromy)`` from the monodromy matrix of ``form(model)``.

    ``rtol`` predicts the effort, ``target`` is the error that every point is refined to. ``stiff(model)`` is the form for
    the implicit scheme, and for the explicit one where damping is strong; None if it is no other one.
    """
    solve = partial(_solve, system, target, results)

    def explicit(name: str, form: Form, effort: Callable[[Mapping[str, Any]], Any]) -> Solver:
        return Solver(
            f"direct: explicit Runge-Kutta of order 8{name}",
            lambda values, steps: solve(form, values, steps, True),
            effort,
            broadcasts=True,
            chunk=chunks[0],
            march=True,
            short_loops=True,
        )

    steps = _ExplicitSteps(system, rtol, stiff is not None)

    implicit = Solver(
        "direct: Radau IIA of 8 stages",
        lambda values, effort: solve(stiff or form, values, effort, False),
        lambda columns: implicit_effort(system, columns, rtol),
        unit_cost=PANEL_COST,
        chunk=chunks[1],
        march=True,
        short_loops=True,
    )
    plain = explicit("", form, lambda columns: steps(columns)["short"])
    long = explicit(", long marches", form, lambda columns: steps(columns)["long"])
    if stiff is None:
        return plain, implicit, long
    return plain, implicit, explicit(", form for strong damping", stiff, lambda columns: steps(columns)["damped"]), long


class _ExplicitSteps:
    """Steps of the explicit scheme by march: ``short``, ``long`` or ``damped`` (the other form), inf for the other two.

    Those asked for last are kept: the solvers of a plan ask for the same columns one after the other.
    """

    def __init__(self, system: System, rtol: float, has_stiff: bool) -> None:
        self._system, self._rtol, self._has_stiff = system, rtol, has_stiff
        self._last: tuple[Mapping[str, Any], Mapping[str, np.ndarray]] = ({}, {})

    def __call__(self, columns: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        asked, found = self._last
        if asked is not columns:
            steps = explicit_effort(self._system, columns, self._rtol)
            damped = strongly_damped(self._system, columns) if self._has_stiff else np.zeros(steps.shape, bool)
            kinds = {"short": ~damped & (steps <= LONG), "long": ~damped & (steps > LONG), "damped": damped}
            found = {kind: np.where(mine, steps, np.inf) for kind, mine in kinds.items()}
            self._last = columns, found
        return found


def _solve(
    system: System,
    target: float,
    results: Results,
    form: Form,
    values: Mapping[str, Any],
    effort: Array,
    explicit: bool,
) -> dict[str, Array]:
    model = system.models["floquet"].build(values)
    periodic = form(model)
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in values.values() if not isinstance(x, str)))
    least = stable_steps(periodic) if explicit else 0.0
    # Errors grow on the way where modes decay at rates that differ by much, and by other ones later than at first.
    pieces = jnp.clip(least, 1, PIECES).astype(effort.dtype)

    def in_lanes(steps: Array) -> Propagator:
        def block(part: Mapping[str, Any], count: int) -> Propagator:
            own = form(system.models["floquet"].build(part))
            return explicit_propagator(own, steps, (count,) if shape else (), pieces)

        return in_blocks(block, values, shape[0] if shape else 1, LANES)

    def one(steps: Array) -> Propagator:
        return implicit_propagator(periodic, steps)

    propagate = in_lanes if explicit else one
    order = EXPLICIT_ORDER if explicit else IMPLICIT_ORDER
    stiffness = stiffness_of(periodic, shape)
    ratio = jnp.where(target <= _FINE, _RATIO, 2) if explicit and model.explicit_steps else 2
    found = direct_monodromy(periodic, propagate, effort, shape, stiffness, target, order, ratio, least)
    return results(model, found)
