"""Floquet analysis of a linear periodic system: multipliers, certified spectral radius and verdict of one point.

``direct`` (what ``auto`` means at present) uses the system's reduced form: an explicit scheme of order 8 batched
inside the state, or an L-stable implicit one where that needs fewer operations. ``diffrax`` integrates the system as
published over its full period with any adaptive diffrax solver: slower, and independent of the former in coordinates,
clock and factorisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.direct import Monodromy, compare, direct_monodromy, stiffness_of
from drivetrain_jax.analysis.linear_algebra import eigenvalues
from drivetrain_jax.analysis.monodromy import SOLVERS, state_transition
from drivetrain_jax.analysis.multipliers import VERDICTS, sort_multipliers, spectral_radius_bound, verdict
from drivetrain_jax.analysis.propagator import (
    EXPLICIT_ORDER,
    IMPLICIT_ORDER,
    Propagator,
    explicit_propagator,
    implicit_propagator,
)
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System

VARIABLES = (
    Variable("floquet_multiplier", "1", "Floquet multiplier over one period", ("multiplier",), "complex128"),
    Variable("spectral_radius", "1", "largest modulus of the Floquet multipliers"),
    Variable("spectral_radius_error", "1", "bound of the absolute error of spectral_radius"),
    Variable("verdict", "1", "stability of the equilibrium", dtype="int8", flags=VERDICTS),
    Variable(
        "liouville_residual", "1", "determinant of the monodromy matrix minus its exact value, over spectral_radius^n"
    ),
)
_NEED_ERROR = {"spectral_radius_error", "verdict"}
# Below this many explicit steps the implicit scheme is never the cheaper one.
_STIFF = 600
# Seconds of one implicit panel over those of one explicit step, per point: 150 in full batches, less in small ones.
_PANEL_COST = 50.0
# Beyond these a scheme does not start: the point is left to the other one, or ends as STEP_LIMIT.
_MAX_EXPLICIT, _MAX_PANELS = 300_000, 20_000
# The diffrax error is the difference between two tolerances a decade apart, taken as it is (see `compare`).
_TOLERANCE_GAP = 4.0


def _results(z: Monodromy, outputs: tuple[str, ...], rtol: float) -> dict[str, Array]:
    """The requested variables and the outcome from a monodromy matrix with trailing batch axes."""
    wanted = set(outputs)
    finite = jnp.all(jnp.isfinite(z.matrix), axis=(0, 1))
    real, imaginary = eigenvalues(jnp.where(finite, z.matrix, jnp.nan))
    size = jnp.exp(z.log_scale)
    rho = jnp.max(jnp.hypot(real, imaginary), axis=0) * size
    results = {"spectral_radius": rho}
    outcome, met = jnp.where(finite, Outcome.SUCCESS, Outcome.NOT_FINITE), z.met
    if "floquet_multiplier" in wanted:
        results["floquet_multiplier"] = sort_multipliers(real, imaginary) * size
    if "liouville_residual" in wanted:
        results["liouville_residual"] = jnp.where(finite, z.residual, jnp.nan)
    if wanted & _NEED_ERROR:
        error = spectral_radius_bound(real, imaginary, z.error) * size
        met = error <= 10 * rtol * rho
        results |= {"spectral_radius_error": error, "verdict": verdict(rho, error)}
    outcome = jnp.where(finite & ~met, Outcome.TOLERANCE_NOT_MET, outcome)
    return {name: results[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}


def _frequency_phase(form: LinearPeriodic, size: int) -> np.ndarray:
    """int max |Im lambda(A(t))| dt over the span for ``size`` points, by Gauss quadrature with 8 nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    phase = np.zeros(size)
    for x, weight in zip(nodes, weights, strict=True):
        a = np.asarray(form.matrix((x + 1) * form.span / 2))
        a = np.broadcast_to(np.moveaxis(a.reshape(*a.shape[:2], -1), -1, 0), (size, *a.shape[:2]))
        finite = np.isfinite(a).all(axis=(1, 2))
        frequency = np.abs(np.linalg.eigvals(np.where(finite[:, None, None], a, 0.0)).imag).max(-1)
        phase += weight * form.span / 2 * np.where(finite, frequency, np.inf)
    return phase


def _generic_steps(form: LinearPeriodic, rtol: float) -> np.ndarray:
    """Steps of the explicit scheme from the size of A^2 at 16 instants, for systems that predict none."""
    samples = [np.asarray(form.matrix((k + 0.5) * form.span / 16)) for k in range(16)]
    rates = [np.sqrt(np.linalg.norm(np.einsum("ij...,jk...->ik...", a, a), axis=(0, 1))) for a in samples]
    phase = form.span * np.maximum(np.mean(rates, axis=0), np.max(rates, axis=0) / 2)
    return (4 + 2.5 * phase**1.1) * (1e-9 / rtol) ** (1 / 9)


