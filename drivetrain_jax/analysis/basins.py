"""Shares of the initial conditions from which an oscillator with play reaches each of its attractors.

Initial states are drawn uniformly from the box ``|u0| <= reach_u, |v0| <= reach_v`` by a seeded generator, equal for all
points of a sweep; each is followed to its attractor exactly (analysis ``steady_state``). Motions of one period multiple and
equal extremes are one attractor. If all motions are non-periodic, they count as one attractor. If some are periodic, the
others count as unsettled: they may be transients that end on a periodic one after ``most_periods``.

Outcome: ``TOLERANCE_NOT_MET`` if some motions have not settled or belong to a ninth attractor (counted by
``unsettled_fraction``), ``NOT_CONVERGED`` if none has settled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.impacts.attractor import attractors, take
from drivetrain_jax.analysis.impacts.exact_response import WIDTH, describe
from drivetrain_jax.analysis.steady_state import WAIT
from drivetrain_jax.systems import PiecewiseLinearOscillator, System

ATTRACTORS = 8
OWN = ("attractor",)
VARIABLES = (
    Variable("basin_fraction", "1", "share of the initial states that lead to the attractor", OWN),
    Variable("basin_error", "1", "standard error of the share", OWN),
    Variable("attractor_u_max", "m", "largest relative displacement on the attractor", OWN),
    Variable("attractor_u_min", "m", "smallest relative displacement on the attractor", OWN),
    Variable(
        "attractor_multiple", "1", "period multiple of the attractor (0: non-periodic or none)", OWN, dtype="int32"
    ),
    Variable(
        "unsettled_fraction", "1", "share of initial states that did not settle (chaotic ones if others are periodic)"
    ),
)
OPTIONS = (
    count("samples", "number of initial states", default=1024, lower=1, upper=1e6),
    count("seed", "seed of the generator", default=0, lower=0, upper=2**32 - 1),
    Parameter("reach_u", "m", "half the range of the initial displacement", default=1.0, lower=0.0),
    Parameter("reach_v", "m/s", "half the range of the initial velocity", default=1.0, lower=0.0),
    WAIT,
)
# Relative difference of extremes below which two motions are the same.
_SAME = 1e-6
# Displacement that is rounding of the rest in the middle of the play, over half the backlash.
_REST = 1e-14
_TOLERANCE = 1e-10
_CHUNK = 8


def _solve(
    build: Callable[..., PiecewiseLinearOscillator], request: Request, values: Mapping[str, Any], effort: Array
) -> dict[str, Array]:
    """The requested results of a batch of points, the batch as last axis; ``effort`` is not used."""
    model, options = build(values), request.options
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in vars(model).values()))
    points, samples = int(np.prod(shape, dtype=int)), options["samples"]
    reach = np.array([[options["reach_u"]], [options["reach_v"]]])
    start = reach * np.random.default_rng(options["seed"]).uniform(-1, 1, (2, samples))
    u0, v0 = (jnp.tile(jnp.asarray(x), points) for x in start)
    route = jnp.repeat(jnp.arange(points, dtype=jnp.int32), samples)
    motions = attractors(model, route[:, None], u0, v0, most_periods=options["most_periods"], width=WIDTH)
    flat = jax.tree.map(lambda x: x[:, 0], motions)
    motion = describe(take(model, route), flat, rtol=_TOLERANCE, integrals=False)
    kept = ("u_max", "u_min", "period_multiple", "outcome")
    rest = _REST * jnp.broadcast_to(jnp.asarray(model.b, float), shape).reshape(points)
    results = shares(*(motion[name].reshape(points, samples).T for name in kept), rest=rest)
    return {name: results[name].reshape(*results[name].shape[:-1], *shape) for name in (*request.outputs, "outcome")}


def shares(high: Array, low: Array, multiple: Array, outcome: Array, rest: Array | float = 0.0) -> dict[str, Array]:
    """Attractors and their shares, shape ``(8, N)``, by falling ``attractor_u_max``, from motions ``(samples, N)``.

    Each attractor is represented by the first motion not yet counted. Motions within ``rest`` (N,) are at rest.
    """
    count = high.shape[0]
    periodic = multiple > 0
    settled = outcome < Outcome.NOT_CONVERGED
    # A finite time cannot distinguish a chaotic attractor from a chaotic transient to a periodic one.
    settled &= periodic | ~jnp.any(settled & periodic, axis=0)
    # Extremes of non-periodic motions depend on the observed time.
    high, low = (jnp.where(periodic, x, jnp.nan) for x in (high, low))

    def next_kind(left: Array, _: None) -> tuple[Array, tuple[Array, Array, Array, Array]]:
        first = jnp.argmax(left, axis=0)[None]
        top, bottom, m = (jnp.take_along_axis(x, first, axis=0) for x in (high, low, multiple))
        size = jnp.maximum(jnp.abs(top), jnp.abs(bottom))
        near = jnp.maximum(jnp.abs(high - top), jnp.abs(low - bottom)) <= jnp.maximum(_SAME * size, rest)
        same = left & (multiple == m) & (near | ~periodic)
        return left & ~same, (same.sum(axis=0), top[0], bottom[0], m[0])

    left, (number, top, bottom, m) = jax.lax.scan(next_kind, settled, None, length=ATTRACTORS)
    exists = number > 0
    order = jnp.argsort(jnp.where(exists, jnp.where(m > 0, -top, jnp.inf), jnp.nan), axis=0)
    number, top, bottom, m, exists = (jnp.take_along_axis(x, order, axis=0) for x in (number, top, bottom, m, exists))
    fraction = number / count
    lost = (~settled | left).sum(axis=0)
    state = jnp.where(lost > 0, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
    return {
        "basin_fraction": jnp.where(exists, fraction, jnp.nan),
        "basin_error": jnp.where(exists, jnp.sqrt(fraction * (1 - fraction) / count), jnp.nan),
        "attractor_u_max": jnp.where(exists, top, jnp.nan),
        "attractor_u_min": jnp.where(exists, bottom, jnp.nan),
        "attractor_multiple": jnp.where(exists, m, 0).astype(jnp.int32),
        "unsettled_fraction": lost / count,
        "outcome": jnp.where(exists.any(axis=0), state, Outcome.NOT_CONVERGED).astype(jnp.int8),
    }


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    build = system.models["basins"].build
    return (Solver("exact", partial(_solve, build, request), seconds=5e-2, chunk=_CHUNK),)


ANALYSIS = Analysis(
    name="basins",
    title="basins of attraction",
    variables=VARIABLES,
    default_outputs=("basin_fraction", "basin_error", "attractor_u_max", "attractor_multiple", "unsettled_fraction"),
    methods={"exact": tuple(option.name for option in OPTIONS)},
    method_titles={"exact": "exact motion from impact to impact, from random initial states"},
    options=OPTIONS,
    patience="most_periods",
    solvers=_solvers,
    dimensions=lambda *_: (
        Dimension("attractor", "number of the attractor, by falling displacement", tuple(range(1, ATTRACTORS + 1))),
    ),
)
