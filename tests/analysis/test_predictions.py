"""Predictions from parameters before a computation."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.numerics import kernels
from drivetrain_jax.analysis.numerics.kernels import predicted


def powers(exponents, values):
    factor = {"single": 1.0, "double": 2.0}[values["kind"]]
    return jnp.stack([factor * values["a"] * values["x"] ** n for n in exponents])


@pytest.mark.parametrize("count", [1, 31, 32, 33, 2048, 5000])
def test_every_point_has_its_own_values(count):
    x = np.linspace(0.5, 2.0, count)
    found = predicted(powers, ((1, 3),), {"x": x, "a": 3.0, "kind": "double"})
    np.testing.assert_allclose(found, [6 * x, 6 * x**3], rtol=1e-15)


def test_what_all_points_share_is_one_point():
    np.testing.assert_array_equal(
        predicted(powers, ((2,),), {"x": 3.0, "a": np.float64(2.0), "kind": "single"}), [[18.0]]
    )


def test_compiled_once_for_all_numbers_and_again_for_other_words():
    traced = []

    def function(values):
        traced.append(values["kind"])
        return values["a"] * values["x"]

    kernels._compiled.cache_clear()
    for a in (1.0, 2.0):
        for count in (7, 9):
            x = np.arange(count) + 1.0
            np.testing.assert_array_equal(predicted(function, (), {"x": x, "a": a, "kind": "one"}), a * x)
    assert traced == ["one"]
    predicted(function, (), {"x": np.ones(7), "a": 1.0, "kind": "other"})
    assert traced == ["one", "other"]


def test_result_without_parameters_is_that_of_every_point():
    np.testing.assert_array_equal(
        predicted(lambda values: jnp.eye(2), (), {"x": np.ones(3)}), np.eye(2)[..., None] * np.ones(3)
    )


def test_lists_have_a_number_for_every_point():
    x = np.arange(40.0)
    found = predicted(
        lambda values: values["list"][0] + 10 * values["list"][1], (), {"list": (x, np.full(40, 2.0)), "y": 1.0}
    )
    np.testing.assert_array_equal(found, x + 20)
