"""Results of exact motions of an oscillator with play: single points, and sweeps of the drive's frequency up and down.

:func:`sweeps` is the method ``exact`` of the analysis ``frequency_response``. ``model.omega`` has the shape ``(L,)``; the
other fields are scalars or have the shape ``(N,)``. Results have the frequencies first, then the direction (up, down), then
the lanes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.impacts.attractor import Attractors, attractors, averaged, take
from drivetrain_jax.analysis.impacts.attractor_lanes import MOST_PERIODS
from drivetrain_jax.analysis.impacts.motion import ABSENT, REGIMES, STABLE, UNSTABLE, phase_lag, regime
from drivetrain_jax.analysis.impacts.orbit_measures import Measures, measure
from drivetrain_jax.analysis.impacts.plane_map import log_determinant, spectral_radius
from drivetrain_jax.systems import PiecewiseLinearOscillator

NON_PERIODIC = REGIMES.index("non_periodic")
# Results that need integrals over the motion.
INTEGRALS = frozenset(("u_mean", "u_rms", "phase"))
# Logarithmic growth of a tangent that only chaos explains, lasting or transient: shear makes a tangent grow in proportion to
# time.
_WILD = 20.0
# Error of u, relative to the distance from the flanks, that may confuse one attractor with another.
_DECIDES = 1e-3
# Excess of the spectral radius over 1 that is no rounding: a motion without damping has 1.
_UNSTABLE = 1e-6
# Lanes computed at a time: enough to fill the vector units, but few lanes wait for the slowest. Sweeps have fewer lanes,
# because they are long jobs of very different length.
WIDTH, _SWEEP_WIDTH = 64, 32


def describe(
    oscillator: PiecewiseLinearOscillator,
    found: Attractors,
    *,
    rtol: float,
    integrals: bool = True,
    largest: Any = jnp.inf,
) -> dict[str, Array]:
    """All results of the motions ``found``, every field of shape ``(N,)`` as those of ``oscillator``.

    Impacts, contacts, states and multipliers are pairs, ``(2, N)``. Unknown values are NaN (``stability``: absent).

    A motion that recurs within 32 periods is measured over its period. A motion that does not, but whose tangent has
    grown by exp(20) over the last three quarters of the run, is non-periodic (``period_multiple`` 0), or still a transient,
    and measured over 32 drive periods. Any other motion has not settled, nor has an orbit whose spectral radius exceeds 1.
    ``outcome`` is TOLERANCE_NOT_MET where the estimated error of u exceeds ``rtol`` times its size, or a thousandth of the
    largest distance from the flanks, and NOT_FINITE where its size exceeds ``largest``.
    """
    stopped = found.stalled == 1
    u, v = jnp.where(stopped, jnp.nan, found.u), found.v
    seen = measure(oscillator, u, v, found.multiple, width=WIDTH, integrals=integrals)
    periodic = found.multiple > 0
    wild = ~periodic & (found.exponent * averaged(found.periods) * oscillator.period > _WILD)
    size = jnp.maximum(jnp.abs(seen.high), jnp.abs(seen.low))
    exact = (found.error <= rtol * size) & (found.error <= _DECIDES * _away(oscillator, seen))
    outcome = jnp.where(periodic & ~exact, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS)
    results = periodic_results(oscillator, seen)
    unstable = periodic & (results["spectral_radius"] > 1 + _UNSTABLE)
    outcome = jnp.where((periodic | wild) & ~unstable, outcome, Outcome.NOT_CONVERGED)
    outcome = jnp.where((found.stalled > 0) | (seen.complete == 0), Outcome.STEP_LIMIT, outcome)
    finite = jnp.isfinite(found.u) & (stopped | (jnp.isfinite(seen.high + seen.low) & (size <= largest)))
    outcome = jnp.where(finite, outcome, Outcome.NOT_FINITE)
    known = outcome < Outcome.NOT_CONVERGED
    results |= {name: jnp.where(periodic, results[name], jnp.nan) for name in ("floquet_multiplier", "spectral_radius")}
    results["lyapunov_exponent"] = jnp.where(periodic, results["lyapunov_exponent"], found.exponent)
    results |= {"orbit_state": jnp.stack([found.u, found.v]), "state_error": jnp.where(periodic, found.error, jnp.nan)}
    results = {name: jnp.where(known, value, jnp.nan) for name, value in results.items()}
    kind = jnp.where(periodic, regime(oscillator, seen.high, seen.low), NON_PERIODIC)
    return results | {
        "regime": jnp.where(known, kind, NON_PERIODIC).astype(jnp.int8),
        "stability": jnp.where(known, jnp.where(periodic, STABLE, UNSTABLE), ABSENT).astype(jnp.int8),
        "period_multiple": jnp.where(periodic & known, seen.periods, 0).astype(jnp.int32),
        "periods_settled": found.periods,
        "outcome": outcome.astype(jnp.int8),
    }


def _away(oscillator: PiecewiseLinearOscillator, seen: Measures) -> Array:
    """Largest distance from the flanks: far from the origin, at a wide backlash, it is much smaller than u."""
    high, low = (jnp.abs(jnp.abs(u) - oscillator.b) for u in (seen.high, seen.low))
    return jnp.maximum(high, low)


def periodic_results(oscillator: PiecewiseLinearOscillator, seen: Measures) -> dict[str, Array]:
    """Extremes, means, contacts and impacts over the measured periods, and the multipliers and Lyapunov exponent of a motion
    with this period."""
    span = seen.periods * oscillator.period
    mean, square, cosine, sine = (integral / span for integral in seen.integrals)
    size = jnp.maximum(jnp.abs(seen.high), jnp.abs(seen.low))
    contraction = log_determinant(oscillator, seen.matrix, span)
    half, determinant = (seen.matrix[0] + seen.matrix[3]) / 2, jnp.exp(contraction)
    root = jnp.sqrt((half**2 - determinant).astype(complex))
    # The larger multiplier first; the smaller one from the product loses no digits.
    first = half + jnp.where(half < 0, -root, root)
    rho = spectral_radius(seen.matrix, contraction)
    return {
        "u_max": seen.high,
        "u_min": seen.low,
        "u_mean": mean,
        "u_rms": jnp.sqrt(square),
        "phase": phase_lag(2 * cosine, 2 * sine, size),
        "impacts": jnp.stack(seen.impacts),
        "impact_velocity": jnp.stack(seen.speed),
        "contact_fraction": jnp.stack(seen.contact) / span,
        "floquet_multiplier": jnp.stack([first, jnp.where(first == 0, 0.0, determinant / first)]),
        "spectral_radius": rho,
        # A radius that underflows has no logarithm.
        "lyapunov_exponent": jnp.where(rho > 0, jnp.log(rho) / span, jnp.nan),
    }


def points_of(model: PiecewiseLinearOscillator, length: int, lanes: int) -> PiecewiseLinearOscillator:
    """The oscillators of all points, frequencies first: fields of shape ``(length * lanes,)``, or scalars."""
    omega = jnp.broadcast_to(jnp.asarray(model.omega).reshape(-1, 1), (length, lanes)).reshape(-1)
    names = ("damping", "stiffness", "alpha", "b", "B0", "B1", "unbalance")
    own = {name: getattr(model, name) for name in names}
    tiled = {name: jnp.tile(value, length) for name, value in own.items() if jnp.ndim(value)}
    return replace(model, **tiled).at(omega)


def sweeps(
    model: PiecewiseLinearOscillator, *, most_periods: int = 1000, rtol: float = 1e-10, integrals: bool = True
) -> dict[str, Array]:
    """Results of sweeps of the drive's frequency up and down from rest; each frequency starts on the previous motion.

    ``model.omega`` has the shape ``(L,)`` and rises; other fields are scalars or have the shape ``(N,)``. The results are
    those of :func:`describe` in the shape ``(L, 2, N)`` (direction up, down), or ``(L, 2, 2, N)`` for results with their own
    axis (flank, multiplier, state). Without lanes the last axis is missing. If a motion has not settled after
    ``most_periods`` drive periods, the next frequency starts from its last state.
    """
    shape = jnp.broadcast_shapes(*(jnp.shape(getattr(model, n)) for n in ("damping", "stiffness", "alpha", "b")))
    shape = jnp.broadcast_shapes(shape, jnp.shape(model.B0), jnp.shape(model.B1), jnp.shape(model.unbalance))
    length, lanes = jnp.size(model.omega), int(np.prod(shape, dtype=int))
    points = points_of(model, length, lanes)
    up = np.arange(length * lanes, dtype=np.int32).reshape(length, lanes).T
    route = np.concatenate([up, up[:, ::-1]])
    rest = jnp.zeros(2 * lanes)
    found = attractors(points, jnp.asarray(route), rest, rest, most_periods=most_periods, width=_SWEEP_WIDTH)
    flat = jax.tree.map(lambda x: x.reshape(-1), found)
    results = describe(take(points, jnp.asarray(route.reshape(-1))), flat, rtol=rtol, integrals=integrals)

    def arrange(x: Array) -> Array:
        own = x.shape[:-1]
        both = x.reshape(*own, 2, lanes, length)
        both = jnp.stack([both[..., 0, :, :], both[..., 1, :, ::-1]])
        # (direction, own..., lane, frequency) to (frequency, direction, own..., lane).
        return jnp.moveaxis(both, -1, 0).reshape(length, 2, *own, *shape)

    return {name: arrange(value) for name, value in results.items()}


def worst(outcome: Array) -> Array:
    """The worse outcome of both directions, ``(L, 2, ...) -> (L, ...)``."""
    return jnp.max(outcome, axis=1)


__all__ = ["INTEGRALS", "MOST_PERIODS", "NON_PERIODIC", "WIDTH", "describe", "points_of", "sweeps", "worst"]
