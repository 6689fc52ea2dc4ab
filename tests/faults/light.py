"""A damped Mathieu oscillator of another package: two states, so that kernels compile soon."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, Model, System


def _model(values) -> FloquetModel:
    delta, epsilon = values["delta"], values["epsilon"]
    system = LinearPeriodic(
        lambda t: ((0, 1.0), (-(delta + epsilon * jnp.cos(t)), -0.02)),
        2 * math.pi,
        log_determinant=lambda: -0.04 * math.pi + 0 * delta,
    )
    return FloquetModel(system, system, lambda rtol: 40 + 60 * np.sqrt(np.asarray(delta)) + 0 * np.asarray(epsilon))


SYSTEM = System(
    name="light",
    title="Damped Mathieu oscillator",
    source="tests",
    parameters=(Parameter("delta", "1", "mean stiffness"), Parameter("epsilon", "1", "depth of modulation")),
    models={"floquet": Model(_model, ("delta", "epsilon"))},
)
