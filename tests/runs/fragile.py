"""A damped Mathieu oscillator of another package, whose computation can kill its process."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves


def _perhaps_die(deadly: np.ndarray, folder: str) -> np.ndarray:
    """Kill this process if ``deadly`` is 1 anywhere, or once if it is 2, which a file in ``folder`` records."""
    once = Path(folder) / "died"
    if np.any(deadly == 1) or (np.any(deadly == 2) and not once.exists()):
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return np.zeros(np.shape(deadly))


class Fragile(System):
    """x'' + 0.02 x' + (delta + epsilon cos t) x = 0."""

    name = "fragile"
    title = "Damped Mathieu oscillator"
    source = "tests"

    delta: float = parameter("1", "mean stiffness")
    epsilon: float = parameter("1", "depth of modulation", default=0.3)
    deadly: int = parameter("1", "what happens", default=0, lower=0, upper=2, integer=True)

    @serves("floquet")
    def floquet_model(self) -> FloquetModel:
        zero = 0.0
        # Only compiled code kills the process; plans use plain arrays.
        if isinstance(self.delta, jax.core.Tracer):
            folder = os.environ["FRAGILE_FOLDER"]
            sort = jnp.asarray(self.deadly) + 0 * self.delta
            zero = jax.pure_callback(
                lambda sort: _perhaps_die(sort, folder),
                jax.ShapeDtypeStruct(sort.shape, float),
                sort,
                vmap_method="broadcast_all",
            )
        system = LinearPeriodic(
            lambda t: ((0, 1.0), (-(self.delta + zero + self.epsilon * jnp.cos(t)), -0.02)),
            2 * math.pi,
            log_determinant=lambda: -0.04 * math.pi + 0 * self.delta,
        )
        return FloquetModel(system, system, panels=self.steps)

    def steps(self, rtol):
        """The effort keeps deadly points in chunks of their own."""
        return 8 + 8 * (self.deadly + 0 * self.delta)
