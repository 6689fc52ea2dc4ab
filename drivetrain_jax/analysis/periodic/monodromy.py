"""Monodromy matrices by diffrax: the path for equations as published, and the oracle of the fast ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jax import Array

if TYPE_CHECKING:
    import diffrax

SOLVERS = ("Dopri8", "Dopri5", "Tsit5", "Kvaerno5")
MAX_STEPS = 200_000


def state_transition(
    matrix: Callable[[Any], Array],
    span: float,
    size: int,
    *,
    solver: diffrax.AbstractSolver,
    stepsize_controller: diffrax.AbstractStepSizeController,
    dt0: Any = None,
    max_steps: int = MAX_STEPS,
) -> tuple[Array, Array]:
    """State transition matrix of ``y' = A(t) y`` over ``[0, span]``: ``Y' = A(t) Y``, ``Y(0) = I``.

    ``matrix(t)`` is A, ``(size, size)``; a ``ConstantStepSize`` controller needs ``dt0``. Returns ``Y(span)``, NaN where the
    integration failed, and whether it succeeded.
    """
    import diffrax

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: matrix(t) @ y),
        solver,
        t0=0.0,
        t1=span,
        dt0=dt0,
        y0=jnp.eye(size),
        stepsize_controller=stepsize_controller,
        saveat=diffrax.SaveAt(t1=True),
        max_steps=max_steps,
        throw=False,
    )
    success = solution.result == diffrax.RESULTS.successful
    return jnp.where(success, solution.ys[-1], jnp.nan), success
