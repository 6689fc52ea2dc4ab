"""Natural frequencies as a differentiable function, with derivatives in closed form.

With the mass-normalised mode u of frequency f the derivative with respect to any parameter is

    df = u^T (dK - (2 pi f)^2 dM) u / (8 pi^2 f),      for a stiffness:  df/dk_j = (b_j^T u)^2 / (8 pi^2 f),

evaluated spring by spring, so that no stiffness matrix is formed. Derivatives by stiffnesses and masses are as exact as
the mode; those by angles, in which the forces of stiff springs cancel, have errors of eps (f_max/f)^2 f. Frequencies
that form a cluster have no derivatives of their own: a change of the parameters splits them along the eigenvalues of
the matrix u_i^T (dK - (2 pi f)^2 dM) u_j, which :func:`directional_derivatives` gives for one direction. What is linear
in the direction, and therefore a gradient, is their mean: :func:`natural_frequencies` gives every member of a cluster
the derivative of the cluster's mean.

>>> import jax
>>> from drivetrain_jax.systems.planetary import Planetary
>>> from drivetrain_jax.analysis.spectra.mode_gradients import natural_frequencies
>>> p, build = Planetary().values, Planetary.models["modes"].build
>>> jax.grad(lambda k: natural_frequencies(build, p | {"k_p": k})[1])(1e8)     # Hz per N/m   # doctest: +SKIP
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.modes import largest_frequency, system_modes
from drivetrain_jax.analysis.numerics.lanes import lane_count
from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul
from drivetrain_jax.analysis.numerics.singular_vectors import jacobi_vectors
from drivetrain_jax.analysis.spectra.mode_types import is_rigid, one_frequency
from drivetrain_jax.systems import SpringSystem

# Slopes of equal frequencies over the largest of all, up to which their differences are rounding.
_SPLIT = 1e-8

Build = Callable[[Mapping[str, Any]], SpringSystem]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def natural_frequencies(build: Build, values: Mapping[str, Any]) -> Array:
    """Natural frequencies in Hz, rising, ``(n,)``, or ``(n, N)`` if some of ``values`` have shape ``(N,)``.

    ``build`` makes the spring system from ``values`` (for the planetary gear that of its model, and all its
    parameters, ``planet_angle`` a tuple). Differentiable once, forwards and backwards, with respect to every value;
    derivatives of clusters are those of their mean, that of a rigid mode is zero, also by the stiffness of a spring that
    holds it, where f grows as sqrt(k) and has none. NaN where a value is not finite.
    """
    return _frequencies_and_shapes(build, values)[0]


@natural_frequencies.defjvp
def _jvp(build: Build, primals: tuple[Any], tangents: tuple[Any]) -> tuple[Array, Array]:
    (values,), (directions,) = primals, tangents
    frequency, shapes, largest, still = _frequencies_and_shapes(build, values)
    _, squares = jax.jvp(lambda p: _excess(build(p), shapes, frequency), (values,), (directions,))
    near = one_frequency(frequency, largest)
    mean = jnp.sum(near * squares[None], axis=1) / jnp.sum(near, axis=1)
    return frequency, _per_frequency(mean, frequency, still)


def directional_derivatives(build: Build, values: Mapping[str, Any], directions: Mapping[str, Any]) -> Array:
    """Derivatives in Hz of all natural frequencies along one direction, of the shape of the frequencies.

    ``directions`` has the structure of ``values``. In a cluster: the derivatives of the branches that leave it in this
    direction, rising.
    """
    values, directions = (jax.tree.map(lambda x: jnp.asarray(x, float), dict(p)) for p in (values, directions))
    frequency, shapes, largest, still = _frequencies_and_shapes(build, values)
    near = one_frequency(frequency, largest).reshape(*frequency.shape[:1] * 2, -1)
    _, matrix = jax.jvp(lambda p: _excess(build(p), shapes, frequency, mixed=True), (values,), (directions,))
    matrix = jnp.where(near, matrix.reshape(*near.shape), 0.0)
    # Made positive, its singular vectors are its eigenvectors.
    lift = jnp.sqrt(jnp.sum(matrix**2, axis=(0, 1)))
    turned, _ = jacobi_vectors(matrix + lift * jnp.eye(len(frequency))[:, :, None])
    slopes = jnp.sum(turned * looped_matmul(matrix, turned), axis=0)
    number = jnp.argmax(near, axis=1)
    order = jnp.lexsort((slopes, number), axis=0)
    slopes = jnp.take_along_axis(slopes, order, axis=0).reshape(frequency.shape)
    return _per_frequency(slopes, frequency, still)


def frequency_jacobian(build: Build, parameters: Any) -> Array:
    """Derivatives in Hz of all natural frequencies ``(n, P)`` by the P numbers in the pytree ``parameters``; NaN where a
    parameter splits frequencies that are equal: these have slopes along a direction, but no derivatives."""
    leaves, tree = jax.tree.flatten(parameters)

    def named(numbers: Any) -> dict[str, Any]:
        return {"all": jax.tree.unflatten(tree, list(numbers))}

    def model(values: Mapping[str, Any]) -> SpringSystem:
        return build(values["all"])

    frequency, _, largest, _ = _frequencies_and_shapes(model, named(leaves))
    near = one_frequency(frequency, largest)

    def along(direction: Array) -> Array:
        slopes = directional_derivatives(model, named(leaves), named(direction))
        own = jnp.where(near, slopes[None], jnp.nan)
        split = jnp.nanmax(own, axis=1) - jnp.nanmin(own, axis=1)
        return jnp.where(split > _SPLIT * jnp.max(jnp.abs(slopes)), jnp.nan, slopes)

    return jax.vmap(along, out_axes=-1)(jnp.eye(len(leaves)))


@partial(jax.jit, static_argnums=0)
def _frequencies_and_shapes(build: Build, values: Mapping[str, Any]) -> tuple[Array, Array, Array, Array]:
    """Frequencies in Hz (n, ...), shapes of unit modal mass (dofs, n, ...), an upper bound of the frequencies (...) and
    which modes are rigid (n, ...)."""
    model, lanes = build(values), lane_count(values)
    modes = system_modes(model, "auto", lanes)
    frequency = jnp.where(modes.found, modes.frequency / (2 * math.pi), jnp.nan)
    largest = largest_frequency(model, lanes)
    mass = model.mass.reshape(*model.mass.shape[:1], 1, -1)
    results = (frequency, modes.vectors / jnp.sqrt(mass), largest / (2 * math.pi), is_rigid(modes.frequency, largest))
    single = all(np.ndim(leaf) == 0 for leaf in jax.tree.leaves(dict(values)))
    return tuple(x[..., 0] for x in results) if single else results


def _excess(model: SpringSystem, shapes: Array, frequency: Array, mixed: bool = False) -> Array:
    """``u^T (K - (2 pi f)^2 M) u`` of the columns (n, ...) of ``shapes``, or of all pairs of them (n, n, ...).

    Zero but for rounding; its derivative at fixed shapes is that of ``(2 pi f)^2``.
    """

    def spread(array: Array, axes: int) -> Array:
        return array.reshape(*array.shape[:axes], 1, *array.shape[axes:], *(1,) * (shapes.ndim - array.ndim - 2 + axes))

    stretched = jnp.sum(spread(model.extensions, 2) * shapes[None], axis=1)
    forces, momenta = spread(model.stiffness, 1) * stretched, spread(model.mass, 1) * shapes
    omega = 2 * math.pi * frequency
    if mixed:
        elastic, inertial = (_products(*pair) for pair in ((stretched, forces), (shapes, momenta)))
        return elastic - omega[:, None] * omega[None] * inertial
    return jnp.sum(stretched * forces, axis=0) - omega**2 * jnp.sum(shapes * momenta, axis=0)


def _products(a: Array, b: Array) -> Array:
    """``a^T b`` (n, n, ...) of columns."""
    return jnp.sum(a[:, :, None] * b[:, None], axis=0)


def _per_frequency(squares: Array, frequency: Array, still: Array) -> Array:
    """``df`` from ``d (2 pi f)^2``; a rigid mode stays where it is."""
    return jnp.where(still, 0.0, squares / (8 * math.pi**2 * jnp.where(still, 1.0, frequency)))
