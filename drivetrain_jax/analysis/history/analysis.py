"""Time histories: the state of a flow at requested times, from any initial state. The system names its components.

diffrax integrates adaptively between strobes and requested times, so every value is the end of a step (no interpolation).
Angles of the clocks are computed from whole strobes: they are as accurate after 50,000 strobes as at the start. Errors are
differences from a second run with ten times the tolerance and up to twice the step. If errors exceed ``rtol`` times the
size of the motion (its largest component), runs with tighter tolerances follow, unless a run is long already.

Outcome: ``TOLERANCE_NOT_MET`` if an error still exceeds ``rtol`` times the size of the motion; ``STEP_LIMIT`` if the
integrator needed too many steps (earlier values are kept), or if the history has more than 2e5 strobes for each second (at
least for one second) or more than 2e6; ``NOT_FINITE`` if the field is not finite at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analysis._base import (
    DIFFRAX_SOLVERS,
    MOST_SECONDS,
    RTOL,
    Analysis,
    Outcome,
    Request,
    Solver,
    forward_derivatives,
    in_time_of,
)
from drivetrain_jax.analysis.history import piecewise
from drivetrain_jax.analysis.history.integration import NUM, has_finite_start, integrated, limits_of, requested_times
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import Flow, PiecewiseLinearOscillator, System


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """All requested results of one point; ``effort`` only orders the batches, as the integration is adaptive."""
    flow: Flow = system.models["history"].build(values)
    found = integrated(flow, request)
    states, error = found.states, found.error
    outcome = jnp.where(found.excess <= 1, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    failed = jnp.where(has_finite_start(flow), Outcome.STEP_LIMIT, Outcome.NOT_FINITE)
    outcome = jnp.where(found.healthy, outcome, failed)
    scale = jnp.stack([jnp.asarray(s, float) for s in flow.scale or (1.0,) * flow.size])
    results = _by_component(system, scale * states, "") | _by_component(system, scale * error, "_error")
    return {name: results[name] for name in request.outputs} | {"outcome": outcome.astype(jnp.int8)}


def _by_component(system: type[System], values: Array, suffix: str) -> dict[str, Array]:
    """The components of ``values`` ``(T, n)`` by name, ``(T,)``, or ``(T, m)`` along the axis of the state."""
    parts = values.reshape(len(values), len(system.state), -1)
    return {
        f"{c.name}{suffix}": parts[:, i] if system.state_axis else parts[:, i, 0] for i, c in enumerate(system.state)
    }


def _effort(system: type[System], request: Request, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Predicted segments, shape (N,): strobes and requested times; infinite beyond the limit."""
    times = requested_times(request)
    size = None if system.state_axis else len(system.state)
    strobes = times[-1] / predicted(_period, (system.models["history"].build, size), columns)
    return np.where(strobes <= limits_of(request).strobes, np.ceil(strobes) + len(times), np.inf)


def _period(build: Callable[..., Flow], size: int | None, values: Mapping[str, Any]) -> Array:
    flow = build(values)
    if size not in (None, flow.size):
        raise InputError(f"system: its flow has {flow.size} components; allowed is one for each of its state, {size}")
    return jnp.asarray(flow.period)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    name = f"diffrax: {request.options['solver']}"
    solve, effort = partial(_solve, system, request), partial(_effort, system, request)
    return (Solver(name, over_lanes(solve), effort, chunk=16, march=True, lengthy=True),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    time = Dimension("time", "time", requested_times(request), system.unit_of_time())
    return (time,) if system.state_axis is None else (time, system.state_axis)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The components of the state, and their errors; for an oscillator with play also its methods."""
    names = tuple(c.name for c in system.state)
    # An oscillator with play is no flow.
    if system.models["history"].returns is PiecewiseLinearOscillator:
        shared = tuple(
            o for o in ANALYSIS.options if o.name in {o for used in piecewise.METHODS.values() for o in used}
        )
        return {
            "variables": piecewise.variables(system),
            "default_outputs": names,
            "methods": piecewise.METHODS,
            "method_titles": piecewise.TITLES,
            "options": (*shared, *piecewise.OPTIONS),
            "solvers": piecewise.solvers,
            "dimensions": piecewise.dimensions,
            "derivatives": piecewise.derivatives,
        }
    dims = ("time",) if system.state_axis is None else ("time", system.state_axis.name)
    values = tuple(Variable(c.name, c.units, c.long_name, dims) for c in system.state)
    errors = tuple(
        Variable(f"{c.name}_error", c.units, f"estimated absolute error of {c.name}", dims) for c in system.state
    )
    return {"variables": values + errors, "default_outputs": names, "options": in_time_of(system, ANALYSIS.options)}


ANALYSIS = Analysis(
    name="history",
    title="time history",
    variables=(),
    default_outputs=(),
    methods={"diffrax": ("times", "stop", "num", "rtol", "solver")},
    method_titles={"diffrax": "adaptive steps from strobe to strobe"},
    options=(
        Parameter(
            "times", "s", "times at which the state is wanted", default=(), listed=True, lower=0.0, upper=MOST_SECONDS
        ),
        Parameter("stop", "s", "end of the history (0: see times)", default=0.0, lower=0.0, upper=MOST_SECONDS),
        NUM,
        RTOL,
        Parameter("solver", "1", "diffrax solver", default="Dopri8", choices=DIFFRAX_SOLVERS),
    ),
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=partial(forward_derivatives, _solvers),
    of_system=_of_system,
)
