"""Steps of diffrax that are longest a given part of the interval, and the largest state that they meet."""

from __future__ import annotations

from typing import Any

import diffrax
import jax.numpy as jnp
from jax import Array

# State of the controller of the steps, largest component so far, and the longest step.
_State = tuple[Any, Array, Array]


class WatchedSteps(diffrax.AbstractAdaptiveStepSizeController[_State, None]):
    """The steps of ``controller``, at most ``part`` of the interval ``length``; a first step of more than half of
    ``length`` is multiplied by ``part``.

    With ``part`` 1 they are the steps of ``controller``. With less they differ even if one or two steps take the whole
    interval, where the tolerance does not matter.
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
        # A short first step depends on the tolerance, or others do that follow it: to halve it would only cost.
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
    """Largest component in absolute value of the states at the ends of the steps; saved with ``controller_state=True``."""
    return solution.controller_state[1]  # pyright: ignore[reportOptionalSubscript]
