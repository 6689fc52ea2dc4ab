"""Constants of a system as functions of its parameters, in closed form.

The system declares its constants: :func:`~drivetrain_jax.systems.serves` has ``results``, and the model maps their names to
values. The value of a constant with the dimension ``mode`` is a function of the mode's number 1, 2, ... The constants are
exact to rounding. A point with a result that is not finite ends as ``NOT_FINITE``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, count
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver, forward_derivatives
from drivetrain_jax.systems import System

MODE = "mode"
_MODES = count("modes", "number of modes", default=5, lower=1, upper=1000)


def _solve(
    name: str, system: type[System], request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    model = system.models[name]
    with_axis = {v.name for v in model.results if v.dims}
    constants, with_modes = model.build(values), {v.name for v in model.results if v.dims == (MODE,)}
    for lacking in (result for result in request.outputs if result not in constants):
        has, declared = ", ".join(constants), ", ".join(v.name for v in model.results)
        raise InputError(f"{system.__name__}: its model of {name} has {has}, not {lacking}; expected {declared}")

    def value(name: str) -> Array:
        if name not in with_axis:
            return jnp.asarray(constants[name], float)
        listed = constants[name]
        if name in with_modes:
            listed = [constants[name](k) for k in range(1, request.options[_MODES.name] + 1)]
        return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(x, float) for x in listed)))

    results = {name: value(name) for name in request.outputs}
    finite = [jnp.all(jnp.isfinite(x if name in with_axis else x[None]), axis=0) for name, x in results.items()]
    whole = jnp.stack(jnp.broadcast_arrays(*finite))
    outcome = jnp.where(jnp.all(whole, axis=0), Outcome.SUCCESS, Outcome.NOT_FINITE)
    # An infinite constant has no value.
    results = {name: jnp.where(jnp.isfinite(x), x, jnp.nan) for name, x in results.items()}
    return results | {"outcome": outcome.astype(jnp.int8)}


def _solvers(name: str, cost: Mapping[str, Any], system: type[System], request: Request) -> tuple[Solver, ...]:
    return (Solver("closed form", partial(_solve, name, system, request), **cost),)


def _dimensions(name: str, system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    count = request.options.get(_MODES.name, 0)
    others = {dim for v in system.models[name].results for dim in v.dims} - {MODE}
    return (
        Dimension(MODE, "number of the mode", tuple(range(1, count + 1))),
        *(Dimension(dim, f"number of the {dim}", ()) for dim in sorted(others)),
    )


def _of_system(name: str, system: type[System]) -> dict[str, Any]:
    """The declared constants, and the number of modes as an option if a constant has modes."""
    model = system.models[name]
    options = (_MODES,) if any(v.dims == (MODE,) for v in model.results) else ()
    return {
        "variables": model.results,
        "default_outputs": model.default_outputs or tuple(v.name for v in model.results),
        "methods": {"exact": tuple(option.name for option in options)},
        "options": options,
    }


def constants(name: str, title: str, **cost: Any) -> Analysis:
    """The analysis ``name``, whose results are the constants that a system declares for it; ``cost`` as of a solver."""
    solvers = partial(_solvers, name, cost)
    return Analysis(
        name=name,
        title=title,
        variables=(),
        default_outputs=(),
        methods={"exact": ()},
        method_titles={"exact": "closed forms"},
        options=(),
        solvers=solvers,
        dimensions=partial(_dimensions, name),
        derivatives=partial(forward_derivatives, solvers),
        of_system=partial(_of_system, name),
    )


PARAMETERS = constants("parameters", "constants of the system", seconds=1e-7, chunk=4096)
# Uneven rotation of a rigid driveline, and the phases of its yokes that minimise it; behind gears it is sampled.
PHASING = constants("phasing", "phases of the yokes", seconds=1e-3, chunk=128)
