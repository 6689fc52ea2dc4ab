"""Constants of a driveshaft's elements: natural frequencies, inertias, nonuniformities, as functions of its geometry.

Closed forms: no iteration, no tolerance, exact to rounding. A point with a result that is not finite ends as
``NOT_FINITE``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver, forward_derivatives
from drivetrain_jax.systems import System

MODE = "mode"
VARIABLES = (
    Variable("natural_angular_frequency", "rad/s", "natural angular frequency of the element"),
    Variable("resonance_frequency", "Hz", "excitation frequency of the principal parametric resonance"),
    Variable("mean_inertia", "kg m2", "mean moment of inertia of the element"),
    Variable("chi_n", "1", "nonuniformity of the inertia"),
    Variable("c_stiffness", "1", "nonuniformity of the bell, numerator of g (c1, c3)"),
    Variable("c_inertia", "1", "nonuniformity of the compliance, denominator of g (c2, c4)"),
    Variable("parametric_excitation", "1", "amplitude of the parametric excitation, c1 - c2 - chi_n"),
    Variable("torsional_stiffness", "N m/rad", "torsional stiffness of the element at its mean moment of area"),
    Variable("axle_area_moment", "m4", "moment of area of the axle about the midshaft"),
    Variable("bell_area_moment", "m4", "mean moment of area of the bell about the midshaft"),
    Variable("joint_amplitude", "rad", "amplitude of the kinematic error of the joint (A_TJ)"),
    Variable("torque_acceleration", "rad/s2", "mean torque over mean inertia"),
    Variable("midshaft_frequency", "Hz", "natural frequency of the midshaft in torsion", (MODE,)),
)


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    del effort
    constants = system.models["parameters"].build(values)
    results = {name: jnp.asarray(constants[name], float) for name in request.outputs if name != "midshaft_frequency"}
    if "midshaft_frequency" in request.outputs:
        first = jnp.asarray(constants["midshaft_frequency"], float)
        results["midshaft_frequency"] = jnp.stack([k * first for k in range(1, request.options["modes"] + 1)])
    finite = jnp.stack(
        jnp.broadcast_arrays(*(jnp.all(jnp.isfinite(_lanes(x, name)), axis=0) for name, x in results.items()))
    )
    outcome = jnp.where(jnp.all(finite, axis=0), Outcome.SUCCESS, Outcome.NOT_FINITE)
    return results | {"outcome": outcome.astype(jnp.int8)}


def _lanes(result: Array, name: str) -> Array:
    """``result`` with its own dimension, if only of length 1, before that of the batch."""
    return result if name == "midshaft_frequency" else result[None]


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    return (Solver("closed form", partial(_solve, system, request), chunk=4096),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    return (Dimension(MODE, "number of the mode", tuple(range(1, request.options["modes"] + 1))),)


ANALYSIS = Analysis(
    name="parameters",
    title="constants of the elements",
    variables=VARIABLES,
    default_outputs=(
        "natural_angular_frequency",
        "mean_inertia",
        "chi_n",
        "c_stiffness",
        "c_inertia",
        "torsional_stiffness",
        "midshaft_frequency",
    ),
    methods={"exact": ("modes",)},
    method_titles={
        "exact": "closed forms",
    },
    options=(Parameter("modes", "1", "modes of the midshaft", default=5, lower=1, upper=1000, integer=True),),
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=partial(forward_derivatives, _solvers),
)
