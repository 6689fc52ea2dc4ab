"""The propagator of a linear periodic system over the span of its reduced form: what an atlas interpolates.

``Phi`` is a smooth function of the parameters, which multipliers and spectral radius are not. It is computed by the
direct solvers of ``floquet`` with two step sizes; the error is relative to a lower bound of the spectral radius of Phi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.direct import direct_monodromy, stiffness_of
from drivetrain_jax.analysis.floquet_effort import PANEL_COST, explicit_effort, implicit_effort
from drivetrain_jax.analysis.propagator import (
    EXPLICIT_ORDER,
    IMPLICIT_ORDER,
    Propagator,
    explicit_propagator,
    implicit_propagator,
)
from drivetrain_jax.systems import LinearPeriodic, System

VARIABLES = (
    Variable("propagator", "1", "entries of the propagator over the span of the reduced form, by rows", ("entry",)),
    Variable("propagator_error", "1", "estimate of its relative error"),
)


def whole_span(form: LinearPeriodic) -> LinearPeriodic:
    """``form`` with its span taken for the period: the monodromy matrix is then the propagator itself."""
    if form.reversor is None or form.log_determinant is None:
        return replace(form, reversor=None)
    exact = form.log_determinant
    return replace(form, reversor=None, log_determinant=lambda: exact() / 2)


def _solvers(system: System, request: Request) -> tuple[Solver, ...]:
    rtol = request.options["rtol"]

    def solve(values: Mapping[str, Any], effort: Array, explicit: bool) -> dict[str, Array]:
        form = whole_span(system.models["floquet"].build(values).reduced)
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in values.values() if not isinstance(x, str)))

        def propagate(steps: Array) -> Propagator:
            return explicit_propagator(form, steps, shape) if explicit else implicit_propagator(form, steps)

        order, stiffness = (EXPLICIT_ORDER, 0.0) if explicit else (IMPLICIT_ORDER, stiffness_of(form))
        phi = direct_monodromy(form, propagate, effort, shape, stiffness, rtol, order)
        return _results(phi.matrix * jnp.exp(phi.log_scale), phi.error, phi.met, request.outputs)

    return (
        Solver(
            "direct: explicit Runge-Kutta of order 8",
            lambda values, effort: solve(values, effort, True),
            lambda columns: explicit_effort(system, columns, rtol),
            broadcasts=True,
            chunk=512,
        ),
        Solver(
            "direct: Radau IIA of 8 stages",
            lambda values, effort: solve(values, effort, False),
            lambda columns: implicit_effort(system, columns, rtol),
            unit_cost=PANEL_COST,
            chunk=64,
        ),
    )


def _results(phi: Array, error: Array, met: Array, outputs: tuple[str, ...]) -> dict[str, Array]:
    entries = phi.reshape(-1, *phi.shape[2:])
    finite = jnp.all(jnp.isfinite(entries), axis=0)
    outcome = jnp.where(finite, jnp.where(met, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET), Outcome.NOT_FINITE)
    results = {"propagator": jnp.where(finite, entries, jnp.nan), "propagator_error": jnp.where(finite, error, jnp.nan)}
    return {name: results[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}


def _dimensions(system: System, request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    return (Dimension("entry", "row times size plus column", ()),)


ANALYSIS = Analysis(
    name="floquet_propagator",
    title="Propagator of a linear periodic system, for its atlas",
    variables=VARIABLES,
    default_outputs=("propagator", "propagator_error"),
    methods={"direct": ("rtol",)},
    options=(RTOL,),
    solvers=_solvers,
    dimensions=_dimensions,
)
