"""Stability as a function of the parameters, for scenes whose axes are ranges.

The solves compute propagators (:mod:`~drivetrain_jax.analysis.atlas.solves`); panels interpolate them, and give the results
of ``floquet`` anywhere in the ranges.
"""

from __future__ import annotations

from dataclasses import replace

from drivetrain_jax.analysis._base import Request, Solver
from drivetrain_jax.analysis.atlas.solves import ANALYSIS as SOLVES
from drivetrain_jax.analysis.floquet.results import VARIABLES, lacks
from drivetrain_jax.systems import System


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    return SOLVES.solvers(system, replace(request, outputs=SOLVES.default_outputs))


ANALYSIS = replace(
    SOLVES,
    title="stability atlas",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    solvers=_solvers,
    lacks=lacks,
    continuous=True,
)
