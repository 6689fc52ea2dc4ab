"""Monodromy matrices by diffrax: the general path for every periodic vector field, and the oracle of the fast ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

if TYPE_CHECKING:
    import diffrax

Field = Callable[[Any, Array], Array]

SOLVERS = ("Dopri8", "Dopri5", "Tsit5", "Kvaerno5")
MAX_STEPS = 200_000


def state_transition(
    field: Field,
    span: float,
    state: Array,
    *,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: Any = None,
    max_steps: int = MAX_STEPS,
    along: bool = True,
) -> tuple[Array, Array, Array]:
    """State and state transition matrix of ``y' = field(t, y)`` over ``[0, span]`` from ``y(0) = state``, shape ``(n,)``.

    The variational equation ``Y' = (df/dy)(t, y) Y``, ``Y(0) = I`` is integrated beside the state (by Jacobian-vector
    products, never by differentiating through the solver). With ``along=False`` the state is a fixed point of the
    field, for example the origin of a linear system, and only ``Y`` is integrated.

    ``solver`` is any diffrax solver (default ``Dopri8``) and ``stepsize_controller`` any controller (default a
    ``PIDController`` with rtol 1e-10, atol 1e-12; use ``ConstantStepSize`` together with ``dt0``).

    Returns ``(state at span, matrix (n, n), success)``; both are NaN where the integration failed.
    """
    import diffrax

    identity = jnp.eye(state.shape[0])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(_variational(field, None if along else state)),
        solver or diffrax.Dopri8(),
        t0=0.0,
        t1=span,
        dt0=dt0,
        y0=(state, identity) if along else identity,
        stepsize_controller=stepsize_controller or diffrax.PIDController(rtol=1e-10, atol=1e-12),
        saveat=diffrax.SaveAt(t1=True),
        max_steps=max_steps,
        throw=False,
    )
    final = jax.tree.map(lambda leaf: leaf[-1], solution.ys)
    end, matrix = final if along else (state, final)
    success = solution.result == diffrax.RESULTS.successful
    return jnp.where(success, end, jnp.nan), jnp.where(success, matrix, jnp.nan), success


def _variational(field: Field, rest: Array | None) -> Callable[[Any, Any, Any], Any]:
    """The rate of a state and of the columns beside it, or of the columns alone about the fixed point ``rest``."""

    def rate(t: Any, y: Any, _: Any) -> Any:
        x, columns = y if rest is None else (rest, y)
        slopes = jax.vmap(lambda v: jax.jvp(lambda z: field(t, z), (x,), (v,))[1], in_axes=1, out_axes=1)(columns)
        return (field(t, x), slopes) if rest is None else slopes

    return rate
