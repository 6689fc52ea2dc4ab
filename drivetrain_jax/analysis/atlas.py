"""Stability as a function of the parameters, for scenes whose axes are ranges.

The solves compute propagators (``periodic/floquet_propagator.py``); panels interpolate them, and give the results of
``floquet`` anywhere in the ranges.
"""

from __future__ import annotations

from dataclasses import replace

from drivetrain_jax.analysis._base import Request, Solver
from drivetrain_jax.analysis.periodic import floquet_propagator
from drivetrain_jax.analysis.periodic.floquet_results import VARIABLES, lacks
from drivetrain_jax.systems import System


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    solves = floquet_propagator.ANALYSIS
    return solves.solvers(system, replace(request, outputs=solves.default_outputs))


ANALYSIS = replace(
    floquet_propagator.ANALYSIS,
    title="stability atlas",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    solvers=_solvers,
    lacks=lacks,
    continuous=True,
)
