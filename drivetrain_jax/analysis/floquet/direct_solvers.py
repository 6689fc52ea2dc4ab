"""The direct solvers of a periodic system: explicit, batched inside the state, and L-stable where that is cheaper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Solver
from drivetrain_jax.analysis.floquet.direct import MAX_STEPS, Monodromy, direct_monodromy, stable_steps, stiffness_of
from drivetrain_jax.analysis.floquet.effort import LONG, MAX_PANELS, PANEL_COST, efforts, traced_steps
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Propagator
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Ratio of the steps of the two explicit solutions behind an error estimate, and the loosest target for it. The ratio needs a
# system that predicts its steps: elsewhere so few steps may not show the order of the scheme.
_RATIO, _FINE = 4, 1e-8

Form = Callable[["FloquetModel"], "LinearPeriodic"]
Results = Callable[["FloquetModel", Monodromy], dict[str, Array]]


def direct_solvers(
    system: type[System],
    rtol: float,
    target: float,
    form: Form,
    results: Results,
    chunks: tuple[int, int] = (512, 64),
    stiff: Form | None = None,
) -> tuple[Solver, ...]:
    """Solvers that return ``results(model, monodromy)`` from the monodromy matrix of ``form(model)``.

    ``rtol`` predicts the effort; every point is refined to the error ``target``. ``stiff(model)`` is the form for the
    implicit scheme, and for the explicit scheme where damping is strong; with None both use ``form``.
    """
    solve = partial(_solve, system, target, results)

    def explicit(name: str, form: Form, effort: Callable[[Mapping[str, Any]], Any]) -> Solver:
        return Solver(
            f"direct: explicit Runge-Kutta of order 8{name}",
            lambda values, steps: solve(form, values, steps, True),
            effort,
            lambda values: traced_steps(system.models["floquet"].build, values, rtol),
            chunk=chunks[0],
            march=True,
            short_loops=True,
        )

    predicted = _Efforts(system, rtol, stiff is not None)

    implicit = Solver(
        "direct: Radau IIA of 8 stages",
        over_lanes(lambda values, effort: solve(stiff or form, values, effort, False)),
        predicted.of("implicit"),
        unit_cost=PANEL_COST,
        chunk=chunks[1],
        march=True,
        short_loops=True,
    )
    plain = explicit("", form, predicted.of("short"))
    long = explicit(", long marches", form, predicted.of("long"))
    if stiff is None:
        return plain, implicit, long
    return plain, implicit, explicit(", form for strong damping", stiff, predicted.of("damped")), long


class _Efforts:
    """Efforts of the ``implicit`` scheme and of three kinds of explicit march: ``short``, ``long`` and ``damped``.

    A damped march uses the form ``stiff``. A point has its steps in one kind of march and inf in the others. The last
    request is cached, because the solvers of a plan request the same columns in turn.
    """

    def __init__(self, system: type[System], rtol: float, has_stiff: bool) -> None:
        self._system, self._rtol, self._has_stiff = system, rtol, has_stiff
        self._last: tuple[Mapping[str, Any], Mapping[str, np.ndarray]] = ({}, {})

    def of(self, kind: str) -> Callable[[Mapping[str, Any]], np.ndarray]:
        """The efforts of ``kind`` as a function of the columns."""
        return lambda columns: self._all(columns)[kind]

    def _all(self, columns: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        asked, found = self._last
        if asked is not columns:
            steps, damped, panels = efforts(self._system, columns, self._rtol)
            damped = damped & self._has_stiff
            kinds = {"short": ~damped & (steps <= LONG), "long": ~damped & (steps > LONG), "damped": damped}
            found = {kind: np.where(mine, steps, np.inf) for kind, mine in kinds.items()} | {"implicit": panels}
            self._last = columns, found
        return found


def _solve(
    system: type[System],
    target: float,
    results: Results,
    form: Form,
    values: Mapping[str, Any],
    effort: Array,
    explicit: bool,
) -> dict[str, Array]:
    # Local import: diffrax takes as long as jax, and only tracing needs it.
    from drivetrain_jax.analysis.floquet.propagator import PIECES, Order8, Radau, propagator

    scheme = Order8 if explicit else Radau
    build = system.models["floquet"].build
    model = build(values)
    periodic = form(model)
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in values.values() if not isinstance(x, str)))
    least = stable_steps(periodic) if explicit else 0.0
    # The growth of errors is measured in more pieces where damping is strong: there modes decay at very different rates.
    pieces = jnp.clip(least, 1, PIECES).astype(effort.dtype) if explicit else PIECES

    def propagate(steps: Array, pieces: Array) -> Propagator:
        def one(own: Mapping[str, Any], _: None) -> Propagator:
            return propagator(form(build(own)), steps, pieces, scheme)

        return over_lanes(one)(values, None) if shape else one(values, None)

    stiffness = stiffness_of(periodic, shape)
    ratio = jnp.where(target <= _FINE, _RATIO, 2) if explicit and model.explicit_steps else 2
    found = direct_monodromy(
        periodic, propagate, effort, shape, stiffness, target, scheme.ORDER, ratio, least, pieces,
        most=MAX_STEPS if explicit else 2 * MAX_PANELS,
    )  # fmt: skip
    return results(model, found)
