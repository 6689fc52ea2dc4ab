"""Time histories: the state of a flow at requested times, from any initial state. The system names its components.

diffrax integrates adaptively between strobes and requested times, so every value is the end of a step (no interpolation).
Angles of the clocks are computed from whole strobes: they are as accurate after 50,000 strobes as at the start. Errors are
differences from a second run with ten times the tolerance and up to three times the step. If errors exceed ``rtol`` times
the size of the motion (its largest component), runs with tighter tolerances follow, unless a run is long already.

Outcome: ``TOLERANCE_NOT_MET`` if an error still exceeds ``rtol`` times the size of the motion; ``STEP_LIMIT`` if the
integrator needed too many steps (earlier values are kept), or if the history has more than 2e5 strobes for each second (at
least for one second) or more than 2e6; ``NOT_FINITE`` if the field is not finite at the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import (
    DIFFRAX_SOLVERS,
    MOST_SECONDS,
    RTOL,
    Analysis,
    Outcome,
    Request,
    Solver,
    finite_results,
    forward_derivatives,
    in_time_of,
)
from drivetrain_jax.analysis.frequency_response.closed_form_response import cubic_fit, self_consistent_range, slow_flow
from drivetrain_jax.analysis.history.integration import (
    NUM,
    History,
    has_finite_start,
    integrated,
    limits_of,
    requested_times,
)
from drivetrain_jax.analysis.impacts.piecewise_march import timed_motion
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import Flow, PiecewiseLinearOscillator, System

# Time histories of oscillators with play: the exact motion with its events, and the averaged motion.
#
# Method ``exact``: the closed form of each linear region from flank to flank, exact up to rounding at any time.
#
# Method ``slow_flow``: amplitude a and phase beta of ``u = a cos(omega t - beta)`` by the averaged equations of
# :mod:`~drivetrain_jax.analysis.frequency_response.closed_form_response`, with ``u' = -w0 a sin(omega t - beta)``. The
# complex amplitude ``z = a exp(i beta)`` has no singularity at rest:
#
#     z' = (-mu + i (omega - w0 - g |z|^2)) z + i F.
#
# Outcome: ``NOT_FINITE`` without a finite motion (resonance without damping; a fit with l1 <= 0); ``STEP_LIMIT`` for more
# events than a motion can have unless it grazes a flank; ``slow_flow`` also ``TOLERANCE_NOT_MET``.

_TIMES = ("times", "stop", "num")
_PLAY_METHODS = {"exact": (*_TIMES, "most_events"), "slow_flow": (*_TIMES, "rtol", "solver", "fit_range")}
_PLAY_TITLES = {
    "exact": "exact motion from impact to impact",
    "slow_flow": "averaged equations of amplitude and phase (multiple scales give the same)",
}
_PLAY_OPTIONS = (
    count("most_events", "length of the list of events", default=256, lower=1, upper=1e6),
    Parameter("fit_range", "m", "range R of the cubic fit (0: its own peak amplitude)", default=0.0, lower=0.0),
)
_FLANKS = ("drive", "back", "none")
_EXACT = (
    Variable("acceleration", "m/s2", "relative acceleration", ("time",)),
    Variable("event_time", "s", "time at which contact is made or lost", ("event",)),
    Variable("event_flank", "1", "flank of the event", ("event",), "int8", _FLANKS),
    Variable("event_velocity", "m/s", "relative velocity at the event", ("event",)),
    Variable("event_count", "1", "number of events, also beyond the list", dtype="int32"),
)
_AVERAGED = (
    Variable("amplitude", "m", "amplitude of the averaged motion", ("time",)),
    Variable("phase", "rad", "lag of the averaged motion behind the drive", ("time",)),
)
# Lists of events are longer than most motions need.
_EVENTS = ("event_time", "event_velocity")
_STARTS = ("initial_displacement", "initial_rate")
_MAX_PERIODS, _PLAY_CHUNK = 2_000_000, 64


def _play_dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Dimensions of times and events; raises ``InputError`` for a result that the method does not compute."""
    PiecewiseLinearOscillator.check_method(fixed.get("damping") != "contact", request.method)
    for variable in _AVERAGED if request.method == "exact" else _EXACT:
        if variable.name in request.outputs:
            other = next(method for method in _PLAY_METHODS if method != request.method)
            raise InputError(f"outputs: method {request.method} does not give {variable.name}; expected {other}")
    events = tuple(range(1, request.options.get("most_events", 0) + 1))
    return Dimension("time", "time", requested_times(request), "s"), Dimension("event", "number of the event", events)


