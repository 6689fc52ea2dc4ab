"""Steady vibration of masses and springs under harmonic errors and forces, by superposition of their modes.

    q = sum_m  phi_m (phi_m^T f)/(omega_m^2 - omega^2 + 2 i zeta omega_m omega)

with modes phi_m of unit modal mass, the same damping ratio zeta for all, and the complex amplitudes f of the forces. No
stiffness matrix is formed, so stiff and soft springs side by side lose no digits.

Outcome: ``NOT_FINITE`` if an amplitude is infinite (an undamped mode at its frequency); only this amplitude is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.modes import described, is_rigid, largest_frequency, system_modes
from drivetrain_jax.analysis.numerics.lanes import lane_count
from drivetrain_jax.systems import DrivenSprings, System

# Points of a chunk; their responses at all frequencies are in memory at the same time.
_CHUNK = 16
# Sum of the forces on a rigid mode, relative to their moduli, up to which they balance.
_BALANCED = 1e-12


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    lanes, damping = lane_count(values, ""), request.options["damping_ratio"]
    model: DrivenSprings = system.models["harmonic_response"].build(values)
    modes = system_modes(model.springs, "auto", lanes)
    weight = 1 / jnp.sqrt(_in_lanes(model.springs.mass, lanes))
    shapes = weight[:, None] * modes.vectors  # pyright: ignore[reportOperatorIssue]
    work = shapes * _in_lanes(model.force, lanes)[:, None]
    driven = jnp.sum(work, axis=0)
    # The computed frequency of a rigid mode is rounding, and so is what internal forces leave to drive it.
    rigid = is_rigid(modes.frequency, largest_frequency(model.springs, lanes))
    natural = jnp.where(rigid, 0.0, modes.frequency)
    driven = jnp.where(rigid & (jnp.abs(driven) <= _BALANCED * jnp.sum(jnp.abs(work), axis=0)), 0.0, driven)
    omega = 2 * math.pi * jnp.asarray(_frequencies(request))[:, None, None]
    # A mode that is not driven stays at rest, also a rigid one at the frequency 0.
    gain = jnp.where(driven == 0, 0.0, driven / (natural**2 - omega**2 + 2j * damping * natural * omega))
    response = jnp.einsum("dnl,fnl->fdl", shapes, gain)
    finite = jnp.isfinite(response)
    polar = {"amplitude": jnp.abs(response), "phase": jnp.angle(response)}
    results = {name: jnp.where(finite & modes.found, polar[name], jnp.nan) for name in request.outputs}
    missing = jnp.where(modes.found, Outcome.NOT_FINITE, Outcome.NOT_CONVERGED)
    outcome = jnp.where(modes.found & jnp.all(finite, axis=(0, 1)), Outcome.SUCCESS, missing)
    return results | {"outcome": outcome.astype(jnp.int8)}


def _in_lanes(array: Array, lanes: int) -> Array:
    """``array`` (n,) or (n, N) as (n, N)."""
    return jnp.broadcast_to(array if array.ndim == 2 else array[:, None], (array.shape[0], lanes))


def _frequencies(request: Request) -> np.ndarray:
    """The frequencies of the options [Hz]; :class:`InputError` without a range."""
    start, stop, num = (request.options[name] for name in ("start", "stop", "num"))
    if stop <= start:
        raise InputError(f"options.stop = {stop:g}: expected more than start = {start:g}, in Hz")
    return np.linspace(start, stop, num)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    return (Solver("superposition of modes", partial(_solve, system, request), chunk=_CHUNK, short_loops=True),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    frequencies = tuple(_frequencies(request).tolist())
    model: DrivenSprings = described(system.models["harmonic_response"], fixed)
    return Dimension("frequency", "frequency", frequencies, "Hz"), Dimension("dof", "coordinate", model.springs.dofs)


_SHAPE = ("frequency", "dof")
ANALYSIS = Analysis(
    name="harmonic_response",
    title="harmonic response",
    variables=(
        Variable("amplitude", "m", "amplitude of the displacement", _SHAPE, lower=0.0),
        Variable("phase", "rad", "phase of the displacement", _SHAPE),
    ),
    default_outputs=("amplitude",),
    methods={"modes": ("start", "stop", "num", "damping_ratio")},
    method_titles={"modes": "superposition of all modes"},
    options=(
        Parameter("start", "Hz", "lowest frequency", default=1.0, lower=0.0, upper=1e9),
        Parameter("stop", "Hz", "highest frequency", default=0.0, lower=0.0, upper=1e9),
        count("num", "number of frequencies", default=1001, lower=2, upper=1e5),
        Parameter("damping_ratio", "1", "damping ratio of every mode", default=0.02, lower=0.0),
    ),
    solvers=_solvers,
    dimensions=_dimensions,
)
