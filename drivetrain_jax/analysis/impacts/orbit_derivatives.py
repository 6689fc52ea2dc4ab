"""Derivatives of the results of a periodic motion of an oscillator with play.

The map F over the period is differentiated along the orbit, by the state z at its start and by the fields p of the
oscillator. The orbit moves by ``dz = (1 - dF/dz)^-1 dF/dp dp``. Every result depends on both z and p.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import stacked
from drivetrain_jax.analysis.impacts.exact_response import INTEGRALS, periodic_results
from drivetrain_jax.analysis.impacts.length_unit import from_scaled_length, to_scaled_length
from drivetrain_jax.analysis.impacts.orbit_history import history
from drivetrain_jax.analysis.impacts.orbit_measures import measure
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.systems import PiecewiseLinearOscillator

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

    scaled, unit = to_scaled_length(model(parameters))
    lengths = jnp.array([unit if name in ("b", "B0", "B1") else 1.0 for name in _FIELDS])
    by_parameter = stacked(jax.jacfwd(lambda p: _vector(model(p)) / lengths)(parameters))
    periodic = results["period_multiple"] > 0
    start = jnp.where(periodic, results["orbit_state"] / unit, 0.0)
    multiple = jnp.maximum(results["period_multiple"], 1)

    def motion(x: Array) -> dict[str, Array]:
        oscillator, u, v = replace(scaled, **dict(zip(_FIELDS, x[:-2], strict=True))), x[-2:-1], x[-1:]
        seen = measure(oscillator, u, v, multiple[None], width=1, integrals=not INTEGRALS.isdisjoint(names))
        found = {name: value[..., 0] for name, value in periodic_results(oscillator, seen).items() if name in names}
        if not {"u_history", "v_history"}.isdisjoint(names):
            sampled = history(oscillator, u, v, multiple[None], samples)
            found |= dict(zip(("u_history", "v_history"), (x[:, 0] for x in sampled), strict=True))
        return found | {"end": jnp.stack(seen.end)[:, 0]}

    moved = jax.jacfwd(motion)(jnp.concatenate([_vector(scaled), start]))
    end = moved.pop("end")
    state = jnp.linalg.solve(jnp.eye(2) - end[:, -2:], end[:, :-2])
    slopes = {name: x[..., :-2] + x[..., -2:] @ state for name, x in moved.items()}
    if "orbit_state" in names:
        slopes["orbit_state"] = state
    ended = (_vector(scaled) == 0) & _ENDS
    slopes = {name: _chained(jnp.where(ended | ~periodic, jnp.nan, x), by_parameter) for name, x in slopes.items()}
    return from_scaled_length(slopes, unit)


def _vector(oscillator: PiecewiseLinearOscillator) -> Array:
    return jnp.stack([jnp.asarray(getattr(oscillator, name), float) for name in _FIELDS])


def _chained(slopes: Array, by_parameter: Array) -> Array:
    """``slopes @ by_parameter``, with 0 for products of 0 and NaN."""
    return jnp.sum(jnp.where(by_parameter == 0, 0.0, slopes[..., None] * by_parameter), axis=-2)
