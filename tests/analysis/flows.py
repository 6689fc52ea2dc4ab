"""Small vector fields with known Lyapunov exponents, as flows with a batch of initial states."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from drivetrain_jax.systems import Flow


def spread(lanes: int, *start: float) -> tuple:
    """Different initial states around ``start``."""
    return tuple(jnp.asarray(x + 0.01 * np.cos(np.arange(lanes) * (i + 1.0))) for i, x in enumerate(start))


def lorenz(lanes: int) -> Flow:
    def field(_, y):
        return 10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]

    return Flow(field, spread(lanes, 1.0, 1.0, 20.0), period=0.5)


def roessler(lanes: int) -> Flow:
    def field(_, y):
        return -y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - 5.7)

    # Start all around the attractor: its phases mix slowly, and members in phase would share the error of a partial turn.
    turn = 2 * math.pi * np.arange(lanes) / lanes
    return Flow(field, (jnp.asarray(6 * np.cos(turn)), jnp.asarray(6 * np.sin(turn)), 0.0), period=2.0)


# x'' + damping x' + linear x + cubic x^3 + sine sin x = amplitude cos(frequency t)
OSCILLATORS = {
    "ueda": {"damping": 0.05, "cubic": 1.0, "amplitude": 7.5, "frequency": 1.0},
    "two_wells": {"damping": 0.25, "linear": -1.0, "cubic": 1.0, "amplitude": 0.4, "frequency": 1.0},
    "pendulum": {"damping": 0.05, "sine": 1.0, "amplitude": 0.6, "frequency": 0.7},
}


def oscillators(lanes: int) -> Flow:
    """All of ``OSCILLATORS`` in one batch, ``lanes`` of each in sequence."""

    def column(name: str):
        return jnp.asarray(np.repeat([p.get(name, 0.0) for p in OSCILLATORS.values()], lanes))

    damping, linear, cubic, sine = (column(name) for name in ("damping", "linear", "cubic", "sine"))
    amplitude = column("amplitude")

    def field(angles, y):
        force = linear * y[0] + cubic * y[0] ** 3 + sine * jnp.sin(y[0])
        return y[1], amplitude * jnp.cos(angles[0]) - damping * y[1] - force

    count = lanes * len(OSCILLATORS)
    return Flow(field, spread(count, 0.1, 0.1), period=2 * math.pi / column("frequency"), turns=(1,), cyclic=(0,))


def linear(damping, stiffness, torque: float = 1.0) -> Flow:
    """x'' + damping x' + stiffness x = torque, with a strobe but without forcing."""
    damping, stiffness = jnp.asarray(damping), jnp.asarray(stiffness)

    def field(_, y):
        return y[1], torque - damping * y[1] - stiffness * y[0]

    return Flow(field, (1.0, 0.5), period=1.0)


def van_der_pol(lanes: int) -> Flow:
    """Van der Pol's oscillator, which has a limit cycle."""

    def field(_, y):
        return y[1], (1 - y[0] ** 2) * y[1] - y[0]

    return Flow(field, spread(lanes, 1.0, 1.0), period=1.7)


def damped(forcing=lambda angles: 0.0, turns: tuple = (1,), damping: float = 0.2, stiffness: float = 1.3) -> Flow:
    """x'' + damping x' + stiffness x = forcing."""

    def field(angles, y):
        return y[1], forcing(angles) - damping * y[1] - stiffness * y[0]

    return Flow(field, spread(1, 0.5, 1.0), period=1.9, turns=turns)


def mathieu(depth: float) -> Flow:
    """x'' + 0.1 x' + (1 + depth cos 2 t) x = 0, unstable for a depth above 0.2."""

    def field(angles, y):
        return y[1], -0.1 * y[1] - (1 + depth * jnp.cos(angles[0])) * y[0]

    return Flow(field, spread(1, 0.5, 1.0), period=math.pi, turns=(1,))


def stuart_landau(*rates: float) -> Flow:
    """Oscillators z' = (1 + i rate) z - |z|^2 z, each with a limit cycle."""

    def field(_, y):
        pairs = ((y[i], y[i + 1], rate) for i, rate in zip(range(0, len(y), 2), rates, strict=True))
        return tuple(x for a, b, w in pairs for x in ((1 - a * a - b * b) * a - w * b, (1 - a * a - b * b) * b + w * a))

    return Flow(field, spread(1, *(0.6, 0.3) * len(rates)), period=1.7)


def forced_cycle(rate: float, drive: float, turn: float = 1.0) -> Flow:
    """Stuart-Landau's oscillator driven by ``drive cos(turn angle)``: locked, or with a frequency of its own."""

    def field(angles, y):
        a, b = y
        drop = 1 - a * a - b * b
        return drop * a - rate * b + drive * jnp.cos(angles[1]), drop * b + rate * a

    return Flow(field, spread(1, 0.6, 0.3), period=1.7, turns=(1, turn))


def algebraic() -> Flow:
    """x' = -x^3, y' = -y: a strobed decay to rest like 1/sqrt(2 t), whose exponent is zero."""

    def field(_, y):
        return -(y[0] ** 3), -y[1]

    return Flow(field, spread(1, 0.6, 0.3), period=1.7, turns=(1,))
