"""A split function returns the same numbers; fixed and shared values are computed once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.propagator import staged
from drivetrain_jax.analysis.numerics.kernels import _operations

LANES = 5
TIMES = jnp.linspace(0.0, 1.0, 3)[:, None]


def entries(beta, mu):
    def function(t):
        root = jnp.sqrt(1 + jnp.sin(beta) ** 2 * t**2)  # used by all entries
        ratio = jnp.where(t > 0.5, root, 1 / root)
        return [root * ratio, mu * ratio, root + jnp.exp(mu), jnp.asarray(2.0), t]

    return function


def counts(function, *arguments):
    names = list(_operations(jax.make_jaxpr(function)(*arguments).jaxpr))
    return {name: names.count(name) for name in set(names)}


def test_same_numbers_and_nothing_twice():
    beta, mu = jnp.linspace(0.1, 1.0, LANES), jnp.float64(3.0)
    split = staged(entries(beta, mu), TIMES)
    for ours, direct in zip(split.moving(split.fixed, TIMES), entries(beta, mu)(TIMES), strict=True):
        np.testing.assert_allclose(np.broadcast_to(ours, np.shape(direct)), direct, rtol=1e-15)
    found = counts(split.moving, split.fixed, TIMES)
    assert found["sqrt"] == 1
    assert "sin" not in found and "exp" not in found, "they do not depend on the time"
    # One array for the lanes of beta, and one for the numbers mu and exp(mu).
    assert sorted(array.shape for array in split.fixed) == [(1, LANES), (2,)]


@pytest.mark.full
def test_inside_a_trace_and_under_differentiation():
    def total(beta, mu):
        split = staged(entries(beta, mu), TIMES)
        return sum(jnp.sum(entry) for entry in split.moving(split.fixed, TIMES))

    def plain(beta, mu):
        return sum(jnp.sum(entry) for entry in entries(beta, mu)(TIMES))

    point = jnp.linspace(0.1, 1.0, LANES), jnp.float64(3.0)
    np.testing.assert_allclose(jax.jit(total)(*point), plain(*point), rtol=1e-14)
    for ours, direct in zip(jax.jacfwd(total, (0, 1))(*point), jax.jacfwd(plain, (0, 1))(*point), strict=True):
        np.testing.assert_allclose(ours, direct, rtol=1e-13)


def test_operations_with_several_results():
    def function(t):
        low, high = jnp.split(t * jnp.arange(4.0), 2, axis=1)
        return [low + high, low]

    split = staged(function, TIMES)
    for ours, direct in zip(split.moving(split.fixed, TIMES), function(TIMES), strict=True):
        np.testing.assert_array_equal(ours, direct)
