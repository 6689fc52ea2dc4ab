"""Steps of diffrax up to a given fraction of the interval, with a record of the largest state."""

from __future__ import annotations

from typing import Any

import diffrax
import jax.numpy as jnp
from jax import Array

# State of the step-size controller, largest component so far, and longest step.
_State = tuple[Any, Array, Array]


class WatchedSteps(diffrax.AbstractAdaptiveStepSizeController[_State, None]):
    """The steps of ``controller``, at most the fraction ``part`` of the interval ``length``.

    A first step of more than half of the longest step is multiplied by ``part``. With ``part`` 1 the steps are those of
    ``controller``. A smaller ``part`` changes the steps even if one or two of them cover the whole interval, where a change
    of the tolerance has no effect.
    """

    controller: diffrax.PIDController
    part: Any
    length: Any

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """rtol of the controller."""
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """atol of the controller."""
        return self.controller.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Norm of the controller."""
        return self.controller.norm

    def wrap(self, direction: Any) -> WatchedSteps:
        """Itself: the steps go forwards."""
        del direction
        return self

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: None, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, _State]:
        """End of the first step, and the state."""
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        longest, step = self.part * self.length, end - t0
        # If the first step is short, it or later steps depend on the tolerance: shortening it would only add cost.
        step = jnp.where(step < longest / 2, step, jnp.minimum(self.part * step, longest))
        return t0 + step, (state, jnp.max(jnp.abs(y0)), longest)

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0: Any, t1: Any, y0: Any, y1_candidate: Any, args: Any, y_error: Any, error_order: Any, state: _State
    ) -> tuple:
        """Flag if the step is accepted, the next step, flag if it begins at a jump, the state, and the result."""
        inner, largest, longest = state
        kept, start, end, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        met = jnp.where(kept, jnp.maximum(largest, jnp.max(jnp.abs(y1_candidate))), largest)
        return kept, start, jnp.minimum(end, start + longest), jumped, (inner, met, longest), result


def largest_met(solution: diffrax.Solution) -> Array:
    """Largest modulus of a component at the ends of the steps; ``solution`` must have ``controller_state=True``."""
    return solution.controller_state[1]  # pyright: ignore[reportOptionalSubscript]
