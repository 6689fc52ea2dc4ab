"""Gradients of the spectral radius and of stability boundaries with respect to parameters.

Inside an atlas they come from the surrogate; with respect to every parameter of the system, fixed ones included, from direct
solves of the system and its derivative together: derivatives of the monodromy matrix, which is smooth, never of the radius.
Both use left and right eigenvectors of Z, so that no branch is picked wrongly near a crossing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from drivetrain_jax.analysis.numerics.kernels import options_for_few
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.analysis.periodic.derivatives import monodromy_change
from drivetrain_jax.analysis.periodic.floquet_effort import PANEL_COST, explicit_effort, implicit_effort
from drivetrain_jax.analysis.periodic.propagator import EXPLICIT_ORDER, EqualSteps, Order8, Radau
from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.growth import growth
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.systems import System

# Relative error of the direct solves that predicts their steps. These are doubled until derivatives agree to the second
# number, four times at most.
_RTOL, _AGREEMENT, _MOST_DOUBLINGS = 1e-12, 1e-8, 4
# Moduli that differ by no more than rounding, as those of all multipliers without damping.
_TIED = 1e-11
# What rounding leaves of a monodromy matrix, relative; and the least by which a doubling of the steps divides their error.
_ROUNDING, _DIVIDED = 16 * np.finfo(float).eps, 2**EXPLICIT_ORDER - 1


@dataclass(frozen=True)
class Sensitivity:
    """``spectral_radius`` at a point, its ``gradient`` by parameter and the dominant ``multiplier``.

    ``gap`` is by how much the modulus of the next multiplier, its conjugate apart, is smaller, relative to its own: at 0 the
    gradient does not exist. ``error`` bounds the relative error of ``multiplier`` to first order; it grows like 1/gap where
    two multipliers coalesce.
    """

    spectral_radius: float
    gradient: Mapping[str, float]
    multiplier: complex
    gap: float
    error: float

    @property
    def exists(self) -> bool:
        """True if one multiplier, or one pair, is the largest by more than the errors: else there is no gradient."""
        return self.gap > max(_TIED, self.error)

    def boundary(self, parameter: str) -> dict[str, float]:
        """Derivative of the boundary value of ``parameter`` with respect to every other one, at a point of the boundary.

        At a tip it is that of the tip, because there the radius does not vary along the speed. NaN where the radius has no
        gradient or does not vary with ``parameter``. Raises ``KeyError`` for a parameter that ``gradient`` lacks.
        """
        slope = self.gradient[parameter]
        known = self.exists and slope != 0
        return {
            name: -value / slope if known else math.nan for name, value in self.gradient.items() if name != parameter
        }


def atlas_sensitivity(atlas: Atlas, system: type[System], point: Mapping[str, float]) -> Sensitivity:
    """The gradient with respect to the parameters of ``atlas`` at ``point`` (a value for each), from the surrogate.

    It is NaN in a gap and outside the domain. Raises ``KeyError`` if ``point`` lacks a parameter,
    :class:`~drivetrain_jax.InputError` for an atlas without panels and a system without boundary functions.
    """
    criteria = Criteria.of(atlas, system)
    values = np.array([[point[name] for name in atlas.parameters]], float)
    x = atlas.to_coordinates(values)
    rates = growth(criteria, x, ["largest"])
    slope = np.array([float(c.slope(values[0, k])) for k, c in enumerate(atlas.coordinates)])
    radius = float(np.exp(rates.rate[0]))
    gradient = radius * rates.gradient[0] * slope
    sigma = complex(rates.multiplier[0])
    slopes = dict(zip(atlas.parameters, map(float, gradient), strict=True))
    return Sensitivity(radius, slopes, sigma, _gap(sigma, criteria.eigenvalues(x)[0]), float(rates.error[0]))


def direct_sensitivity(system: type[System], values: Mapping[str, float]) -> Sensitivity:
    """The gradient with respect to all parameters of ``system``, which ``values`` holds, from direct solves.

    It is NaN where no scheme can take so many steps, derivatives overflow or the radius underflows. Raises ``KeyError`` if
    ``values`` lacks a parameter or the system has no model for ``floquet``.
    """
    names = system.models["floquet"].parameters
    point = np.array([float(values[name]) for name in names])
    solver, count = _scheme(system, dict(zip(names, point[:, None], strict=True)))
    if not math.isfinite(count):
        return _unknown(names)
    solve, count = _derivatives(system.models["floquet"].build, names, solver), int(count)
    z, change = solve(point, count)
    for _ in range(_MOST_DOUBLINGS):
        coarse, before, count = z, change, 2 * count
        z, change = solve(point, count)
        if np.all(_norms(change - before) <= _AGREEMENT * _norms(change)):
            break
    error = np.linalg.norm(z - coarse) / _DIVIDED + _ROUNDING * np.linalg.norm(z)
    return _sensitivity(names, z, change, float(error))


def _scheme(system: type[System], columns: Mapping[str, np.ndarray]) -> tuple[type[EqualSteps], float]:
    """The cheaper scheme for one point, and its predicted steps or panels; infinite if there would be too many of both."""
    explicit, implicit = (float(of(system, columns, _RTOL)[0]) for of in (explicit_effort, implicit_effort))
    if PANEL_COST * implicit < explicit:
        return Radau, implicit
    return Order8, explicit


def _unknown(names: Sequence[str]) -> Sensitivity:
    return Sensitivity(math.nan, dict.fromkeys(names, math.nan), complex(math.nan), math.nan, math.nan)


def _norms(change: np.ndarray) -> np.ndarray:
    """Frobenius norms of the derivatives by each parameter."""
    return np.sqrt(np.sum(change**2, axis=(0, 1)))


def _sensitivity(names: Sequence[str], z: np.ndarray, change: np.ndarray, error: float) -> Sensitivity:
    """From ``z``, the norm of whose error is at most ``error``, and its derivatives."""
    if not (np.isfinite(z).all() and np.isfinite(change).all() and z.any()):
        return _unknown(names)
    sigma, right = np.linalg.eig(z)
    k = int(np.argmax(np.abs(sigma)))
    left = np.linalg.inv(right)[k]
    condition = np.linalg.norm(left) * np.linalg.norm(right[:, k])
    rates = np.einsum("i,ijp,j->p", left, change, right[:, k]) / sigma[k]
    radius = float(np.abs(sigma[k]))
    gradient = dict(zip(names, map(float, radius * rates.real), strict=True))
    gap = _gap(complex(sigma[k]), sigma)
    return Sensitivity(radius, gradient, complex(sigma[k]), gap, float(condition * error / radius))


def _gap(sigma: complex, multipliers: np.ndarray) -> float:
    """``gap`` of ``sigma`` among all ``multipliers``, which hold it and, if it is complex, its conjugate."""
    own = [sigma, sigma.conjugate()] if abs(sigma.imag) > 1e-12 * abs(sigma) else [sigma]
    others = list(multipliers)
    for value in own:
        others.pop(int(np.argmin(np.abs(np.array(others) - value))))
    return float(1 - np.abs(others).max(initial=0.0) / abs(sigma))


@lru_cache
def _derivatives(
    build: Callable, names: tuple[str, ...], solver: type[EqualSteps]
) -> Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]]:
    """Z of a model at a point, ``(n, n)``, and its derivatives by all parameters, ``(n, n, p)``, compiled for any steps."""

    def both(point: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
        parameters, constants = dict(zip(names, point, strict=True)), Constants(dict.fromkeys(names))
        found = monodromy_change(build, parameters, constants, steps, solver)
        size = jnp.exp(found.log_scale)
        # Leaves of a dictionary are in the order of the alphabet.
        place = np.argsort(np.argsort(names))
        return size * found.z, size * jnp.moveaxis(found.dz, 0, -1)[..., place]

    compiled = jax.jit(both, compiler_options=options_for_few())
    return lambda point, steps: tuple(map(np.asarray, compiled(point, np.int64(steps))))  # pyright: ignore[reportReturnType]
