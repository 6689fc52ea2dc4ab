"""Whirl: frequencies of a shaft that turns, with the gyroscopic effect of its discs, each certified by a count.

The modes of isotropic supports are circular. The whirl of either sense is the vibration of a shaft in one plane whose
rotary inertias are ``I - I_p speed/omega``, omega > 0 forward and < 0 backward, so the search for natural frequencies finds
both. If the supports differ between two planes, :mod:`~drivetrain_jax.analysis.critical_speeds.coupled` counts the modes.

Modes are numbered by frequency; equal frequencies of both senses begin with backward whirl. Derivatives are those of the
frequency within its sense, NaN for zero modes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from drivetrain_jax._quantities import Dimension, Variable, count
from drivetrain_jax.analysis._base import Analysis, Request, Solver
from drivetrain_jax.analysis.critical_speeds import coupled
from drivetrain_jax.analysis.critical_speeds.analysis import Build, outcomes
from drivetrain_jax.analysis.critical_speeds.frequency_roots import (
    Roots,
    find_roots,
    follows,
    frequency_derivatives,
    multiple,
)
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.systems import Shaft, System

BACKWARD, PLANAR, FORWARD = range(3)
# Directions within rounding of 0.
_PLANAR = 1e-8
_CHUNK = 256
_MODE, _SENSES = ("mode",), ("backward", "planar", "forward")
_CERTIFIED = "whether the count of whirl frequencies below and above certifies the mode"
VARIABLES = (
    Variable("whirl_frequency", "rad/s", "whirl frequency", _MODE),
    Variable("whirl_direction", "1", "direction of whirl, weighted by mass", _MODE, "int8", _SENSES),
    Variable("whirl_count_certified", "1", _CERTIFIED, _MODE, "int8"),
)
OPTIONS = (count("modes", "number of modes of both directions", default=8, lower=1, upper=1000),)


def _whirl(shaft: Shaft, modes: int) -> tuple[Roots, Array]:
    """The first frequencies of both senses, rising, and their directions as codes."""
    if shaft.k_y is not None:
        roots = find_roots(shaft, modes)
        moving = (roots.q > 0) & jnp.isfinite(roots.q)
        direction = coupled.directions(shaft, jnp.where(moving, roots.q, 1.0))
        codes = jnp.where(direction > _PLANAR, FORWARD, jnp.where(direction < -_PLANAR, BACKWARD, PLANAR))
        # Any combination of modes of one frequency is a mode: the extreme ones whirl in opposite senses.
        number = jnp.arange(modes).reshape(modes, *(1,) * (roots.q.ndim - 1))
        place = number - jax.lax.cummax(jnp.where(follows(roots.q), 0, number))
        pair = multiple(shaft, roots.q) & (codes != PLANAR)
        codes = jnp.where(pair, jnp.where(place % 2 == 0, BACKWARD, FORWARD), codes)
        return roots, jnp.where(moving, codes, PLANAR)
    pair = jax.tree.map(lambda field: jnp.stack([field, field], axis=-1), shaft.spread())
    if pair.spin is not None:
        pair = pair._replace(spin=pair.spin * jnp.array([-1.0, 1.0]))

    def merged(x: Array) -> Array:
        return jnp.moveaxis(x, -1, 1).reshape(-1, *x.shape[1:-1])

    roots = Roots(*(merged(x) for x in find_roots(pair, modes)))
    order = jnp.argsort(roots.q, axis=0, stable=True)[:modes]
    lost = jnp.any(jnp.isnan(roots.q), axis=0)
    q, width, certified = (jnp.take_along_axis(x, order, axis=0) for x in roots)
    roots = Roots(jnp.where(lost, jnp.nan, q), width, certified & ~lost)
    moving = (roots.q > 0) & jnp.isfinite(roots.q)
    return roots, jnp.where(moving, jnp.where(order % 2 == 0, BACKWARD, FORWARD), PLANAR)


def _solve(build: Build, request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    shaft = build(values)
    roots, direction = _whirl(shaft, request.options["modes"])
    results = {
        "whirl_frequency": roots.q**2,
        "whirl_direction": direction.astype(jnp.int8),
        "whirl_count_certified": roots.certified.astype(jnp.int8),
        "outcome": outcomes(shaft, roots),
    }
    return {name: results[name] for name in (*request.outputs, "outcome")}


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    q, direction = jnp.sqrt(results["whirl_frequency"]), results["whirl_direction"]

    def build(sense: ArrayLike, parameters: Any) -> Shaft:
        shaft = system.models["whirl"].build(eqx.combine(parameters, constants.tree))
        return shaft if shaft.spin is None else shaft._replace(spin=sense * shaft.spin)

    if build(1.0, parameters).k_y is not None:
        return {"whirl_frequency": frequency_derivatives(partial(build, 1.0), parameters, q)}

    def within(sense: Array) -> Array:
        """Derivatives of the modes of one sense, at their places; neighbours of the other sense do not count."""
        chosen = direction == jnp.where(sense < 0, BACKWARD, FORWARD)
        place = jnp.argsort(~chosen, stable=True)
        others = 2 * jnp.max(q, initial=1.0, where=chosen) + jnp.arange(len(q))
        slopes = frequency_derivatives(partial(build, sense), parameters, jnp.where(chosen, q, others)[place])
        return jnp.where(chosen[:, None], slopes[jnp.argsort(place)], 0.0)

    still = jnp.where(jnp.isfinite(q) & (q > 0), 0.0, jnp.nan)[:, None]
    # A loop compiles the derivatives once for both senses.
    return {"whirl_frequency": jnp.sum(jax.lax.map(within, jnp.array([-1.0, 1.0])), axis=0) + still}


ANALYSIS = Analysis(
    name="whirl",
    title="whirl of a turning shaft",
    variables=VARIABLES,
    default_outputs=tuple(variable.name for variable in VARIABLES),
    methods={"certified": ("modes",)},
    method_titles={"certified": "roots counted, at full accuracy for any mode"},
    options=OPTIONS,
    solvers=lambda system, request: (
        Solver(request.method, partial(_solve, system.models["whirl"].build, request), seconds=1e-4, chunk=_CHUNK),
    ),
    dimensions=lambda system, request, fixed: (
        Dimension("mode", "number of the mode", tuple(range(1, request.options["modes"] + 1))),
    ),
    derivatives=_derivatives,
    derivative_outputs=lambda outputs: ("whirl_frequency", "whirl_direction"),
)
