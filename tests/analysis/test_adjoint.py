"""The adjoint of the collocation: long marches, and systems with parts, against short ones and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet import derivatives
from drivetrain_jax.analysis.floquet.derivatives import monodromy
from drivetrain_jax.analysis.numerics import lanes
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, get_system
from tests.quick_jit import quick_jit

SHAFT = {"beta": 0.7, "Omega": 1.3, "zeta": 0.02, "alpha": 1.5, "mu": 0.8, "gamma": 20.0}
SWING = {"high": 3.0, "low": 0.6, "jump": 0.8}


def gradients(build, values, steps, weights):
    parameters = {name: jnp.asarray(x) for name, x in values.items()}
    _, log_scale, _, pull = monodromy(build, parameters, Constants(dict.fromkeys(values)), jnp.int64(steps))
    return jnp.exp(log_scale) * pull(weights)


@pytest.mark.full
def test_two_levels_of_kept_states_give_what_one_gives(monkeypatch, retraced):
    """Nine panels; with three states on a level they become three times three."""
    build = get_system("cardan").models["floquet"].build
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4, 4)))
    once = quick_jit(lambda: gradients(build, SHAFT, 9, weights))()
    monkeypatch.setattr(derivatives, "_KEPT", 3)
    lanes._trace.cache_clear()
    again = quick_jit(lambda: gradients(build, SHAFT, 9, weights))()
    np.testing.assert_allclose(again, once, rtol=1e-11)


def swing(values):
    """A pendulum ``x'' + k x = 0`` whose stiffness jumps: its propagator is a product of two rotations."""

    def rows(t):
        return ((0, 1), (-jnp.where(t < values["jump"], values["high"], values["low"]), 0))

    form = LinearPeriodic(jax.tree_util.Partial(rows), 2.0, breakpoints=(values["jump"],))
    return FloquetModel(natural=form, reduced=form)


def rotated(values):
    def turn(k, t):
        w = jnp.sqrt(k)
        c, s = jnp.cos(w * t), jnp.sin(w * t)
        return jnp.array([[c, s / w], [-w * s, c]])

    return turn(values["low"], 2.0 - values["jump"]) @ turn(values["high"], values["jump"])


def test_gradients_double_panels_that_are_too_few():
    """A short pulse, which the prediction of the panels misses."""

    def pulse(values):
        def rows(t):
            return (0, 1.0), (-0.9 - values["e"] * jnp.exp(-(((t - 1) / 0.1) ** 2)), -0.01)

        form = LinearPeriodic(jax.tree_util.Partial(rows), 6.0)
        return FloquetModel(natural=form, reduced=form)

    slopes = quick_jit(lambda panels: gradients(pulse, {"e": 8.0}, panels, jnp.eye(2)[None]))
    np.testing.assert_allclose(slopes(8), slopes(128), rtol=1e-8)


def test_gradients_include_the_motion_of_a_jump():
    weights = jnp.array([[[1.0, -2.0], [0.3, 0.7]]])
    exact = jax.grad(lambda values: jnp.sum(weights[0] * rotated(values)))(SWING)
    found = quick_jit(lambda: gradients(swing, SWING, 32, weights))()
    np.testing.assert_allclose(found[0], jax.tree.leaves(exact), rtol=1e-9)