def _play_solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    effort = partial(_effort, system, request, _MAX_PERIODS)
    if request.method == "exact":
        return (
            Solver("exact", partial(_exact, system, request), effort, seconds=1e-5, chunk=_PLAY_CHUNK, lengthy=True),
        )
    solve = over_lanes(partial(_averaged, system, request))
    return (Solver("slow flow", solve, effort, seconds=1e-5, chunk=16, march=True, lengthy=True),)


def _play_derivatives(
    system: type[System], request: Request, parameters: Any, constants: Any, results: Mapping[str, Array]
) -> Mapping[str, Array]:
    """Jacobians of the exact motion, without its events.

    The averaged motion has none, because bisection finds the range of its fit.
    """
    known = {name: x for name, x in results.items() if not name.startswith("event")}
    exact = request.method == "exact"
    return forward_derivatives(_play_solvers, system, request, parameters, constants, known) if exact else {}


def _exact(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """The requested results of a batch, lanes last; ``effort`` only orders the batches."""
    times = np.array(requested_times(request))
    model: PiecewiseLinearOscillator = system.models["history"].build(values)
    starts = [values[system.role(role)] for role in _STARTS]
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in (*vars(model).values(), *starts)))
    u0, v0 = (jnp.broadcast_to(jnp.asarray(x, float), shape or (1,)) for x in starts)
    turns = jnp.asarray(times)[:, None] / (model.period + jnp.zeros(u0.shape))
    u, v, events, stuck = timed_motion(model, u0, v0, turns, times[-1], request.options["most_events"])
    finite = jnp.all(jnp.isfinite(u), axis=0)
    outcome = jnp.where(stuck, Outcome.STEP_LIMIT, jnp.where(finite, Outcome.SUCCESS, Outcome.NOT_FINITE))
    names = tuple(c.name for c in system.state)
    results = dict(zip(names, (u, v), strict=True))
    results["acceleration"] = model.field(times[:, None], jnp.stack([u, v]))[1]
    results |= {"event_time": events.time, "event_flank": events.flank, "event_velocity": events.velocity}
    results |= {"event_count": events.number, "outcome": outcome.astype(jnp.int8)}
    wanted = finite_results({name: results[name] for name in (*request.outputs, "outcome")}, gaps=_EVENTS)
    return {name: x.reshape(*x.shape[:-1], *shape) for name, x in wanted.items()}


def averaged_flow(
    model: PiecewiseLinearOscillator, fit_range: Array | None, u0: Array, v0: Array
) -> tuple[Flow, Array]:
    """The flow of ``(Re z, Im z)`` from the state ``(u0, v0)``, and w0.

    Without ``fit_range`` the range of the fit is the self-consistent one, the peak amplitude.
    """
    reach = self_consistent_range(model, ()) if fit_range is None else fit_range
    slow = slow_flow(model, cubic_fit(model, reach))
    drive, detuning = jnp.sign(model.B1) * slow.drive, model.omega - slow.frequency

    def field(_: Any, y: Any) -> tuple[Any, Any]:
        real, imaginary = y
        drift = detuning - slow.bend * (real**2 + imaginary**2)
        return -slow.decay * real - drift * imaginary, drift * real - slow.decay * imaginary + drive

    return Flow(field, (u0, v0 / slow.frequency), model.period), slow.frequency


