"""Derivatives of a periodic solution of ``y' = f(t, y; p)``, and of its largest displacements, by the variational equations.

With s = t/T as time, the columns ``V = dy/dy0`` and ``S = dy/dp`` at fixed ``y0`` obey ``V' = T f_y V`` and
``S' = T f_y S + d(T f)/dp``. The start moves by ``dy0 = (I - V(1))^-1 S(1) dp``. At a peak the solution is stationary in
time, so that its height moves by ``V dy0 + S dp``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.forced.orbit import MAX_STEPS, controller, size_of
from drivetrain_jax.analysis.numerics.linear_algebra import solve

Parametric = Callable[[Any, Any, Array], Array]


class PeriodicSlopes(NamedTuple):
    """Derivatives by the P parameters: of the ``state`` at the start, ``(n, P)``, and of the largest displacements
    ``tops``, ``(k, P)``."""

    state: Array
    tops: Array


def periodic_slopes(
    field: Parametric, parameters: Any, state: Array, peaks: tuple[Array, tuple[int, ...]], rtol: float
) -> PeriodicSlopes:
    """Derivatives of the periodic solution through ``state`` by all ``parameters``, a pytree of P numbers.

    ``field(parameters, s, y)`` returns ``T f`` at the fraction s of the period. ``peaks`` holds the fractions of the period
    at which displacements have their largest modulus, and the indices of these displacements. NaN where the integration
    fails.
    """
    import diffrax

    n, size = state.size, size_of(state)
    lifted, scale = _lifted(field, parameters, n, size)
    places, indices = peaks
    order = jnp.argsort(places)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lifted),
        diffrax.Dopri8(),
        0.0,
        1.0,
        None,
        jnp.concatenate([(state / size)[None], jnp.eye(n), jnp.zeros((scale.size, n))]),
        saveat=diffrax.SaveAt(t1=True, ts=jnp.clip(places[order], 0.0, 1.0)),
        stepsize_controller=controller(1.0, rtol),
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    found = jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys, jnp.nan)  # pyright: ignore[reportArgumentType]
    on_peaks, end = found[:-1][jnp.argsort(order)], found[-1]
    moved = solve(jnp.eye(n) - end[1 : n + 1].T, end[n + 1 :].T)
    tops = [
        jnp.sign(rows[0, i]) * (rows[1 : n + 1, i] @ moved + rows[n + 1 :, i])
        for rows, i in zip(on_peaks, indices, strict=True)
    ]
    return PeriodicSlopes(size * moved / scale, size * jnp.array(tops).reshape(-1, scale.size) / scale)


def _lifted(field: Parametric, parameters: Any, n: int, size: Array) -> tuple[Callable[..., Array], Array]:
    """The field of the rows ``y/size``, V and S, ``(1 + n + P, n)``, and the unit of every parameter, ``(P,)``."""
    leaves, tree = jax.tree.flatten(parameters)
    point = jnp.stack(leaves)
    # Relative changes of the parameters keep all rows of similar size.
    scale = jnp.where(point == 0, 1.0, jnp.abs(point))
    directions = jnp.concatenate([jnp.zeros((n, point.size)), jnp.eye(point.size)])

    def lifted(s: Any, rows: Array, _: None) -> Array:
        def right(y: Array, change: Array) -> Array:
            moved = jax.tree.unflatten(tree, list(point + scale * change))
            return field(moved, s, size * y) / size

        slope, push = jax.linearize(right, rows[0], jnp.zeros(point.size))
        return jnp.concatenate([slope[None], jax.vmap(push)(rows[1:], directions)])

    return lifted, scale
