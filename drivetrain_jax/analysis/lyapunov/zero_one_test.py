"""The 0-1 test for chaos: does a walk driven by an observable stay bounded or diffuse?

Gottwald & Melbourne, SIAM J. Appl. Dyn. Syst. 8 (2009) 129: with p(n) = sum phi(j) cos(j c), q(n) = sum phi(j) sin(j c),
the mean square displacement M_c(n) = <(p(j+n) - p(j))^2 + (q(j+n) - q(j))^2> without its oscillating part
<phi>^2 (1 - cos n c)/(1 - cos c) grows linearly in n if phi is chaotic. K is the median over c of its correlation with n.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

import drivetrain_jax.systems  # noqa: F401  double precision

# As many angles as the authors use, equally spaced over their recommended range.
_ANGLES = 100
_RANGE = (math.pi / 5, 4 * math.pi / 5)
_CUT = 10
# Series computed together: their walks fit into the inner caches.
_BLOCK = 32


def chaos_k01(series: Array) -> Array:
    """K of ``series``, shape ``(T, ...)`` -> ``(...)``: near 0 if regular, near 1 if chaotic; 0 for a constant series.

    The displacements extend over 1 to T/10 samples. The test needs about 1000 samples, whose distance is not below the time
    scale of the series: oversampled flows look regular.
    """
    angles = _RANGE[0] + (_RANGE[1] - _RANGE[0]) * (jnp.arange(_ANGLES) + 0.5) / _ANGLES
    mean = jnp.mean(series, axis=0)
    size = jnp.max(jnp.abs(series - mean), axis=0)
    constant = ~(size > 1e-12 * jnp.abs(mean))
    # The test does not depend on the scale of the observable, and an offset only adds to the oscillating part.
    scaled = (series - mean) / jnp.where(constant, 1.0, size)
    values = jax.lax.map(partial(_correlations, angles), _blocks(scaled))
    values = jnp.moveaxis(values, 1, 0).reshape(_ANGLES, -1)[:, : math.prod(size.shape)]
    return jnp.where(constant, 0.0, jnp.median(values.reshape(_ANGLES, *size.shape), axis=0))


def _blocks(series: Array) -> Array:
    """``(T, ...)`` in blocks of ``_BLOCK`` series, ``(blocks, T, _BLOCK)``, the last block padded with zeros."""
    flat = series.reshape(len(series), -1)
    flat = jnp.pad(flat, ((0, 0), (0, -flat.shape[1] % _BLOCK)))
    return jnp.moveaxis(flat.reshape(len(series), -1, _BLOCK), 1, 0)


def _correlations(angles: Array, series: Array) -> Array:
    """Correlation for every angle, shape ``(len(angles), ...)``."""
    return jax.lax.map(lambda angle: _correlation(series, angle), angles)


def largest_k01(section: Array) -> Array:
    """The largest K of the components of ``section``, shape ``(T, n, ...)`` -> ``(...)``.

    The largest is the right one: all components of a regular motion are regular, and a slow component of a chaotic motion
    needs a longer record than a fast component.
    """
    return jnp.max(chaos_k01(section), axis=0)


def _correlation(series: Array, angle: Array) -> Array:
    """Correlation of the displacement with n, for one angle."""
    length = series.shape[0]
    cut = length // _CUT
    turns = (angle * jnp.arange(1, length + 1)).reshape(-1, *(1,) * (series.ndim - 1))
    p, q = jnp.cumsum(series * jnp.cos(turns), axis=0), jnp.cumsum(series * jnp.sin(turns), axis=0)
    kept = length - cut

    def displacement(n: Array) -> Array:
        moved = [jax.lax.dynamic_slice_in_dim(x, n, kept) - x[:kept] for x in (p, q)]
        return jnp.mean(moved[0] ** 2 + moved[1] ** 2, axis=0)

    n = jnp.arange(1, cut + 1)
    distance = jax.lax.map(displacement, n)
    steps = n.reshape(-1, *(1,) * (series.ndim - 1)) - (cut + 1) / 2
    spread = distance - jnp.mean(distance, axis=0)
    norm = jnp.sqrt(jnp.sum(steps**2, axis=0) * jnp.sum(spread**2, axis=0))
    return jnp.sum(steps * spread, axis=0) / jnp.where(norm > 0, norm, 1.0)
