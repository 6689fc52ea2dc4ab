"""Sine and cosine over many lanes against NumPy and exact values."""

from __future__ import annotations

import jax
import mpmath
import numpy as np

from drivetrain_jax.systems._models import cos, sin, sincos

ANGLES = np.concatenate([np.random.default_rng(1).uniform(-(2.0**k), 2.0**k, 400) for k in (-3, 0, 3, 10, 20)])


def test_both_are_within_two_units_in_the_last_place():
    found = np.asarray(jax.jit(sincos)(ANGLES))
    with mpmath.workprec(200):
        exact = np.array([[f(mpmath.mpf(x)) for x in ANGLES] for f in (mpmath.sin, mpmath.cos)])
        error = np.array([[float(abs(mpmath.mpf(a) - b)) for a, b in zip(*rows, strict=True)]
                          for rows in zip(found.tolist(), exact.tolist(), strict=True)])  # fmt: skip
    assert error.max() < 2.3e-16


def test_derivatives():
    x = ANGLES[:50]
    np.testing.assert_allclose(jax.vmap(jax.grad(sin))(x), np.cos(x), rtol=0, atol=3e-16)
    np.testing.assert_allclose(jax.vmap(jax.grad(cos))(x), -np.sin(x), rtol=0, atol=3e-16)


def test_what_is_no_angle_gives_nan():
    assert np.isnan(np.asarray(sincos(np.array([np.nan, np.inf])))).all()
