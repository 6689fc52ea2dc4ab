"""Stability as a function of the parameters, for scenes whose axes are ranges.

``SOLVES`` computes propagators; panels interpolate them, and give the results of ``floquet`` anywhere in the ranges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.floquet.analysis import direct_solvers
from drivetrain_jax.analysis.floquet.direct import Monodromy
from drivetrain_jax.analysis.floquet.results import VARIABLES, lacks
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.systems import LinearPeriodic

# The propagator of a linear periodic system over the span of its reduced form, interpolated by an atlas.
#
# ``Phi`` is a smooth function of the parameters; multipliers and spectral radius are not. The direct solvers of
# ``floquet`` compute it with two step sizes, whose difference estimates its error.

# The interpolated result, and its error.
PROPAGATOR, CHANGE = "propagator", "propagator_change"
_SOLVED = (
    Variable(PROPAGATOR, "1", "entries of the propagator over the span of the reduced form, by rows", ("entry",)),
    Variable(CHANGE, "1", "estimated error of the propagator, by rows", ("entry",)),
)
# An atlas asks for a hundred points at a time: large chunks would leave most lanes, and a core, without work.
_CHUNK = 32


def whole_span(form: LinearPeriodic) -> LinearPeriodic:
    """``form`` with its span as period: the monodromy matrix is then the propagator itself."""
    if form.reversor is None or form.log_determinant is None:
        # The determinant of the monodromy matrix includes those of the matrices of a reversal.
        known = form.log_determinant if form.reversal is None else None
        return replace(form, reversor=None, reversal=None, log_determinant=known)
    return replace(form, reversor=None, log_determinant=Partial(_half, form.log_determinant))


def _half(function: Callable[[], Array]) -> Array:
    return function() / 2


def _propagator_solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    rtol = request.options["rtol"]
    return direct_solvers(
        system,
        rtol,
        rtol,
        lambda model: whole_span(model.reduced),
        lambda model, phi, _: _results(phi, request.outputs),
        _CHUNK,
        few=request.method != "direct",
        small=request.method == "small",
    )


def _results(phi: Monodromy, outputs: tuple[str, ...]) -> dict[str, Array]:
    matrices = {PROPAGATOR: phi.matrix, CHANGE: phi.change}
    entries = {name: (jnp.exp(phi.log_scale) * x).reshape(-1, *phi.met.shape) for name, x in matrices.items()}
    finite = jnp.all(jnp.isfinite(jnp.concatenate(list(entries.values()))), axis=0)
    outcome = jnp.where(finite, jnp.where(phi.met, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET), Outcome.NOT_FINITE)
    results = {name: jnp.where(finite, entry, jnp.nan) for name, entry in entries.items()}
    return {name: results[name] for name in outputs} | {"outcome": outcome.astype(jnp.int8)}


SOLVES = Analysis(
    name="atlas",
    title="Propagator of a linear periodic system, for its atlas",
    variables=_SOLVED,
    default_outputs=(PROPAGATOR, CHANGE),
    methods=dict.fromkeys(("direct", "few", "small"), ("rtol",)),
    method_titles={
        "direct": "direct solves of floquet at the nodes of Chebyshev panels",
        "few": "the same at held-out points alone, by a program that is not optimised",
        "small": "the same by a small program, for cheap points",
    },
    options=(RTOL,),
    solvers=_propagator_solvers,
    dimensions=lambda *_: (Dimension("entry", "row times size plus column", ()),),
)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    return SOLVES.solvers(system, replace(request, outputs=SOLVES.default_outputs))


ANALYSIS = replace(
    SOLVES,
    title="stability atlas",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    methods={"direct": ("rtol",)},
    method_titles={"direct": SOLVES.method_titles["direct"]},
    solvers=_solvers,
    lacks=lacks,
    continuous=True,
)
