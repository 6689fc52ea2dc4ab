"""Gradients of the spectral radius and of stability boundaries with respect to parameters.

Inside an atlas they come from the surrogate; with respect to every parameter of the system, fixed ones included, from a few
dozen direct solves around the point: differences of order 6 of the monodromy matrix, which is smooth, never of the spectral
radius. Both use left and right eigenvectors of Z, so that no branch is picked wrongly near a crossing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import jax
import numpy as np

from drivetrain_jax.analysis.numerics.kernels import options_for_few
from drivetrain_jax.analysis.periodic.direct import assemble
from drivetrain_jax.analysis.periodic.propagator import explicit_propagator
from drivetrain_jax.atlas.criteria import Criteria
from drivetrain_jax.atlas.growth import growth
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.systems import System

# Relative error of the direct solves, and steps if the system predicts none.
_RTOL, _STEPS = 1e-13, 400
# Differences of order 6, their step relative to the parameter, and the value below which it is not smaller.
_SHIFTS = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
_WEIGHTS = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60
_STEP, _SMALL = 2e-4, 0.01
# Moduli that differ by no more than rounding, as those of all multipliers without damping.
_TIED = 1e-11


@dataclass(frozen=True)
class Sensitivity:
    """``spectral_radius`` at a point, its ``gradient`` by parameter and the dominant ``multiplier``.

    ``gap`` is by how much the modulus of the next multiplier, its conjugate apart, is smaller, relative to its own: at 0 the
    gradient does not exist.
    """

    spectral_radius: float
    gradient: Mapping[str, float]
    multiplier: complex
    gap: float

    @property
    def exists(self) -> bool:
        """Whether there is a gradient: one multiplier, or a pair, is the largest."""
        return self.gap > _TIED

    def boundary(self, parameter: str) -> dict[str, float]:
        """Derivative of the boundary value of ``parameter`` with respect to every other one, at a point of the boundary.

        At a tip it is that of the tip, because there the radius does not vary along the speed.
        """
        slope = self.gradient[parameter]
        return {
            name: -value / slope if slope else float("nan")
            for name, value in self.gradient.items()
            if name != parameter
        }


def atlas_sensitivity(atlas: Atlas, system: System, point: Mapping[str, float]) -> Sensitivity:
    """The gradient with respect to the parameters of ``atlas`` at ``point`` (a value for each), from the surrogate."""
    criteria = Criteria.of(atlas, system)
    values = np.array([[point[name] for name in atlas.parameters]], float)
    x = atlas.to_coordinates(values)
    rates = growth(criteria, x, ["largest"])
    slope = np.array([float(c.slope(values[0, k])) for k, c in enumerate(atlas.coordinates)])
    radius = float(np.exp(rates.rate[0]))
    gradient = radius * rates.gradient[0] * slope
    sigma = complex(rates.multiplier[0])
    slopes = dict(zip(atlas.parameters, map(float, gradient), strict=True))
    return Sensitivity(radius, slopes, sigma, _gap(sigma, criteria.eigenvalues(x)[0]))


def direct_sensitivity(system: System, values: Mapping[str, float]) -> Sensitivity:
    """The gradient with respect to every parameter of ``system`` (``values`` holds them all) from 37 direct solves."""
    build, names = system.models["floquet"].build, system.models["floquet"].parameters
    point = np.array([float(values[name]) for name in names])
    size = _STEP * np.maximum(np.abs(point), _SMALL)
    around = point[:, None, None] + np.eye(len(names))[:, :, None] * size[:, None, None] * _SHIFTS
    columns = dict(zip(names, np.concatenate([point[:, None], around.reshape(len(names), -1)], axis=1), strict=True))
    predicted = build(columns).explicit_steps
    steps = int(np.ceil(np.max(predicted(_RTOL)))) if predicted else _STEPS
    z = np.asarray(_monodromy(build)(columns, np.int64(steps)))
    change = z[:, :, 1:].reshape(*z.shape[:2], len(names), len(_SHIFTS)) @ _WEIGHTS / size
    sigma, right = np.linalg.eig(z[:, :, 0])
    k = int(np.argmax(np.abs(sigma)))
    left = np.linalg.inv(right)[k]
    rates = np.einsum("i,ijp,j->p", left, change, right[:, k]) / sigma[k]
    radius = float(np.abs(sigma[k]))
    gradient = dict(zip(names, map(float, radius * rates.real), strict=True))
    return Sensitivity(radius, gradient, complex(sigma[k]), _gap(complex(sigma[k]), sigma))


def _gap(sigma: complex, multipliers: np.ndarray) -> float:
    """``gap`` of ``sigma`` among all ``multipliers``, which hold it and, if it is complex, its conjugate."""
    own = [sigma, sigma.conjugate()] if abs(sigma.imag) > 1e-12 * abs(sigma) else [sigma]
    others = list(multipliers)
    for value in own:
        others.pop(int(np.argmin(np.abs(np.array(others) - value))))
    return float(1 - np.abs(others).max(initial=0.0) / abs(sigma))


@lru_cache
def _monodromy(build: Callable) -> Callable:
    """Compiled Z of a model for a batch of points, ``(4, 4, N)``."""

    def monodromy(columns: Mapping[str, jax.Array], steps: jax.Array) -> jax.Array:
        form = build(columns).reduced
        shape = next(iter(columns.values())).shape
        return assemble(form, explicit_propagator(form, steps, shape).matrix)

    return jax.jit(monodromy, compiler_options=options_for_few())
