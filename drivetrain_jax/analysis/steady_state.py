"""Steady state of an oscillator with play: the attractor reached from given initial conditions, or a chaotic motion.

The motion is exact up to rounding (closed form in each linear region), and so are its extremes, multipliers and contacts.
An orbit found by Newton shooting is accepted only if the motion has come so close that the linearisation about the orbit
governs the rest of the way (:mod:`~drivetrain_jax.analysis.impacts.attractor`).

A motion that has not settled within ``most_periods`` drive periods is ``non_periodic``, a success, if neighbouring motions
separated by a factor of exp(20) over the last three quarters of that time, which only chaos explains. A finite time cannot
distinguish a chaotic attractor from a long transient; a larger ``most_periods`` may show the end of a transient.

Outcome: ``NOT_CONVERGED`` if the motion has neither settled nor separated; ``TOLERANCE_NOT_MET`` if the estimated error of
the orbit exceeds ``rtol`` times its largest displacement, or a thousandth of its largest distance from the flanks;
``STEP_LIMIT`` if the motion has more events per period than a motion can have unless it grazes a flank, or if a drive period
may need more than 2e7 steps (``c = 2e5`` or ``omega = 5e-6`` with k = I = 1). A motion also stops at 1e7 steps in all, and
200 more for each of ``most_periods``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Variable, count
from drivetrain_jax.analysis._base import RTOL, Analysis, Outcome, Request, Solver, stacked
from drivetrain_jax.analysis.impacts.attractor import attractors
from drivetrain_jax.analysis.impacts.exact_response import INTEGRALS, WIDTH, describe, periodic_results
from drivetrain_jax.analysis.impacts.motion import PHASE, REGIME, REGIMES
from drivetrain_jax.analysis.impacts.orbit_measures import history, measure
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.systems import PiecewiseLinearOscillator, System, UnderdampedOscillator

# Derivatives of the results of a periodic motion of an oscillator with play.
#
# The map F over the period is differentiated along the orbit, by the state z at its start and by the fields p of the
# oscillator. The orbit moves by ``dz = (1 - dF/dz)^-1 dF/dp dp``. Every result depends on both z and p.

# At one frequency the unbalance is part of B1.
_FIELDS = tuple(f.name for f in fields(PiecewiseLinearOscillator) if f.name not in ("unbalance", "damps_play"))
# Fields whose range ends at zero: there the oscillator has other formulas, and no derivative.
_ENDS = np.array([name in ("alpha", "b") for name in _FIELDS])


def orbit_jacobians(
    build: Callable[[Any], PiecewiseLinearOscillator],
    parameters: Any,
    constants: Constants,
    results: Mapping[str, Array],
    names: tuple[str, ...],
    samples: int,
) -> dict[str, Array]:
    """Jacobians ``(..., P)`` of the results ``names`` by all ``parameters`` (numbers).

    ``results`` hold ``orbit_state`` and ``period_multiple``. NaN for a motion that is not periodic.
    """

    def model(parameters: Any) -> PiecewiseLinearOscillator:
        return build(eqx.combine(parameters, constants.tree))

    here = model(parameters)
    by_parameter = stacked(jax.jacfwd(lambda p: _vector(model(p)))(parameters))
    periodic = results["period_multiple"] > 0
    start = jnp.where(periodic, results["orbit_state"], 0.0)
    multiple = jnp.maximum(results["period_multiple"], 1)

    def motion(x: Array) -> dict[str, Array]:
        oscillator, u, v = replace(here, **dict(zip(_FIELDS, x[:-2], strict=True))), x[-2:-1], x[-1:]
        seen = measure(oscillator, u, v, multiple[None], width=1, integrals=not INTEGRALS.isdisjoint(names))
        values = {name: value[..., 0] for name, value in periodic_results(oscillator, seen).items() if name in names}
        if not {"u_history", "v_history"}.isdisjoint(names):
            sampled = history(oscillator, u, v, multiple[None], samples)
            values |= dict(zip(("u_history", "v_history"), (x[:, 0] for x in sampled), strict=True))
        return values | {"end": jnp.stack(seen.end)[:, 0]}

    moved = jax.jacfwd(motion)(jnp.concatenate([_vector(here), start]))
    end = moved.pop("end")
    state = jnp.linalg.solve(jnp.eye(2) - end[:, -2:], end[:, :-2])
    slopes = {name: x[..., :-2] + x[..., -2:] @ state for name, x in moved.items()}
    if "orbit_state" in names:
        slopes["orbit_state"] = state
    ended = (_vector(here) == 0) & _ENDS

    def chained(slopes: Array) -> Array:
        """``slopes @ by_parameter``, with 0 for products of 0 and NaN."""
        known = jnp.where(ended | ~periodic, jnp.nan, slopes)
        return jnp.sum(jnp.where(by_parameter == 0, 0.0, known[..., None] * by_parameter), axis=-2)

    return {name: chained(x) for name, x in slopes.items()}


def _vector(oscillator: PiecewiseLinearOscillator) -> Array:
    return jnp.stack([jnp.asarray(getattr(oscillator, name), float) for name in _FIELDS])


SAMPLES = 512
DIMENSIONS = (
    Dimension("state", "component of the state", ("u", "v")),
    Dimension("flank", "flank of the tooth", ("drive", "back")),
    Dimension("multiplier", "number of the multiplier, by falling modulus", (1, 2)),
    Dimension("sample", "part of the motion's period", tuple(k / SAMPLES for k in range(SAMPLES))),
)
HISTORIES = frozenset(("u_history", "v_history"))
_CONTACT = "(b = 0: always, with the flank loaded by B0)"
_WHOLE = "over the period of the orbit (non-periodic: over 32 drive periods)"
_AVERAGED = "(non-periodic: of this motion, mean over the last three quarters of most_periods)"
VARIABLES = (
    Variable("u_max", "m", "largest relative displacement"),
    Variable("u_min", "m", "smallest relative displacement"),
    Variable("u_mean", "m", "mean relative displacement"),
    Variable("u_rms", "m", "root mean square of the relative displacement, mean included"),
    Variable("phase", "rad", PHASE),
    Variable("period_multiple", "1", "period multiple (0: not periodic within most_periods)", dtype="int32"),
    Variable("spectral_radius", "1", "spectral radius of the transition over the motion's period"),
    Variable("floquet_multiplier", "1", "multipliers of the motion over its period", ("multiplier",), "complex128"),
    Variable("lyapunov_exponent", "1/s", f"largest Lyapunov exponent {_AVERAGED}"),
    Variable("regime", "1", REGIME, dtype="int8", flags=REGIMES),
    Variable("impacts", "1", f"number of times that a flank is reached {_WHOLE}", ("flank",)),
    Variable("impact_velocity", "m/s", "largest velocity at which a flank is reached", ("flank",)),
    Variable("contact_fraction", "1", f"fraction of the time in contact {_CONTACT}", ("flank",)),
    Variable("orbit_state", "m, m/s", "state at the start of a drive period", ("state",)),
    Variable("state_error", "m", "estimated absolute error of the orbit's displacement"),
    Variable("u_history", "m", "relative displacement", ("sample",)),
    Variable("v_history", "m/s", "relative velocity", ("sample",)),
    Variable("periods_settled", "1", "drive periods until the attractor was recognised", dtype="int32"),
)
WAIT = count("most_periods", "largest number of drive periods of a motion", default=4000, lower=64, upper=1e8)
# Points per chunk: so many that the lanes are busy until the queue is nearly empty.
_CHUNK = 4096


# Roles of the parameters of the initial state.
_STARTS = ("initial_displacement", "initial_rate")


def _solve(
    system: type[System], request: Request, underdamped: bool, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    """The requested results of a batch of points, the batch as last axis; ``effort`` is not used."""
    model: PiecewiseLinearOscillator = system.models["steady_state"].build(values)
    model = UnderdampedOscillator(**vars(model)) if underdamped else model
    start = [values[system.role(role)] for role in _STARTS]
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in (*vars(model).values(), *start)))
    count = int(np.prod(shape, dtype=int))
    u0, v0 = (jnp.broadcast_to(jnp.asarray(x, float), (count,)) for x in start)
    route = jnp.arange(count, dtype=jnp.int32)[:, None]
    motions = attractors(model, route, u0, v0, most_periods=request.options["most_periods"], width=WIDTH)
    flat = jax.tree.map(lambda x: x[:, 0], motions)
    integrals = not INTEGRALS.isdisjoint(request.outputs)
    results = describe(model, flat, rtol=request.options["rtol"], integrals=integrals)
    if not HISTORIES.isdisjoint(request.outputs):
        known = results["outcome"] < Outcome.NOT_CONVERGED
        u, v = (jnp.where(known, x, jnp.nan) for x in (flat.u, flat.v))
        sampled = history(model, u, v, results["period_multiple"], SAMPLES)
        results |= dict(zip(("u_history", "v_history"), sampled, strict=True))
    return {name: results[name].reshape(*results[name].shape[:-1], *shape) for name in (*request.outputs, "outcome")}


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    """The solver for all motions, and a faster solver for motions whose free part oscillates."""

    def effort(columns: Mapping[str, Any]) -> np.ndarray:
        return np.where(system.models["steady_state"].build(columns).oscillates, 1.0, np.inf)

    return (
        Solver("exact", partial(_solve, system, request, False), seconds=3e-4, chunk=_CHUNK, unit_cost=1.15),
        Solver("underdamped", partial(_solve, system, request, True), effort, seconds=3e-4, chunk=_CHUNK),
    )


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    """Jacobians of all results of a periodic motion that are not counts or errors."""
    real = (n for n, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact) and not n.endswith("_error"))
    names = tuple(n for n in real if n != "impacts")
    build = system.models["steady_state"].build
    return orbit_jacobians(build, parameters, constants, results, names, SAMPLES)


ANALYSIS = Analysis(
    name="steady_state",
    title="steady state",
    variables=VARIABLES,
    default_outputs=("u_max", "u_min", "u_rms", "period_multiple", "spectral_radius", "regime", "impacts"),
    methods={"exact": ("rtol", "most_periods")},
    method_titles={"exact": "exact motion from impact to impact, until it repeats"},
    options=(RTOL, WAIT),
    patience="most_periods",
    solvers=_solvers,
    dimensions=lambda *_: DIMENSIONS,
    derivatives=_derivatives,
    derivative_outputs=lambda _: ("orbit_state", "period_multiple"),
)
