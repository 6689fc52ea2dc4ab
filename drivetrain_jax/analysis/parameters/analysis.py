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

from drivetrain_jax._quantities import Dimension, Parameter
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver, forward_derivatives
from drivetrain_jax.systems import System

MODE = "mode"
_MODES = Parameter("modes", "1", "number of modes", default=5, lower=1, upper=1000, integer=True)


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    del effort
    model = system.models["parameters"]
    constants, with_modes = model.build(values), {v.name for v in model.results if v.dims == (MODE,)}

    def value(name: str) -> Array:
        if name not in with_modes:
            return jnp.asarray(constants[name], float)
        numbers = range(1, request.options[_MODES.name] + 1)
        return jnp.stack([jnp.asarray(constants[name](k), float) for k in numbers])

    results = {name: value(name) for name in request.outputs}
    # Every result gets an axis of modes before the batch, of length 1 if it has none.
    finite = [jnp.isfinite(x if name in with_modes else x[None]) for name, x in results.items()]
    whole = jnp.stack(jnp.broadcast_arrays(*(jnp.all(x, axis=0) for x in finite)))
    outcome = jnp.where(jnp.all(whole, axis=0), Outcome.SUCCESS, Outcome.NOT_FINITE)
    # An infinite constant has no value.
    results = {name: jnp.where(jnp.isfinite(x), x, jnp.nan) for name, x in results.items()}
    return results | {"outcome": outcome.astype(jnp.int8)}


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    return (Solver("closed form", partial(_solve, system, request), seconds=1e-7, chunk=4096),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    count = request.options.get(_MODES.name, 0)
    return (Dimension(MODE, "number of the mode", tuple(range(1, count + 1))),)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The declared constants, and the number of modes as an option if a constant has modes."""
    model = system.models["parameters"]
    options = (_MODES,) if any(v.dims == (MODE,) for v in model.results) else ()
    return {
        "variables": model.results,
        "default_outputs": model.default_outputs or tuple(v.name for v in model.results),
        "methods": {"exact": tuple(option.name for option in options)},
        "options": options,
    }


ANALYSIS = Analysis(
    name="parameters",
    title="constants of the system",
    variables=(),
    default_outputs=(),
    methods={"exact": ()},
    method_titles={
        "exact": "closed forms",
    },
    options=(),
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=partial(forward_derivatives, _solvers),
    of_system=_of_system,
)