def _averaged(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    model: PiecewiseLinearOscillator = system.models["history"].build(values)
    model.check_method(model.damps_play, request.method)
    u0, v0 = (jnp.asarray(values[system.role(role)], float) for role in _STARTS)
    asked = request.options["fit_range"]
    flow, frequency = averaged_flow(model, jnp.asarray(asked) if asked > 0 else None, u0, v0)
    history = integrated(flow, request)
    real, imaginary = history.states.T
    turned = model.omega * jnp.asarray(requested_times(request))
    cosine, sine = jnp.cos(turned), jnp.sin(turned)
    u, v = real * cosine + imaginary * sine, frequency * (imaginary * cosine - real * sine)
    results = dict(zip((c.name for c in system.state), (u, v), strict=True))
    results |= {"amplitude": jnp.hypot(real, imaginary), "phase": jnp.arctan2(imaginary, real)}
    return finite_results({name: results[name] for name in request.outputs} | {"outcome": _outcome(flow, history)})


def _flow(system: type[System], values: Mapping[str, Any]) -> Flow:
    """The flow of one point, with the components of the system's state."""
    flow = system.models["history"].build(values)
    if isinstance(flow, Flow) and system.state_axis is None and flow.size != (size := len(system.state)):
        raise InputError(f"system: its flow has {flow.size} components; expected one for each of its state, {size}")
    return flow


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """All requested results of one point; ``effort`` only orders the batches, as the integration is adaptive."""
    flow = _flow(system, values)
    history = integrated(flow, request)
    scale = jnp.stack([jnp.asarray(s, float) for s in flow.scale or (1.0,) * flow.size])
    results = _by_component(system, scale * history.states, "") | _by_component(system, scale * history.error, "_error")
    return {name: results[name] for name in request.outputs} | {"outcome": _outcome(flow, history)}


def _by_component(system: type[System], values: Array, suffix: str) -> dict[str, Array]:
    """The components of ``values`` ``(T, n)`` by name, ``(T,)``, or ``(T, m)`` along the axis of the state."""
    parts = values.reshape(len(values), len(system.state), -1)
    return {
        f"{c.name}{suffix}": parts[:, i] if system.state_axis else parts[:, i, 0] for i, c in enumerate(system.state)
    }


def _effort(system: type[System], request: Request, most: float, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Predicted segments, shape (N,): strobes or periods, and requested times; infinite beyond ``most`` strobes."""
    times = requested_times(request)
    strobes = times[-1] / predicted(_period, (system,), columns)
    return np.where(strobes <= most, np.ceil(strobes) + len(times), np.inf)


def _period(system: type[System], values: Mapping[str, Any]) -> Array:
    return jnp.asarray(_flow(system, values).period)


def _outcome(flow: Flow, history: History) -> Array:
    """The outcome of the integration of ``flow``, int8."""
    outcome = jnp.where(history.excess <= 1, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    failed = jnp.where(has_finite_start(flow), Outcome.STEP_LIMIT, Outcome.NOT_FINITE)
    return jnp.where(history.healthy, outcome, failed).astype(jnp.int8)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    name = f"diffrax: {request.options['solver']}"
    solve, effort = partial(_solve, system, request), partial(_effort, system, request, limits_of(request).strobes)
    return (Solver(name, over_lanes(solve), effort, seconds=1e-5, chunk=16, march=True, lengthy=True),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    time = Dimension("time", "time", requested_times(request), system.unit_of_time())
    return (time,) if system.state_axis is None else (time, system.state_axis)


def _of_system(system: type[System]) -> dict[str, Any]:
    """The components of the state, and their errors; for an oscillator with play also its methods."""
    names = tuple(c.name for c in system.state)
    # An oscillator with play is no flow.
    if system.models["history"].returns is PiecewiseLinearOscillator:
        shared = tuple(o for o in ANALYSIS.options if o.name in {o for used in _PLAY_METHODS.values() for o in used})
        of_state = (Variable(c.name, c.units, c.long_name, ("time",)) for c in system.state)
        return {
            "variables": (*of_state, *_EXACT, *_AVERAGED),
            "default_outputs": names,
            "methods": _PLAY_METHODS,
            "method_titles": _PLAY_TITLES,
            "options": (*shared, *_PLAY_OPTIONS),
            "solvers": _play_solvers,
            "dimensions": _play_dimensions,
            "derivatives": _play_derivatives,
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
