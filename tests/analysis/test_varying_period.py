"""A period that depends on a parameter: an equation in seconds against the same one in turns of its excitation."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves
from tests.quick_jit import quick_jit

SPEEDS = np.array([0.05, 1.0, 1.9, 2.05, 3.1])
OUTPUTS = ["spectral_radius", "spectral_radius_error", "floquet_multiplier"]


class InSeconds(System):
    """x'' + c x' + (1 + cos(speed t)/2) x = 0."""

    name = "in_seconds"
    title = "Mathieu's equation in seconds"

    speed: float = parameter("rad/s", "frequency of the excitation", lower=0.0, open_lower=True)
    c: float = parameter("1/s", "damping", default=0.1)

    def rows(self, t):
        return (0, 1.0), (-(1 + jnp.cos(self.speed * t) / 2), -self.c)

    @serves("floquet")
    def model(self):
        form = LinearPeriodic(self.rows, 2 * math.pi / self.speed)
        return FloquetModel(form, form)


class InTurns(InSeconds):
    """The same with the angle as time."""

    name = "in_turns"

    def rows(self, angle):
        s = 1 / self.speed
        return (0, s), (-(1 + jnp.cos(angle) / 2) * s, -self.c * s)

    @serves("floquet")
    def model(self):
        form = LinearPeriodic(self.rows, 2 * math.pi)
        return FloquetModel(form, form)


@pytest.mark.full
@pytest.mark.parametrize("damping", [0.1, 40.0])
@pytest.mark.parametrize("method", ["direct", "diffrax"])
def test_both_clocks_have_the_same_multipliers(method, damping):
    def radius(system):
        def solve(speed):
            return dt.floquet(system(c=damping, speed=speed), outputs=OUTPUTS, method=method).variables

        found = jax.vmap(solve)(SPEEDS)
        assert not found["outcome"].any()
        return found

    seconds, turns = radius(InSeconds), radius(InTurns)
    error = seconds["spectral_radius_error"] + turns["spectral_radius_error"]
    assert (np.abs(seconds["spectral_radius"] - turns["spectral_radius"]) <= error).all()
    assert (error < 1e-8 * turns["spectral_radius"] + 1e-300).all()


@pytest.mark.full
def test_one_point_a_batch_and_the_derivative():
    def radii_and_slopes(system):
        radius = jax.value_and_grad(lambda speed: dt.floquet(system(speed=speed)).spectral_radius)
        return quick_jit(jax.vmap(radius))(SPEEDS[1:4])

    (seconds, slopes), (turns, others) = radii_and_slopes(InSeconds), radii_and_slopes(InTurns)
    np.testing.assert_allclose(seconds, turns, rtol=1e-12)
    np.testing.assert_allclose(slopes, others, rtol=1e-9)
    np.testing.assert_allclose(dt.floquet(InSeconds(speed=2.05)).spectral_radius, turns[2], rtol=1e-12)


@pytest.mark.full
def test_a_period_that_is_not_positive_has_no_value():
    speeds = jnp.array([0.0, -1.0, math.nan, 1.0])
    found = jax.vmap(lambda speed: dt.floquet(InSeconds(speed=speed)).spectral_radius)(speeds)
    assert np.isnan(found[:3]).all() and found[3] > 0
