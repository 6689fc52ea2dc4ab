"""Multipliers far below the largest one, by QR decompositions of the panels' factors."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.multipliers import graded_multipliers
from drivetrain_jax.analysis.floquet.propagator import factored
from drivetrain_jax.systems import LinearPeriodic
from tests.quick_jit import quick_jit

RATES = {
    "decay": [-1.0, -4.0, -9.0, -20.0],
    "growth": [9.0, 1.0, -1.0, -9.0],
    "equal sizes": [-1.0, -1.0, -15.0, -15.5],
    "decoupled": [-12.0, 6.0, -12.0, 6.0],
}


class Turning(eqx.Module):
    """``x' = A(t) x`` with ``x = S(t) y``, ``y' = D y`` and a periodic S, so that the multipliers are those of D."""

    rates: jax.Array
    mixing: jax.Array

    def rows(self, t):
        # S = T R(t) with a rotation by t of the first and the third component: S' S^-1 + S D S^-1.
        n, c, s = len(self.mixing), jnp.cos(t), jnp.sin(t)
        turn = [[jnp.full_like(c, float(i == j)) for j in range(n)] for i in range(n)]
        turn[0][0], turn[0][2], turn[2][0], turn[2][2] = c, -s, s, c
        inner = [[sum(turn[i][k] * self.rates[k] * turn[j][k] for k in range(n)) for j in range(n)] for i in range(n)]
        inner[0][2], inner[2][0] = inner[0][2] - 1, inner[2][0] + 1
        back = jnp.asarray(np.linalg.inv(mixing(n)))
        return tuple(
            tuple(
                sum(self.mixing[i, k] * inner[k][m] * back[m, j] for k in range(n) for m in range(n)) for j in range(n)
            )
            for i in range(n)
        )


def mixing(n):
    return np.eye(n) + 0.3 * np.random.default_rng(0).normal(size=(n, n))


@pytest.fixture(scope="module")
def graded():
    def found(rates, mixing):
        return graded_multipliers(factored(LinearPeriodic(Turning(rates, mixing).rows, 2 * np.pi), jnp.int64(160)))

    return quick_jit(found)


@pytest.mark.full
@pytest.mark.parametrize("kind", RATES)
def test_small_multipliers_lie_within_their_errors(graded, kind):
    rates = np.array(RATES[kind])
    logs, sigma, errors = map(np.asarray, graded(jnp.asarray(rates), jnp.asarray(mixing(len(rates)))))
    exact = np.sort(2 * np.pi * rates)[::-1]
    wrong = np.abs(sigma - np.exp(exact - logs))
    assert (wrong <= errors).all(), (wrong, errors)
    # A double multiplier has the root of the error of its polynomial.
    assert (errors < 1e-3 * np.abs(sigma)).all(), errors
