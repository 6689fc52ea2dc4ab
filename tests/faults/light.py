"""A damped Mathieu oscillator of another package: two states, so that kernels compile soon."""

from __future__ import annotations

import math

import jax.numpy as jnp

from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves


class Light(System):
    """x'' + 0.02 x' + (delta + epsilon cos t) x = 0."""

    name = "light"
    title = "Damped Mathieu oscillator"
    source = "tests"

    delta: float = parameter("1", "mean stiffness")
    epsilon: float = parameter("1", "depth of modulation")

    @serves("floquet")
    def floquet_model(self) -> FloquetModel:
        system = LinearPeriodic(self.rows, 2 * math.pi, log_determinant=self.log_determinant)
        return FloquetModel(system, system, self.steps)

    def rows(self, t):
        return (0, 1.0), (-(self.delta + self.epsilon * jnp.cos(t)), -0.02)

    def log_determinant(self):
        return -0.04 * math.pi + 0 * self.delta

    def steps(self, rtol):
        return 40 + 60 * self.delta**0.5 + 0 * self.epsilon