def _explicit_effort(system: System, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    model: FloquetModel = system.models["floquet"].build(columns)
    size = max(np.size(column) for column in columns.values())
    steps = model.explicit_steps(rtol) if model.explicit_steps else _generic_steps(model.reduced, rtol)
    # Even, so that the coarse solution has exactly half as many.
    return np.broadcast_to(2 * np.ceil(steps / 2), size)


def _implicit_effort(system: System, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    """Panels of the implicit scheme: it must resolve what oscillates, whereas decay costs it nothing."""
    explicit = _explicit_effort(system, columns, rtol)
    effort = np.full(explicit.shape, np.inf)
    stiff = np.flatnonzero(explicit > _STIFF)
    if stiff.size:
        chosen = {name: np.broadcast_to(column, explicit.shape)[stiff] for name, column in columns.items()}
        phase = _frequency_phase(system.models["floquet"].build(chosen).reduced, stiff.size)
        effort[stiff] = 2 * np.ceil((8 + phase / 5) * (1e-10 / rtol) ** (1 / 16) / 2)
    return _up_to(_MAX_PANELS, effort)


def _up_to(limit: int, effort: np.ndarray) -> np.ndarray:
    return np.where(effort <= limit, effort, np.inf)


def _direct_solvers(system: System, request: Request) -> tuple[Solver, ...]:
    rtol = request.options["rtol"]

    def solve(values: Mapping[str, Any], effort: Array, explicit: bool) -> dict[str, Array]:
        form = system.models["floquet"].build(values).reduced
        shape = jnp.broadcast_shapes(*(jnp.shape(value) for value in values.values()))

        def propagate(steps: Array) -> Propagator:
            if explicit:
                return explicit_propagator(form, steps, shape)
            return implicit_propagator(form, steps)

        order, stiffness = (EXPLICIT_ORDER, 0.0) if explicit else (IMPLICIT_ORDER, stiffness_of(form))
        z = direct_monodromy(form, propagate, effort, shape, stiffness, rtol / 4, order)
        return _results(z, request.outputs, rtol)

    return (
        Solver(
            "direct: explicit Runge-Kutta of order 8",
            lambda values, effort: solve(values, effort, True),
            lambda columns: _up_to(_MAX_EXPLICIT, _explicit_effort(system, columns, rtol)),
            broadcasts=True,
            chunk=512,
        ),
        Solver(
            "direct: Radau IIA of 8 stages",
            lambda values, effort: solve(values, effort, False),
            lambda columns: _implicit_effort(system, columns, rtol),
            unit_cost=_PANEL_COST,
            chunk=64,
        ),
    )


def _diffrax_solvers(system: System, request: Request) -> tuple[Solver, ...]:
    rtol, atol = request.options["rtol"], request.options["atol"]
    method = getattr(diffrax, request.options["solver"])()
    needs_error = bool(_NEED_ERROR & set(request.outputs))

    def solve(values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        form = system.models["floquet"].build(values).natural

        def propagate(tolerance: float) -> tuple[Propagator, Array]:
            _, matrix, success = state_transition(
                lambda t, y: form.matrix(t) @ y,
                form.span,
                jnp.zeros(form.size),
                solver=method,
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance / rtol * atol),
                along=False,
            )
            return Propagator(matrix, jnp.zeros(())), success

        fine, success = propagate(rtol / 10)
        coarse, success_coarse = propagate(rtol) if needs_error else (fine, success)
        z = compare(form, coarse, fine, jnp.zeros(()), 0.0, rtol, _TOLERANCE_GAP)
        results = _results(z, request.outputs, rtol)
        failed = ~(success & success_coarse)
        return results | {"outcome": jnp.where(failed, jnp.int8(Outcome.STEP_LIMIT), results["outcome"])}

    return (
        Solver(
            f"diffrax: {request.options['solver']}",
            solve,
            lambda columns: np.nan_to_num(_explicit_effort(system, columns, rtol)),
            chunk=256,
        ),
    )


def _solvers(system: System, request: Request) -> tuple[Solver, ...]:
    return (_diffrax_solvers if request.method == "diffrax" else _direct_solvers)(system, request)


ANALYSIS = Analysis(
    name="floquet",
    title="Floquet stability of the equilibrium",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    methods={"auto": ("rtol",), "direct": ("rtol",), "diffrax": ("rtol", "atol", "solver")},
    options=(
        RTOL,
        Parameter("atol", "1", "absolute tolerance of the integrator", default=1e-12, lower=0.0, upper=1e-2),
        Parameter("solver", "1", "diffrax solver", default="Dopri8", choices=SOLVERS),
    ),
    solvers=_solvers,
    dimensions=lambda *_: (Dimension("multiplier", "Floquet multipliers by falling modulus", ()),),
)
