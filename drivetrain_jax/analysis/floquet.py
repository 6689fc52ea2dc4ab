"""Floquet analysis of a linear periodic system: multipliers, certified spectral radius and verdict of one point.

``direct`` uses the system's reduced form: an explicit scheme of order 8 batched inside the state, or an L-stable
implicit one where that needs fewer operations. ``atlas`` evaluates a whole scene from polynomials held against direct solves
(see ``drivetrain_jax.atlas``), and what they do not cover directly; ``auto`` does so where it is cheaper. ``diffrax``
integrates the system as published over its full period with any adaptive diffrax solver: slower, and independent of
the others in coordinates, clock and factorisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.periodic.direct import compare
from drivetrain_jax.analysis.periodic.direct_solvers import direct_solvers
from drivetrain_jax.analysis.periodic.floquet_effort import explicit_effort
from drivetrain_jax.analysis.periodic.floquet_results import NEED_ERROR, VARIABLES, lacks, results
from drivetrain_jax.analysis.periodic.monodromy import SOLVERS, state_transition
from drivetrain_jax.analysis.periodic.propagator import Propagator
from drivetrain_jax.systems import System

# Passed to `compare` as the reduction of the error, it cancels that function's safety factor: the error is the difference
# between two tolerances a decade apart, as it is.
_REDUCTION = 4.0


def _direct_solvers(system: System, request: Request) -> tuple[Solver, ...]:
    rtol = request.options["rtol"]
    return direct_solvers(
        system,
        rtol,
        rtol / 4,
        lambda model: model.reduced,
        lambda model, z: results(z, request.outputs, rtol, model.natural),
        stiff=lambda model: model.stiff or model.reduced,
    )


def _diffrax_solvers(system: System, request: Request) -> tuple[Solver, ...]:
    import diffrax  # a quarter of the time in which a process that does not need it is ready

    rtol, atol = request.options["rtol"], request.options["atol"]
    method = getattr(diffrax, request.options["solver"])()
    needs_error = bool(NEED_ERROR & set(request.outputs))

    def solve(values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        form = system.models["floquet"].build(values).natural

        def propagate(tolerance: float) -> tuple[Propagator, Array]:
            matrix, success = state_transition(
                form.matrix,
                form.span,
                form.size,
                solver=method,
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance / rtol * atol),
            )
            return Propagator(matrix, jnp.zeros(())), success

        fine, success = propagate(rtol / 10)
        coarse, success_coarse = propagate(rtol) if needs_error else (fine, success)
        z = compare(form, coarse, fine, jnp.zeros(()), 0.0, rtol, _REDUCTION)
        found = results(z, request.outputs, rtol, form)
        failed = ~(success & success_coarse)
        return found | {"outcome": jnp.where(failed, jnp.int8(Outcome.STEP_LIMIT), found["outcome"])}

    def effort(columns: Mapping[str, Any]) -> np.ndarray:
        # Large, not infinite, where the explicit scheme would need too many steps: diffrax tries these points as well.
        return np.nan_to_num(explicit_effort(system, columns, rtol))

    return (Solver(f"diffrax: {request.options['solver']}", solve, effort, chunk=256),)


def _solvers(system: System, request: Request) -> tuple[Solver, ...]:
    return (_diffrax_solvers if request.method == "diffrax" else _direct_solvers)(system, request)


def _lacks(system: System) -> dict[str, str]:
    return lacks(system) | ({} if "atlas" in system.models else {"atlas": f"{system.name} has no model for it"})


ANALYSIS = Analysis(
    name="floquet",
    title="Floquet stability of the equilibrium",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    methods={"auto": ("rtol",), "atlas": ("rtol",), "direct": ("rtol",), "diffrax": ("rtol", "atol", "solver")},
    method_titles={
        "auto": "atlas where that is cheaper, else direct",
        "atlas": "Chebyshev panels held against direct solves, with their bound",
        "direct": "equal steps of order 8, implicit where that is cheaper",
        "diffrax": "adaptive steps, for the equations as published",
    },
    options=(
        RTOL,
        Parameter("atol", "1", "absolute tolerance of the integrator", default=1e-12, lower=0.0, upper=1e-2),
        Parameter("solver", "1", "diffrax solver", default="Dopri8", choices=SOLVERS),
    ),
    solvers=_solvers,
    dimensions=lambda *_: (Dimension("multiplier", "Floquet multipliers by falling modulus", ()),),
    lacks=_lacks,
)
